"""Unscented Kalman filter with the trained net as its model: state [theta (2), memory of the net], 18 with 8 cells.

Process noise acts on the temperatures only; the memory's covariance comes from them through the net. Delay-aware: the
filter stands 1.5 s back, where the measurement speaks, and the net runs from its mean to now with the stored inputs.
Sigma points: n columns of the Cholesky factor of P, times ±sqrt(n), equal weights (alpha 1, kappa 0, beta 0: no
central point). The measurement is linear in the state, so the update is the Kalman update, exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import DELAY_STEPS, OFFSET_DEGC, Drive, Estimates
from tools.estimators.jit import compiled
from tools.estimators.net import Net, memory_size, run_ahead, scratch_size, step
from tools.estimators.session import ArraySession
from tools.estimators.start import EARLY, PRIOR_VARIANCE_K2, begins, start_up

Array = NDArray[np.float64]


class Ukf:
    """Estimator of drive.Estimator.

    Parameters
    ----------
    q_k2, r_k2
        Process noise per interval and measurement noise, variances per channel in K².
    gate_sigmas
        Innovations beyond so many of their standard deviations are not used; inf: none is refused.
    """

    def __init__(
        self, name: str, net: Net, q_k2: tuple[float, float], r_k2: tuple[float, float], gate_sigmas: float
    ) -> None:
        self.name, self._net, self._gate = name, net, gate_sigmas
        self._q, self._r = np.array(q_k2), np.array(r_k2)

    def begin(self) -> ArraySession:
        n = 2 + memory_size(self._net)
        return ArraySession(np.zeros(EARLY + n + n * n), 2, self._loop)

    def read(self, rows: Array) -> Estimates:
        return Estimates(rows)

    def _loop(self, memory: Array, drive: Drive, first: int, last: int, out: Array) -> None:
        scratch = np.empty(scratch_size(self._net))
        _filter(self._net, self._q, self._r, self._gate, memory, drive.u, drive.y, first, last, scratch, out)


@compiled
def _filter(net, q, r, gate, memory, u, y, first, last, scratch, out):
    early, rest = memory[:EARLY], memory[EARLY:]
    n = 0
    while n + n * n < rest.size:
        n += 1
    mean, cov = rest[:n], rest[n:].reshape(n, n)
    points, root, ahead = np.empty((2 * n, n)), np.empty((n, n)), np.empty(n)
    for row in range(first, last):
        node = row - DELAY_STEPS
        if early[4] == 0.0:
            if not begins(early, y[row], row):
                continue
            start_up(net, early, u[node + 1], mean, scratch)
            for ch in range(2):
                cov[ch, ch] = PRIOR_VARIANCE_K2
        else:
            _predict(net, q, u[node], mean, cov, points, root, scratch)
        for ch in range(2):
            innovation = y[row, ch] - OFFSET_DEGC - mean[ch]
            variance = cov[ch, ch] + r[ch]
            if abs(innovation) <= gate * np.sqrt(variance):  # false for NaN too
                correct(mean, cov, ch, innovation, variance)
        run_ahead(net, u, node + 1, row, mean, ahead, scratch)
        for ch in range(2):
            out[row - first, ch] = ahead[ch]


@compiled
def _predict(net, q, u, mean, cov, points, root, scratch):
    """Mean and covariance one step on, through the sigma points."""
    n = mean.size
    square_root(cov, root)
    spread, weight = np.sqrt(float(n)), 0.5 / n
    for k in range(n):
        for i in range(n):
            points[k, i] = mean[i] + spread * root[i, k]
            points[n + k, i] = mean[i] - spread * root[i, k]
    mean[:] = 0.0
    for k in range(2 * n):
        step(net, u, points[k], scratch)
        for i in range(n):
            mean[i] += weight * points[k, i]
    cov[:] = 0.0
    for k in range(2 * n):
        for i in range(n):
            points[k, i] -= mean[i]
        for i in range(n):
            scaled = weight * points[k, i]
            for j in range(i + 1):
                cov[i, j] += scaled * points[k, j]
    for ch in range(2):
        cov[ch, ch] += q[ch]
    for i in range(n):
        for j in range(i):
            cov[j, i] = cov[i, j]


@compiled
def correct(mean, cov, ch, innovation, variance):
    """Kalman update by one component of the state measured directly; variance: of the innovation."""
    n = mean.size
    column = cov[:, ch].copy()
    for i in range(n):
        mean[i] += column[i] * innovation / variance
        for j in range(n):
            cov[i, j] -= column[i] * column[j] / variance


@compiled
def square_root(cov, root):
    """Lower Cholesky factor of a covariance that may be singular: directions without variance give empty columns."""
    n = cov.shape[0]
    root[:] = 0.0
    for k in range(n):
        pivot = cov[k, k]
        for j in range(k):
            pivot -= root[k, j] ** 2
        if pivot <= 1e-14 * cov[k, k] or pivot <= 0.0:
            continue
        root[k, k] = np.sqrt(pivot)
        for i in range(k + 1, n):
            total = cov[i, k]
            for j in range(k):
                total -= root[i, j] * root[k, j]
            root[i, k] = total / root[k, k]
