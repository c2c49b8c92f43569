"""The training loop: Adam over mini-batches, validation now and then, the best kept; it can stop and go on."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from estimator_c.formulation.weights import LstmWeights
from tools.evaluate import DataError, Rows
from tools.lstm_torch import LstmRates, Scaling, net_from_weights, spread_time_constants, start_as_matlab
from tools.train_configs import Settings
from tools.train_windows import FixedSequences, Validation, Windows, integral_loss_of, loss_of, split

SAVE_EVERY_S = 10.0


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
    history: tuple[Progress, ...]


@dataclass(frozen=True)
class Checkpoint:
    """Where a run keeps what it needs to go on, and whether this run starts from it."""

    path: Path
    resume: bool = False


def fit(
    rows: Rows,
    s: Settings,
    budget_s: float = math.inf,
    report: Callable[[Progress], None] = lambda progress: None,
    start: LstmWeights | None = None,
    checkpoint: Checkpoint | None = None,
) -> Fit:
    """Train; returns the net with the best validation score √((w² + r²)/2).

    `start` is a net to go on from, with its scaling. With a checkpoint the state is kept in a file at least every ten
    seconds and at the end of a run that was cut short; a run that resumes gives the same bits as one never stopped.
    A KeyboardInterrupt ends the run like a spent budget, unless it comes before the first validation: then there is
    nothing to keep and it goes on to the caller.

    Raises
    ------
    DataError
        Nothing to resume from, or it belongs to other data, settings or another start.
    """
    run = _Run(rows, s, start)
    if checkpoint is not None and checkpoint.resume:
        run.restore(checkpoint.path)
    begun, saved, before_s = time.monotonic(), time.monotonic(), run.elapsed_s
    ended, kept = "complete", run.state() if run.history else None
    try:
        for iteration in range(run.iteration, run.total + 1):
            if run.validates(iteration) and not (run.history and iteration == run.iteration):
                now_s = time.monotonic()
                run.validate(iteration, before_s + now_s - begun)
                kept = run.state()
                report(run.history[-1])
                if now_s - begun > budget_s:
                    ended = "budget"
                    break
                if checkpoint is not None and now_s - saved > SAVE_EVERY_S:
                    _save(checkpoint.path, kept)
                    saved = now_s
            if iteration < run.total:
                run.step(iteration)
    except KeyboardInterrupt:
        if kept is None:
            raise
        ended = "interrupted"
    if checkpoint is not None:
        if ended == "complete":
            checkpoint.path.unlink(missing_ok=True)
        elif kept is not None:
            _save(checkpoint.path, kept)
    assert run.best is not None, "iteration 0 always validates"
    run.net.load_state_dict(run.best_state)
    elapsed_s = before_s + time.monotonic() - begun
    return Fit(run.net, run.scaling, run.best, run.held_ids, ended, elapsed_s, tuple(run.history))


class _Run:
    """Everything that changes while training, so that it can be kept and restored as a whole."""

    def __init__(self, rows: Rows, s: Settings, start: LstmWeights | None) -> None:
        torch.manual_seed(s.seed)
        self.s = s
        parts = split(rows, s.fold)
        if start is None:
            self.scaling = Scaling.from_rates(rows.rates_degc_s[np.concatenate(parts.train)])
            self.net = LstmRates(s.hidden, s.cell, s.layers)
        else:
            self.net, self.scaling = net_from_weights(start)
            self.net = self.net.float()
        if start is None and s.initial == "spread":
            spread_time_constants(self.net, s.dt_s, shortest_s=1.0, longest_s=300.0)
        elif start is None:
            start_as_matlab(self.net)
        if s.trained == "head":
            for layer in self.net.stack:
                layer.requires_grad_(False)
        source = Windows if s.sequences == "random" else FixedSequences
        self.windows = source(rows, parts.train, self.scaling, s)
        self.validation = Validation.of(self.windows, parts.held, s)
        self.held_ids = parts.held_ids
        self.trained = [p for p in self.net.parameters() if p.requires_grad]
        self.adam = torch.optim.Adam(self.trained, lr=s.lr)
        self.per_epoch = self.windows.batches_per_epoch()
        self.total = s.epochs * self.per_epoch
        self.every = s.validate_every * (self.per_epoch if s.validate_unit == "epoch" else 1)
        self.origin = {
            "settings": dataclasses.asdict(s),
            "data_sha256": rows.sha256,
            "start_sha256": start.sha256 if start is not None else None,
        }
        self.iteration = 0
        self.elapsed_s = 0.0
        self.loss_sum, self.loss_count = 0.0, 0
        self.history: list[Progress] = []
        self.best: Progress | None = None
        self.best_state: dict[str, torch.Tensor] = {}

    def validates(self, iteration: int) -> bool:
        return iteration % self.every == 0 or iteration == self.total

    def validate(self, iteration: int, elapsed_s: float) -> None:
        """Judge the net as it is now; keep it if it is the best."""
        self.iteration, self.elapsed_s = iteration, elapsed_s
        val_w, val_r = self.validation.errors(self.net)
        score = math.hypot(val_w, val_r) / math.sqrt(2.0)
        better = self.best is None or score < self.best.score
        best_score = score if self.best is None or better else self.best.score
        loss = self.loss_sum / self.loss_count if self.loss_count else math.nan
        now = Progress(iteration // self.per_epoch, loss, val_w, val_r, score, best_score, elapsed_s)
        if better:
            self.best, self.best_state = now, {k: v.clone() for k, v in self.net.state_dict().items()}
        self.history.append(now)
        self.loss_sum, self.loss_count = 0.0, 0

    def step(self, iteration: int) -> None:
        """One mini-batch forward, back, and Adam's step."""
        s = self.s
        for group in self.adam.param_groups:
            group["lr"] = learning_rate(iteration // self.per_epoch, s)
        u, y, weights = self.windows.batch()
        error = self.net(u) - y
        loss = loss_of(error, weights, s.rotor_weight)
        if s.integral_weight > 0:
            loss = loss + s.integral_weight * integral_loss_of(error, weights, s)
        self.adam.zero_grad()
        loss.backward()
        if s.l2 > 0:
            for name, p in self.net.named_parameters():
                if p.grad is not None and "bias" not in name:
                    p.grad.add_(p.detach(), alpha=s.l2)
        for group in [[p] for p in self.trained] if s.clip_each else [self.trained]:
            torch.nn.utils.clip_grad_norm_(group, s.clip)
        self.adam.step()
        self.loss_sum += loss.item()
        self.loss_count += 1

    def state(self) -> dict[str, Any]:
        """A copy of the run as it is at this validation: tensors, and the rest as JSON text."""
        assert self.best is not None
        rest = {
            "origin": self.origin,
            "iteration": self.iteration,
            "next": getattr(self.windows, "next", 0),
            "random": self.windows.rng.bit_generator.state,
            "history": [dataclasses.astuple(p) for p in self.history],
            "best": dataclasses.astuple(self.best),
        }
        moments = {
            f"{i}.{name}": value.clone()
            for i, of in self.adam.state_dict()["state"].items()
            for name, value in of.items()
        }
        return {
            "rest": json.dumps(rest),
            "net": {k: v.clone() for k, v in self.net.state_dict().items()},
            "best": dict(self.best_state),
            "adam": moments,
        }

    def restore(self, path: Path) -> None:
        """Go back to the state kept in a file."""
        try:
            state = torch.load(path, weights_only=True)
            rest = json.loads(state["rest"])
        except FileNotFoundError as error:
            raise DataError(f"nothing to resume: {path} does not exist; start without --resume") from error
        except Exception as error:  # whatever a broken file makes torch raise
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise DataError(f"checkpoint {path} cannot be read ({reason}); start without --resume") from error
        if rest["origin"] != self.origin:
            theirs, ours = rest["origin"]["settings"], self.origin["settings"]
            others = {k for k in ours if theirs.get(k) != ours[k]}
            others |= {k for k in ("data_sha256", "start_sha256") if rest["origin"][k] != self.origin[k]}
            raise DataError(
                f"checkpoint {path} belongs to another run ({', '.join(sorted(others))} differ); "
                "give the same options and data, or start without --resume"
            )
        self.net.load_state_dict(state["net"])
        slots: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in state["adam"].items():
            slot, name = key.split(".")
            slots.setdefault(int(slot), {})[name] = value
        self.adam.load_state_dict({"state": slots, "param_groups": self.adam.state_dict()["param_groups"]})
        self.windows.rng.bit_generator.state = rest["random"]
        if isinstance(self.windows, FixedSequences):
            self.windows.next = rest["next"]
        self.history = [Progress(*values) for values in rest["history"]]
        self.best, self.best_state = Progress(*rest["best"]), state["best"]
        self.iteration, self.elapsed_s = rest["iteration"], self.history[-1].elapsed_s


def learning_rate(epoch: int, s: Settings) -> float:
    """Adam's rate in an epoch: half a cosine from lr to lr_end, or steps down."""
    if s.schedule == "steps":
        return s.lr * s.lr_drop ** (epoch // s.drop_epochs)
    return s.lr_end + 0.5 * (s.lr - s.lr_end) * (1.0 + math.cos(math.pi * epoch / s.epochs))


def _save(path: Path, state: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    torch.save(state, part)
    os.replace(part, path)
