"""Driving cycles from CSV: a column of time or distance, a speed (or curvature), and optionally a grade."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle
from plant_sim.errors import CycleError
from plant_sim.params import PlantParams
from plant_sim.track import STEP_M, speed_profile

# Accepted header (lower case) -> factor to SI. Grade columns give rise over run, slope columns an angle.
TIME = {"t_s": 1.0, "time_s": 1.0, "time": 1.0, "t": 1.0, "cycsecs": 1.0}
DISTANCE = {"s_m": 1.0, "distance_m": 1.0, "distance": 1.0, "s_km": 1000.0, "distance_km": 1000.0}
SPEED = {
    "v_mps": 1.0,
    "speed_mps": 1.0,
    "speed": 1.0,
    "v_ref_mps": 1.0,
    "cycmps": 1.0,
    "v_kmh": 1 / 3.6,
    "speed_kmh": 1 / 3.6,
}
GRADE = {"grade": 1.0, "cycgrade": 1.0, "grade_percent": 0.01}
SLOPE = {"slope_rad": 1.0, "phi_rad": 1.0}
CURVATURE = {"kappa_1pm": 1.0, "curvature_1pm": 1.0}
_TIME_STEP_S = 0.1
_START_MPS = 3.0


def read_csv_cycle(
    path: str | Path, params: PlantParams, a_lat_mps2: float = 8.0, length_m: float | None = None
) -> Cycle:
    """Read a cycle; UTF-8 with or without byte-order mark, header in the first line.

    Parameters
    ----------
    path
        CSV file with one of the columns named in this module for time or distance, speed, grade or slope. A
        distance file without a speed may give a curvature instead: its speed is then the quasi-steady
        profile.
    params
        For the top speed, and the envelope in the speed profile.
    a_lat_mps2
        Lateral acceleration of that profile.
    length_m
        Stretch the distance axis to this length.

    Raises
    ------
    CycleError
        With file, line and remedy, if the file cannot be used.
    """
    source = Path(path)
    header, table = _read_table(source)
    axis, by_distance = _find(header, table, TIME), False
    if axis is None:
        axis, by_distance = _find(header, table, DISTANCE), True
    if axis is None:
        raise CycleError(
            f"{source}:1: no time or distance column; name one {' or '.join([*TIME, *DISTANCE])}"
        )
    speed, curvature = _find(header, table, SPEED), _find(header, table, CURVATURE)
    if speed is None and (curvature is None or not by_distance):
        raise CycleError(
            f"{source}:1: no speed column; name one {' or '.join(SPEED)}"
            + (f", or a curvature {' or '.join(CURVATURE)}" if by_distance else "")
        )
    _require_rising(source, axis)
    slope = _find(header, table, SLOPE)
    if slope is None:
        grade = _find(header, table, GRADE)
        slope = np.zeros_like(axis) if grade is None else np.arctan(grade)
    axis = axis - axis[0]
    if by_distance and length_m is not None:
        axis = axis * (length_m / axis[-1])

    step = STEP_M if by_distance else _TIME_STEP_S
    grid = np.arange(0.0, axis[-1] + 1e-9, step)
    slope = np.interp(grid, axis, slope)
    if speed is not None:
        v = np.clip(np.interp(grid, axis, speed), 0.0, params.vehicle.v_max_mps)
        if by_distance:  # a stop has no duration over distance: the car would stand there for ever
            v = np.maximum(v, _START_MPS)
    else:
        assert curvature is not None
        v = speed_profile(np.interp(grid, axis, curvature), slope, step, a_lat_mps2, params)
    return Cycle(source.stem, by_distance, step, v, slope)


def _read_table(source: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Return lower-case header and the numbers (rows, columns); empty cells become NaN."""
    rows: list[list[float]] = []
    try:
        with source.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [name.strip().lower() for name in next(reader, [])]
            if not header:
                raise CycleError(f"{source}:1: empty file; the first line must name the columns")
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                if len(cells) != len(header):
                    raise CycleError(
                        f"{source}:{reader.line_num}: {len(cells)} cells but {len(header)} columns; "
                        f"complete the line"
                    )
                rows.append(
                    [
                        _number(source, reader.line_num, name, cell)
                        for name, cell in zip(header, cells, strict=True)
                    ]
                )
    except OSError as error:
        raise CycleError(f"{source}: cannot read the cycle ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise CycleError(f"{source}: not UTF-8 text (byte {error.start}); save it as UTF-8 CSV") from error
    if len(rows) < 2:
        raise CycleError(f"{source}: {len(rows)} data lines; a cycle needs at least 2")
    return header, np.array(rows)


def _number(source: Path, line: int, column: str, cell: str) -> float:
    """Parse a cell of a column that we use; others may hold anything."""
    if not any(column in known for known in (TIME, DISTANCE, SPEED, GRADE, SLOPE, CURVATURE)):
        return 0.0
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise CycleError(f"{source}:{line}: '{cell}' in column '{column}' is not a finite number; correct it")
    return value


def _find(
    header: list[str], table: NDArray[np.float64], names: dict[str, float]
) -> NDArray[np.float64] | None:
    """Return the first column that goes by one of the names, in SI."""
    for i, name in enumerate(header):
        if name in names:
            return table[:, i] * names[name]
    return None


def _require_rising(source: Path, axis: NDArray[np.float64]) -> None:
    falling = np.flatnonzero(np.diff(axis) <= 0.0)
    if falling.size:
        raise CycleError(
            f"{source}: time or distance does not rise at data row {int(falling[0]) + 2}; sort the rows and "
            f"remove repeats"
        )
