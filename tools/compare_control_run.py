"""One lap under one controller: plant, estimator and controller in this process, with the numbers of the bus.

No clock, no frames: a test shows that commands and temperatures are those of `rt-runner mil`, to the last bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import CycleSpec
from plant_sim.driver import TorqueCommand
from plant_sim.faults import Fault
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.state import ROW_SPEED, ROW_THETA_R, ROW_THETA_W, ROW_TORQUE, ROW_V, ROW_V_REF, ROW_X
from rt_runner.dbc import SignalInfo, load_dbc
from tools import libctl, libest
from tools.estimators.core import SIGMA, STATUS, THETA, UPPER

Array = NDArray[np.float64]
TICKS = 10
TICK_S = 0.01
ESTIMATES = (2, 3, 6, 7)  # Estimate.status: ok, predicting, open_loop, fallback
LAP_MAX_S = 1500.0
LIMIT_DEGC = 155.0
W_PER_RPM_NM = math.pi / 30.0


@dataclass(frozen=True)
class Belief:
    """What the controller is told of the temperatures; NaN: not available."""

    theta_w_degc: float
    theta_r_degc: float
    sigma_degc: float = math.nan
    upper_degc: float = math.nan
    usable: bool = True


class Feedback(Protocol):
    """Where the controller's temperatures come from."""

    def __call__(self, rows: Array, measured: Array) -> Belief:
        """Of ten ticks of the plant and the readings at their end."""
        ...


@cache
def _signals(message: str) -> dict[str, SignalInfo]:
    return {s.name: s for s in load_dbc()[message].signals}


def carried(message: str, name: str, value: float) -> float:
    """A value as a receiver gets it back; NaN (not available) stays NaN."""
    signal = _signals(message)[name]
    return value if math.isnan(value) else signal.to_raw(value) * signal.factor + signal.offset


class Ideal:
    """The truth."""

    def __call__(self, rows: Array, measured: Array) -> Belief:
        return Belief(float(rows[-1, ROW_THETA_W]), float(rows[-1, ROW_THETA_R]))


class Raw:
    """The sensors' readings as they are."""

    def __call__(self, rows: Array, measured: Array) -> Belief:
        w, r = (carried("TempMeas", f"theta_{c}_meas_degc", float(measured[-1, k])) for k, c in enumerate("wr"))
        return Belief(w, r)


class Estimated:
    """A setting of the estimator's C core, fed and read as over the bus."""

    def __init__(self, setting: str, coolant_degc: float) -> None:
        lib = libest.load()
        self._core = libest.Estimator(lib, lib.setting(setting))
        self._coolant_degc = carried("Coolant", "coolant_degc", coolant_degc)
        self._tick = 0

    def __call__(self, rows: Array, measured: Array) -> Belief:
        torque = [carried("MotorState", "torque_nm", x) for x in rows[:, ROW_TORQUE].tolist()]
        speed = [carried("MotorState", "speed_rpm", x) for x in rows[:, ROW_SPEED].tolist()]
        y = [carried("TempMeas", f"theta_{c}_meas_degc", float(measured[-1, k])) for k, c in enumerate("wr")]
        coolant = self._coolant_degc if (self._tick + TICKS) % 100 == 0 else math.nan
        out = self._core.run(torque, speed, [y], self._tick, [coolant], [False])[0]
        self._tick += TICKS
        w, r = (carried("Estimate", f"theta_{c}_est_degc", float(t)) for c, t in zip("wr", out[THETA], strict=True))
        sigma = carried("EstWinding", "sigma_w_degc", float(out[SIGMA][0]))
        upper = carried("EstWinding", "upper_w_degc", float(out[UPPER][0]))
        return Belief(w, r, sigma, upper, int(out[STATUS]) in ESTIMATES)


FEEDBACKS: dict[str, Callable[[float], Feedback]] = {
    "ideal": lambda coolant: Ideal(),
    "raw": lambda coolant: Raw(),
    "paper": lambda coolant: Estimated("paper", coolant),
    "default": lambda coolant: Estimated("default", coolant),
}


