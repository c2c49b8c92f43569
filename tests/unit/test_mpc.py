"""The MPC's solver: ipopt's solution on recorded steps, derivatives, quadratic programmes, and what it promises."""

from __future__ import annotations

import ctypes as ct
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from estimator_c.formulation.mpc import MpcOracle, MpcSolution
from estimator_c.formulation.mpc_settings import load_mpc_settings, load_vehicle
from estimator_c.formulation.net import build_net
from estimator_c.formulation.weights import load_weights
from tests.support.mpc_drives import Step, recorded
from tools.libctl import FAILED, MAX_ITERATIONS, MPC_SETTINGS, OK, WEIGHTS, Memory, Mpc, Result, load

KERNELS = ("portable", "avx2", "avx512")
GATE_NM = 1e-3
HOT = (452.0, 14.0, 60.0)  # seconds of the lap driven before, seconds recorded, start temperature: meets the limit
SETTINGS = {setting.name: setting for setting in load_mpc_settings(MPC_SETTINGS)}


@cache
def oracle(name: str) -> MpcOracle:
    return MpcOracle(load_weights(WEIGHTS), SETTINGS[name], load_vehicle(MPC_SETTINGS))


def converged(name: str, step: Step) -> tuple[int, Result]:
    return Mpc(load(), load().setting(name, mode=0, max_iterations=50)).solve(
        step.problem, step.torque_nm, step.friction_nm
    )


def ipopt(name: str, step: Step, near: Result) -> MpcSolution:
    n = len(SETTINGS[name].substeps)
    return oracle(name).solve(step.data(n), np.array(near.torque_nm[:n]), np.array(near.friction_nm[:n]))


# ---- against ipopt --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["mpc-S", "mpc-M", "paper"])
def test_solution_is_ipopts(name: str) -> None:
    steps, n = recorded(name, *HOT), len(SETTINGS[name].substeps)
    in_force = 0
    for place in (3, 70, 135):
        status, found = converged(name, steps[place])
        assert status == OK
        best = ipopt(name, steps[place], found)
        torque, friction = best.accelerate_nm + best.brake_nm, best.friction_nm
        assert np.abs(torque - found.torque_nm[:n]).max() < GATE_NM
        assert np.abs(friction - found.friction_nm[:n]).max() < GATE_NM
        assert np.abs(best.theta - np.array(found.theta)[: n + 1]).max() < 1e-4
        # What the one motor torque in C takes for granted, and the paper demands: never two torques against each other.
        assert (best.accelerate_nm * -best.brake_nm).max() < 1e-3
        assert (best.accelerate_nm * -best.friction_nm).max() < 1e-3
        in_force += np.array(found.multiplier)[:n, 0].max() > 1e-3 * SETTINGS[name].values["speed"]
    assert in_force > 0, "the limit was never met: these steps prove little"


def test_from_no_guess_it_finds_the_same() -> None:
    step = recorded("mpc-M", *HOT)[70]
    _, near = converged("mpc-M", step)
    mpc = Mpc(load(), load().setting("mpc-M", max_iterations=50))
    status, far = mpc.solve(step.problem)
    assert status == OK
    assert np.abs(np.array(far.torque_nm) - np.array(near.torque_nm))[:30].max() < GATE_NM


def test_every_kernel_has_the_same_solution() -> None:
    step, found = recorded("mpc-M", *HOT)[135], []
    try:
        for kernel in KERNELS:
            if load().select(kernel):
                found.append(np.array(converged("mpc-M", step)[1].torque_nm))
    finally:
        load().select(None)
    assert max(np.abs(f - found[0]).max() for f in found) < 1e-6


def test_few_linearisations_are_enough() -> None:
    steps = recorded("mpc-M", *HOT)
    results = [converged("mpc-M", step) for step in steps[3::4]]
    assert {status for status, _ in results} == {OK}
    assert np.mean([r.iterations for _, r in results]) < 5
    assert np.mean([r.qp_iterations == 0 for _, r in results]) > 0.3, "active sets hardly ever settle"


