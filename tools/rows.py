"""Rows at the net's rate: what the trainer, the evaluation and the readers of user tables hand each other."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

DT_S = 0.1
INPUTS = ("n_rpm", "torque_nm", "theta_w_degc", "theta_r_degc")
COLUMNS = (*INPUTS, "dtheta_w_degc_s", "dtheta_r_degc_s")


class DataError(Exception):
    """A data set that cannot be used; the message says what, where and what to do."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a data set at the net's rate, 0.1 s apart within each trajectory.

    Row k holds the mean speed and torque over its interval, the temperatures at its start, and their rates
    (theta(k+1) - theta(k)) / 0.1 s.

    Attributes
    ----------
    x : (N, 4)
        Inputs in rpm, Nm, °C, °C.
    rates_degc_s : (N, 2)
        Rates of winding and rotor in °C/s.
    trajectory : (N,)
        Number of the drive that a row belongs to; memory is empty at the first row of each.
    sha256 : str
        Hash of the rows, see `hash_of`.
    notes : tuple of str
        What the reader did to the data beyond reading it (resampled, smoothed, left out).
    """

    x: NDArray[np.float64]
    rates_degc_s: NDArray[np.float64]
    trajectory: NDArray[np.integer]
    sha256: str
    notes: tuple[str, ...] = ()

    def pieces(self) -> list[NDArray[np.intp]]:
        """Row numbers of each trajectory, in order of their ids."""
        return [np.flatnonzero(self.trajectory == i) for i in np.unique(self.trajectory)]


def rows_from(values: NDArray[np.float64], trajectory: NDArray[np.integer], notes: tuple[str, ...] = ()) -> Rows:
    """Rows out of values (N, 6) in the order of COLUMNS."""
    return Rows(values[:, :4], values[:, 4:], trajectory, hash_of(values, trajectory), notes)


def hash_of(values: NDArray[np.float64], trajectory: NDArray[np.integer]) -> str:
    """SHA-256 over the rows (N, 6) (little-endian float64, row by row), then the trajectory numbers."""
    digest = hashlib.sha256(np.ascontiguousarray(values, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(trajectory, dtype="<i4").tobytes())
    return digest.hexdigest()


def load_npz(path: Path) -> Rows:
    """Read a data set that `rt-runner dataset` wrote.

    Raises
    ------
    DataError
        File missing or unreadable, a column missing or of another length, a value not finite.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = [np.asarray(file[name], dtype=np.float64) for name in COLUMNS]
            trajectory = np.asarray(file["trajectory"]) if "trajectory" in file else np.zeros(len(columns[0]), int)
            sha256 = str(file["sha256"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).strip("'\"")
        raise DataError(
            f"data set {path}: {reason}; build it with `rt-runner dataset` (`python -m tools.dataset`)"
        ) from error
    if len({len(c) for c in (*columns, trajectory)}) != 1 or not all(np.isfinite(c).all() for c in columns):
        raise DataError(f"data set {path}: columns of unequal length or values not finite; build it again")
    if len(trajectory) == 0:
        raise DataError(f"data set {path}: no rows; build it again")
    return Rows(np.stack(columns[:4], axis=1), np.stack(columns[4:], axis=1), trajectory, sha256)
