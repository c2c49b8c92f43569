"""What a user without a model has: the raw sensor, and its 1.5 s moving average. Offset and delay stay in.

Where the bus says "not available" the last value is held, as a plain user would.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import Drive, Estimates
from tools.estimators.jit import compiled
from tools.estimators.session import ArraySession

Array = NDArray[np.float64]
AVERAGE_ROWS = 15  # 1.5 s


class MovingAverage:
    """Estimator of drive.Estimator: mean of what came in the last `rows` intervals; 1 is the raw sensor."""

    def __init__(self, name: str, rows: int) -> None:
        self.name, self._rows = name, rows

    def begin(self) -> ArraySession:
        return ArraySession(np.full(2 + 2 * self._rows, np.nan), 2, self._loop)

    def read(self, rows: Array) -> Estimates:
        return Estimates(rows)

    def _loop(self, memory: Array, drive: Drive, first: int, last: int, out: Array) -> None:
        _average(memory, drive.y, first, last, self._rows, out)


@compiled
def _average(memory, y, first, last, count, out):
    held, ring = memory[:2], memory[2:].reshape(count, 2)
    for row in range(first, last):
        for ch in range(2):
            ring[row % count, ch] = y[row, ch]
            total, seen = 0.0, 0
            for k in range(1, count + 1):  # oldest first: the same sum wherever the ring stands
                value = ring[(row + k) % count, ch]
                if not np.isnan(value):
                    total += value
                    seen += 1
            if seen > 0:
                held[ch] = total / seen
            out[row - first, ch] = held[ch]
