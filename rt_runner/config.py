"""Scenarios: one TOML file says what is driven, sensed and demanded. What cannot be is refused here, before a start."""

import hashlib
import math
import os
import subprocess
import sys
import tomllib
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from rt_runner.errors import UsageError
from rt_runner.result import Limits
from rt_runner.timing_config import TimingConfig, check_timing, timing_from

TICK_S = 0.01  # the plant's step
START_MAX_S = 10_800.0
KEY_ON_MAX_S = 600.0
SCENARIO_DIR = Path(__file__).parent / "scenarios"


@dataclass(frozen=True)
class CycleConfig:
    """What is driven, and from where on; ``key_on_s`` of standstill come before it and count in the plant's time."""

    kind: str = "lap"
    path: str | None = None
    start_s: float = 0.0
    theta0_degc: float = 60.0
    key_on_s: float = 0.0


@dataclass(frozen=True)
class PlantConfig:
    """How the plant differs from the nominal one; scales and shares are factors."""

    coolant_flow_share: float = 1.0
    coolant_degc: float | None = None
    ac_loss_scale: float = 1.0
    resistance_scale: float = 1.0
    liner_contact_scale: float = 1.0


@dataclass(frozen=True)
class SensorConfig:
    """The two temperature sensors: y = theta(t - delay) + N(offset, variance)."""

    offset_degc: float = -1.0
    variance: float = 0.1
    delay_s: float = 1.5


@dataclass(frozen=True)
class EstimatorConfig:
    """Which named setting of the estimator, the period of its loop, and what releases its jobs.

    ``trigger``: "time", the grid of the period, or "frame", each TempMeas on its arrival.
    """

    setting: str = "default"
    period_s: float = 0.1
    trigger: str = "time"


CONTROLLERS = ("none", "rule-150-155", "rule-145-160", "mpc-S", "mpc-M", "paper")
NO_CONTROLLER = "off"
CONTROLLER_PERIODS_S = (0.01, 0.02, 0.05, 0.1)


@dataclass(frozen=True)
class ControllerConfig:
    """Which controller commands the torque, and the period of its loop; "off": the plant's own driver, no process."""

    name: str = NO_CONTROLLER
    period_s: float = 0.1

    @property
    def present(self) -> bool:
        """Whether there is one."""
        return self.name != NO_CONTROLLER


