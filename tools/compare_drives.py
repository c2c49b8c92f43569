"""The lap as arrays, and what the bus would carry of it: the same numbers as in lock-step, without the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import CycleSpec
from plant_sim.faults import Fault
from plant_sim.mismatch import mismatched
from plant_sim.params import PlantParams, SensorParams, load_params
from plant_sim.plant import Plant
from plant_sim.sensors import TemperatureSensor
from plant_sim.state import ROW_SPEED, ROW_THETA_R, ROW_THETA_W, ROW_TORQUE
from rt_runner.dbc import Dbc, SignalInfo, load_dbc
from tools.estimators.drive import TICKS, Drive, interval_means

Array = NDArray[np.float64]
LAP_MAX_S = 3600.0
SENSOR_STREAM = 61  # the second word of the seed that Plant gives its sensors; a test holds the two together


@dataclass(frozen=True, eq=False)
class Lap:
    """One plant once around, from the start at 60 °C; row j ends at tick 10 (j + 1).

    Attributes
    ----------
    torque_nm, speed_rpm : (10 n,)
        As the bus carries them.
    u : (n, 2)
        Their means over the rows, [speed rpm, torque Nm].
    truth_degc : (n, 2)
        Winding and rotor at the end of each row.
    theta0_degc : (2,)
        The same at the start.
    sensor
        Delay and noise of the sensors.
    coolant_degc : (n,)
        As the bus carries it: once a second, NaN elsewhere. The machine never starts soaked here.
    """

    torque_nm: Array
    speed_rpm: Array
    u: Array
    truth_degc: Array
    theta0_degc: Array
    sensor: SensorParams
    coolant_degc: Array

    @property
    def t_s(self) -> Array:
        """Time at the end of each row, (n,)."""
        return 0.1 * np.arange(1, len(self.truth_degc) + 1, dtype=np.float64)


@cache
def _dbc() -> Dbc:
    return load_dbc()


def drive_lap(mismatch: str | None = None, spec: CycleSpec | None = None) -> Lap:
    """Drive the lap (or another cycle) with the plant as designed, or with a named mismatch."""
    params: PlantParams = load_params()
    if mismatch is not None:
        params = mismatched(params, mismatch)
    spec = CycleSpec("lap") if spec is None else spec
    plant = Plant(params, spec)
    rows = plant.record(round(LAP_MAX_S * 100))
    count = len(rows) // TICKS
    rows = rows[: count * TICKS]
    motor = _dbc()["MotorState"].signals
    torque = carried(motor, "torque_nm", rows[:, ROW_TORQUE])
    speed = carried(motor, "speed_rpm", rows[:, ROW_SPEED])
    return Lap(
        torque, speed, interval_means(torque, speed), rows[TICKS - 1 :: TICKS, [ROW_THETA_W, ROW_THETA_R]].copy(),
        np.full(2, spec.theta0_degc), params.sensor, _coolant(params.boundary.coolant_degc, count),
    )  # fmt: skip


def _coolant(inlet_degc: float, count: int) -> Array:
    """Of `count` rows: the frames at whole seconds."""
    once = carried(_dbc()["Coolant"].signals, "coolant_degc", np.array([inlet_degc]))[0]
    return np.where(np.arange(1, count + 1) % 10 == 0, once, np.nan)


def sense(lap: Lap, seed: int, faults: Sequence[Fault] = ()) -> Drive:
    """What the bus carries when this lap is measured by the sensors of a seed, with these faults."""
    rng = np.random.default_rng([seed, SENSOR_STREAM])
    read = TemperatureSensor(lap.sensor, lap.theta0_degc, rng, faults).sample(lap.truth_degc)
    signals = _dbc()["TempMeas"].signals
    names = ("theta_w_meas_degc", "theta_r_meas_degc")
    y = np.stack([carried(signals, name, read[:, k]) for k, name in enumerate(names)], axis=1)
    return Drive(lap.torque_nm, lap.speed_rpm, lap.u, y, coolant_degc=lap.coolant_degc)


def carried(signals: Sequence[SignalInfo], name: str, values: Array) -> Array:
    """Values as a receiver gets them back; NaN (not available) stays NaN."""
    signal = next(s for s in signals if s.name == name)
    return codes(signal, values) * signal.factor + signal.offset


def codes(signal: SignalInfo, values: Array) -> Array:
    """`SignalInfo.to_raw` for arrays: nearest valid code, ties away from zero; NaN stays NaN."""
    with np.errstate(over="ignore"):  # beyond the largest double is beyond the range, too
        scaled = np.clip((values - signal.offset) / signal.factor, signal.raw_min, signal.raw_max)
    whole = np.trunc(scaled)
    rest = scaled - whole
    return whole + np.where(rest >= 0.5, 1.0, 0.0) - np.where(rest <= -0.5, 1.0, 0.0)
