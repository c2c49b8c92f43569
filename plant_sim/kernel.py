"""The plant's 10-ms step compiled with numba, for live stepping and for hours of training data.

Same equations and order as `plant_sim.reference`, written as one loop over plain arrays. A test holds the
two together.
"""

from __future__ import annotations

from functools import lru_cache
from math import atan, cos, exp, pi, sin, tanh
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import Cycle
from plant_sim.dq_map import SPEED_STEP_RPM, THETA_GRID, TORQUE_STEP_NM, build_dq_map
from plant_sim.driver import STANDSTILL_MPS, TorqueCommand
from plant_sim.jit import compiled
from plant_sim.losses import LossModel
from plant_sim.lptn import DT_S, GRID_RPM, build_lptn
from plant_sim.network import build_network
from plant_sim.nodes import N_NODES, THETA_R, THETA_W
from plant_sim.params import PlantParams
from plant_sim.state import GRADE, INTEGRAL, N_ROW, TORQUE, V, X
from plant_sim.vehicle import ROLLING_FROM_MPS

_R0, _R1, _R2 = THETA_R
NO_COMMAND = TorqueCommand(0.0, 0.0, 0.0)
_DQ_THETA0 = float(THETA_GRID[0])
_TICKS_PER_SERVO = round(1.0 / DT_S)


class Scalars(NamedTuple):
    """Every figure the loop needs; names as in the parameter file, or derived once."""

    mass: float
    drag: float
    roll: float
    gravity: float
    force_per_nm: float
    rpm_per_mps: float
    torque_max: float
    power_max: float
    regen_torque: float
    regen_power: float
    regen_lo: float
    regen_hi: float
    lag: float
    kp: float
    ki: float
    u_min: float
    u_max: float
    integral_max: float
    lookahead: float
    i_max: float
    pole_pairs: float
    alpha: float
    copper: float
    ac: float
    n_base: float
    b_tooth: float
    b_tooth_slope: float
    b_yoke: float
    b_yoke_slope: float
    teeth: float
    yoke: float
    kh: float
    kc: float
    ke: float
    harmonics: float
    rotor0: float
    rotor1: float
    rotor_exp: float
    magnet0: float
    magnet1: float
    magnet_exp: float
    bearing0: float
    bearing1: float
    windage: float


class Tables(NamedTuple):
    """Arrays of network and loss model; matrices transposed so that the inner loop runs along memory."""

    a_t: NDArray[np.float64]
    b_t: NDArray[np.float64]
    b_b: NDArray[np.float64]
    dq: NDArray[np.float64]
    copper_m3: NDArray[np.float64]
    ac_share: NDArray[np.float64]
    split: NDArray[np.float64]


class Course(NamedTuple):
    """The cycle as plain arrays."""

    by_distance: bool
    step: float
    end: float
    v_ref: NDArray[np.float64]
    slope: NDArray[np.float64]
    servo: bool
    target: NDArray[np.float64]
    dither: NDArray[np.float64]
    servo_p: NDArray[np.float64]


class CompiledEngine:
    """Same interface as `plant_sim.reference.ReferenceEngine`, about 50 times faster."""

    def __init__(self, params: PlantParams, cycle: Cycle) -> None:
        self._scalars, self._tables = _pack(params)
        servo = cycle.servo
        none = np.zeros(1)
        self._course = Course(
            cycle.by_distance,
            float(cycle.step),
            float(cycle.end),
            np.ascontiguousarray(cycle.v_ref_mps, dtype=float),
            np.ascontiguousarray(cycle.slope_rad, dtype=float),
            servo is not None,
            none if servo is None else np.ascontiguousarray(servo.target_degc, dtype=float),
            none if servo is None else np.ascontiguousarray(servo.dither, dtype=float),
            none
            if servo is None
            else np.array(
                [
                    servo.gain_1_k,
                    servo.offset,
                    servo.grade_min,
                    servo.grade_max,
                    servo.filter_s,
                    servo.from_mps,
                ]
            ),
        )

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
        """Advance ``state`` and ``theta`` in place; return one row per tick done."""
        rows = np.empty((ticks, N_ROW))
        done = _run(
            ticks,
            tick,
            state,
            theta,
            boundary,
            float(derate),
            float(rule[0]),
            float(rule[1]),
            stop,
            command is not None,
            NO_COMMAND if command is None else TorqueCommand(*map(float, command)),
            self._scalars,
            self._tables,
            self._course,
            rows,
        )
        return rows[:done]


