"""Train the thermal net on a data set of the plant and write its weights as text.

    python -m tools.train --data build/data/R.npz --lap build/data/lap.npz --out estimator_c/weights/lstm8.json

Trains on windows cut at random from the trajectories, each with an EMPTY memory at its first row, because that is how the
estimator starts. Whole trajectories are held out; the net that does best on them is kept. The lap is never trained or
selected on: its figures are computed once, for the file. Ctrl-C stops early and keeps the best net so far.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from tools.evaluate import DataError, Rows, evaluate, load_rows, net_from_document, read_document, table
from tools.lstm_torch import LstmRates, Scaling, spread_time_constants, weights_document, write_document
from tools.lstm_torch import net_from_document as torch_net_from_document


@dataclass(frozen=True)
class Settings:
    """What a training run depends on, beside its data; written into the weights file."""

    hidden: int = 8
    seed: int = 1
    epochs: int = 3000
    lr: float = 0.02
    lr_end: float = 1e-4
    batch: int = 16
    window_s: float = 120.0
    early_weight: float = 0.1  # of a window's first row in the loss: the memory is still empty there
    early_s: float = 30.0  # ... growing to 1 over this time
    drift_weight: float = 0.05  # of the squared integral of the rate error over a window, in 1/K²
    theta_noise_degc: float = 0.1  # slow noise on the temperature inputs, as from an estimator
    theta_noise_s: float = 5.0  # its correlation time
    rotor_weight: float = 1.0  # of the rotor's normalised squared error beside the winding's
    clip: float = 1.0
    l2: float = 0.0
    dt_s: float = 0.1
    validate_every: int = 20


@dataclass(frozen=True)
class Progress:
    """State of a run after a validation; losses and errors are in units of each channel's standard deviation."""

    epoch: int
    loss: float
    val_w: float
    val_r: float
    score: float
    best_score: float
    elapsed_s: float


@dataclass(frozen=True)
class Fit:
    """The best net of a run, how it scored, and why the run ended (`complete`, `budget` or `interrupted`)."""

    net: LstmRates
    scaling: Scaling
    best: Progress
    validation: tuple[int, ...]
    ended: str
    elapsed_s: float


def split(rows: Rows, seed: int) -> tuple[list[np.ndarray], list[np.ndarray], tuple[int, ...]]:
    """Train and validation pieces, about 80:20: every fifth trajectory in order of length, so both kinds are in both.

    A data set of fewer than five trajectories gives the last fifth of each to the validation instead.
    """
    pieces = rows.pieces()
    if len(pieces) < 5:
        cuts = [round(0.8 * len(p)) for p in pieces]
        return [p[:c] for p, c in zip(pieces, cuts)], [p[c:] for p, c in zip(pieces, cuts)], ()
    order = np.argsort([-len(p) for p in pieces], kind="stable")
    held = {int(i) for i in order[seed % 5 :: 5]}
    ids = np.unique(rows.trajectory)
    return (
        [p for i, p in enumerate(pieces) if i not in held],
        [pieces[i] for i in sorted(held)],
        tuple(int(ids[i]) for i in sorted(held)),
    )


def row_weights(n_rows: int, s: Settings) -> torch.Tensor:
    """Weight of each row of a window in the loss, shape (n_rows, 1, 1): low while the memory fills, then one."""
    t_s = torch.arange(n_rows) * s.dt_s
    ramp = (t_s / s.early_s).clamp(max=1.0) if s.early_s > 0 else torch.ones(n_rows)
    return (s.early_weight + (1.0 - s.early_weight) * ramp)[:, None, None]


