"""Laps with sensor faults through the C core: each lap is driven once per process, each estimate computed once."""

from __future__ import annotations

import ctypes as ct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from plant_sim.cycles import CycleSpec
from plant_sim.faults import Fault, parse_fault
from tools.compare_drives import Lap, drive_lap, sense
from tools.estimators.drive import Drive
from tools.libest import WEIGHTS, Estimator, Lib, compile_library

OK, OFFSET, NOISE, STUCK, DROPOUT, SPIKE, DRIFT, SLOW = range(8)  # sensor_class_t
INIT, STARTING, RUNNING, PREDICTING, INPUT_STALE, INVALID, OPEN_LOOP, FALLBACK = range(8)  # estimator_status_t
W, R = 0, 1
HEAD_ROWS = 4280  # 428 s, without a fault and computed once
SETTLED_S = 10.0  # from here on an estimate is judged


@cache
def library() -> Lib:
    """The core as its sources are now."""
    return Lib(compile_library(WEIGHTS))


@cache
def lap_of(mismatch: str | None = None, cycle: str = "lap") -> Lap:
    """One plant once around."""
    return drive_lap(mismatch, CycleSpec(cycle))


@dataclass(frozen=True, eq=False)
class FaultedLap:
    """What the core said of a lap, one row per 0.1 s; columns of two are winding and rotor.

    Attributes
    ----------
    t_s : (n,)
        Time at the row's end, as fault times count.
    error, innovation, sigma, upper, innovation_sigma : (n, 2)
        degC; error is estimate minus truth, innovation NaN where there was no measurement.
    headroom : (n, 2)
        Upper bound minus truth, degC.
    fault : (n, 2) of int
        Published class.
    trusted : (n, 2) of bool
    status : (n,) of int
    sweeps : (n,) of int
    truth, measured, theta : (n, 2)
        degC; measured as the bus carries it.
    """

    t_s: np.ndarray
    truth: np.ndarray
    measured: np.ndarray
    theta: np.ndarray
    innovation: np.ndarray
    status: np.ndarray
    sweeps: np.ndarray
    fault: np.ndarray
    trusted: np.ndarray
    sigma: np.ndarray
    upper: np.ndarray
    innovation_sigma: np.ndarray

    @property
    def error(self) -> np.ndarray:
        return self.theta - self.truth

    @property
    def headroom(self) -> np.ndarray:
        return self.upper - self.truth

    def between(self, start_s: float, end_s: float) -> np.ndarray:
        """Rows with start_s <= t < end_s, a mask."""
        return (self.t_s >= start_s - 1e-6) & (self.t_s < end_s - 1e-6)

    @property
    def settled(self) -> np.ndarray:
        """Rows that are judged, a mask."""
        return self.t_s >= SETTLED_S - 1e-6

    def rmse(self, channel: int = W, rows: np.ndarray | None = None) -> float:
        """Root mean squared error over rows (all judged ones), degC."""
        return float(np.sqrt(np.mean(self.error[self.settled if rows is None else rows, channel] ** 2)))

    def worst(self, channel: int = W, rows: np.ndarray | None = None) -> float:
        """Largest error over rows (all judged ones), degC; missing estimates count as infinite."""
        size = np.abs(self.error[self.settled if rows is None else rows, channel])
        return float(np.where(np.isfinite(size), size, np.inf).max())

    def alarms(self, rows: np.ndarray, channel: int) -> int:
        """How often a class other than ok began in rows."""
        bad = self.fault[:, channel] != OK
        return int(np.sum(bad & ~np.concatenate([[False], bad[:-1]]) & rows))

    def first(self, rows: np.ndarray) -> float | None:
        """Time of the first row of a mask; None: it has none."""
        return float(self.t_s[rows.argmax()]) if rows.any() else None


class _Run:
    """One core on one lap with one seed of noise; every fault begins where the lap was still whole."""

    def __init__(self, seed: int, setting: str, mismatch: str | None, cycle: str) -> None:
        self._lap, self._seed = lap_of(mismatch, cycle), seed
        self._core = Estimator(library(), library().setting(setting))
        self._whole = sense(self._lap, seed)
        self._head = self._part(self._whole, 0, HEAD_ROWS)
        self._memory = self._core.memory.raw

    def _part(self, drive: Drive, first: int, last: int) -> np.ndarray:
        part = drive.cut(first, last)
        return self._core.run(part.torque_nm, part.speed_rpm, part.y, part.first_tick, part.coolant_degc)

    def __call__(self, faults: Sequence[Fault]) -> FaultedLap:
        drive = sense(self._lap, self._seed, faults)
        np.testing.assert_array_equal(drive.y[:HEAD_ROWS], self._whole.y[:HEAD_ROWS], "a fault before HEAD_ROWS")
        ct.memmove(self._core.memory, self._memory, len(self._memory))
        return _read(self._lap, drive, np.concatenate([self._head, self._part(drive, HEAD_ROWS, len(drive))]))


_run = cache(_Run)


@cache
def faulted_lap(
    faults: tuple[str, ...] = (), seed: int = 0, setting: str = "default", mismatch: str | None = None,
    cycle: str = "lap",
) -> FaultedLap:  # fmt: skip
    """Drive a lap's arrays through the core; faults in text form, from second 428 on."""
    return _run(seed, setting, mismatch, cycle)([parse_fault(text) for text in faults])


def _read(lap: Lap, drive: Drive, out: np.ndarray) -> FaultedLap:
    return FaultedLap(
        t_s=lap.t_s, truth=lap.truth_degc, measured=drive.y, theta=out[:, 0:2], innovation=out[:, 2:4],
        status=out[:, 4].astype(int), sweeps=out[:, 5].astype(int), fault=out[:, 7:9].astype(int),
        trusted=out[:, 9:11] > 0.0, sigma=out[:, 11:13], upper=out[:, 13:15], innovation_sigma=out[:, 15:17],
    )  # fmt: skip
