"""Anybody's drives as rows at the net's rate: any table of (t, n, T, θw, θr) as CSV, Parquet or our own MCAP log.

``load_rows(path)`` is all that the trainer and the evaluation need. A table has one line per sample in rising time;
column names are matched by `QUANTITIES` below, letters' case and the unit's brackets do not matter. A column of drive
numbers (`trajectory`, `profile_id`, …) separates drives. A row's speed and torque are taken as the mean from its time
to the next; samples 10 Hz apart are used as they are, others are resampled (`tools.resample`).
"""

from __future__ import annotations

import csv
import importlib.util
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.resample import Drive, to_rows
from tools.rows import DataError, Rows, load_npz

Array = NDArray[np.float64]
_RAD_S = 30.0 / math.pi
_SAME = dict.fromkeys


def _celsius(stem: str, *others: str) -> dict[str, tuple[float, float]]:
    names = [stem, f"{stem}_degc", f"{stem}_c", f"{stem}_true_degc"]
    names += [name + unit for name in others for unit in ("", "_degc", "_c")]
    return {**_SAME(names, (1.0, 0.0)), f"{stem}_k": (1.0, -273.15)}


# What is wanted -> accepted column names -> factor and offset to our unit.
QUANTITIES: dict[str, dict[str, tuple[float, float]]] = {
    "time": {
        **_SAME(("t_s", "time_s", "time", "t", "timestamp", "timestamp_s"), (1.0, 0.0)),
        **_SAME(("t_ms", "time_ms"), (1e-3, 0.0)),
    },
    "speed": {
        **_SAME(("n_rpm", "speed_rpm", "rpm", "n", "speed", "motor_speed", "motor_speed_rpm", "n_em_rpm"), (1.0, 0.0)),
        **_SAME(("omega_rad_s", "omega_radps", "speed_rad_s", "speed_radps"), (_RAD_S, 0.0)),
    },
    "torque": _SAME(
        ("torque_nm", "torque", "t_em_nm", "motor_torque", "motor_torque_nm", "torque_em_nm", "t_nm"), (1.0, 0.0)
    ),
    "winding temperature": _celsius("theta_w", "winding", "stator_winding", "winding_temperature"),
    "rotor temperature": _celsius("theta_r", "rotor", "pm", "magnet", "rotor_temperature"),
}
RATES: tuple[dict[str, tuple[float, float]], ...] = (
    _SAME(("dtheta_w_degc_s", "dtheta_w_c_s", "dtheta_w_cps", "dtheta_w_degcps"), (1.0, 0.0)),
    _SAME(("dtheta_r_degc_s", "dtheta_r_c_s", "dtheta_r_cps", "dtheta_r_degcps"), (1.0, 0.0)),
)
DRIVES = ("trajectory", "profile_id", "drive", "drive_id", "run_id")
_PLAUSIBLE = {
    "speed": (-60000.0, 60000.0, "rpm"),
    "torque": (-20000.0, 20000.0, "Nm"),
    "winding temperature": (-60.0, 400.0, "°C"),
    "rotor temperature": (-60.0, 400.0, "°C"),
}
READABLE = (".npz", ".csv", ".parquet", ".mcap")


def load_rows(path: Path, smooth_s: float | None = None) -> Rows:
    """Read drives for training or evaluation.

    Parameters
    ----------
    path : .npz (written by ``rt-runner dataset``), .csv, .parquet, or .mcap (our own log)
    smooth_s : window in s over which temperatures are smoothed before their rates are formed; None takes the
        shortest one that hides the sensors' resolution, usually none at all. Not for .npz.

    Raises
    ------
    DataError
        One line with file, line and what to do.
    """
    kind = path.suffix.lower()
    if kind == ".npz":
        return load_npz(path)
    if kind == ".csv":
        drives = _drives(_read_csv(path))
    elif kind in (".parquet", ".pq"):
        drives = _drives(_read_parquet(path))
    elif kind == ".mcap":
        from tools.tables_mcap import read_log_drives

        drives = read_log_drives(path)
    else:
        raise DataError(f"{path}: unknown kind of file; give one of {', '.join(READABLE)}")
    return to_rows(drives, str(path), smooth_s)


@dataclass(frozen=True, eq=False)
class _Raw:
    """A table as found: normalised column names, numbers (rows, columns; NaN: no number), where each row stood."""

    source: Path
    header: tuple[str, ...]
    titles: tuple[str, ...]
    values: Array
    places: Sequence[str]


def _drives(raw: _Raw) -> list[Drive]:
    """Choose the columns, convert, check, and cut a table into its drives."""
    columns = []
    for what, names in QUANTITIES.items():
        found = _column(raw, names, what)
        if found is None:
            raise DataError(f"{raw.source}: no column for {what}; name one {' or '.join(list(names)[:4])}")
        values = _finite(raw, found, names)
        if what in _PLAUSIBLE:
            _check_range(raw, found, values, what)
        columns.append(values)
    rate_columns = [_column(raw, names, "rate") for names in RATES]
    rates = None
    if all(index is not None for index in rate_columns):
        pairs = zip(rate_columns, RATES, strict=True)
        rates = np.stack([_finite(raw, index, names) for index, names in pairs if index is not None], axis=1)
    x = np.stack(columns[1:], axis=1)
    drive_column = _column(raw, dict.fromkeys(DRIVES, (1.0, 0.0)), "drive number")
    number = np.zeros(len(x)) if drive_column is None else _finite(raw, drive_column, {})
    starts: list[int] = np.flatnonzero(np.diff(number, prepend=np.nan)).tolist()
    drives = []
    for begin, end in zip(starts, [*starts[1:], len(x)], strict=True):
        t_s = columns[0][begin:end]
        falls = np.flatnonzero(np.diff(t_s) <= 0.0)
        if falls.size:
            raise DataError(
                f"{raw.source}:{raw.places[begin + int(falls[0]) + 1]}: time does not rise; sort the rows and remove "
                f"repeats, or number the drives in a column '{DRIVES[0]}'"
            )
        drives.append(Drive(t_s - t_s[0], x[begin:end], None if rates is None else rates[begin:end]))
    return drives


