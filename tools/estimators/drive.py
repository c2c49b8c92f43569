"""What an off-line estimator takes and gives: a drive as the bus carried it, an estimate at every 0.1 s."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TICKS = 10  # of 10 ms per interval
DELAY_STEPS = 15  # the sensor's, in intervals of 0.1 s
OFFSET_DEGC = -1.0  # of the sensor's data sheet: measurement = temperature + offset
VARIANCE_K2 = 0.1  # of the sensor's noise, from the same sheet


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded drive; row j is the interval that ends at node j, where the estimate is wanted.

    Attributes
    ----------
    torque_nm, speed_rpm : (10 n,)
        Of every tick: ten per row.
    u : (n, 2)
        [speed rpm, torque Nm], mean over the row's interval.
    y : (n, 2)
        Raw measurement of winding and rotor in °C received at node j; it speaks for the temperature 1.5 s before.
        NaN: the bus said "not available".
    first_tick : int
        Plant tick before the first row.
    coolant_degc, soaked : (n,) or None
        Coolant frame of the row (NaN: none), and its flag.
    """

    torque_nm: Array
    speed_rpm: Array
    u: Array
    y: Array
    first_tick: int = 0
    coolant_degc: Array | None = None
    soaked: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.y)

    def cut(self, first: int, last: int) -> Drive:
        """Rows first .. last - 1 as a drive of its own."""
        ticks, rows = slice(TICKS * first, TICKS * last), slice(first, last)
        return Drive(
            self.torque_nm[ticks], self.speed_rpm[ticks], self.u[rows], self.y[rows], self.first_tick + TICKS * first,
            None if self.coolant_degc is None else self.coolant_degc[rows],
            None if self.soaked is None else self.soaked[rows],
        )  # fmt: skip


def interval_means(torque_nm: Array, speed_rpm: Array) -> Array:
    """u (n, 2) of ticks (10 n,)."""
    return np.stack([speed_rpm.reshape(-1, TICKS).mean(axis=1), torque_nm.reshape(-1, TICKS).mean(axis=1)], axis=1)


@dataclass(frozen=True, eq=False)
class Estimates:
    """What an estimator says at every node; NaN before its first estimate.

    Attributes
    ----------
    theta_degc : (n, 2)
        Winding and rotor.
    fault : (n, 2) of int, or None
        Published sensor class, 0 is "ok"; None: it publishes none.
    sigma_degc, upper_degc : (n, 2) or None
        Published standard deviation and upper bound.
    status : (n,) of int, or None
        estimator_status_t.
    """

    theta_degc: Array
    fault: NDArray[np.int64] | None = None
    sigma_degc: Array | None = None
    upper_degc: Array | None = None
    status: NDArray[np.int64] | None = None


class Session(Protocol):
    """One estimator under way on one drive."""

    def advance(self, drive: Drive, first: int, last: int) -> Array:
        """Take rows first .. last - 1, which follow those taken before; return (last - first, columns)."""
        ...

    def save(self) -> Any:
        """Everything it remembers."""
        ...

    def restore(self, memory: Any) -> None:
        """Back to what `save` gave."""
        ...


class Estimator(Protocol):
    """One way to estimate, by name."""

    @property
    def name(self) -> str: ...

    def begin(self) -> Session:
        """Start empty."""
        ...

    def read(self, rows: Array) -> Estimates:
        """The columns that its sessions return, as estimates."""
        ...


def run(estimator: Estimator, drive: Drive) -> Estimates:
    """One drive from its first row to its last."""
    return estimator.read(estimator.begin().advance(drive, 0, len(drive)))


def run_each(estimator: Estimator, drives: Sequence[Drive]) -> list[Estimates]:
    """`run` for drives that differ in their measurements only; what they have in common is computed once.

    Faults begin late in a lap, so this halves a campaign. The results are the same to the last bit, because an
    estimator knows nothing but what it was given.
    """
    first = drives[0]
    for other in drives[1:]:
        if other.u is not first.u or len(other) != len(first):
            raise ValueError("drives that are run together must share their inputs")
    common = min((_first_difference(first.y, d.y) for d in drives[1:]), default=len(first))
    session = estimator.begin()
    head = session.advance(first, 0, common)
    memory = session.save()
    results = []
    for drive in drives:
        session.restore(memory)
        tail = session.advance(drive, common, len(drive))
        results.append(estimator.read(np.concatenate([head, tail])))
    return results


def _first_difference(a: Array, b: Array) -> int:
    differs = ((a != b) & ~(np.isnan(a) & np.isnan(b))).any(axis=1)
    return int(differs.argmax()) if differs.any() else len(a)
