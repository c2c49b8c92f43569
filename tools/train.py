"""Train the thermal net on a data set of the plant and write its weights as text.

    python -m tools.train --data build/data/R.npz --lap build/data/lap.npz --out net.json

Trains on windows cut at random from the trajectories, each with an EMPTY memory at its first row, because
that is how the estimator starts. Whole trajectories are held out; the net that does best on them is kept.
The lap is never trained or selected on: its figures are computed once, for the file. Ctrl-C stops early and
keeps the best so far.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import LstmWeights, load_weights
from tools.evaluate import DataError, Rows, evaluate, load_rows, table
from tools.lstm_torch import (
    LstmRates,
    Scaling,
    net_from_weights,
    spread_time_constants,
    weights_document,
    write_document,
)
from tools.train_windows import Settings, Validation, Windows, loss_of, row_weights, split


@dataclass(frozen=True)
class Progress:
    """State of a run after a validation; losses and errors are in standard deviations."""

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


def fit(
    rows: Rows,
    s: Settings,
    budget_s: float = math.inf,
    report: Callable[[Progress], None] = lambda progress: None,
    start: LstmWeights | None = None,
) -> Fit:
    """Train; returns the net with the best validation score √((w² + r²)/2).

    `start` is a net to go on from, with its scaling. A KeyboardInterrupt ends the run like a spent budget,
    unless it comes before the first validation: then there is nothing to keep and it goes on to the caller.
    """
    begun = time.monotonic()
    torch.manual_seed(s.seed)
    parts = split(rows, s.fold)
    if start is None:
        scaling = Scaling.from_rates(rows.rates_degc_s[np.concatenate(parts.train)])
        net = LstmRates(s.hidden)
        spread_time_constants(net, s.dt_s, shortest_s=1.0, longest_s=300.0)
    else:
        net, scaling = net_from_weights(start)
        net = net.float()
    windows = Windows(rows, parts.train, scaling, s)
    validation = Validation.of(windows, parts.held, s)
    weights = row_weights(windows.length, s)
    adam = torch.optim.Adam(net.parameters(), lr=s.lr, weight_decay=s.l2)

    best: Progress | None = None
    best_state: dict[str, torch.Tensor] = {}
    ended, mean_loss = "complete", math.nan
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
                loss = loss_of(net(u) - y, weights, s.rotor_weight)
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
    assert best is not None, "epoch 0 always validates"
    net.load_state_dict(best_state)
    return Fit(net, scaling, best, parts.held_ids, ended, time.monotonic() - begun)


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
        print(
            f"\r{text}\033[K" if self.terminal else text,
            end="" if self.terminal else "\n",
            file=self.stream,
            flush=True,
        )

    def close(self) -> None:
        if self.terminal:
            print(file=self.stream)


def as_read(document: dict) -> LstmWeights:
    """The net as the C generator's strict reader sees it: what is measured is what is embedded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.json"
        write_document(path, document)
        return load_weights(path)


def document_of(result: Fit, rows: Rows, lap: Rows | None, s: Settings) -> dict:
    """Weights document of a fit, with what made it and, if a lap is given, how it does there."""
    document = weights_document(result.net, result.scaling, s.dt_s)
    scale_w, scale_r = result.scaling.out_scale
    metrics: dict[str, object] = {
        "validation": {
            "rmse_degc_s_w": result.best.val_w * scale_w,
            "rmse_degc_s_r": result.best.val_r * scale_r,
            "trajectories": list(result.validation),
        }
    }
    if lap is not None:
        metrics["lap"] = evaluate(as_read(document), lap)
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
    parser = argparse.ArgumentParser(prog="python -m tools.train", description=(__doc__ or "").splitlines()[0])
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
        start = load_weights(args.start) if args.start else None
    except (DataError, FormulationError) as error:
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