# ---- what it promises -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["mpc-S", "mpc-M", "paper"])
def test_every_result_keeps_to_the_envelope_and_the_limit(name: str) -> None:
    n, car = len(SETTINGS[name].substeps), load_vehicle(MPC_SETTINGS)
    for step in recorded(name, *HOT)[3::20]:
        _, r = converged(name, step)
        v, torque, friction = np.array(r.v_mps[:n]), np.array(r.torque_nm[:n]), np.array(r.friction_nm[:n])
        omega = v * car["gear_per_m"]
        assert (torque <= np.minimum(car["drive_nm"], car["drive_w"] / omega) + 1e-9).all()
        assert (torque >= -np.minimum(car["regen_nm"], car["regen_w"] / omega) - 1e-9).all()
        assert (friction <= 0).all()
        assert (friction >= -car["friction_nm"]).all()
        theta = np.array(r.theta)[: n + 1, 0]
        assert theta.max() <= max(step.problem.theta[0], step.problem.limit[0]) + 0.05


def test_hotter_is_never_more_torque() -> None:
    step = recorded("mpc-M", *HOT)[3]
    torques = []
    for theta in np.arange(146.0, 158.0, 1.0):
        problem = type(step.problem).from_buffer_copy(step.problem)
        problem.theta[0] = theta
        _, found = Mpc(load(), "mpc-M").solve(problem, step.torque_nm, step.friction_nm)
        torques.append(found.torque_nm[0])
    assert (np.diff(torques) <= 1e-6).all()
    assert torques[-1] < torques[0] - 5.0


@pytest.mark.parametrize("field", ["v_mps", "torque_nm", "theta", "memory", "limit", "v_ref_mps", "slope_rad"])
def test_data_that_are_not_finite_fail(field: str) -> None:
    step = recorded("mpc-S", *HOT)[3]
    problem = type(step.problem).from_buffer_copy(step.problem)
    if isinstance(getattr(problem, field), float):
        setattr(problem, field, np.nan)
    else:
        getattr(problem, field)[1] = np.nan
    assert Mpc(load(), "mpc-S").solve(problem, step.torque_nm, step.friction_nm)[0] == FAILED


def test_one_linearisation_in_rti() -> None:
    step = recorded("mpc-S", *HOT)[70]
    status, found = Mpc(load(), load().setting("mpc-S", mode=1)).solve(step.problem, step.torque_nm, step.friction_nm)
    assert (status, found.iterations, found.rolls) == (MAX_ITERATIONS, 1, 2)
    _, best = converged("mpc-S", step)
    assert abs(found.torque_nm[0] - best.torque_nm[0]) < 1.0


def test_same_call_same_bytes() -> None:
    step = recorded("mpc-M", *HOT)[135]
    first, second = (converged("mpc-M", step)[1] for _ in range(2))
    assert bytes(first) == bytes(second)


# ---- the bulk work --------------------------------------------------------------------------------------------
class Row(ct.Structure):
    """ocp_row_t of eight cells."""

    _fields_ = (("c", ct.c_double * 8), ("h", ct.c_double * 8), ("theta", ct.c_double * 2), ("u", ct.c_double * 2),
                ("_end", ct.c_double * 4))  # fmt: skip


class Kernel(ct.Structure):
    """ocp_kernel_t."""

    _fields_ = (("name", ct.c_char_p), *((name, ct.c_void_p) for name in (
        "available", "pull_back", "pull_back_one", "push", "gram", "factor", "solve")))  # fmt: skip


def function(kernel: str, name: str, *types: Any, restype: Any = None):
    if not load().select(kernel):
        pytest.skip(f"this processor has no {kernel}")
    table = ct.POINTER(Kernel).in_dll(load().c, "ocp_kernel").contents
    load().select(None)
    return ct.CFUNCTYPE(restype, *types)(getattr(table, name))