@dataclass(frozen=True)
class Scenario:
    """One scenario, checked. ``name`` is what the user typed, ``path`` the file it came from.

    ``faults`` are the file's sensor faults, ``added_faults`` those of the command line, as text: what they mean is the
    plant's business, see `check_faults`. ``sha256`` is of the file's bytes and, where there are any, of the latter:
    plant, estimator and log speak of one scenario by it.
    """

    name: str
    path: Path
    sha256: str
    title: str = ""
    duration_s: float = 0.0
    cycle: CycleConfig = field(default_factory=CycleConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    limits: Limits = field(default_factory=Limits)
    plant: PlantConfig = field(default_factory=PlantConfig)
    faults: tuple[str, ...] = ()
    added_faults: tuple[str, ...] = ()

    @property
    def all_faults(self) -> tuple[str, ...]:
        """The file's sensor faults, then those of the command line."""
        return self.faults + self.added_faults


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the project."""
    return sorted(p.stem for p in SCENARIO_DIR.glob("*.toml"))


def load_scenario(name_or_path: str) -> Scenario:
    """Read and check a scenario by name, or by the path of a TOML file.

    Raises
    ------
    UsageError
        Unknown name, unreadable file, unknown or ill-typed key, or a value that cannot be.
    """
    path = SCENARIO_DIR / f"{name_or_path}.toml"
    if name_or_path.endswith(".toml") or "/" in name_or_path:
        path = Path(name_or_path)
    elif name_or_path not in scenario_names():
        raise UsageError(
            f"unknown scenario '{name_or_path}': choose one of {', '.join(scenario_names())}, "
            "or give the path of a .toml file"
        )
    try:
        raw = path.read_bytes()
        tree = tomllib.loads(raw.decode())
    except OSError as e:
        raise UsageError(f"cannot read scenario {path}: {e.strerror}") from e
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise UsageError(f"scenario {path} is not valid TOML: {e}") from e
    scenario = _build(tree, name_or_path if path.parent == SCENARIO_DIR else path.stem, path.resolve(), raw)
    _check(scenario)
    return scenario


def _build(tree: dict, name: str, path: Path, raw: bytes) -> Scenario:
    tables = {
        "cycle": CycleConfig,
        "plant": PlantConfig,
        "sensor": SensorConfig,
        "estimator": EstimatorConfig,
        "controller": ControllerConfig,
        "limits": Limits,
    }
    values: dict = {"name": name, "path": path, "sha256": hashlib.sha256(raw).hexdigest()}
    for key, value in tree.items():
        if key in tables:
            if not isinstance(value, dict):
                raise UsageError(f"scenario {path}: '{key}' must be a table")
            values[key] = _table(tables[key], value, f"scenario {path}, [{key}]")
        elif key == "timing":
            if not isinstance(value, dict):
                raise UsageError(f"scenario {path}: 'timing' must be a table")
            values[key] = timing_from(value, f"scenario {path}, [timing]")
        elif key in ("title", "duration_s"):
            values[key] = _typed(value, str if key == "title" else float, f"scenario {path}: {key}")
        elif key == "faults":
            if not (isinstance(value, list) and all(isinstance(fault, str) for fault in value)):
                raise UsageError(f"scenario {path}: faults must be a list of texts such as 'offset:-20@430-550'")
            values[key] = tuple(value)
        else:
            known = ", ".join(("title", "duration_s", "faults", "timing", *tables))
            raise UsageError(f"scenario {path}: unknown key '{key}' (known: {known})")
    return Scenario(**values)


def _table(cls, values: dict, where: str):
    known = {f.name: f for f in fields(cls)}
    for key in values:
        if key not in known:
            raise UsageError(f"{where}: unknown key '{key}' (known: {', '.join(known)})")
    texts = ("kind", "path", "setting", "name", "trigger")
    return cls(**{k: _typed(v, str if k in texts else float, f"{where} {k}") for k, v in values.items()})


def _typed(value, want: type, where: str):
    if want is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, want):
        return value
    raise UsageError(f"{where} = {value!r}: must be a {'number' if want is float else 'text'}")


def _check(s: Scenario) -> None:
    def refuse(why: str) -> None:
        raise UsageError(f"scenario {s.path}: {why}")

    if s.cycle.kind not in ("lap", "class3", "csv"):
        refuse(f"[cycle] kind = '{s.cycle.kind}' is none of lap, class3, csv")
    if (s.cycle.kind == "csv") != (s.cycle.path is not None):
        refuse('[cycle] path belongs to kind = "csv", and that kind needs it')
    if s.cycle.path is not None and not (s.path.parent / s.cycle.path).is_file():
        refuse(f"[cycle] path: no file {s.path.parent / s.cycle.path}")
    if not (s.duration_s == 0 or TICK_S <= s.duration_s < math.inf):
        refuse(f"duration_s must be 0 (to the end of the cycle), or {TICK_S:g} s or more")
    if not 0 <= s.cycle.start_s <= START_MAX_S:
        refuse(f"[cycle] start_s must lie in 0 … {START_MAX_S:g}: the plant is driven up to there before the start")
    if not 0 <= s.cycle.key_on_s <= KEY_ON_MAX_S or abs(s.cycle.key_on_s * 100 - round(s.cycle.key_on_s * 100)) > 1e-6:
        refuse(f"[cycle] key_on_s must lie in 0 … {KEY_ON_MAX_S:g} in steps of {TICK_S:g} s")
    if s.cycle.key_on_s and s.cycle.start_s:
        refuse("[cycle] key_on_s is the run's beginning: it needs start_s = 0")
    p = s.plant
    if not all(0 < x <= 10 for x in (p.coolant_flow_share, p.ac_loss_scale, p.resistance_scale, p.liner_contact_scale)):
        refuse("[plant] shares and scales must be above 0 and at most 10")
    if p.coolant_degc is not None and not -40 <= p.coolant_degc <= 120:
        refuse("[plant] coolant_degc must lie in -40 … 120")
    if not -40 <= s.cycle.theta0_degc <= 200:
        refuse("[cycle] theta0_degc must lie in -40 … 200")
    if not (0 <= s.sensor.variance < math.inf and 0 <= s.sensor.delay_s <= 10 and abs(s.sensor.offset_degc) <= 100):
        refuse("[sensor] needs variance >= 0, delay_s in 0 … 10, |offset_degc| <= 100")
    check_period(s.estimator.period_s, f"scenario {s.path}: [estimator] period_s")
    check_timing(s.timing, s.estimator.period_s, s.estimator.trigger, f"scenario {s.path}: [timing]")
    check_controller(s, f"scenario {s.path}: [controller]")
    if not (0 < s.limits.miss_rate_max < 1):
        refuse("[limits] miss_rate_max must lie between 0 and 1")
    if not (s.limits.theta_w_rmse_max_degc > 0 and s.limits.theta_r_rmse_max_degc > 0):
        refuse("[limits] temperature limits must be positive")


def check_period(period_s: float, what: str) -> None:
    """Refuse an estimator period that is not 1 ms … 1 s in whole microseconds."""
    us = period_s * 1e6
    if not (1000 <= us <= 1_000_000) or abs(us - round(us)) > 1e-6:
        raise UsageError(f"{what} = {period_s:g}: must be 0.001 … 1 s in whole microseconds")


def check_controller(s: Scenario, what: str) -> None:
    """Refuse a controller that is none of ours, one at a period it does not know, or one on a road over time."""
    c = s.controller
    if c.name not in (NO_CONTROLLER, *CONTROLLERS):
        raise UsageError(f"{what}: '{c.name}' is none of {', '.join((NO_CONTROLLER, *CONTROLLERS))}")
    if c.period_s not in CONTROLLER_PERIODS_S:
        known = ", ".join(f"{p:g}" for p in CONTROLLER_PERIODS_S)
        raise UsageError(f"{what}: period_s = {c.period_s:g} is none of {known}")
    if c.present and s.cycle.kind == "class3":
        raise UsageError(f"{what}: a controller looks ahead by distance, and class3 is a cycle over time; drive a lap")


def with_duration(s: Scenario, duration_s: float | None) -> Scenario:
    """The scenario with its duration replaced, where one is given."""
    if duration_s is None:
        return s
    if not TICK_S <= duration_s < math.inf:
        raise UsageError(f"--duration {duration_s:g}: must be {TICK_S:g} s or more")
    return replace(s, duration_s=duration_s)


def with_faults(s: Scenario, faults: list[str] | None) -> Scenario:
    """The scenario with sensor faults added, where some are given; its hash then stands for the file and for them."""
    for fault in faults or ():
        digest = hashlib.sha256(f"{s.sha256} {fault}".encode()).hexdigest()
        s = replace(s, added_faults=(*s.added_faults, fault), sha256=digest)
    return s


def check_faults(s: Scenario) -> None:
    """Have the plant's package read the scenario's sensor faults: what cannot be is refused before anything starts.

    Raises
    ------
    UsageError
        A fault is not understood, impossible, in conflict with another one, or outside the run.
    """
    if not s.all_faults:
        return
    end_s = s.cycle.start_s + s.duration_s if s.duration_s else math.inf
    command = [sys.executable, "-m", "plant_sim.faults", str(s.cycle.start_s), str(end_s), *s.all_faults]
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise UsageError(lines[-1] if lines else f"plant_sim.faults ended with exit status {done.returncode}")
