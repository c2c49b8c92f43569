"""The MHE in C against ipopt on recorded windows, against finite differences, and against its own optimality."""

from __future__ import annotations

import ctypes as ct
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from estimator_c.formulation.lstm_numpy import lstm_step
from estimator_c.formulation.mhe import MheOracle
from estimator_c.formulation.weights import NetWeights, load_weights
from tests.support.mhe_checks import equals_oracle
from tools.libest import NODES, WEIGHTS, Lib, Mhe, compile_library
from tools.mhe_recorder import Record, Recorder, record

AGREEMENT_DEGC = 1e-6
TIGHT = {"tolerance_degc": 1e-9, "max_sweeps": 60, "loss": 0}  # robust ones: test_mhe_kernels.py


@cache
def library() -> Lib:
    return Lib(compile_library(WEIGHTS))


@cache
def weights() -> NetWeights:
    return load_weights(WEIGHTS)


@cache
def oracle(statement: str) -> MheOracle:
    return MheOracle(weights(), statement)


@cache
def data() -> Record:
    return record(weights())


CASES = {
    "default": (("default", {}), {}),
    "paper": (("paper", {}), {}),
    "hard box met": (("paper", {"upper_degc": 140.0, "weight_noise": (50.0, 50.0)}), {}),
    "both hard bounds met": (("default", {"hard_bounds": True, "lower_degc": 111.0, "upper_degc": 140.5}), {}),
    "soft bound met": (("default", {"upper_degc": 140.0, "bound_weight": 300.0}), {}),
    "stiff soft bounds met": (("default", {"lower_degc": 111.0, "upper_degc": 140.0, "bound_weight": 1e5}), {}),
    "missing winding": (("default", {}), {"missing": frozenset((k, 0) for k in range(5, 60))}),
    "missing here and there": (
        ("default", {}),
        {"missing": frozenset((k, k % 2) for k in range(0, 60, 3)) | {(16, 1), (31, 0)}},
    ),
    "missing from the first": (("default", {}), {"missing": frozenset((k, c) for k in range(60) for c in (0, 1))}),
}
STEPS = (0, 1, 7, 15, 16, 17, 35)  # the growing window, the first shifts, the steady window


def recorder(name: str, **extra: float) -> Recorder:
    (setting, changes), kwargs = CASES[name]
    return Recorder(library(), weights(), library().setting(setting, **TIGHT, **changes, **extra), data(), **kwargs)


@pytest.mark.parametrize("name", CASES)
def test_equals_ipopt(name: str) -> None:
    run = recorder(name)
    active = equals_oracle(run, oracle("theta"), STEPS, AGREEMENT_DEGC)
    assert (active > 0) == ("met" in name)


@pytest.mark.parametrize("name", ["default", "both hard bounds met", "soft bound met"])
def test_both_statements_have_one_solution(name: str) -> None:
    run = recorder(name)
    for _ in range(20):
        run.advance()
        problem = run.problem()
        run.mhe.solve()
    expected = oracle("shooting").solve(problem, guess=run.mhe.theta())
    np.testing.assert_allclose(run.mhe.theta(), expected, rtol=0, atol=AGREEMENT_DEGC)


def test_late_measurement_gives_the_solution_it_would_have_given_in_time() -> None:
    late = recorder("default")
    for _ in range(20):
        late.advance()
    late.mhe.measure(0, 0, 150.0)
    late.mhe.solve()
    late.data = replace(late.data, y=late.data.y.copy())
    late.data.y[late.step, 0] = 150.0
    late.missing = frozenset()
    problem = late.problem()
    # The window solved only at its end: its memory and prior are those of the first solution, as in the problem.
    np.testing.assert_allclose(late.mhe.theta(), oracle("theta").solve(problem), rtol=0, atol=AGREEMENT_DEGC)


@pytest.mark.parametrize("name", ["default", "paper", "missing here and there"])
@pytest.mark.parametrize("steps", [3, 25])
def test_gradient_equals_finite_differences(name: str, steps: int) -> None:
    run = recorder(name)
    for _ in range(steps):
        run.advance()
        run.mhe.solve()
    rng = np.random.default_rng(steps)
    theta = run.mhe.theta() + rng.normal(0, 0.5, (run.mhe.count, 2))
    run.mhe.set_theta(theta)
    _, gradient = run.mhe.cost()
    eps = 1e-4
    for k in range(run.mhe.count):
        for channel in range(2):
            costs = []
            for sign in (1, -1):
                moved = theta.copy()
                moved[k, channel] += sign * eps
                run.mhe.set_theta(moved)
                costs.append(run.mhe.cost()[0])
            difference = (costs[0] - costs[1]) / (2 * eps)
            assert gradient[k, channel] == pytest.approx(difference, rel=1e-6, abs=1e-6 * np.abs(gradient).max())


def test_innovation_is_what_the_window_did_not_know() -> None:
    run = recorder("default")
    for _ in range(20):
        run.advance()
        run.mhe.solve()
    before = run.mhe.theta()[-1]
    c, h = run.mhe.memory_of(0, 8)
    _, _, rate = lstm_step(weights(), np.concatenate([run.data.u[run.step], before]), c, h)
    run.mhe.advance(run.data.u[run.step])
    assert run.mhe.measure(0, 0, 123.0) == pytest.approx(123.0 - (before + 0.1 * rate)[0], abs=1e-9)


