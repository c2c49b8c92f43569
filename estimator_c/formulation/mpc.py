"""The MPC problem as stated, in CasADi: the reference that the solver in C is held against.

Unknowns are the three torques of each interval and, at its end, all that the car and the net carry from there; the
slacks of the temperatures too. Interval k holds its torques over substeps[k] steps of 0.1 s:

    v+ = v + dt/m ((T_acc + T_brk + T_fric) i/r - m g sin(slope) - drag v^2 - m g c_r v/sqrt(v^2 + 0.05^2))
    theta+ = theta + dt rate(n, T_acc + T_brk, theta, memory),   memory+ = net(...),   n = 30 v i/(pi r)

    min sum Dt (q_v (v+ - v_ref)^2 + r_F T_fric^2 + r_u (T_acc^2 + T_brk^2)) + r_d (T - T before)^2
        + Dt (q_a max(v+ - v_ref, 0)^2 + q_b (max(v+ - v_max - 1, 0)^2 + max(-v+, 0)^2)) + Dt (rho_1 s + rho_2 s^2)
    0 <= T_acc <= drive(v),  -regen(v) <= T_brk <= 0,  -friction <= T_fric <= 0,  theta+ <= limit + s,  s >= 0

with drive and regen at the interval's beginning. C knows one motor torque in place of two, a box in place of the
envelope, and no slacks; it has to find the same solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .mpc_settings import MpcSetting
from .net import build_net
from .weights import NetWeights

Array = NDArray[np.float64]

STANDSTILL_MPS, ABOVE_V_MAX_MPS = 0.05, 1.0
RPM_PER_RAD_S = 30.0 / np.pi
IPOPT = {
    "ipopt.tol": 1e-11,
    "ipopt.acceptable_tol": 1e-10,
    "ipopt.constr_viol_tol": 1e-11,
    "ipopt.compl_inf_tol": 1e-11,
    "ipopt.dual_inf_tol": 1e-9,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.mu_init": 1e-2,
    "ipopt.max_iter": 500,
    "ipopt.nlp_scaling_method": "none",
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
}


@dataclass(frozen=True)
class MpcData:
    """One problem of N intervals.

    Attributes
    ----------
    v_mps, torque_nm : float
        Speed now, motor torque of the interval before.
    theta, limit : (2,)
        Winding and rotor now, and their limits, degC.
    memory : (M,)
        Of the net, now.
    v_ref_mps, slope_rad : (N,)
        At the end of each interval, over it.
    """

    v_mps: float
    torque_nm: float
    theta: Array
    limit: Array
    memory: Array
    v_ref_mps: Array
    slope_rad: Array


@dataclass(frozen=True)
class MpcSolution:
    """(N,) torques in Nm; (N + 1, 2) temperatures and (N + 1,) speeds at the nodes; the cost."""

    accelerate_nm: Array
    brake_nm: Array
    friction_nm: Array
    theta: Array
    v_mps: Array
    cost: float


class MpcOracle:
    """ipopt on the problem of one setting; builds its NLP once."""

    def __init__(self, weights: NetWeights, setting: MpcSetting, vehicle: dict[str, float]) -> None:
        self.setting, self.vehicle = setting, vehicle
        self._memory = weights.memory
        self._scale = setting.values["speed"]  # all weights over q_v: the solution is the same, the numbers are tame
        self._interval = self._step_function(weights)
        self._solver = self._build()

    def solve(self, data: MpcData, torque_nm: Array, friction_nm: Array) -> MpcSolution:
        """The solution next to a guess of motor and friction torque (N,); raises RuntimeError if ipopt fails."""
        n = len(self.setting.substeps)
        start, low, high, g_low, g_high = self._start(data, torque_nm, friction_nm)
        parameters = np.concatenate([
            [data.v_mps, data.torque_nm], data.theta, data.limit, data.memory, data.v_ref_mps, data.slope_rad,
        ])  # fmt: skip
        out = self._solver(x0=start, p=parameters, lbx=low, ubx=high, lbg=g_low, ubg=g_high)
        stats = self._solver.stats()
        if not stats["success"] and stats["return_status"] != "Solved_To_Acceptable_Level":
            raise RuntimeError(f"ipopt: {stats['return_status']}")
        x = np.array(out["x"]).reshape(n, -1)
        return MpcSolution(
            x[:, 0],
            x[:, 1],
            x[:, 2],
            np.vstack([data.theta, x[:, 4:6]]),
            np.concatenate([[data.v_mps], x[:, 3]]),
            float(out["f"]) * self._scale,
        )

    def _step_function(self, weights: NetWeights) -> dict[int, ca.Function]:
        """Substeps -> (v, theta, memory, T, F, slope) -> (v, theta, memory) at the interval's end."""
        car, net, dt_s = self.vehicle, build_net(weights).forward, weights.dt_s
        v, theta, memory = ca.SX.sym("v"), ca.SX.sym("theta", 2), ca.SX.sym("memory", weights.memory)
        torque, friction, slope = ca.SX.sym("torque"), ca.SX.sym("friction"), ca.SX.sym("slope")
        weight = car["mass_kg"] * car["gravity_mps2"]
        force = (torque + friction) * car["gear_per_m"] - weight * ca.sin(slope) - car["drag_kg_m"] * v**2
        force -= weight * car["roll_coeff"] * ca.cos(slope) * v / ca.sqrt(v**2 + STANDSTILL_MPS**2)
        n_rpm = v * car["gear_per_m"] * RPM_PER_RAD_S
        memory_next, rate, _ = net(ca.vertcat(n_rpm, torque), theta, memory)
        given = [v, theta, memory, torque, friction, slope]
        step = ca.Function("step", given, [v + dt_s / car["mass_kg"] * force, theta + dt_s * rate, memory_next])
        functions = {}
        for count in sorted(set(self.setting.substeps)):
            state = [v, theta, memory]
            for _ in range(count):
                state = list(step(*state, torque, friction, slope))
            functions[count] = ca.Function(f"interval_{count}", given, state)
        return functions

    def _limits(self, v: ca.MX) -> tuple[list[ca.MX], list[ca.MX]]:
        """Upper bounds on T_acc and on -T_brk, each of which holds."""
        car = self.vehicle
        omega = v * car["gear_per_m"]
        fade = (v - car["regen_from_mps"]) / (car["regen_full_mps"] - car["regen_from_mps"])
        fade = ca.fmin(ca.fmax(fade, 0), 1)
        drive = [ca.MX(car["drive_nm"]), car["drive_w"] / ca.fmax(omega, 1e-3)]
        return drive, [car["regen_nm"] * fade, car["regen_w"] / ca.fmax(omega, 1e-3) * fade]

    def _build(self) -> ca.Function:
        set_, n, m = self.setting, len(self.setting.substeps), self._memory
        w = {key: value / self._scale for key, value in set_.values.items()}
        v_0, before = ca.MX.sym("v_0"), ca.MX.sym("before")
        theta_0, limit, memory_0 = ca.MX.sym("theta_0", 2), ca.MX.sym("limit", 2), ca.MX.sym("memory_0", m)
        v_ref, slope = ca.MX.sym("v_ref", n), ca.MX.sym("slope", n)
        v, theta, memory, last = v_0, theta_0, memory_0, before
        unknowns, constraints, cost = [], [], ca.MX(0)
        for k, (count, dt) in enumerate(zip(set_.substeps, set_.dt_s, strict=True)):
            x = ca.MX.sym(f"x_{k}", 3 + 1 + 2 + m + 2)
            acc, brk, fric, v_next, theta_next, memory_next, slack = (
                x[0], x[1], x[2], x[3], x[4:6], x[6 : 6 + m], x[6 + m :]
            )  # fmt: skip
            drive, regen = self._limits(v)
            reached = self._interval[count](v, theta, memory, acc + brk, fric, slope[k])
            constraints += [reached[0] - v_next, reached[1] - theta_next, reached[2] - memory_next]
            constraints += [bound - acc for bound in drive] + [bound + brk for bound in regen]
            constraints += [limit + slack - theta_next]
            error, change = v_next - v_ref[k], acc + brk - last
            fast = v_next - self.vehicle["v_max_mps"] - ABOVE_V_MAX_MPS
            cost += dt * (w["speed"] * error**2 + w["friction"] * fric**2 + w["torque"] * (acc**2 + brk**2))
            cost += w["torque_change"] * change**2
            cost += dt * w["above_reference"] * ca.fmax(error, 0) ** 2
            cost += dt * w["above_v_max"] * (ca.fmax(fast, 0) ** 2 + ca.fmax(-v_next, 0) ** 2)
            cost += dt * (w["slack"] * ca.sum1(slack) + w["slack_square"] * ca.sumsqr(slack))
            v, theta, memory, last = v_next, theta_next, memory_next, acc + brk
            unknowns.append(x)
        nlp = {
            "x": ca.vertcat(*unknowns),
            "p": ca.vertcat(v_0, before, theta_0, limit, memory_0, v_ref, slope),
            "f": cost,
            "g": ca.vertcat(*constraints),
        }
        return ca.nlpsol("mpc_oracle", "ipopt", nlp, IPOPT)

    def _start(self, data: MpcData, torque_nm: Array, friction_nm: Array) -> tuple[Array, ...]:
        n, m = len(self.setting.substeps), self._memory
        v, theta, memory = data.v_mps, np.asarray(data.theta, dtype=float), np.asarray(data.memory, dtype=float)
        rows = []
        for k, count in enumerate(self.setting.substeps):
            torque, friction = float(torque_nm[k]), float(friction_nm[k])
            out = self._interval[count](v, theta, memory, torque, friction, data.slope_rad[k])
            v, theta, memory = float(out[0]), np.array(out[1]).ravel(), np.array(out[2]).ravel()
            slack = np.maximum(theta - data.limit, 0.0) + 1e-3
            rows.append(np.concatenate([[max(torque, 0.0), min(torque, 0.0), friction, v], theta, memory, slack]))
        free = [np.inf] * (1 + 2 + m)
        low = np.tile([0.0, -np.inf, -self.vehicle["friction_nm"], *(-x for x in free), 0.0, 0.0], n)
        high = np.tile([np.inf, 0.0, 0.0, *free, np.inf, np.inf], n)
        equal, above = 1 + 2 + m, 4 + 2
        g_low = np.zeros(n * (equal + above))
        g_high = np.tile([0.0] * equal + [np.inf] * above, n)
        return np.concatenate(rows), low, high, g_low, g_high
