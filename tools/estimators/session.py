"""A session whose whole memory is one flat array, worked on by a compiled loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import Drive

Array = NDArray[np.float64]
# (memory, drive, first row, last row, out): rows out (last - first, columns) are filled, memory is moved on
Loop = Callable[[Array, Drive, int, int, Array], None]


class ArraySession:
    """Session of drive.Session around a loop.

    Parameters
    ----------
    memory
        What the loop starts from; copied.
    columns
        Numbers per row it gives.
    """

    def __init__(self, memory: Array, columns: int, loop: Loop) -> None:
        self._memory, self._columns, self._loop = memory.copy(), columns, loop

    def advance(self, drive: Drive, first: int, last: int) -> Array:
        out = np.full((last - first, self._columns), np.nan)
        self._loop(self._memory, drive, first, last, out)
        return out

    def save(self) -> Array:
        return self._memory.copy()

    def restore(self, memory: Array) -> None:
        self._memory[:] = memory
