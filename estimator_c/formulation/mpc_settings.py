"""The controller's settings, settings/mpc/*.toml, as constant tables in C: mpc_settings.{h,c}. The schema is here.

`vehicle.toml` is what the controller believes of the car; every other file is one way to run the MPC.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import FormulationError

REMEDY = "see estimator_c/settings/mpc for every field and its meaning"
MODES = ("converged", "rti")
INTERVALS_MAX, SUBSTEPS_MAX = 40, 160


@dataclass(frozen=True)
class Number:
    """A number of a file: TOML table and key (its name in C too), range (inclusive), meaning."""

    table: str
    key: str
    low: float
    high: float
    meaning: str
    whole: bool = False


VEHICLE = (
    Number("vehicle", "mass_kg", 1, 1e5, "mass"),
    Number("vehicle", "drag_kg_m", 0, 100, "air drag over the square of the speed, 1/2 cd A rho"),
    Number("vehicle", "roll_coeff", 0, 1, "rolling resistance over weight"),
    Number("vehicle", "gravity_mps2", 1, 100, "gravity"),
    Number("vehicle", "gear_per_m", 0.1, 1000, "gear ratio over wheel radius"),
    Number("vehicle", "v_max_mps", 1, 200, "top speed"),
    Number("envelope", "drive_nm", 1, 1e5, "largest driving torque"),
    Number("envelope", "drive_w", 1, 1e7, "largest driving power"),
    Number("envelope", "regen_nm", 0, 1e5, "largest regenerating torque"),
    Number("envelope", "regen_w", 0, 1e7, "largest regenerating power"),
    Number("envelope", "regen_from_mps", 0, 100, "no regeneration below"),
    Number("envelope", "regen_full_mps", 0, 100, "all of it above"),
    Number("envelope", "friction_nm", 1, 1e5, "largest friction torque, at the motor's shaft"),
    Number("driver", "kp_nm_per_mps", 0, 1e5, "proportional gain"),
    Number("driver", "ki_nm_per_m", 0, 1e5, "integral gain"),
    Number("driver", "u_min_nm", -1e5, 0, "least torque asked for"),
    Number("driver", "u_max_nm", 0, 1e5, "most torque asked for"),
    Number("driver", "integral_max_nm", 0, 1e5, "limit of the integrator"),
)
SETTING = (
    Number("weights", "speed", 0, 1e6, "of (v - v_ref)^2, per s"),
    Number("weights", "friction", 1e-12, 1e6, "of the friction torque squared, per s"),
    Number("weights", "torque", 1e-12, 1e6, "of the motor torque squared, per s"),
    Number("weights", "torque_change", 0, 1e6, "of the change of the motor torque squared"),
    Number("weights", "slack", 0, 1e6, "of a temperature's excess, per K s"),
    Number("weights", "slack_square", 0, 1e6, "of its square, per K^2 s"),
    Number("weights", "above_reference", 0, 1e6, "of (v - v_ref)^2 where v > v_ref, per s"),
    Number("weights", "above_v_max", 0, 1e6, "of (v - v_max - 1 m/s)^2 and v^2 beyond the bounds, per s"),
    Number("limits", "theta_w_degc", 0, 500, "limit of the winding"),
    Number("limits", "theta_r_degc", 0, 500, "limit of the rotor"),
    Number("limits", "margin_min_k", 0, 100, "least margin of the winding's limit"),
    Number("limits", "margin_max_k", 0, 100, "largest one"),
    Number("limits", "margin_sigma", 0, 10, "standard deviations in the margin"),
    Number("solver", "max_iterations", 1, 100, "most linearisations per step", whole=True),
    Number("solver", "tolerance_nm", 0, 1, "converged when the next change of any torque is below"),
)


@dataclass(frozen=True)
class MpcSetting:
    """One validated settings file; `values` by key, `substeps` per interval, `mode` an index of MODES."""

    name: str
    title: str
    id: int
    substeps: tuple[int, ...]
    mode: int
    values: dict[str, float]

    @property
    def dt_s(self) -> tuple[float, ...]:
        """Length of each interval."""
        return tuple(0.1 * m for m in self.substeps)


def load_vehicle(folder: str | Path) -> dict[str, float]:
    """vehicle.toml of a folder by key. Raises FormulationError with file, field and what to do."""
    path = Path(folder) / "vehicle.toml"
    data = _read(path)
    _refuse_unknown(path, data, {(n.table, n.key) for n in VEHICLE})
    values = {n.key: _number(path, data, n) for n in VEHICLE}
    if values["regen_from_mps"] >= values["regen_full_mps"]:
        raise FormulationError(path, "envelope", "regen_from_mps must lie below regen_full_mps", REMEDY)
    return values


def load_mpc_settings(folder: str | Path) -> list[MpcSetting]:
    """All MPC settings of a folder, ordered by id. Raises FormulationError with file, field and what to do."""
    paths = [path for path in sorted(Path(folder).glob("*.toml")) if path.name != "vehicle.toml"]
    if not paths:
        raise FormulationError(folder, "folder", "holds no MPC settings", "give the folder with mpc-M.toml")
    settings = sorted((_load(path) for path in paths), key=lambda setting: setting.id)
    ids = [setting.id for setting in settings]
    if len(set(ids)) != len(ids):
        raise FormulationError(folder, "id", f"is used twice ({ids})", "give every settings file its own id")
    return settings


def _load(path: Path) -> MpcSetting:
    data = _read(path)
    title, number = data.pop("title", ""), data.pop("id", None)
    if not isinstance(title, str):
        raise FormulationError(path, "title", "must be text", REMEDY)
    if type(number) is not int or not 0 <= number <= 254:
        raise FormulationError(path, "id", f"must be a whole number 0..254, is {number!r}", REMEDY)
    known = {(n.table, n.key) for n in SETTING} | {("grid", "substeps"), ("solver", "mode")}
    _refuse_unknown(path, data, known)
    substeps = data.get("grid", {}).get("substeps")
    whole = isinstance(substeps, list) and all(type(m) is int and m >= 1 for m in substeps)
    if not isinstance(substeps, list) or not whole or not 2 <= len(substeps) <= INTERVALS_MAX:
        raise FormulationError(path, "grid.substeps", f"must be 2..{INTERVALS_MAX} whole numbers above 0", REMEDY)
    if sum(substeps) > SUBSTEPS_MAX:
        raise FormulationError(path, "grid.substeps", f"must not add up to more than {SUBSTEPS_MAX}", REMEDY)
    if substeps[0] != 1:
        raise FormulationError(path, "grid.substeps", "must begin with 1: the first torque holds for 0.1 s", REMEDY)
    mode = data.get("solver", {}).get("mode")
    if mode not in MODES:
        raise FormulationError(path, "solver.mode", f"must be one of {', '.join(MODES)}, is {mode!r}", REMEDY)
    values = {n.key: _number(path, data, n) for n in SETTING}
    if values["margin_min_k"] > values["margin_max_k"]:
        raise FormulationError(path, "limits", "margin_min_k must not be above margin_max_k", REMEDY)
    return MpcSetting(path.stem, title, number, tuple(substeps), MODES.index(mode), values)


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise FormulationError(path, "file", f"cannot be read ({err})", REMEDY) from err


def _refuse_unknown(path: Path, data: dict[str, Any], known: set[tuple[str, str]]) -> None:
    for table, content in data.items():
        if not isinstance(content, dict):
            raise FormulationError(path, table, "is not a known field", REMEDY)
        for key in content:
            if (table, key) not in known:
                raise FormulationError(path, f"{table}.{key}", "is not a known field", REMEDY)


def _number(path: Path, data: dict[str, Any], number: Number) -> float:
    where = f"{number.table}.{number.key}"
    found = data.get(number.table, {}).get(number.key)
    if found is None:
        raise FormulationError(path, where, "is missing", REMEDY)
    right_type = type(found) is int or (type(found) is float and not number.whole)
    if not right_type or not math.isfinite(found) or not number.low <= found <= number.high:
        kind = "a whole number" if number.whole else "a number"
        raise FormulationError(path, where, f"must be {kind} in {number.low:g}..{number.high:g}, is {found!r}", REMEDY)
    return int(found) if number.whole else float(found)


def settings_header(banner: str, count: int) -> str:
    """mpc_settings.h."""

    def members(numbers: tuple[Number, ...]) -> str:
        types = {True: "int32_t", False: "double"}
        return "\n".join(f"    {types[n.whole]} {n.key + ';':<24} /* {n.meaning} */" for n in numbers)

    modes = ", ".join(f"MPC_MODE_{mode.upper()} = {k}" for k, mode in enumerate(MODES))
    return f"""{banner}#ifndef MPC_SETTINGS_H
