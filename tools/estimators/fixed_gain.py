"""The net corrected by one constant gain per channel, delay-aware, datasheet offset removed; and the net alone.

theta(k) += K (y - offset - theta(k)) at the node the measurement speaks for, then the net forward to now with the
stored inputs. Gain 0 is the open loop: started from the first 1.5 s of measurements, never corrected. The gains come
from training-type drives (`tune.py`), never from the lap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import DELAY_STEPS, OFFSET_DEGC, Drive, Estimates
from tools.estimators.jit import compiled
from tools.estimators.net import Net, memory_size, run_ahead, scratch_size, step
from tools.estimators.session import ArraySession
from tools.estimators.start import EARLY, begins, start_up

Array = NDArray[np.float64]


class FixedGain:
    """Estimator of drive.Estimator.

    Parameters
    ----------
    gain
        Per channel; 0 for the open loop.
    gate_degc
        Innovations beyond this are not used; inf: the textbook's observer, which uses all.
    """

    def __init__(self, name: str, net: Net, gain: tuple[float, float], gate_degc: tuple[float, float]) -> None:
        self.name, self._net = name, net
        self._gain, self._gate = np.array(gain), np.array(gate_degc)

    def begin(self) -> ArraySession:
        return ArraySession(np.zeros(EARLY + 2 + memory_size(self._net)), 2, self._loop)

    def read(self, rows: Array) -> Estimates:
        return Estimates(rows)

    def _loop(self, memory: Array, drive: Drive, first: int, last: int, out: Array) -> None:
        scratch = np.empty(scratch_size(self._net))
        _observe(self._net, self._gain, self._gate, memory, drive.u, drive.y, first, last, scratch, out)


@compiled
def _observe(net, gain, gate, memory, u, y, first, last, scratch, out):
    early, state = memory[:EARLY], memory[EARLY:]
    ahead = np.empty_like(state)
    for row in range(first, last):
        node = row - DELAY_STEPS
        if early[4] == 0.0:
            if not begins(early, y[row], row):
                continue
            start_up(net, early, u[node + 1], state, scratch)
        else:
            step(net, u[node], state, scratch)
        for ch in range(2):
            innovation = y[row, ch] - OFFSET_DEGC - state[ch]
            if abs(innovation) <= gate[ch]:  # false for NaN too
                state[ch] += gain[ch] * innovation
        run_ahead(net, u, node + 1, row, state, ahead, scratch)
        out[row - first, 0], out[row - first, 1] = ahead[0], ahead[1]