def aligned(array: np.ndarray) -> tuple[Memory, np.ndarray]:
    """A copy on 64 bytes, and a view of it."""
    memory = Memory(array.nbytes)
    assert memory.at.value is not None
    view = np.ctypeslib.as_array((ct.c_uint8 * array.nbytes).from_address(memory.at.value)).view(array.dtype)
    view = view.reshape(array.shape)
    view[...] = array
    return memory, view


@cache
def net_step() -> tuple[ca.Function, ca.Function, ca.Function]:
    """Of y = [n, T, theta, memory]: the tape, d [theta + dt rate, memory+]/dy, the second derivative of bar . that."""
    net, y = build_net(load_weights(WEIGHTS)).forward, ca.SX.sym("y", 20)
    memory_next, rate, tape = net(y[:2], y[2:4], y[4:])
    reached = ca.vertcat(y[2:4] + 0.1 * rate, memory_next)
    bar = ca.SX.sym("bar", 18)
    second = ca.hessian(ca.dot(bar, reached), y)[0]
    return (
        ca.Function("tape", [y], [tape]),
        ca.Function("first", [y], [ca.jacobian(reached, y)]),
        ca.Function("second", [y, bar], [second]),
    )


def random_point(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([
        [rng.uniform(500, 11000), rng.uniform(-80, 160), rng.uniform(60, 160), rng.uniform(60, 140)],
        rng.uniform(-2, 2, 8), rng.uniform(-0.9, 0.9, 8),
    ])  # fmt: skip


@pytest.mark.parametrize("kernel", KERNELS)
def test_way_back_is_the_nets_jacobian(kernel: str) -> None:
    back = function(kernel, "pull_back", ct.c_void_p, ct.c_void_p, ct.c_void_p, ct.c_int)
    rng, (tape, first, _) = np.random.default_rng(3), net_step()
    for rows in (1, 2, 7):
        y, seeds = random_point(rng), rng.normal(size=(rows, 18))
        m_tape, _ = aligned(np.array(tape(y)).ravel())
        m_memory, _ = aligned(y[4:])
        m_rows, view = aligned(np.zeros((rows, 24)))
        view[:, :16], view[:, 16:18] = seeds[:, 2:], seeds[:, :2]
        back(m_tape.at, m_memory.at, m_rows.at, rows)
        expected = seeds @ np.array(first(y))  # over n, T, theta, memory
        np.testing.assert_allclose(view[:, 18:20], expected[:, :2], rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(view[:, 16:18], expected[:, 2:4], rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(view[:, :16], expected[:, 4:], rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("directions", [1, 5, 8, 30, 40])
def test_way_forward_and_curvature_are_the_nets(kernel: str, directions: int) -> None:
    push = function(kernel, "push", *[ct.c_void_p] * 5, ct.c_int, ct.c_void_p)
    rng, (tape, first, second) = np.random.default_rng(directions), net_step()
    y, bar = random_point(rng), rng.normal(size=18)
    tangents = rng.normal(size=(19, directions))  # of T, theta, memory; none of n
    m_tape, _ = aligned(np.array(tape(y)).ravel())
    m_memory, _ = aligned(y[4:])
    out_w = np.array(first(y))[:2]  # only for shape
    assert out_w.shape == (2, 20)
    weights = load_weights(WEIGHTS)
    of_rates = 0.1 * (weights.out_scale[:, None] * weights.w_y).T @ bar[:2]
    m_bar, _ = aligned(np.concatenate([bar[2:10], bar[10:] + of_rates]))
    m_torque, torque = aligned(np.zeros(40))
    torque[:directions] = tangents[0]
    m_tangent, tangent = aligned(np.zeros((18, 40)))
    tangent[:16, :directions], tangent[16:, :directions] = tangents[3:], tangents[1:3]
    m_curve, curve = aligned(np.zeros((40, 40)))
    push(m_tape.at, m_memory.at, m_bar.at, m_torque.at, m_tangent.at, directions, m_curve.at)
    full = np.vstack([np.zeros(directions), tangents])
    reached = np.array(first(y)) @ full
    np.testing.assert_allclose(tangent[16:, :directions], reached[:2], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(tangent[:16, :directions], reached[2:], rtol=1e-10, atol=1e-12)
    expected = full.T @ np.array(second(y, bar)) @ full
    upper = np.triu_indices(directions)
    np.testing.assert_allclose(curve[:directions, :directions][upper], expected[upper], rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 40, 60, 79, 80])
def test_gram_factor_and_solve(kernel: str, n: int) -> None:
    gram = function(kernel, "gram", ct.c_void_p, ct.c_int, *[ct.c_void_p] * 3, ct.c_int)
    factor = function(kernel, "factor", ct.c_void_p, ct.c_int, restype=ct.c_bool)
    solve = function(kernel, "solve", ct.c_void_p, ct.c_int, ct.c_void_p)
    rng, rows = np.random.default_rng(n), 20
    support = np.sort(rng.integers(1, n + 1, rows)).astype(np.int32)
    a = np.zeros((rows, 80))
    for k in range(rows):
        a[k, : support[k]] = rng.normal(size=support[k])
    h, weight = np.zeros((80, 80)), rng.uniform(0.1, 2.0, rows)
    h[np.arange(n), np.arange(n)] = 1.0
    m_h, view = aligned(h)
    m_a, _ = aligned(a)
    m_support, _ = aligned(support)
    m_weight, _ = aligned(weight)
    gram(m_h.at, n, m_a.at, m_support.at, m_weight.at, rows)
    expected = np.eye(n) + a[:, :n].T @ (weight[:, None] * a[:, :n])
    np.testing.assert_allclose(np.triu(view[:n, :n]), np.triu(expected), rtol=1e-12, atol=1e-12)
    x = rng.normal(size=n)
    m_x, solved = aligned(np.concatenate([x, np.zeros(80 - n)]))
    assert factor(m_h.at, n)
    solve(m_h.at, n, m_x.at)
    np.testing.assert_allclose(expected @ solved[:n], x, rtol=1e-9, atol=1e-10)


def test_factor_refuses_what_is_not_positive_definite() -> None:
    factor = function("portable", "factor", ct.c_void_p, ct.c_int, restype=ct.c_bool)
    h = np.zeros((80, 80))
    h[0, :2], h[1, 1] = (1.0, 2.0), 1.0
    for value in (1.0, -1.0, np.nan):
        h[1, 1] = value
        assert not factor(aligned(h)[0].at, 2)


# ---- the quadratic programme ----------------------------------------------------------------------------------
MATRIX = (ct.c_double * 80) * 80


class Qp(ct.Structure):
    """ocp_qp_t."""

    _fields_ = (
        ("n", ct.c_int32), ("rows", ct.c_int32), ("_align", ct.c_double * 7), ("h", MATRIX), ("a", MATRIX),
        ("work", MATRIX * 3), ("support", ct.c_int32 * 80),
        *((name, ct.c_double * 80) for name in ("e", "rho_1", "rho_2", "g", "low", "high")),
        ("bound", ct.c_uint8 * 80), ("kink", ct.c_uint8 * 80), ("_align_d", ct.c_double * 4), ("d", ct.c_double * 80),
        ("multiplier", ct.c_double * 80), ("decrease", ct.c_double), ("iterations", ct.c_int32), ("sets", ct.c_int32),
    )  # fmt: skip


def random_qp(rng: np.random.Generator, n: int, rows: int) -> Qp:
    """Badly scaled as ours: a few stiff directions, bounds and kinks that are met."""
    qp, basis = Qp(), rng.normal(size=(n, n))
    h = basis.T @ (10.0 ** rng.uniform(-3.5, 0.0, n)[:, None] * basis) / n + 1e-4 * np.eye(n)
    np.ctypeslib.as_array(qp.h)[:n, :n] = h
    support = np.sort(rng.integers(1, n + 1, rows))
    a = np.ctypeslib.as_array(qp.a)
    for k in range(rows):
        a[k, : support[k]] = rng.normal(size=support[k]) * 0.02
    qp.n, qp.rows = n, rows
    qp.support[:rows] = [int(s) for s in support]
    for name, values in (
        ("e", rng.normal(scale=0.5, size=rows)), ("rho_1", rng.uniform(0.5, 50.0, rows)),
        ("rho_2", rng.uniform(0.1, 20.0, rows)), ("g", rng.normal(scale=0.2, size=n)),
        ("low", -rng.uniform(0.0, 100.0, n)), ("high", rng.uniform(0.1, 100.0, n)),
    ):  # fmt: skip
        getattr(qp, name)[: len(values)] = list(values)
    qp.bound[:n] = [int(b) for b in rng.integers(0, 3, n)]  # a wild guess
    qp.kink[:rows] = [int(k) for k in rng.integers(0, 3, rows)]
    return qp


def assert_optimal(qp: Qp) -> None:
    n, rows = qp.n, qp.rows
    d, low, high = (np.array(getattr(qp, name)[:n]) for name in ("d", "low", "high"))
    h, a = np.ctypeslib.as_array(qp.h)[:n, :n], np.ctypeslib.as_array(qp.a)[:rows, :n]
    h = np.triu(h) + np.triu(h, 1).T
    y, e, rho_1, rho_2 = (np.array(getattr(qp, name)[:rows]) for name in ("multiplier", "e", "rho_1", "rho_2"))
    excess = e + a @ d
    assert (d >= low).all()
    assert (d <= high).all()
    gradient = h @ d + np.array(qp.g[:n]) + a.T @ y
    free, scale = (d > low + 1e-6) & (d < high - 1e-6), 1e-6
    assert np.abs(gradient[free]).max(initial=0.0) < scale
    assert (gradient[d <= low + 1e-6] > -scale).all()
    assert (gradient[d >= high - 1e-6] < scale).all()
    assert (y >= -scale).all()
    over, under = excess > 1e-6, excess < -1e-6
    np.testing.assert_allclose(y[over], (rho_1 + 2 * rho_2 * excess)[over], atol=1e-5)
    assert np.abs(y[under]).max(initial=0.0) < 1e-5
    assert (y <= rho_1 + 2 * rho_2 * np.maximum(excess, 0.0) + 1e-5).all()


def test_random_programmes_are_solved() -> None:
    rng, solver, by_points = np.random.default_rng(5), load().c.ocp_qp_solve, 0
    solver.restype = ct.c_bool
    for n, rows in [(2, 0), (4, 3), (20, 10), (40, 20), (60, 30), (80, 80)] * 12:
        qp = random_qp(rng, n, rows)
        place = Memory(ct.sizeof(Qp))
        ct.memmove(place.at, ct.byref(qp), ct.sizeof(Qp))
        assert solver(place.at)
        assert place.at.value is not None
        found = Qp.from_address(place.at.value)
        assert_optimal(found)
        by_points += found.iterations > 0
        assert found.iterations < 40
    assert by_points > 10, "interior points were not tested"


def test_a_programme_that_is_not_finite_is_refused() -> None:
    solver = load().c.ocp_qp_solve
    solver.restype = ct.c_bool
    for name in ("g", "e"):
        qp = random_qp(np.random.default_rng(1), 20, 10)
        getattr(qp, name)[3] = np.nan
        place = Memory(ct.sizeof(Qp))
        ct.memmove(place.at, ct.byref(qp), ct.sizeof(Qp))
        assert not solver(place.at)
