"""The reference backend: its model against the net, its answers against ipopt in every form, its refusals."""

from __future__ import annotations

import ctypes as ct
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from estimator_c.formulation.lstm_numpy import lstm_step
from estimator_c.formulation.mhe import LOSSES
from estimator_c.formulation.settings import FIELDS
from estimator_c.formulation.weights import load_weights
from tests.support.nets import random_net
from tools.libest import WEIGHTS
from tools.solver_backends.build import BuildError, build_hpipm
from tools.solver_backends.configs import CONFIGS, HPIPM, REFERENCE, Config
from tools.solver_backends.figures import THETA
from tools.solver_backends.measure import Bench, pinned_core
from tools.solver_backends.model import model_functions
from tools.solver_backends.oracle import NODES, Answers, problem_of
from tools.solver_backends.stream import Segment, Situation, record_all, situations

TIGHT_DEGC = 146.5
MEMORY = 16  # of the estimator's net
AT_BOUND_DEGC = 5e-5  # an interior point stays off a hard bound that hardly pushes
AGREEMENT_DEGC = 5e-6  # of SQP stopped at 1e-6 degC, QPs at 1e-8
FORMS = ("hpipm_ocp", "hpipm_pcond5", "hpipm_full", "hpipm_ocp_free", "hpipm_full_free")
SHOWN = (
    "lap, seed 0",
    "fault offset",
    "fault noise",
    "hard box met",
    "soft bound met",
    "paper, hard box",
    "Huber loss",
)
NETS = {
    "lstm 8": None,
    "lstm 4": ("lstm", 1, 4),
    "lstm 2x8": ("lstm", 2, 8),
    "gru 8": ("gru", 1, 8),
    "gru 2x5": ("gru", 2, 5),
}


@pytest.fixture(scope="module")
def segments() -> list[Segment]:
    """The first 18 s of each: faults last from 10 s on."""
    chosen = [replace(s, end_s=s.begin_s + 18.0) for s in situations() if s.name in SHOWN]
    return record_all(WEIGHTS, chosen=[tightened(s) if "met" in s.name or s.setting == "paper" else s for s in chosen])


def tightened(situation: Situation) -> Situation:
    """Bounds tight enough to be met from the first seconds on."""
    return replace(
        situation,
        begin_s=430.0,
        end_s=448.0,
        changes=situation.changes | {"upper_degc": TIGHT_DEGC, "lower_degc": -20.0},
    )


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    chosen = [config for config in CONFIGS if config.name in FORMS]
    return Bench(WEIGHTS, tmp_path_factory.mktemp("bench"), [REFERENCE, *chosen])


@pytest.mark.parametrize("name", NETS)
def test_model_is_the_net_and_its_derivative(name: str, tmp_path: Path) -> None:
    kind = NETS[name]
    path = WEIGHTS if kind is None else random_net(tmp_path, kind[2], 1, cell=kind[0], layers=kind[1])
    weights = load_weights(path)
    linear, plain = model_functions(weights)
    rng = np.random.default_rng(5)
    u, theta, memory = ca.SX.sym("u", 2), ca.SX.sym("theta", 2), ca.SX.sym("memory", weights.memory)
    following = ca.vertcat(*plain(u, theta, memory))
    derivative = ca.Function("derivative", [u, theta, memory], [ca.jacobian(following, ca.vertcat(theta, memory))])
    for _ in range(5):
        at = (rng.uniform([0, -150], [11000, 150]), rng.uniform(20, 170, 2), rng.normal(0, 0.4, weights.memory))
        found = [np.array(value) for value in linear(*at)]
        c, h, rate = lstm_step(weights, np.concatenate(at[:2]), at[2][: weights.memory_c], at[2][weights.memory_c :])
        np.testing.assert_allclose(found[0].ravel(), at[1] + weights.dt_s * rate, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[1].ravel(), np.concatenate([c, h]), rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[2], np.array(derivative(*at)), rtol=0, atol=1e-12)


def test_step_in_place_is_the_step(bench: Bench, tmp_path: Path) -> None:
    """model_ahead() overwrites what it reads from."""
    library = ct.CDLL(str(build_hpipm(WEIGHTS, tmp_path)))
    weights = load_weights(WEIGHTS)
    rng = np.random.default_rng(2)
    u, theta, memory = np.array([6000.0, 90.0]), np.array([140.0, 110.0]), rng.normal(0, 0.4, weights.memory)
    expected = [np.array(value).ravel() for value in model_functions(weights)[1](u, theta, memory)]
    library.model_ahead(*(a.ctypes.data_as(ct.c_void_p) for a in (u, theta, memory)))
    np.testing.assert_allclose(theta, expected[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory, expected[1], rtol=0, atol=1e-12)


def test_every_form_equals_ipopt(bench: Bench, segments: list[Segment]) -> None:
    measured = bench.time(range(len(bench.configs)), segments, 1, 9, pinned_core())
    answers, checked = Answers(load_weights(WEIGHTS)), 0
    for place in range(len(measured.windows)):
        start = measured.window(place, 0)
        if len(start) < NODES:
            continue
        hard = problem_of(measured.problems[place, 1:], MEMORY).bound_weight is None
        expected = answers.ask(measured.problems[place, 1:], start).theta_degc
        for at, config in enumerate(bench.configs):
            limit = 1e-6 if at == 0 else AT_BOUND_DEGC if hard else AGREEMENT_DEGC
            np.testing.assert_allclose(
                measured.window(place, at), expected, rtol=0, atol=limit, err_msg=f"{config.name}, step {9 * place}"
            )
        checked += 1
    assert checked > 100
    for at, config in enumerate(bench.configs[1:], start=1):  # and so do the growing windows, and all other steps
        apart = np.abs(measured.rows[at, :, THETA] - measured.rows[0, :, THETA]).max()
        assert apart < AT_BOUND_DEGC, config.name


def test_bounds_are_met_in_what_was_compared(bench: Bench, segments: list[Segment]) -> None:
    tight = [s for s in segments if s.situation.changes.get("upper_degc") == TIGHT_DEGC]
    assert len(tight) == 3
    measured = bench.time([0], tight, 1, 1, pinned_core())
    ends = np.cumsum([len(s) for s in tight])
    tops = [max(measured.window(k, 0)[:, 0].max() for k in range(a, b)) for a, b in zip([0, *ends], ends, strict=False)]
    hard = [s.situation.name != "soft bound met" for s in tight]
    for top, is_hard in zip(tops, hard, strict=True):
        assert top == pytest.approx(TIGHT_DEGC, abs=1e-9) if is_hard else top > TIGHT_DEGC


def test_losses_are_numbered_as_in_the_settings() -> None:
    field = next(field for field in FIELDS if field.c_name == "loss")
    assert tuple(field.choices) == LOSSES


def test_unknown_form_is_refused(tmp_path: Path) -> None:
    machine = Bench(WEIGHTS, tmp_path, [REFERENCE, Config("x", "", HPIPM, "ocp-best")])
    assert machine.runs(0)
    assert not machine.runs(1)


def test_wheel_without_hpipm_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ca, "__file__", str(tmp_path / "casadi" / "__init__.py"))
    with pytest.raises(BuildError, match=r"no libhpipm\.so: install a casadi wheel"):
        build_hpipm(WEIGHTS, tmp_path)
