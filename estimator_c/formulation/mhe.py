"""The MHE problem as the paper states it, in CasADi: the reference every solver here is held against.

Two statements of one problem over nodes k = 0..m (theta in degC, rates in degC/s):

    min 1/2 |theta_0 - prior|^2_P0 + sum_k Wy,k s^2 rho((y_k - theta_k)/s) + 1/2 sum_k |w_k|^2_Ww
    theta_{k+1} = theta_k + dt F(u_k, theta_k, c_k, h_k) + w_k,   (c, h)_{k+1} = LSTM(u_k, theta_k, c_k, h_k)

rho(x) = x^2/2 (quadratic; s does not matter), |x| - 1/2 beyond |x| = 1 (Huber 1964), or x^2/2/(1 + x^2) (Geman and
McClure 1987), which is not convex: the minimum found is the one whose valley the guess lies in.

`shooting`: unknowns theta, c, h of all nodes and w of all stages, the dynamics as equality constraints.
`theta`: w eliminated and c, h substituted; unknowns theta alone. Both have the same solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .net import build_net
from .weights import NetWeights

Array = NDArray[np.float64]

# Tolerances are on the gradient in 1/K: divided by the curvature (>= 1 1/K²) they leave 1e-9 degC and better; the
# rounding of weights times temperatures does not allow less.
IPOPT = {
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-7,
    "ipopt.constr_viol_tol": 1e-11,
    "ipopt.compl_inf_tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.mu_target": 0.0,
    "ipopt.max_iter": 300,
    "ipopt.nlp_scaling_method": "none",
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
}


LOSSES = ("quadratic", "huber", "geman-mcclure")  # in the order of EST_LOSS_...


@dataclass(frozen=True)
class MheProblem:
    """The data of one window of m + 1 nodes.

    Attributes
    ----------
    u : (m, 2)
        [speed rpm, torque Nm] of each stage.
    y, weight : (m + 1, 2)
        Measurements (offset removed, degC) and their weights in 1/K²; weight 0 = no measurement.
    prior, weight_arrival, weight_noise : (2,)
        theta bar of node 0 and its weight, weight of the process noise per stage, 1/K².
    memory : (M,)
        Memory of the net at node 0, fixed.
    lower, upper : float
        Bounds on all temperatures, degC.
    bound_weight : float or None
        Penalty of soft bounds in 1/K² per node; None = hard box.
    loss, loss_scale : str, float
        One of LOSSES, and s in degC.
    """

    u: Array
    y: Array
    weight: Array
    prior: Array
    weight_arrival: Array
    weight_noise: Array
    memory: Array
    lower: float = -np.inf
    upper: float = np.inf
    bound_weight: float | None = None
    loss: str = "quadratic"
    loss_scale: float = 1.0


class MheOracle:
    """ipopt on the problem, to about 1e-9 degC; builds one NLP per number of nodes and statement."""

    def __init__(self, weights: NetWeights, statement: str = "theta") -> None:
        if statement not in ("theta", "shooting"):
            raise ValueError(f"statement must be 'theta' or 'shooting', is {statement!r}")
        self.weights, self.statement = weights, statement
        self._solvers: dict[tuple[int, bool, str], ca.Function] = {}

    def prepare(self, problem: MheProblem) -> ca.Function:
        """Build the NLP of problems of this kind and size, if there is none yet; for those who time `solve`."""
        if problem.loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(LOSSES)}, is {problem.loss!r}")
        key = (len(problem.y), problem.bound_weight is not None, problem.loss)
        if key not in self._solvers:
            self._solvers[key] = self._build(*key)
        return self._solvers[key]

    def solve(self, problem: MheProblem, guess: Array | None = None) -> Array:
        """Temperatures of all nodes (m + 1, 2) in degC; raises RuntimeError if ipopt fails."""
        nodes, soft = len(problem.y), problem.bound_weight is not None
        solver = self.prepare(problem)
        start = self._start(problem, problem.y if guess is None else guess)
        low, high = self._bounds(problem, start.size, nodes, soft)
        g_high = np.zeros(solver.sparsity_out("g").numel())
        if soft:
            g_high[-2 * 2 * nodes :] = np.inf
        out = solver(x0=start, p=_parameters(problem), lbx=low, ubx=high, lbg=0.0, ubg=g_high)
        stats = solver.stats()
        if not stats["success"] and stats["return_status"] != "Solved_To_Acceptable_Level":
            raise RuntimeError(f"ipopt: {stats['return_status']}")
        return np.array(out["x"][: 2 * nodes]).reshape(nodes, 2)

    def _build(self, nodes: int, soft: bool, loss: str) -> ca.Function:
        n_m, dt_s = self.weights.memory, self.weights.dt_s
        net = build_net(self.weights).forward
        theta = ca.SX.sym("theta", 2, nodes)
        p: dict[str, Any] = {
            "u": ca.SX.sym("u", 2, nodes - 1),
            "y": ca.SX.sym("y", 2, nodes),
            "weight": ca.SX.sym("weight", 2, nodes),
            "prior": ca.SX.sym("prior", 2),
            "p0": ca.SX.sym("p0", 2),
            "ww": ca.SX.sym("ww", 2),
            "memory": ca.SX.sym("memory", n_m),
            "bounds": ca.SX.sym("bounds", 3),
            "scale": ca.SX.sym("scale"),
        }
        unknowns, constraints = [ca.vec(theta)], []
        cost = 0.5 * ca.dot(p["p0"], (theta[:, 0] - p["prior"]) ** 2)
        cost += ca.dot(p["weight"], _loss(loss, theta - p["y"], p["scale"]))
        memory = p["memory"]
        for k in range(nodes - 1):
            memory_next, rate, _ = net(p["u"][:, k], theta[:, k], memory)
            w = theta[:, k + 1] - theta[:, k] - dt_s * rate
            if self.statement == "shooting":
                w_k = ca.SX.sym(f"w_{k}", 2)
                memory = ca.SX.sym(f"memory_{k + 1}", n_m)
                unknowns += [w_k, memory]
                constraints += [w - w_k, memory - memory_next]
                w = w_k
            else:
                memory = memory_next
            cost += 0.5 * ca.dot(p["ww"], w**2)
        if soft:
            over, under = ca.SX.sym("over", 2 * nodes), ca.SX.sym("under", 2 * nodes)
            lower, upper, rho = ca.vertsplit(p["bounds"])
            unknowns += [over, under]
            constraints += [upper + over - ca.vec(theta), ca.vec(theta) + under - lower]
            cost += 0.5 * rho * (ca.sumsqr(over) + ca.sumsqr(under))
        nlp = {
            "x": ca.vertcat(*unknowns),
            "p": ca.vertcat(*(ca.vec(value) for value in p.values())),
            "f": cost,
            "g": ca.vertcat(*constraints),
        }
        return ca.nlpsol("mhe_oracle", "ipopt", nlp, IPOPT)

    def _start(self, problem: MheProblem, theta: Array) -> Array:
        net = build_net(self.weights).forward
        parts, memory = [np.asarray(theta).ravel()], problem.memory
        if self.statement == "shooting":
            for k in range(len(problem.u)):
                memory = np.array(net(problem.u[k], theta[k], memory)[0]).ravel()
                parts += [np.zeros(2), memory]
        if problem.bound_weight is not None:
            flat = np.asarray(theta).ravel()
            parts += [np.maximum(flat - problem.upper, 0.0) + 1e-3, np.maximum(problem.lower - flat, 0.0) + 1e-3]
        return np.concatenate(parts)

    @staticmethod
    def _bounds(problem: MheProblem, size: int, nodes: int, soft: bool) -> tuple[Array, Array]:
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        if soft:
            low[-2 * 2 * nodes :] = 0.0
        else:
            low[: 2 * nodes], high[: 2 * nodes] = problem.lower, problem.upper
        return low, high


def _loss(loss: str, residual: ca.SX, scale: ca.SX) -> ca.SX:
    """s^2 rho(r/s), element by element."""
    square = 0.5 * residual**2
    if loss == "huber":
        return ca.if_else(ca.fabs(residual) > scale, scale * (ca.fabs(residual) - 0.5 * scale), square)
    return square / (1 + (residual / scale) ** 2) if loss == "geman-mcclure" else square


def _parameters(problem: MheProblem) -> Array:
    bounds = np.nan_to_num(
        np.array([problem.lower, problem.upper, problem.bound_weight or 0.0]), posinf=1e9, neginf=-1e9
    )
    parts = (
        problem.u, problem.y, problem.weight, problem.prior, problem.weight_arrival, problem.weight_noise,
        problem.memory, bounds, problem.loss_scale,
    )  # fmt: skip
    return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])
