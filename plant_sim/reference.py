"""The plant's 10-ms step in plain numpy: the readable definition that the compiled step is checked against.

Data flow of one step: reference -> driver -> torque lag -> losses -> thermal network; then the vehicle moves.
"""

from __future__ import annotations

from math import atan, exp

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle
from plant_sim.dq_map import build_dq_map
from plant_sim.driver import TorqueCommand, driver_step, linear_share, obey
from plant_sim.losses import LossModel
from plant_sim.lptn import DT_S, build_lptn
from plant_sim.network import build_network
from plant_sim.nodes import THETA_R, THETA_W
from plant_sim.params import PlantParams
from plant_sim.state import GRADE, INTEGRAL, N_ROW, TORQUE, V, X
from plant_sim.vehicle import motor_speed_rpm, motoring_limit_nm, regen_limit_nm, vehicle_step


class ReferenceEngine:
    """Runs the plant step by step in numpy (about 150 us per step).

    Parameters
    ----------
    params, cycle
        The plant and what it drives.
    """

    def __init__(self, params: PlantParams, cycle: Cycle) -> None:
        self._params, self._cycle = params, cycle
        self._lptn = build_lptn(params)
        self._losses = LossModel(params, build_network(params), build_dq_map(params.machine))
        self._lag = exp(-DT_S / params.machine.torque_lag_s)

    def run(
        self,
        ticks: int,
        tick: int,
        state: NDArray[np.float64],
        theta: NDArray[np.float64],
        boundary: NDArray[np.float64],
        derate: float,
        rule: tuple[float, float],
        stop: bool,
        command: TorqueCommand | None = None,
    ) -> NDArray[np.float64]:
        """Advance ``state`` (5,) and ``theta`` (70,) in place; return one row (8) per tick done.

        Parameters
        ----------
        ticks, tick
            How many steps, and the tick the state is at.
        boundary
            Coolant, ambient, gearbox temperature (3,).
        derate
            Fixed derating factor; multiplied with that of the rule.
        rule
            Linear derating on the true winding temperature (start, end) in degC; end <= start switches it
            off.
        stop
            Return early when the cycle's end is reached.
        command
            Torques to obey within the envelope instead of the driver; derating is then the sender's affair.
        """
        rows = np.empty((ticks, N_ROW))
        for k in range(ticks):
            factor = derate * linear_derate(theta[THETA_W], rule)
            rows[k] = self._step(tick + k, state, theta, boundary, factor, command)
            if stop and self._cycle.done((tick + k + 1) * DT_S, state[X]):
                return rows[: k + 1]
        return rows

    def _step(
        self,
        tick: int,
        s: NDArray[np.float64],
        theta: NDArray[np.float64],
        boundary: NDArray[np.float64],
        derate: float,
        order: TorqueCommand | None,
    ) -> tuple[float, ...]:
        p, cycle = self._params, self._cycle
        v_ref, slope = cycle.reference(tick * DT_S, s[X], p.driver.lookahead_m)
        if cycle.servo is not None:
            slope = self._servo_slope(tick, s, theta[THETA_W])

        speed = motor_speed_rpm(s[V], p.vehicle)
        drive_limit = motoring_limit_nm(speed, p.machine)
        regen_limit = regen_limit_nm(speed, s[V], p.machine)
        if order is None:
            command = driver_step(s[V], v_ref, s[INTEGRAL], drive_limit, regen_limit, derate, DT_S, p.driver)
        else:
            command = obey(order, s[V], v_ref, drive_limit, regen_limit, p.driver)
        lagged = self._lag * s[TORQUE] + (1.0 - self._lag) * (command.drive_nm + command.regen_nm)
        torque = min(max(lagged, -regen_limit), drive_limit)

        heat, _ = self._losses.heat(theta, torque, speed)
        theta[:] = self._lptn.step(theta, heat, speed, boundary)
        s[X], s[V] = vehicle_step(s[X], s[V], torque + command.friction_nm, slope, DT_S, p.vehicle)
        s[INTEGRAL], s[TORQUE] = command.integral_nm, torque
        theta_r = (theta[THETA_R[0]] + theta[THETA_R[1]] + theta[THETA_R[2]]) / 3.0
        return torque, speed, s[V], s[X], v_ref, slope, theta[THETA_W], theta_r

    def _servo_slope(self, tick: int, s: NDArray[np.float64], theta_w: float) -> float:
        """Slope of the grade servo; moves its filter state."""
        servo = self._cycle.servo
        assert servo is not None
        k = min(tick // round(1.0 / DT_S), servo.target_degc.size - 1)
        grade = servo.gain_1_k * (servo.target_degc[k] - theta_w) + servo.offset + servo.dither[k]
        grade = min(max(grade, servo.grade_min), servo.grade_max)
        s[GRADE] += DT_S / servo.filter_s * (grade - s[GRADE])
        return atan(s[GRADE]) if s[V] > servo.from_mps else 0.0


def linear_derate(theta_w_degc: float, rule: tuple[float, float]) -> float:
    """Linear rule: 1 below start, 0 above end (degC); 1 if switched off."""
    start, end = rule
    return linear_share(theta_w_degc, start, end) if end > start else 1.0
