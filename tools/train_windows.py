"""What the trainer learns from: windows of the training trajectories; and the held-out ones that judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tools.evaluate import Rows
from tools.lstm_torch import LstmRates, Scaling
from tools.train_configs import Settings

__all__ = ["FixedSequences", "Settings", "Split", "Validation", "Windows", "loss_of", "row_weights", "split"]


@dataclass(frozen=True)
class Split:
    """Row numbers of the training and the held-out pieces, and the held-out trajectories' numbers."""

    train: list[np.ndarray]
    held: list[np.ndarray]
    held_ids: tuple[int, ...]


def split(rows: Rows, fold: int) -> Split:
    """About 80:20: every fifth trajectory in order of length, so that both kinds are on both sides.

    A data set of fewer than five trajectories gives the last fifth of each to the validation instead.
    """
    pieces = rows.pieces()
    if len(pieces) < 5:
        cuts = [round(0.8 * len(p)) for p in pieces]
        ends = list(zip(pieces, cuts, strict=True))
        return Split([p[:c] for p, c in ends], [p[c:] for p, c in ends], ())
    order = np.argsort([-len(p) for p in pieces], kind="stable")
    held = sorted(int(i) for i in order[fold % 5 :: 5])
    ids = np.unique(rows.trajectory)
    return Split(
        [p for i, p in enumerate(pieces) if i not in held],
        [pieces[i] for i in held],
        tuple(int(ids[i]) for i in held),
    )


def row_weights(n_rows: int, s: Settings) -> torch.Tensor:
    """Weight of a window's rows in the loss, shape (n_rows, 1, 1): low while the memory fills, then one."""
    t_s = torch.arange(n_rows) * s.dt_s
    ramp = (t_s / s.early_s).clamp(max=1.0) if s.early_s > 0 else torch.ones(n_rows)
    return (s.early_weight + (1.0 - s.early_weight) * ramp)[:, None, None]


def loss_of(error: torch.Tensor, weights: torch.Tensor, rotor_weight: float) -> torch.Tensor:
    """Weighted mean square of the normalised rate errors (rows, batch, 2)."""
    return (weights * error.new_tensor([1.0, rotor_weight]) * error.square()).mean()


def integral_loss_of(error: torch.Tensor, weights: torch.Tensor, s: Settings) -> torch.Tensor:
    """Weighted mean square of what the rate errors add up to from the window's first row on, over its length.

    The error in temperature at the window's end, as a mean rate; what the memory could not know yet does not count.
    """
    added = (weights * error).cumsum(0) / len(error)
    return (error.new_tensor([1.0, s.rotor_weight]) * added.square()).mean()


class Windows:
    """Random windows of the training pieces, scaled, as float32 tensors of shape (rows, batch, channels)."""

    def __init__(self, rows: Rows, pieces: list[np.ndarray], scaling: Scaling, s: Settings) -> None:
        self.rng = np.random.default_rng(s.seed)
        self.length = min(round(s.window_s / s.dt_s), min(len(p) for p in pieces))
        self.u = torch.tensor((rows.x - scaling.in_offset) / scaling.in_scale, dtype=torch.float32)
        self.y = torch.tensor((rows.rates_degc_s - scaling.out_offset) / scaling.out_scale, dtype=torch.float32)
        self.starts = np.concatenate([p[: len(p) - self.length + 1] for p in pieces])
        self.firsts = np.array([p[0] for p in pieces])
        self.rows_in_all = sum(len(p) for p in pieces)
        self.s = s
        self.noise_scale = torch.tensor(s.theta_noise_degc / scaling.in_scale[2:], dtype=torch.float32)
        self.weights = row_weights(self.length, s)

    def batches_per_epoch(self) -> int:
        return max(1, round(self.rows_in_all / (self.s.batch * self.length)))

    def batch(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Scaled inputs and rates of the next mini-batch, and the weights of its rows in the loss."""
        return *self.draw(), self.weights

    def draw(self) -> tuple[torch.Tensor, torch.Tensor]:
        first = self.rng.choice(self.starts, self.s.batch)
        at_start = self.rng.random(self.s.batch) < self.s.start_share
        first[at_start] = self.rng.choice(self.firsts, np.count_nonzero(at_start))
        at = torch.from_numpy(first)[None, :] + torch.arange(self.length)[:, None]
        u, y = self.u[at], self.y[at]
        if self.s.theta_noise_degc > 0:
            u[:, :, 2:] += self.noise_scale * self.slow_noise()
        return u, y

    def slow_noise(self) -> torch.Tensor:
        """Noise (rows, batch, 2) of about unit variance, linear between knots one correlation time apart."""
        step = max(1, round(self.s.theta_noise_s / self.s.dt_s))
        knots = self.rng.standard_normal((self.length // step + 2, self.s.batch, 2)).astype(np.float32)
        position = np.arange(self.length) / step + self.rng.random()
        left = np.minimum(position.astype(int), len(knots) - 2)
        part = (position - left).astype(np.float32)[:, None, None]
        return torch.from_numpy((1.0 - part) * knots[left] + part * knots[left + 1])


class FixedSequences(Windows):
    """The training pieces cut once into equal sequences of at most a window, taken in order, as in Algorithm 1.

    Sequences shorter than the longest repeat their last row to its length; such rows do not count in the loss.
    """

    def __init__(self, rows: Rows, pieces: list[np.ndarray], scaling: Scaling, s: Settings) -> None:
        super().__init__(rows, pieces, scaling, s)
        most = round(s.window_s / s.dt_s)
        cuts = [part for p in pieces for part in np.array_split(p, -(-len(p) // most))]
        self.length = max(len(cut) for cut in cuts)
        padded = [np.concatenate((cut, np.full(self.length - len(cut), cut[-1]))) for cut in cuts]
        self.at = torch.from_numpy(np.stack(padded, axis=1))
        lengths = torch.tensor([len(cut) for cut in cuts])
        self.counts = (torch.arange(self.length)[:, None] < lengths)[:, :, None] * row_weights(self.length, s)
        self.next = 0

    def batches_per_epoch(self) -> int:
        return -(-self.at.shape[1] // self.s.batch)

    def batch(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        part = slice(self.next * self.s.batch, (self.next + 1) * self.s.batch)
        self.next = (self.next + 1) % self.batches_per_epoch()
        at, counts = self.at[:, part], self.counts[:, part]
        u, y = self.u[at], self.y[at]
        if self.s.theta_noise_degc > 0:
            u[:, :, 2:] += self.noise_scale * self.slow_noise()[:, : u.shape[1]]
        return u, y, counts * (counts.numel() / counts.count_nonzero())


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