@lru_cache(maxsize=8)
def _pack(params: PlantParams) -> tuple[Scalars, Tables]:
    """Flatten parameters and derived tables (read only; 20 MB, cached by parameters)."""
    v, m, d, c = params.vehicle, params.machine, params.driver, params.loss
    lptn, network = build_lptn(params), build_network(params)
    dq_map = build_dq_map(m)
    model = LossModel(params, network, dq_map)
    rho = params.material.rho_el20_ohm_m
    windage = (
        c.windage_cf
        * pi
        * params.material.rho_air_kg_m3
        * params.geometry.r_rotor_m**4
        * params.geometry.stack_m
    )
    scalars = Scalars(
        v.mass_kg,
        0.5 * v.drag_coeff * v.frontal_area_m2 * v.rho_air_kg_m3,
        v.roll_coeff,
        v.gravity_mps2,
        v.gear_ratio / v.wheel_radius_m,
        30.0 * v.gear_ratio / (pi * v.wheel_radius_m),
        m.torque_max_nm,
        m.power_max_w,
        m.regen_torque_max_nm,
        m.regen_power_max_w,
        m.regen_v_lo_mps,
        m.regen_v_hi_mps,
        exp(-DT_S / m.torque_lag_s),
        d.kp_nm_per_mps,
        d.ki_nm_per_m,
        d.u_min_nm,
        d.u_max_nm,
        d.integral_max_nm,
        d.lookahead_m,
        m.i_max_a,
        float(m.pole_pairs),
        params.material.alpha_cu_1_k,
        rho * model.j_per_a**2,
        rho * model.j_per_a**2 * model.ac_volume_m3 * c.k_ac / c.f_ac_hz**2,
        c.n_base_rpm,
        c.b_tooth_t,
        c.b_tooth_slope / c.psi_base_vs,
        c.b_yoke_t,
        c.b_yoke_slope / c.psi_base_vs,
        model.teeth_kg * c.kb_fe,
        model.yoke_kg * c.kb_fe,
        c.kh,
        c.kc,
        c.ke,
        c.harmonics,
        c.rotor_fe0_w,
        c.rotor_fe1_w,
        c.rotor_fe_exp,
        c.magnet0_w,
        c.magnet1_w,
        c.magnet_exp,
        c.bearing0_nm,
        c.bearing1_nms,
        windage,
    )
    scalars = Scalars(*(float(x) for x in scalars))
    tables = Tables(
        np.ascontiguousarray(lptn.a_d.transpose(0, 2, 1)),
        np.ascontiguousarray(lptn.b_d.transpose(0, 2, 1)),
        lptn.b_b,
        dq_map.table,
        model.copper_m3,
        model.ac_share,
        model.split,
    )
    return scalars, tables


@compiled
def _interpolate(values, position):
    position = min(max(position, 0.0), values.size - 1.0)
    i = min(int(position), values.size - 2)
    w = position - i
    return values[i] * (1.0 - w) + values[i + 1] * w


@compiled
def _heat(theta, torque, speed, c, tab, heat):
    """Fill heat (70,) in W."""
    # Operating point: trilinear in magnet temperature, |T|, n.
    dq = tab.dq
    x = min(max(((theta[_R0] + theta[_R1] + theta[_R2]) / 3.0 - _DQ_THETA0) / 60.0, 0.0), dq.shape[0] - 1.0)
    y = min(abs(torque) / TORQUE_STEP_NM, dq.shape[1] - 1.0)
    z = min(speed / SPEED_STEP_RPM, dq.shape[2] - 1.0)
    i, j, k = min(int(x), dq.shape[0] - 2), min(int(y), dq.shape[1] - 2), min(int(z), dq.shape[2] - 2)
    x, y, z = x - i, y - j, z - k
    current = psi = minus_id = 0.0
    for a in range(2):
        wa = x if a else 1.0 - x
        for b in range(2):
            wb = wa * (y if b else 1.0 - y)
            for e in range(2):
                w = wb * (z if e else 1.0 - z)
                current += w * dq[i + a, j + b, k + e, 0]
                psi += w * dq[i + a, j + b, k + e, 1]
                minus_id += w * dq[i + a, j + b, k + e, 2]
    f = c.pole_pairs * speed / 60.0
    nu, omega, load = speed / c.n_base, speed * pi / 30.0, (current / c.i_max) ** 2
    harmonic = 1.0 + c.harmonics * (minus_id / c.i_max) * nu
    bt, by = c.b_tooth * tanh(c.b_tooth_slope * psi), c.b_yoke * tanh(c.b_yoke_slope * psi)
    teeth = (c.kh * f * bt**2 + c.kc * (f * bt) ** 2 + c.ke * (f * bt) ** 1.5) * c.teeth * harmonic
    yoke = (c.kh * f * by**2 + c.kc * (f * by) ** 2 + c.ke * (f * by) ** 1.5) * c.yoke
    rotor = (c.rotor0 + c.rotor1 * load) * nu**c.rotor_exp
    magnet = (c.magnet0 + c.magnet1 * load) * nu**c.magnet_exp
    bearing = 2.0 * (c.bearing0 + c.bearing1 * omega) * omega
    windage = c.windage * omega**3
    dc, ac, s = c.copper * current**2, c.ac * current**2 * f**2, tab.split
    for n in range(N_NODES):
        q = (
            s[n, 0] * teeth
            + s[n, 1] * yoke
            + s[n, 2] * rotor
            + s[n, 3] * magnet
            + s[n, 4] * bearing
            + s[n, 5] * windage
        )
        if tab.copper_m3[n] > 0.0:
            resist = 1.0 + c.alpha * (theta[n] - 20.0)
            q += dc * tab.copper_m3[n] * resist + ac * tab.ac_share[n] / resist
        heat[n] = q


