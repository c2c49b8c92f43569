"""The plant as one object: step it live, advance it fast, or simulate whole runs.

Pure core: no clock, no socket, no file beyond parameters and cycle at construction, no global random state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle, CycleSpec, build_cycle
from plant_sim.driver import TorqueCommand
from plant_sim.errors import PlantStateError
from plant_sim.faults import Fault, active_faults
from plant_sim.lptn import DT_S
from plant_sim.nodes import AMBIENT, COOLANT, HOT_SPOT, N_NODES, THETA_R, THETA_W
from plant_sim.params import PlantParams
from plant_sim.sensors import TemperatureSensor
from plant_sim.state import (
    N_STATE,
    ROW_SLOPE,
    ROW_SPEED,
    ROW_THETA_R,
    ROW_THETA_W,
    ROW_TORQUE,
    ROW_V,
    ROW_V_REF,
    ROW_X,
    X,
)

TICKS_PER_SAMPLE = 10
NO_RULE = (0.0, 0.0)
KEY_ON_MAX_S = 600.0
SOAKED_WITHIN_K = 0.5
STANDSTILL = Cycle("standstill", False, 1.0, np.zeros(2), np.zeros(2))
Engine = Literal["numba", "numpy"]


@dataclass(frozen=True)
class PlantSample:
    """The plant at tick k, that is at t = k * 0.01 s.

    Attributes
    ----------
    torque_nm, speed_rpm, v_ref_mps, slope_rad
        What acted over the step that ENDED at this tick. The mean over ticks 10j+1 .. 10j+10 is therefore
        the input of the 0.1-s interval j.
    v_mps, x_m, theta_w_degc, theta_r_degc
        State at this tick (truth).
    done
        Whether the cycle's end has been reached.
    theta_w_meas_degc, theta_r_meas_degc
        Sensor readings at every tenth tick, else None; NaN: the sensor gives no value.
    coolant_degc, ambient_degc
        What flows in and what is around.
    soaked
        Whether the whole machine has stood long enough to have the coolant's temperature: key-on only.
    fault_w, fault_r
        Truth: bit masks of the sensor faults at this tick, see `plant_sim.faults.KINDS`.
    """

    tick: int
    t_s: float
    torque_nm: float
    speed_rpm: float
    v_mps: float
    x_m: float
    v_ref_mps: float
    slope_rad: float
    theta_w_degc: float
    theta_r_degc: float
    done: bool
    theta_w_meas_degc: float | None = None
    theta_r_meas_degc: float | None = None
    coolant_degc: float = np.nan
    ambient_degc: float = np.nan
    soaked: bool = False
    fault_w: int = 0
    fault_r: int = 0


class Plant:
    """Vehicle, driver, machine, thermal network and sensors on one cycle.

    Parameters
    ----------
    params
        Physical parameters (truth).
    cycle
        What to drive: a specification or a built cycle.
    theta0_degc
        Start temperature of all nodes, or one value per node (70,); None takes the specification's (60 for a
        built cycle).
    seed
        Seed of the sensor noise.
    engine
        ``numba`` (compiled) or ``numpy`` (the readable reference); both give the same run within rounding.
    faults
        What is wrong with the sensors, when; times count from the plant's start.
    key_on_s
        Standstill before the cycle: no speed, no torque, coolant running. Ticks count through it from 0, the cycle's
        own time starts behind it.
    """

    def __init__(
        self,
        params: PlantParams,
        cycle: CycleSpec | Cycle,
        theta0_degc: float | NDArray[np.float64] | None = None,
        seed: int = 0,
        engine: Engine = "numba",
        faults: Sequence[Fault] = (),
        key_on_s: float = 0.0,
    ) -> None:
        if theta0_degc is None:
            theta0_degc = cycle.theta0_degc if isinstance(cycle, CycleSpec) else 60.0
        self.params = params
        self.cycle = build_cycle(cycle, params) if isinstance(cycle, CycleSpec) else cycle
        self._engine = _make_engine(engine, params, self.cycle)
        self._key_on_ticks = round(key_on_s / DT_S)
        if not 0.0 <= key_on_s <= KEY_ON_MAX_S or abs(self._key_on_ticks * DT_S - key_on_s) > 1e-6:
            raise PlantStateError(f"key-on of {key_on_s} s: give 0 to {KEY_ON_MAX_S:g} s in steps of {DT_S} s")
        self._standing = _make_engine(engine, params, STANDSTILL) if self._key_on_ticks else self._engine
        self._theta = np.array(np.broadcast_to(np.asarray(theta0_degc, dtype=float), (N_NODES,)))
        if not np.isfinite(self._theta).all():
            raise PlantStateError("start temperature is not finite; give degC for all nodes")
        self._state = np.zeros(N_STATE)
        self._tick = 0
        b = params.boundary
        self._boundary = np.array([b.coolant_degc, b.ambient_degc, b.gearbox_degc])
        self._soaked = bool(np.all(np.abs(self._theta - b.coolant_degc) <= SOAKED_WITHIN_K))
        self.faults = tuple(faults)
        self._sensor = TemperatureSensor(
            params.sensor, self._theta_pair(), np.random.default_rng([seed, 61]), self.faults
        )

    @property
    def tick(self) -> int:
        """Steps of 10 ms since the start of the cycle."""
        return self._tick

    @property
    def theta_degc(self) -> NDArray[np.float64]:
        """All 70 node temperatures (a copy)."""
        return self._theta.copy()

    @property
    def hot_spot_degc(self) -> float:
        """Hottest copper: slot core of the inner layer, a few kelvin above theta_w."""
        return float(self._theta[HOT_SPOT])

    @property
    def done(self) -> bool:
        """Whether the cycle's end has been reached."""
        driven = self._tick - self._key_on_ticks
        return driven > 0 and self.cycle.done(driven * DT_S, float(self._state[X]))

    @property
    def driving(self) -> bool:
        """Whether the next step is one of the cycle: not of the standstill at key-on."""
        return self._tick >= self._key_on_ticks

    @property
    def soaked(self) -> bool:
        """Whether this is the standstill at key-on, started at the coolant's temperature."""
        return self._soaked and self._tick <= self._key_on_ticks

    def active_faults(self, t_s: float) -> tuple[int, int]:
        """Bit masks (winding, rotor) of the sensor faults at a time (s since the plant's start)."""
        return active_faults(self.faults, t_s)

    def set_boundary(self, coolant_degc: float, ambient_degc: float, gearbox_degc: float) -> None:
        """Change the surroundings from the next step on."""
        self._boundary[:] = coolant_degc, ambient_degc, gearbox_degc

    def step(self, derate: float = 1.0, command: TorqueCommand | None = None) -> PlantSample:
        """Advance by 10 ms under a derating factor, or obeying a command, and return the new sample.

        Past the cycle's end the plant goes on with the last reference; ``done`` stays true. A command replaces the
        driver and is clipped to the envelope; derating is its sender's affair then. The driver follows what is
        commanded, so that it can take over without a jump. At key-on the car stands, whatever is commanded.

        Raises
        ------
        PlantStateError
            If the factor is not within 0..1, or a commanded torque is not finite.
        """
        row, measured = self._advance(1, derate, NO_RULE, False, command)
        r = row[0]
        meas_w, meas_r = measured[0].tolist() if measured.size else (None, None)
        fault_w, fault_r = self.active_faults(self._tick * DT_S)
        return PlantSample(
            self._tick,
            self._tick * DT_S,
            float(r[ROW_TORQUE]),
            float(r[ROW_SPEED]),
            float(r[ROW_V]),
            float(r[ROW_X]),
            float(r[ROW_V_REF]),
            float(r[ROW_SLOPE]),
            float(r[ROW_THETA_W]),
            float(r[ROW_THETA_R]),
            self.done,
            meas_w,
            meas_r,
            float(self._boundary[COOLANT]),
            float(self._boundary[AMBIENT]),
            self.soaked,
            fault_w,
            fault_r,
        )

    def advance(self, seconds: float, derate: float = 1.0) -> None:
        """Advance many steps at once; leaves the state that stepping would, sensor history and noise too."""
        ticks = round(seconds / DT_S)
        if ticks < 0 or abs(ticks * DT_S - seconds) > 1e-6:
            raise PlantStateError(f"cannot advance by {seconds} s: give a non-negative multiple of {DT_S} s")
        while ticks > 0:
            chunk = min(ticks, 100_000)
            self._advance(chunk, derate, NO_RULE, False)
            ticks -= chunk

    def record(
        self, ticks: int, derate: float = 1.0, rule_degc: tuple[float, float] = NO_RULE, stop: bool = True
    ) -> NDArray[np.float64]:
        """Advance up to ``ticks`` steps (``stop``: to the cycle's end); return their rows (n, 8)."""
        return self._advance(ticks, derate, rule_degc, stop)[0]

    def drive(
        self, ticks: int, derate: float = 1.0, command: TorqueCommand | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Advance ``ticks`` steps as `step` would; return their rows (n, 8) and the sensor readings due (m, 2)."""
        return self._advance(ticks, derate, NO_RULE, False, command)

    def _advance(
        self,
        ticks: int,
        derate: float,
        rule: tuple[float, float],
        stop: bool,
        command: TorqueCommand | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if not 0.0 <= derate <= 1.0:
            raise PlantStateError(f"derating factor {derate} is outside 0..1")
        if command is not None and not np.isfinite(command).all():
            raise PlantStateError(f"{command}: a commanded torque is not finite; send no command instead")
        standing = min(max(self._key_on_ticks - self._tick, 0), ticks)
        rows = self._run(self._standing, standing, self._tick, derate, rule, False, None)
        if ticks > standing or not standing:
            driven = self._tick + standing - self._key_on_ticks
            moving = self._run(self._engine, ticks - standing, driven, derate, rule, stop, command)
            rows = np.concatenate([rows, moving]) if standing else moving
        first = -(self._tick + 1) % TICKS_PER_SAMPLE
        self._tick += rows.shape[0]
        due = rows[first::TICKS_PER_SAMPLE, ROW_THETA_W : ROW_THETA_R + 1]
        return rows, self._sensor.sample(due) if due.size else due

    def _run(
        self,
        engine,
        ticks: int,
        tick: int,
        derate: float,
        rule: tuple[float, float],
        stop: bool,
        command: TorqueCommand | None,
    ) -> NDArray[np.float64]:
        return engine.run(ticks, tick, self._state, self._theta, self._boundary, derate, rule, stop, command)

    def _theta_pair(self) -> NDArray[np.float64]:
        t = self._theta
        return np.array([t[THETA_W], (t[THETA_R[0]] + t[THETA_R[1]] + t[THETA_R[2]]) / 3.0])


def _make_engine(name: str, params: PlantParams, cycle: Cycle):
    if name == "numba":
        from plant_sim.kernel import CompiledEngine

        return CompiledEngine(params, cycle)
    if name == "numpy":
        from plant_sim.reference import ReferenceEngine

        return ReferenceEngine(params, cycle)
    raise PlantStateError(f"unknown engine '{name}': use 'numba' or 'numpy'")