class Windows:
    """Random windows of the training pieces, scaled, as float32 tensors of shape (rows, batch, channels)."""

    def __init__(self, rows: Rows, pieces: list[np.ndarray], scaling: Scaling, s: Settings) -> None:
        self.rng = np.random.default_rng(s.seed)
        self.length = min(round(s.window_s / s.dt_s), min(len(p) for p in pieces))
        self.u = torch.tensor((rows.x - scaling.in_offset) / scaling.in_scale, dtype=torch.float32)
        self.y = torch.tensor((rows.rates_degc_s - scaling.out_offset) / scaling.out_scale, dtype=torch.float32)
        self.starts = np.concatenate([p[: len(p) - self.length + 1] for p in pieces])
        self.rows_in_all = sum(len(p) for p in pieces)
        self.s = s
        self.noise_scale = torch.tensor(s.theta_noise_degc / scaling.in_scale[2:], dtype=torch.float32)

    def batches_per_epoch(self) -> int:
        return max(1, round(self.rows_in_all / (self.s.batch * self.length)))

    def draw(self) -> tuple[torch.Tensor, torch.Tensor]:
        at = torch.from_numpy(self.rng.choice(self.starts, self.s.batch))[None, :] + torch.arange(self.length)[:, None]
        u, y = self.u[at], self.y[at]
        if self.s.theta_noise_degc > 0:
            u[:, :, 2:] += self.noise_scale * self.slow_noise()
        return u, y

    def slow_noise(self) -> torch.Tensor:
        """Unit-variance noise (rows, batch, 2) linear between knots one correlation time apart."""
        step = max(1, round(self.s.theta_noise_s / self.s.dt_s))
        knots = self.rng.standard_normal((self.length // step + 2, self.s.batch, 2)).astype(np.float32)
        position = np.arange(self.length) / step + self.rng.random()
        left = np.minimum(position.astype(int), len(knots) - 2)
        part = (position - left).astype(np.float32)[:, None, None]
        return torch.from_numpy((1.0 - part) * knots[left] + part * knots[left + 1])


def loss_of(error: torch.Tensor, weights: torch.Tensor, rate_scale: torch.Tensor, s: Settings) -> torch.Tensor:
    """Loss of the normalised rate errors (rows, batch, 2).

    Mean square plus the mean square of the error's running integral in K: small errors of one sign, which the first term
    hardly sees, are what drives a temperature away in open loop.
    """
    channel = error.new_tensor([1.0, s.rotor_weight])
    loss = (weights * channel * error.square()).mean()
    if s.drift_weight > 0:
        drift_degc = (weights * error * rate_scale).cumsum(0) * s.dt_s
        loss = loss + s.drift_weight * drift_degc.square().mean()
    return loss


@dataclass(frozen=True)
class Validation:
    """Held-out pieces run as a whole from an empty memory; the first `early_s` of each do not count."""

    groups: list[tuple[torch.Tensor, torch.Tensor]]
    skip: int

    @classmethod
    def of(cls, windows: Windows, pieces: list[np.ndarray], s: Settings) -> Validation:
        by_length: dict[int, list[np.ndarray]] = {}
        for piece in pieces:
            by_length.setdefault(len(piece), []).append(piece)
        groups = []
        for same in by_length.values():
            at = torch.from_numpy(np.stack(same, axis=1))
            groups.append((windows.u[at], windows.y[at]))
        return cls(groups, min(round(s.early_s / s.dt_s), min(len(p) for p in pieces) // 2))

    def errors(self, net: LstmRates) -> tuple[float, float]:
        """RMSE of winding and rotor rate, in standard deviations of the training data."""
        with torch.no_grad():
            squares = [(net(u) - y)[self.skip :].square().flatten(0, 1) for u, y in self.groups]
        w, r = torch.cat(squares).mean(0).sqrt().tolist()
        return w, r


def fit(
    rows: Rows,
    s: Settings,
    budget_s: float = math.inf,
    report: Callable[[Progress], None] = lambda progress: None,
    start: dict | None = None,
) -> Fit:
    """Train; returns the net with the best validation score √((w² + r²)/2).

    `start` is a weights document to go on from. A KeyboardInterrupt ends the run like a spent budget, unless it comes
    before the first validation: then there is nothing to keep and it goes on to the caller.
    """
    begun = time.monotonic()
    torch.manual_seed(s.seed)
    train, held, held_ids = split(rows, s.seed)
    if start is None:
        scaling = Scaling.from_rates(rows.rates_degc_s[np.concatenate(train)])
        net = LstmRates(s.hidden)
        spread_time_constants(net, s.dt_s, shortest_s=1.0, longest_s=300.0)
    else:
        net, scaling = torch_net_from_document(start)
        net = net.float()
    windows = Windows(rows, train, scaling, s)
    validation = Validation.of(windows, held, s)
    weights = row_weights(windows.length, s)
    rate_scale = torch.tensor(scaling.out_scale, dtype=torch.float32)
    adam = torch.optim.Adam(net.parameters(), lr=s.lr, weight_decay=s.l2)

    best, best_state, ended, mean_loss = None, None, "complete", math.nan
    try:
        for epoch in range(s.epochs + 1):
            if epoch % s.validate_every == 0 or epoch == s.epochs:
                val_w, val_r = validation.errors(net)
                score = math.hypot(val_w, val_r) / math.sqrt(2.0)
                better = best is None or score < best.score
                now = Progress(
                    epoch, mean_loss, val_w, val_r, score, score if better or best is None else best.score,
                    time.monotonic() - begun,
                )  # fmt: skip
                if better:
                    best, best_state = now, {k: v.clone() for k, v in net.state_dict().items()}
                report(now)
                if now.elapsed_s > budget_s:
                    ended = "budget"
                    break
            if epoch == s.epochs:
                break
            for group in adam.param_groups:
                group["lr"] = s.lr_end + 0.5 * (s.lr - s.lr_end) * (1.0 + math.cos(math.pi * epoch / s.epochs))
            total = 0.0
            for _ in range(windows.batches_per_epoch()):
                u, y = windows.draw()
                loss = loss_of(net(u) - y, weights, rate_scale, s)
                adam.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(net.parameters(), s.clip)
                adam.step()
                total += loss.item()
            mean_loss = total / windows.batches_per_epoch()
    except KeyboardInterrupt:
        if best is None:
            raise
        ended = "interrupted"
    assert best is not None and best_state is not None  # epoch 0 always validates
    net.load_state_dict(best_state)
    return Fit(net, scaling, best, held_ids, ended, time.monotonic() - begun)


class ProgressLine:
    """One line that renews itself on a terminal, a line now and then elsewhere."""

    def __init__(self, epochs: int, stream=sys.stdout, every_s: float = 10.0) -> None:
        self.epochs, self.stream, self.every_s, self.last_s = epochs, stream, every_s, -math.inf
        self.terminal = stream.isatty()

    def __call__(self, p: Progress) -> None:
        if not self.terminal and p.elapsed_s - self.last_s < self.every_s and p.epoch != self.epochs:
            return
        self.last_s = p.elapsed_s
        text = (
            f"epoch {p.epoch}/{self.epochs}  loss {p.loss:.5f}  validation w {p.val_w:.4f} r {p.val_r:.4f}"
            f"  score {p.score:.4f} (best {p.best_score:.4f})  {p.elapsed_s:.0f} s"
        )
        print(f"\r{text}\033[K" if self.terminal else text, end="" if self.terminal else "\n", file=self.stream, flush=True)

    def close(self) -> None:
        if self.terminal:
            print(file=self.stream)


def document_of(result: Fit, rows: Rows, lap: Rows | None, s: Settings) -> dict:
    """Weights document of a fit, with what made it and, if a lap is given, how it does there."""
    document = weights_document(result.net, result.scaling, s.dt_s)
    scale_w, scale_r = result.scaling.out_scale
    metrics = {
        "validation": {
            "rmse_degc_s_w": result.best.val_w * scale_w,
            "rmse_degc_s_r": result.best.val_r * scale_r,
            "trajectories": list(result.validation),
        }
    }
    if lap is not None:
        metrics["lap"] = evaluate(net_from_document(document), lap)
        metrics["lap_sha256"] = lap.sha256
    document["data_sha256"] = rows.sha256
    document["training"] = {
        **dataclasses.asdict(s),
        "rows": len(rows.x),
        "best_epoch": result.best.epoch,
        "ended": result.ended,
        "optimizer": "adam, cosine schedule",
        "torch": torch.__version__,
    }
    document["metrics"] = metrics
    return document


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.train", description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set written by tools.dataset")
    parser.add_argument("--lap", type=Path, help="rows of the test lap, for the figures in the weights file")
    parser.add_argument("--out", type=Path, required=True, help="weights file to write")
    parser.add_argument("--start", type=Path, help="go on from this weights file instead of from random weights")
    parser.add_argument("--budget-s", type=float, default=math.inf, help="stop after this time and keep the best")
    parser.add_argument("--threads", type=int, default=1)
    for field in dataclasses.fields(Settings):
        option = "--" + field.name.replace("_", "-")
        parser.add_argument(option, type=type(field.default), default=field.default, help="default %(default)s")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    settings = Settings(**{f.name: getattr(args, f.name) for f in dataclasses.fields(Settings)})
    torch.set_num_threads(args.threads)
    try:
        rows = load_rows(args.data)
        lap = load_rows(args.lap) if args.lap else None
        start = read_document(args.start) if args.start else None
    except DataError as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    line = ProgressLine(settings.epochs)
    try:
        result = fit(rows, settings, args.budget_s, line, start)
    except KeyboardInterrupt:
        print("train: stopped before the first validation, nothing written", file=sys.stderr)
        return 130
    finally:
        line.close()
    document = document_of(result, rows, lap, settings)
    write_document(args.out, document)
    print(f"{args.out}: {result.ended}, best epoch {result.best.epoch}, {result.elapsed_s:.0f} s")
    if lap is not None:
        print(table(document["metrics"]["lap"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