@pytest.mark.parametrize(("age", "channel", "y"), [(-1, 0, 1.0), (16, 0, 1.0), (0, 2, 1.0), (0, 0, np.nan)])
def test_unusable_measurement_is_ignored(age: int, channel: int, y: float) -> None:
    run = recorder("default")
    for _ in range(20):
        run.advance()
    run.mhe.solve()
    theta = run.mhe.theta()
    assert np.isnan(run.mhe.measure(age, channel, y))
    run.mhe.solve()
    np.testing.assert_allclose(run.mhe.theta(), theta, rtol=0, atol=1e-8)  # a solve again: the rest of the tolerance


def test_sweep_limit_is_reported_and_empty_window_is_invalid() -> None:
    run = Recorder(library(), weights(), library().setting("default", max_sweeps=1, tolerance_degc=1e-9), data())
    run.advance()
    assert run.mhe.solve()[0] == 1
    empty = Mhe(library(), library().setting("default"))
    assert empty.solve()[0] == 2


@pytest.mark.parametrize("where", ["input", "prior"])
def test_not_finite_is_invalid(where: str) -> None:
    mhe = Mhe(library(), library().setting("default"))
    bad = np.array([np.nan, 100.0])
    mhe.start(bad if where == "prior" else [100.0, 100.0], np.zeros(8), np.zeros(8))
    mhe.advance(bad if where == "input" else [5000.0, 50.0])
    assert mhe.solve()[0] == 2


def test_default_setting_converges_in_few_sweeps() -> None:
    run = Recorder(library(), weights(), library().setting("default"), data())
    sweeps = []
    for _ in range(50):
        run.advance()
        status, result = run.mhe.solve()
        assert status == 0
        assert result.kkt_degc <= run.setting.tolerance_degc
        sweeps.append(result.sweeps)
    assert max(sweeps) <= 5


def test_state_size_is_what_the_header_says(tmp_path: Path) -> None:
    program = tmp_path / "size.c"
    program.write_text('#include <stdio.h>\n#include "estimator.h"\nint main(void)'
                       '{printf("%zu %zu", sizeof(mhe_t), sizeof(estimator_t));}\n')  # fmt: skip
    folder = library().path.parent
    src = Path(__file__).resolve().parents[2] / "estimator_c" / "src"
    subprocess.run(
        ["gcc", f"-I{src}", f"-I{src / 'solver'}", f"-I{folder}", str(program), "-o", str(tmp_path / "size")],
        check=True,
    )
    out = subprocess.run([str(tmp_path / "size")], capture_output=True, text=True, check=True).stdout
    mhe_bytes, estimator_bytes = map(int, out.split())
    assert mhe_bytes <= 16_384 <= Mhe.SIZE
    assert estimator_bytes <= 40_000


class BoxQp(ct.Structure):
    """box_qp_t."""

    _vector = ct.c_double * NODES
    _fields_ = (
        ("n", ct.c_int), ("diag", _vector), ("off", _vector), ("gradient", _vector), ("lower", _vector),
        ("upper", _vector), ("hard", ct.c_bool), ("rho", ct.c_double), ("factor", ct.c_double * (2 * NODES)),
    )  # fmt: skip


@hypothesis_settings(max_examples=300, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), n=st.integers(1, NODES), hard=st.booleans(),
    width=st.sampled_from([1e-3, 0.3, 1.0, 10.0]), stiffness=st.sampled_from([1e-2, 1.0, 1e3]),
)  # fmt: skip
def test_box_qp_meets_the_optimality_conditions(seed: int, n: int, hard: bool, width: float, stiffness: float) -> None:
    rng = np.random.default_rng(seed)
    off = -stiffness * rng.uniform(0.1, 1.0, n - 1)
    matrix = np.diag(off, 1) + np.diag(off, -1)
    matrix += np.diag(-matrix.sum(1) + rng.uniform(1e-2, 2.0, n))
    gradient, middle = rng.normal(0, 2.0, n), rng.normal(0, 1.0, n)
    qp = BoxQp(n=n, hard=hard, rho=float(rng.uniform(1, 1e3)))
    for name, values in (
        ("diag", np.diag(matrix)), ("off", off), ("gradient", gradient),
        ("lower", middle - width), ("upper", middle + width),
    ):  # fmt: skip
        getattr(qp, name)[: len(values)] = values.tolist()
    x = np.zeros(n)
    library().c.box_qp_factor(ct.byref(qp))
    changes = library().c.box_qp_solve(ct.byref(qp), x.ctypes.data_as(ct.c_void_p))
    assert changes >= 0
    push = -(matrix @ x + gradient)  # what the objective would move x by
    over, under = np.maximum(x - (middle + width), 0), np.maximum(middle - width - x, 0)
    scale = 1e-9 * (1 + np.abs(matrix).max() * (1 + np.abs(x).max()))
    if hard:
        assert max(over.max(), under.max()) < 1e-9
        at_upper, at_lower = x > middle + width - 1e-9, x < middle - width + 1e-9
        assert np.all(push[~at_upper] < scale)
        assert np.all(push[~at_lower] > -scale)
    else:
        np.testing.assert_allclose(push, qp.rho * (over - under), rtol=0, atol=scale * (1 + qp.rho))
