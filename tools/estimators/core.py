"""The C core itself, under a setting compiled into the library: what the process on the bus computes."""

from __future__ import annotations

import ctypes as ct

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import TICKS, Drive, Estimates
from tools.libest import Estimator as CoreObject
from tools.libest import Lib, Setting

Array = NDArray[np.float64]
# Columns of est_batch.h.
THETA, STATUS, FAULT, SIGMA, UPPER = slice(0, 2), 4, slice(7, 9), slice(11, 13), slice(13, 15)


class Core:
    """Estimator of drive.Estimator.

    Raises
    ------
    KeyError
        The library has no setting of that name.
    """

    def __init__(self, name: str, lib: Lib) -> None:
        self.name, self._lib = name, lib
        self._setting: Setting = lib.setting(name)

    def begin(self) -> CoreSession:
        return CoreSession(CoreObject(self._lib, self._setting))

    def read(self, rows: Array) -> Estimates:
        return Estimates(
            rows[:, THETA].copy(), rows[:, FAULT].astype(np.int64), rows[:, SIGMA].copy(), rows[:, UPPER].copy(),
            rows[:, STATUS].astype(np.int64),
        )  # fmt: skip


class CoreSession:
    """Session of drive.Session around one estimator_t; its memory is the object's bytes, put back where they were."""

    def __init__(self, core: CoreObject) -> None:
        self._core = core

    def advance(self, drive: Drive, first: int, last: int) -> Array:
        part = drive.cut(first, last)
        if not len(part):
            return self._core.run(np.empty(0), np.empty(0), np.empty((0, 2)))
        return self._core.run(
            part.torque_nm, part.speed_rpm, part.y, drive.first_tick + TICKS * first, part.coolant_degc, part.soaked
        )

    def save(self) -> bytes:
        return self._core.memory.raw

    def restore(self, memory: bytes) -> None:
        ct.memmove(self._core.memory, memory, len(memory))