#define MPC_SETTINGS_H

#include <stdint.h>

#define MPC_SETTINGS_COUNT {count}
#define MPC_INTERVALS_MAX {INTERVALS_MAX}
#define MPC_SUBSTEPS_MAX {SUBSTEPS_MAX} /* of 0.1 s, over the horizon */

enum {{ {modes} }};

/* What the controller believes of the car. */
typedef struct mpc_vehicle {{
{members(VEHICLE)}
}} mpc_vehicle_t;

extern const mpc_vehicle_t mpc_vehicle;

/* One way to run the MPC. */
typedef struct mpc_setting {{
    const char *name;
    int32_t id;
    int32_t intervals;
    int32_t substeps[MPC_INTERVALS_MAX]; /* per interval */
    int32_t mode;                        /* MPC_MODE_... */
{members(SETTING)}
}} mpc_setting_t;

/* The settings compiled in, ordered by id. */
extern const mpc_setting_t mpc_settings[MPC_SETTINGS_COUNT];

/* The setting of that name, or NULL. Pure; any thread. */
const mpc_setting_t *mpc_setting_find(const char *name);

#endif
"""


def settings_source(banner: str, vehicle: dict[str, float], settings: list[MpcSetting]) -> str:
    """mpc_settings.c."""
    car = "\n".join(f"    .{key} = {value!r}," for key, value in vehicle.items())
    rows = []
    for setting in settings:
        lines = [f'.name = "{setting.name}",', f".id = {setting.id},", f".intervals = {len(setting.substeps)},"]
        lines += [f".substeps = {{{', '.join(map(str, setting.substeps))}}},", f".mode = {setting.mode},"]
        lines += [f".{key} = {value!r}," for key, value in setting.values.items()]
        rows.append("    {\n" + "\n".join(f"        {line}" for line in lines) + "\n    },")
    return f"""{banner}#include "mpc_settings.h"

#include <stddef.h>
#include <string.h>

const mpc_vehicle_t mpc_vehicle = {{
{car}
}};

const mpc_setting_t mpc_settings[MPC_SETTINGS_COUNT] = {{
{chr(10).join(rows)}
}};

const mpc_setting_t *mpc_setting_find(const char *name)
{{
    for (size_t k = 0; k < MPC_SETTINGS_COUNT; k++) {{
        if (strcmp(mpc_settings[k].name, name) == 0) {{
            return &mpc_settings[k];
        }}
    }}
    return NULL;
}}
"""
