"""Kalman filter on the four-node network (`lptn.py`): delay-aware, datasheet offset removed; knows no net.

The filter stands 1.5 s back, where the measurement speaks, and the network runs from there to now with the stored
inputs. The network is linear in its temperatures but for the copper's resistance, which is linearised in every step.
Teeth and yoke start at the mean of winding and coolant, uncertain by 20 K.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.estimators import lptn
from tools.estimators.drive import DELAY_STEPS, OFFSET_DEGC, Drive, Estimates
from tools.estimators.jit import compiled
from tools.estimators.lptn import COOLANT_DEGC, NODES, ROTOR, Lptn
from tools.estimators.session import ArraySession
from tools.estimators.start import EARLY, PRIOR_VARIANCE_K2, begins
from tools.estimators.ukf import correct

Array = NDArray[np.float64]
IRON_START_VARIANCE_K2 = 400.0


class LptnKf:
    """Estimator of drive.Estimator.

    Parameters
    ----------
    q_k2
        Process noise per interval of winding, teeth, yoke, rotor, variances in K².
    r_k2
        Measurement noise of winding and rotor.
    gate_sigmas
        Innovations beyond so many of their standard deviations are not used; inf: none is refused.
    """

    def __init__(
        self, name: str, network: Lptn, q_k2: tuple[float, ...], r_k2: tuple[float, float], gate_sigmas: float
    ) -> None:
        self.name, self._network, self._gate = name, network, gate_sigmas
        self._q, self._r = np.array(q_k2), np.array(r_k2)
        self._heats: tuple[Array, Array] | None = None  # of the drive worked on last: (u, heats)

    def begin(self) -> ArraySession:
        return ArraySession(np.zeros(EARLY + NODES + NODES * NODES), 2, self._loop)

    def read(self, rows: Array) -> Estimates:
        return Estimates(rows)

    def _loop(self, memory: Array, drive: Drive, first: int, last: int, out: Array) -> None:
        if self._heats is None or self._heats[0] is not drive.u:
            self._heats = drive.u, lptn.heats(drive.u)
        heat = self._heats[1]
        _filter(self._network, self._q, self._r, self._gate, memory, drive.u, heat, drive.y, first, last, out)


@compiled
def _filter(network, q, r, gate, memory, u, heat, y, first, last, out):
    early, theta, cov = memory[:EARLY], memory[EARLY : EARLY + NODES], memory[EARLY + NODES :].reshape(NODES, NODES)
    slope, work, ahead = np.empty((NODES, NODES)), np.empty((NODES, NODES)), np.empty(NODES)
    for row in range(first, last):
        node = row - DELAY_STEPS
        if early[4] == 0.0:
            if not begins(early, y[row], row):
                continue
            theta[0], theta[ROTOR] = early[0] / early[2], early[1] / early[3]
            theta[1] = theta[2] = 0.5 * (theta[0] + COOLANT_DEGC)
            cov[0, 0] = cov[ROTOR, ROTOR] = PRIOR_VARIANCE_K2
            cov[1, 1] = cov[2, 2] = IRON_START_VARIANCE_K2
        else:
            lptn.step(network, u[node, 0], heat[node], theta, slope)
            _spread(slope, q, cov, work)
        for ch in range(2):
            at = 0 if ch == 0 else ROTOR
            innovation = y[row, ch] - OFFSET_DEGC - theta[at]
            variance = cov[at, at] + r[ch]
            if abs(innovation) <= gate * np.sqrt(variance):  # false for NaN too
                correct(theta, cov, at, innovation, variance)
        ahead[:] = theta
        for k in range(node + 1, row + 1):
            lptn.step(network, u[k, 0], heat[k], ahead, slope)
        out[row - first, 0], out[row - first, 1] = ahead[0], ahead[ROTOR]


@compiled
def _spread(slope, q, cov, work):
    """cov becomes slope cov slope' + diag(q)."""
    for i in range(NODES):
        for j in range(NODES):
            total = 0.0
            for k in range(NODES):
                total += slope[i, k] * cov[k, j]
            work[i, j] = total
    for i in range(NODES):
        for j in range(NODES):
            total = q[i] if i == j else 0.0
            for k in range(NODES):
                total += work[i, k] * slope[j, k]
            cov[i, j] = total