def _column(raw: _Raw, names: dict[str, tuple[float, float]], what: str) -> int | None:
    """Index of the one column that goes by one of the names."""
    found = [i for i, name in enumerate(raw.header) if name in names]
    if len(found) > 1:
        titles = ", ".join(f"'{raw.titles[i]}'" for i in found)
        raise DataError(f"{raw.source}: columns {titles} all name the {what}; rename or remove all but one")
    return found[0] if found else None


def _finite(raw: _Raw, column: int, names: dict[str, tuple[float, float]]) -> Array:
    factor, offset = names.get(raw.header[column], (1.0, 0.0))
    values = raw.values[:, column] * factor + offset
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise DataError(
            f"{raw.source}:{raw.places[int(bad[0])]}: column '{raw.titles[column]}' holds no finite number; correct "
            f"the value or delete the row"
        )
    return values


def _check_range(raw: _Raw, column: int, values: Array, what: str) -> None:
    low, high, unit = _PLAUSIBLE[what]
    bad = np.flatnonzero((values < low) | (values > high))
    if bad.size:
        row = int(bad[0])
        hint = f", or name the column '{raw.header[column]}_k' if it is in kelvin" if unit == "°C" else ""
        raise DataError(
            f"{raw.source}:{raw.places[row]}: {what} of {values[row]:g} {unit} in column '{raw.titles[column]}' is not "
            f"plausible ({low:g}..{high:g} {unit}); correct it{hint}"
        )


def _normalised(title: str) -> str:
    """``Speed [rpm]`` -> ``speed_rpm``, ``theta_w (°C)`` -> ``theta_w_c``."""
    return re.sub(r"[^a-z0-9]+", "_", title.strip().lower()).strip("_")


def _used(header: Sequence[str]) -> list[int]:
    known = {name for names in (*QUANTITIES.values(), *RATES, dict.fromkeys(DRIVES)) for name in names}
    return [i for i, name in enumerate(header) if name in known]


def _read_csv(path: Path) -> _Raw:
    """UTF-8, comma, semicolon (then with a decimal comma, too) or tab; the header in the first line."""
    places: list[str] = []
    rows: list[list[float]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            delimiter = max(",;\t", key=first.count)
            file.seek(0)
            reader = csv.reader(file, delimiter=delimiter)
            titles = [title.strip() for title in next(reader, [])]
            header = [_normalised(title) for title in titles]
            used = _used(header)
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                if len(cells) != len(header):
                    raise DataError(
                        f"{path}:{reader.line_num}: {len(cells)} cells but {len(header)} columns; complete the line"
                    )
                rows.append([_number(cells[i], delimiter) for i in used])
                places.append(str(reader.line_num))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8 CSV") from error
    except csv.Error as error:
        raise DataError(f"{path}:{len(places) + 2}: not CSV ({error}); save it as UTF-8 CSV") from error
    if not rows:
        raise DataError(f"{path}: no data below a header line; the first line must name the columns")
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(used))
    return _Raw(path, tuple(header[i] for i in used), tuple(titles[i] for i in used), values, places)


def _number(cell: str, delimiter: str) -> float:
    try:
        return float(cell.replace(",", ".") if delimiter == ";" else cell)
    except ValueError:
        return math.nan


def _read_parquet(path: Path) -> _Raw:
    if importlib.util.find_spec("pyarrow") is None:
        raise DataError(
            f"{path}: reading Parquet needs the package pyarrow: install the extra with pip install -e '.[train]'"
        )
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        schema = pq.read_schema(path)
        header = [_normalised(name) for name in schema.names]
        used = _used(header)
        table = pq.read_table(path, columns=[schema.names[i] for i in used])
    except OSError as error:  # ArrowInvalid is a ValueError, ArrowIOError an OSError
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except (pa.ArrowInvalid, ValueError) as error:
        raise DataError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]}); write it anew") from error
    columns = []
    for i, column in zip(used, table.columns, strict=True):
        name, kind = schema.names[i], column.type
        if pa.types.is_timestamp(kind):
            ns = column.cast(pa.timestamp("ns", tz=kind.tz)).cast(pa.int64()).to_numpy()
            columns.append((ns - ns[0]) * 1e-9 if len(ns) else ns.astype(np.float64))
        elif pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
            columns.append(column.cast(pa.float64()).to_numpy())
        else:
            raise DataError(f"{path}: column '{name}' holds {kind}, not numbers; store it as numbers")
    if not len(table):
        raise DataError(f"{path}: no rows; give a table with data")
    values = np.stack(columns, axis=1) if columns else np.empty((len(table), 0))
    names = tuple(schema.names[i] for i in used)
    places = [f"row {i + 1}" for i in range(len(table))]
    return _Raw(path, tuple(header[i] for i in used), names, values, places)