@dataclass(frozen=True, eq=False)
class Lap:
    """A drive under a controller.

    Attributes
    ----------
    rows : (n, 8)
        Of the plant, one per tick.
    commands : (n / 10, 3)
        Accelerating, braking, friction torque of each interval's end; NaN: the controller had nothing to say.
    solve_us : (n / 10,)
        Processor time of each step of the controller.
    finish_s
        When the end of the cycle was passed; None: it was not.
    """

    rows: Array
    commands: Array
    solve_us: Array
    finish_s: float | None


def drive(
    controller: str, feedback: str, faults: tuple[Fault, ...] = (), seconds: float = LAP_MAX_S, seed: int = 1
) -> Lap:
    """Drive the lap from a cold start, or its first seconds."""
    params = load_params()
    plant = Plant(params, CycleSpec("lap"), seed=seed, faults=faults)
    lib = libctl.Lib(libest.load().path)
    cycle = plant.cycle
    core = libctl.Controller(lib, controller, cycle.v_ref_mps, cycle.slope_rad, cycle.step)
    if core.error:
        raise ValueError(f"controller '{controller}' is not in {lib.path} (error {core.error}): run 'make build'")
    believe = FEEDBACKS[feedback](params.boundary.coolant_degc)
    command: TorqueCommand | None = None
    rows, commands, solve_us, done = [], [], [], False
    while not done and len(rows) * TICKS * TICK_S < seconds - 1e-9:
        ten, measured = plant.drive(TICKS, command=command)
        rows.append(ten)
        done = plant.done
        _feed(core, ten, believe(ten, measured))
        begun = time.thread_time_ns()
        out = core.step()
        solve_us.append((time.thread_time_ns() - begun) / 1e3)
        command = _command(out, controller != "none")
        commands.append((math.nan,) * 3 if command is None else tuple(command))
    every = np.concatenate(rows)
    return Lap(every, np.array(commands), np.array(solve_us), _finish_s(every, cycle.end))


def _feed(core: libctl.Controller, rows: Array, belief: Belief) -> None:
    for torque, speed in rows[:, [ROW_TORQUE, ROW_SPEED]].tolist():
        core.motor(carried("MotorState", "torque_nm", torque), carried("MotorState", "speed_rpm", speed))
    x, v = float(rows[-1, ROW_X]), float(rows[-1, ROW_V])
    core.motion(carried("VehicleState", "distance_m", x), carried("VehicleState", "v_mps", v))
    core.estimate(belief.theta_w_degc, belief.theta_r_degc, belief.sigma_degc, belief.upper_degc, belief.usable)


def _command(out: libctl.Out, needs_estimate: bool) -> TorqueCommand | None:
    """As the plant gets it; before the first estimate there is none, and the plant's own driver drives on."""
    if needs_estimate and math.isnan(out.theta_w_degc):
        return None
    acc = carried("TorqueCommand", "torque_acc_nm", out.drive_nm)
    brake = carried("TorqueCommand", "torque_brk_nm", -out.regen_nm)
    friction = carried("TorqueCommand", "torque_fric_nm", -out.friction_nm)
    return TorqueCommand(acc, -brake, -friction)


def _finish_s(rows: Array, end_m: float) -> float | None:
    over = rows[:, ROW_X] >= end_m - 1e-9
    return TICK_S * (int(over.argmax()) + 1) if over.any() else None


def figures(lap: Lap) -> dict[str, float | dict[str, float] | None]:
    """What a lap is judged by: time, net energy at the shaft, heat, speed kept, processor time of a step."""
    end = len(lap.rows) if lap.finish_s is None else round(lap.finish_s / TICK_S)
    rows = lap.rows[:end]
    power_w = rows[:, ROW_TORQUE] * rows[:, ROW_SPEED] * W_PER_RPM_NM
    excess = np.maximum(rows[:, ROW_THETA_W] - LIMIT_DEGC, 0.0)
    p50, p99, most = np.percentile(lap.solve_us, [50, 99, 100])
    return {
        "lap_s": None if lap.finish_s is None else round(lap.finish_s, 2),
        "energy_kwh": round(float(power_w.sum()) * TICK_S / 3.6e6, 4),
        "theta_w_max_degc": round(float(rows[:, ROW_THETA_W].max()), 3),
        "ks_above_155": round(float(excess.sum()) * TICK_S, 3),
        "v_rms": round(float(np.sqrt(np.mean((rows[:, ROW_V_REF] - rows[:, ROW_V]) ** 2))), 4),
        "solve_us": {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "max": round(float(most), 1)},
    }
