"""A recorded drive of a net, and the C's MHE run over it with each step's problem kept in the oracle's terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator_c.formulation.lstm_numpy import lstm_step
from estimator_c.formulation.mhe import MheProblem
from estimator_c.formulation.weights import NetWeights
from tools.libest import NODES, Lib, Mhe, Setting


@dataclass(frozen=True)
class Record:
    """A recorded drive at the net's rate: inputs u (n, 2), true temperatures (n, 2), noisy measurements (n, 2)."""

    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray


def record(
    weights: NetWeights, start_degc: tuple[float, float] = (140.0, 110.0), seed: int = 1, steps: int = 60
) -> Record:
    """The net itself with process noise, driven hard; measurements with the sensor's noise."""
    rng = np.random.default_rng(seed)
    levels = -(-steps // 5)
    u = np.repeat(np.stack([rng.uniform(3000, 10000, levels), rng.uniform(-80, 155, levels)], 1), 5, axis=0)[:steps]
    theta = np.empty((steps, 2))
    theta[0] = start_degc
    c, h = weights.empty_memory()
    for k in range(steps - 1):
        c, h, rate = lstm_step(weights, np.concatenate([u[k], theta[k]]), c, h)
        theta[k + 1] = theta[k] + 0.1 * rate + rng.normal(0, [0.02, 0.005])
    return Record(u, theta, theta + rng.normal(0, np.sqrt(0.1), theta.shape))


@dataclass
class Recorder:
    """Runs the C over a record and keeps the problem that each step solved, in the oracle's terms."""

    lib: Lib
    weights: NetWeights
    setting: Setting
    data: Record
    missing: frozenset[tuple[int, int]] = frozenset()  # (step, channel) without a measurement

    def __post_init__(self) -> None:
        self.mhe = Mhe(self.lib, self.setting)
        self.mhe.start(self.data.y[0], *self.weights.empty_memory())
        self.prior, self.step = self.data.y[0], 0
        self.measure(0)

    def measure(self, k: int) -> None:
        for channel in range(2):
            if (k, channel) not in self.missing:
                self.mhe.measure(self.step - k, channel, self.data.y[k, channel])

    def advance(self) -> None:
        if self.mhe.count == NODES:
            self.prior = self.mhe.theta()[1]
        self.mhe.advance(self.data.u[self.step])
        self.step += 1
        self.measure(self.step)

    def problem(self) -> MheProblem:
        s, count = self.setting, self.mhe.count
        first = self.step - count + 1
        weight = np.tile(np.array(s.weight_measurement[:]), (count, 1))
        for k, channel in self.missing:
            if first <= k <= self.step:
                weight[k - first, channel] = 0.0
        if not s.newest_measurement:
            weight[-1] = 0.0
        c, h = self.mhe.memory_of(count - 1, self.weights.memory_c)
        return MheProblem(
            u=self.data.u[first : self.step],
            y=self.data.y[first : self.step + 1],
            weight=weight,
            prior=self.prior,
            weight_arrival=np.array(s.weight_arrival[:] if first > 0 else s.weight_prior[:]),
            weight_noise=np.array(s.weight_noise[:]),
            memory=np.concatenate([c, h]),
            lower=s.lower_degc,
            upper=s.upper_degc,
            bound_weight=None if s.hard_bounds else s.bound_weight,
        )