@compiled
def _thermal(theta, heat, speed, boundary, tab, out):
    """Blend the exact steps of the two neighbouring grid speeds; result lands in theta."""
    position = min(speed / GRID_RPM, tab.a_t.shape[0] - 1.0)
    g = min(int(position), tab.a_t.shape[0] - 2)
    w = position - g
    for i in range(N_NODES):
        total = 0.0
        for b in range(3):
            total += ((1.0 - w) * tab.b_b[g, i, b] + w * tab.b_b[g + 1, i, b]) * boundary[b]
        out[i] = total
    for j in range(N_NODES):
        lower, upper = (1.0 - w) * theta[j], w * theta[j]
        a0, a1 = tab.a_t[g, j], tab.a_t[g + 1, j]
        for i in range(N_NODES):
            out[i] += a0[i] * lower + a1[i] * upper
        if heat[j] != 0.0:
            lower, upper = (1.0 - w) * heat[j], w * heat[j]
            b0, b1 = tab.b_t[g, j], tab.b_t[g + 1, j]
            for i in range(N_NODES):
                out[i] += b0[i] * lower + b1[i] * upper
    for i in range(N_NODES):
        theta[i] = out[i]


@compiled
def _run(ticks, tick, s, theta, boundary, derate, rule_start, rule_end, stop, obeys, order, c, tab, course, rows):
    """Advance the plant; return the number of ticks done."""
    heat, work = np.zeros(N_NODES), np.zeros(N_NODES)
    for step in range(ticks):
        now = tick + step
        t_s = now * DT_S
        if course.by_distance:
            v_ref = _interpolate(course.v_ref, (s[X] + c.lookahead) / course.step)
            slope = _interpolate(course.slope, s[X] / course.step)
        else:
            v_ref = _interpolate(course.v_ref, t_s / course.step)
            slope = _interpolate(course.slope, t_s / course.step)
        if course.servo:
            k = min(now // _TICKS_PER_SERVO, course.target.size - 1)
            p = course.servo_p
            grade = p[0] * (course.target[k] - theta[THETA_W]) + p[1] + course.dither[k]
            s[GRADE] += DT_S / p[4] * (min(max(grade, p[2]), p[3]) - s[GRADE])
            slope = atan(s[GRADE]) if s[V] > p[5] else 0.0
        factor = derate
        if rule_end > rule_start:
            factor *= min(max((rule_end - theta[THETA_W]) / (rule_end - rule_start), 0.0), 1.0)

        # Envelope at this speed.
        speed = s[V] * c.rpm_per_mps
        omega = speed * pi / 30.0
        drive_limit = c.torque_max if omega * c.torque_max <= c.power_max else c.power_max / omega
        regen_limit = c.regen_torque if omega * c.regen_torque <= c.regen_power else c.regen_power / omega
        regen_limit *= min(max((s[V] - c.regen_lo) / (c.regen_hi - c.regen_lo), 0.0), 1.0)

        # Driver.
        wanted = friction = integral = 0.0
        if obeys:
            wanted = min(max(order.accelerate_nm, 0.0), drive_limit) + max(min(order.brake_nm, 0.0), -regen_limit)
            friction = max(min(order.friction_nm, 0.0), c.u_min)
            integral = wanted + friction - c.kp * (v_ref - s[V])
            integral = min(max(integral, -c.integral_max), c.integral_max)
        elif v_ref > STANDSTILL_MPS or s[V] > STANDSTILL_MPS:
            error = v_ref - s[V]
            wish = c.kp * error + s[INTEGRAL]
            u = min(max(wish, c.u_min), c.u_max)
            shortfall = 0.0
            if u >= 0.0:
                wanted = min(u, drive_limit * factor)
                shortfall = wanted - u
            else:
                wanted = max(u, -regen_limit * factor)
                friction = u - wanted
            rate = c.ki * error + (u - wish + shortfall) * 2.0 * c.ki / c.kp
            integral = min(max(s[INTEGRAL] + DT_S * rate, -c.integral_max), c.integral_max)

        torque = min(max(c.lag * s[TORQUE] + (1.0 - c.lag) * wanted, -regen_limit), drive_limit)
        _heat(theta, torque, speed, c, tab, heat)
        _thermal(theta, heat, speed, boundary, tab, work)

        # Vehicle, explicit Euler.
        force = (torque + friction) * c.force_per_nm - c.mass * c.gravity * sin(slope) - c.drag * s[V] * s[V]
        if s[V] > ROLLING_FROM_MPS:
            force -= c.mass * c.gravity * c.roll * cos(slope)
        s[X] += DT_S * s[V]
        s[V] = max(s[V] + DT_S * force / c.mass, 0.0)
        s[INTEGRAL], s[TORQUE] = integral, torque

        row = rows[step]
        row[0], row[1], row[2], row[3] = torque, speed, s[V], s[X]
        row[4], row[5], row[6] = v_ref, slope, theta[THETA_W]
        row[7] = (theta[_R0] + theta[_R1] + theta[_R2]) / 3.0
        if stop and (s[X] if course.by_distance else (now + 1) * DT_S) >= course.end - 1e-9:
            return step + 1
    return ticks
