"""Estimator settings: TOML files -> one constant table in C. The schema is here, the values in settings/*.toml."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import FormulationError

REMEDY = "see estimator_c/settings/default.toml for every field and its meaning"
PER_CHANNEL = "pair"


@dataclass(frozen=True)
class Field:
    """One setting: TOML table and key, C name and type, allowed range (inclusive), one line of meaning."""

    table: str
    key: str
    c_name: str
    kind: str  # "int" | "float" | "bool" | "pair" (one value per channel: winding, rotor) | "choice"
    low: float
    high: float
    meaning: str
    choices: tuple[str, ...] = ()  # of a "choice": the value is the index, in C an enumerator


ESTIMATORS = ("mhe", "ekf")
ARRIVALS = ("smoothed", "filter")
MODES = ("converged", "feedback")
LOSSES = ("quadratic", "huber", "geman-mcclure")
FIELDS = (
    Field("estimator", "kind", "kind", "choice", 0, 1, "whose estimate is published", ESTIMATORS),
    Field("sensor", "delay_steps", "delay_steps", "int", 0, 50, "sensor delay in intervals of 0.1 s"),
    Field("sensor", "offset_degc", "offset_degc", "float", -50, 50, "known sensor offset, subtracted"),
    Field("sensor", "offset_sigma_degc", "offset_sigma_degc", "float", 0, 50, "its standard deviation"),
    Field(
        "sensor",
        "timeout_s",
        "sensor_timeout_s",
        "float",
        0.1,
        60,
        "status 'predicting' after this long without a measurement",
    ),
    Field("sensor", "range_low_degc", "range_low_degc", "float", -273.15, 1000, "below: open circuit, no value"),
    Field("sensor", "range_high_degc", "range_high_degc", "float", -273.15, 1000, "above: short circuit, no value"),
    Field("sensor", "key_on_calibration", "key_on_calibration", "bool", 0, 1, "measure the offset at key-on"),
    Field("robust", "loss", "loss", "choice", 0, 2, "loss of a measurement's residual", LOSSES),
    Field("robust", "loss_scale_degc", "loss_scale_degc", "float", 1e-3, 1e6, "where the loss bends"),
    Field("robust", "supervise", "supervise", "bool", 0, 1, "watch the sensors and distrust a faulty one"),
    Field("robust", "gate_sigma", "gate_sigma", "float", 1, 100, "standard deviations beyond which a value is out"),
    Field("robust", "drift_degc", "drift_degc", PER_CHANNEL, 0.01, 1000, "slow innovation that means drift"),
    Field("robust", "open_loop_s", "open_loop_s", "float", 1, 3600, "distrust after which the status is open_loop"),
    Field("weights", "measurement", "weight_measurement", PER_CHANNEL, 0, 1e6, "Wy, 1/K^2"),
    Field("weights", "noise", "weight_noise", PER_CHANNEL, 1e-6, 1e9, "Ww, 1/K^2 per interval"),
    Field("weights", "arrival", "weight_arrival", PER_CHANNEL, 1e-9, 1e9, "P0 once the window is full, 1/K^2"),
    Field("weights", "arrival_from", "arrival_from", "choice", 0, 1, "prior of a full window", ARRIVALS),
    Field("weights", "prior", "weight_prior", PER_CHANNEL, 1e-9, 1e9, "P0 while the window grows, 1/K^2"),
    Field(
        "weights",
        "newest_measurement",
        "newest_measurement",
        "bool",
        0,
        1,
        "the newest node carries a measurement residual",
    ),
    Field("bounds", "hard", "hard_bounds", "bool", 0, 1, "bounds are a hard box, else a quadratic penalty"),
    Field("bounds", "lower_degc", "lower_degc", "float", -273.15, 1000, "lower bound on both temperatures"),
    Field("bounds", "upper_degc", "upper_degc", "float", -273.15, 1000, "upper bound on both temperatures"),
    Field("bounds", "weight", "bound_weight", "float", 0, 1e9, "penalty of soft bounds, 1/K^2 per node"),
    Field("solver", "mode", "mode", "choice", 0, 1, "publish the solution, or the first sweep's and solve on", MODES),
    Field("solver", "max_sweeps", "max_sweeps", "int", 1, 100, "most gradient sweeps per step"),
    Field("solver", "tolerance_degc", "tolerance_degc", "float", 0, 1, "stop when the next change is below this"),
    Field(
        "start",
        "spin_up_steps",
        "spin_up_steps",
        "int",
        0,
        2000,
        "steps of the net with the first input before the first node",
    ),
    Field(
        "start",
        "max_gap_steps",
        "max_gap_steps",
        "int",
        1,
        60,
        "intervals without motor frames bridged by holding; more restarts",
    ),
)


@dataclass(frozen=True)
class Setting:
    """One validated settings file; values are keyed by C name (int, float, bool or a pair of floats)."""

    name: str
    title: str
    id: int
    values: dict[str, Any]


def load_settings(folder: str | Path) -> list[Setting]:
    """All *.toml of a folder, ordered by id. Raises FormulationError with file, field and what to do."""
    paths = sorted(Path(folder).glob("*.toml"))
    if not paths:
        raise FormulationError(folder, "folder", "holds no *.toml settings", "give the folder with default.toml")
    settings = sorted((_load(path) for path in paths), key=lambda setting: setting.id)
    ids = [setting.id for setting in settings]
    if len(set(ids)) != len(ids):
        raise FormulationError(folder, "id", f"is used twice ({ids})", "give every settings file its own id")
    return settings


def _load(path: Path) -> Setting:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise FormulationError(path, "file", f"cannot be read ({err})", REMEDY) from err
    title, number = data.pop("title", ""), data.pop("id", None)
    if not isinstance(title, str):
        raise FormulationError(path, "title", "must be text", REMEDY)
    if type(number) is not int or not 0 <= number <= 254:
        raise FormulationError(path, "id", f"must be a whole number 0..254, is {number!r}", REMEDY)
    known = {(field.table, field.key) for field in FIELDS}
    for table, content in data.items():
        if not isinstance(content, dict):
            raise FormulationError(path, table, "is not a known field", REMEDY)
        for key in content:
            if (table, key) not in known:
                raise FormulationError(path, f"{table}.{key}", "is not a known field", REMEDY)
    values = {field.c_name: _value(path, field, data) for field in FIELDS}
    for table, low, high in (("bounds", "lower_degc", "upper_degc"), ("sensor", "range_low_degc", "range_high_degc")):
        if values[low] >= values[high]:
            raise FormulationError(path, table, f"{low} must lie below {high}", REMEDY)
    return Setting(path.stem, title, number, values)


def _value(path: Path, field: Field, data: dict[str, Any]) -> Any:
    where = f"{field.table}.{field.key}"
    if field.key not in data.get(field.table, {}):
        raise FormulationError(path, where, "is missing", REMEDY)
    found: Any = data[field.table][field.key]
    if field.kind == "bool":
        if type(found) is not bool:
            raise FormulationError(path, where, f"must be true or false, is {found!r}", REMEDY)
        return found
    if field.kind == "choice":
        if found not in field.choices:
            raise FormulationError(path, where, f"must be one of {', '.join(field.choices)}, is {found!r}", REMEDY)
        return field.choices.index(found)
    if field.kind == PER_CHANNEL:
        if not isinstance(found, list) or len(found) != 2:
            raise FormulationError(path, where, f"must be [winding, rotor], is {found!r}", REMEDY)
        return tuple(_number(path, where, field, item) for item in found)
    number = _number(path, where, field, found)
    return int(number) if field.kind == "int" else number


def _number(path: Path, where: str, field: Field, found: Any) -> float:
    right_type = type(found) is int or (type(found) is float and field.kind != "int")
    if not right_type or not math.isfinite(found) or not field.low <= found <= field.high:
        kind = "a whole number" if field.kind == "int" else "a number"
        raise FormulationError(path, where, f"must be {kind} in {field.low:g}..{field.high:g}, is {found!r}", REMEDY)
    return float(found)
