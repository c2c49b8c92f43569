"""The bench of solvers: recorded steps are the estimator's own, every backend agrees on them, figures, verb."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.mhe import LOSSES, MheOracle, MheProblem
from estimator_c.formulation.weights import load_weights
from plant_sim.faults import parse_fault
from rt_runner.cli import main as rt_runner
from tools import bench_solver
from tools.compare_drives import drive_lap, sense
from tools.libest import ROOT, WEIGHTS, Estimator, Lib, compile_library
from tools.solver_backends import stream, table
from tools.solver_backends.configs import CONFIGS, KEYS, REFERENCE, UnknownBackend, chosen
from tools.solver_backends.contraction import contraction_of
from tools.solver_backends.figures import (
    AHEAD,
    COLUMNS,
    FIELDS,
    STATUS,
    STEP_NS,
    SWEEPS,
    THETA,
    Measured,
    best_hpipm,
    document,
    figures_of,
    read_measured,
)  # fmt: skip
from tools.solver_backends.measure import Bench, pinned_core
from tools.solver_backends.oracle import Answers

DOUBLE_DEGC, FLOAT_DEGC = 1e-6, 5e-5  # the targets; float has 1.5e-5 degC between numbers


@pytest.fixture(scope="module")
def segments() -> list[stream.Segment]:
    """All situations, whole: what the bench runs."""
    return stream.record_all(WEIGHTS)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    configs = [
        c for c in CONFIGS if c.name in ("portable", "simd_avx2", "simd", "portable_f32", "simd_feedback", "portable_2")
    ]
    return Bench(WEIGHTS, tmp_path_factory.mktemp("bench"), [REFERENCE, *configs])


def test_record_has_every_kind_of_step(segments: list[stream.Segment]) -> None:
    assert sum(len(s) for s in segments) >= 20_000
    found = {op for s in segments for _, op, _ in stream.records(s.data)}
    assert found == set(range(stream.INIT, stream.SOLVE + 1))
    assert {s.situation.kind for s in segments} == {"nominal", "faults", "bounds", "quadratic"}
    losses = {int(s.data[2 + 8]) for s in segments}
    assert losses == set(range(len(LOSSES)))
    for segment in segments:
        solves = [place for place, op, _ in stream.records(segment.data) if op == stream.SOLVE]
        assert len(solves) == len(segment)
        assert solves[-1] + 2 == len(segment.data)


def test_record_is_the_same_every_time(segments: list[stream.Segment]) -> None:
    again = stream.record_all(WEIGHTS, chosen=[s.situation for s in segments[2:5]])
    for first, second in zip(segments[2:5], again, strict=True):
        assert first.data.tobytes() == second.data.tobytes()


def test_replay_gives_what_the_estimator_published(segments: list[stream.Segment], bench: Bench) -> None:
    """To the last bit: nothing that the estimator asks of its MHE is missing from the record."""
    segment = next(s for s in segments if s.situation.name == "fault noise")
    what = segment.situation
    lib = Lib(compile_library(WEIGHTS))
    lib.c.net_select(b"portable")
    drive = sense(drive_lap(), what.seed, [parse_fault(text) for text in what.faults]).cut(4200, 5200)
    out = Estimator(lib, lib.setting("default")).run(drive.torque_nm, drive.speed_rpm, drive.y, drive.first_tick)
    place = next(k for k, c in enumerate(bench.configs) if c.name == "portable")
    rows = bench.time([place], [segment], 1, 0, pinned_core()).rows[0]
    solved = np.flatnonzero(out[:, 5] > 0)  # intervals with sweeps
    assert len(solved) == len(rows)
    whole = slice(0, -15)  # the inputs behind the end are not in the record
    np.testing.assert_array_equal(rows[whole, AHEAD], out[solved][whole, :2])
    np.testing.assert_array_equal(rows[:, SWEEPS], out[solved, 5])


def test_every_backend_agrees_with_ipopt(segments: list[stream.Segment], bench: Bench) -> None:
    measured = bench.time(range(len(bench.configs)), segments, 1, 97, pinned_core())
    answers, _ = bench_solver.ask_oracle(measured, Answers(load_weights(WEIGHTS)))
    assert len(answers) >= 280
    kinds = bench_solver.kinds_of(segments)
    for at, config in enumerate(bench.configs):
        figures = figures_of(measured, at, answers, kinds, config.converges)
        if not config.converges:
            assert figures["max_error_degc"] is None
            continue
        limit = 1e-6 if at == 0 else FLOAT_DEGC if config.name == "portable_f32" else DOUBLE_DEGC
        assert figures["max_error_degc"] <= limit, config.name
        assert figures["unconverged_steps"] <= (10 if config.name == "portable_f32" else 0), config.name
    early = next(k for k, c in enumerate(bench.configs) if c.early)
    # After the rest of its work the early answer's window is the converged one.
    for place, theta in answers.items():
        np.testing.assert_allclose(measured.window(place, early), theta, rtol=0, atol=DOUBLE_DEGC)


@pytest.mark.parametrize("loss", LOSSES)
def test_oracle_is_stationary_under_every_loss(loss: str) -> None:
    """Its own optimality by finite differences of a cost written down here, outliers and missing values included."""
    weights = load_weights(WEIGHTS)
    rng = np.random.default_rng(3)
    y = 120.0 + rng.normal(0, 0.3, (6, 2))
    y[2, 0] += 9.0
    weight = np.full((6, 2), 10.0)
    weight[3, 1] = 0.0
    problem = MheProblem(
        u=rng.uniform([3000, 0], [9000, 120], (5, 2)), y=y, weight=weight, prior=np.array([120.0, 119.0]),
        weight_arrival=np.array([3.0, 5.0]), weight_noise=np.array([4e3, 4e4]), memory=np.zeros(weights.memory),
        lower=-40.0, upper=200.0, bound_weight=1e3, loss=loss, loss_scale=1.5,
    )  # fmt: skip
    theta = MheOracle(weights).solve(problem, np.full((6, 2), 120.0))

    def rho(x: np.ndarray) -> np.ndarray:
        if loss == "huber":
            return np.where(np.abs(x) > 1, np.abs(x) - 0.5, 0.5 * x**2)
        return 0.5 * x**2 / (1 + x**2) if loss == "geman-mcclure" else 0.5 * x**2

    from estimator_c.formulation.lstm_numpy import lstm_step

    def cost(t: np.ndarray) -> float:
        c, h = weights.empty_memory()
        total = 0.5 * np.sum(problem.weight_arrival * (t[0] - problem.prior) ** 2) + np.sum(
            weight * 2.25 * rho((t - y) / 1.5)
        )
        for k in range(5):
            c, h, rate = lstm_step(weights, np.concatenate([problem.u[k], t[k]]), c, h)
            total += 0.5 * np.sum(problem.weight_noise * (t[k + 1] - t[k] - weights.dt_s * rate) ** 2)
        return float(total)

    for k in range(6):
        for channel in range(2):
            step = np.zeros((6, 2))
            step[k, channel] = 1e-4
            slope = (cost(theta + step) - cost(theta - step)) / 2e-4
            curvature = (cost(theta + step) + cost(theta - step) - 2 * cost(theta)) / 1e-8
            assert curvature > 0
            assert abs(slope / curvature) < 1e-5


def test_unknown_loss_is_refused() -> None:
    zeros = np.zeros((2, 2))
    problem = MheProblem(zeros[:1], zeros, zeros, zeros[0], zeros[0], zeros[0], np.zeros(16), loss="absolute")
    with pytest.raises(ValueError, match="one of quadratic, huber, geman-mcclure"):
        MheOracle(load_weights(WEIGHTS)).solve(problem)


def test_shortened_keeps_whole_steps(segments: list[stream.Segment]) -> None:
    short = stream.shortened(segments, 1000)
    assert 1000 <= sum(len(s) for s in short) < 1000 + len(segments)
    for segment in short:
        assert [op for _, op, _ in stream.records(segment.data)][-1] == stream.SOLVE


def _measured(times_ns: list[float], theta: float) -> Measured:
    rows = np.zeros((2, len(times_ns), COLUMNS))
    rows[1, :, STEP_NS], rows[1, :, THETA], rows[1, 0, STATUS], rows[1, :, SWEEPS] = times_ns, theta, 1, 3
    windows = np.zeros((1, 2, 33))
    windows[:, :, 0] = 2
    windows[:, 1, 1:5] = 0.5
    return Measured(rows, windows, np.zeros((1, 4)), (1, 77))


def test_figures_are_what_they_say() -> None:
    measured = _measured([1000.0, 2000.0, 9000.0], 0.25)
    kinds = np.array(["a", "b", "b"])
    figures = figures_of(measured, 1, {0: np.full((2, 2), 0.1)}, kinds, True)
    assert (figures["median_us"], figures["max_us"], figures["state_bytes"]) == (2.0, 9.0, 77)
    assert figures["p99_us"] == pytest.approx(np.percentile([1, 2, 9], 99))
    assert figures["max_error_degc"] == pytest.approx(
        0.4
    )  # the oracle's window is further off than the newest node's 0.25
    assert figures["unconverged_steps"] == 1
    assert figures["kinds"]["b"]["median_us"] == 5.5
    assert figures_of(measured, 1, {}, kinds, True)["max_error_degc"] == 0.25
    assert figures_of(measured, 1, {}, kinds, False)["max_error_degc"] is None


def test_numbers_that_do_not_add_up_are_refused() -> None:
    with pytest.raises(ValueError, match="wrote 3 numbers and announced 10"):
        read_measured(np.zeros(3), ["1", "1", "0", "512", "8"])


def test_document_has_exactly_the_agreed_keys() -> None:
    fast, slow = {"median_us": 5.0}, {"median_us": 90.0}
    found = {"simd": fast, "hpipm_ocp": slow, "hpipm_full_free": {"median_us": 80.0}, "simd_2": fast}
    text = document(found)
    assert tuple(text) == KEYS
    assert all(tuple(text[key]) == FIELDS for key in KEYS)
    assert best_hpipm(found) == "hpipm_full_free"
    assert text["best_hpipm"]["median_us"] == 80.0
    assert text["portable"] == dict.fromkeys(FIELDS)


def test_backends_are_chosen_by_name() -> None:
    configs, oracle = chosen(["portable", "oracle"])
    assert [c.name for c in configs] == ["portable"]
    assert oracle
    assert "hpipm_ocp_free" in [c.name for c in chosen(["best_hpipm"])[0]]
    with pytest.raises(UnknownBackend, match="no backend 'acados': choose from simd, portable"):
        chosen(["acados"])


def test_table_goes_between_the_markers(tmp_path: Path) -> None:
    path = tmp_path / "a.md"
    path.write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n", encoding="utf-8")
    assert table.inserted(path, "new") == f"before\n{table.BEGIN}\nnew\n{table.END}\nafter\n"
    path.write_text("nothing here\n", encoding="utf-8")
    with pytest.raises(table.DocumentError, match="needs the lines"):
        table.inserted(path, "new")
    with pytest.raises(table.DocumentError, match="give a document"):
        table.inserted(tmp_path / "none.md", "new")


def test_solver_document_has_the_markers() -> None:
    text = table.inserted(ROOT / "docs" / "solver.md", "TABLE")
    assert "TABLE" in text


def test_verb_measures_and_writes(tmp_path: Path) -> None:
    out, details, doc = tmp_path / "a.json", tmp_path / "b.json", tmp_path / "c.md"
    doc.write_text(f"{table.BEGIN}\n{table.END}\n", encoding="utf-8")
    command = ["bench", "solver", "--backend", "portable,hpipm_full,oracle", "--steps", "320", "--repeat", "1"]
    assert rt_runner([*command, "--json", str(out), "--details", str(details), "--doc", str(doc)]) == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    assert tuple(found) == KEYS
    assert found["simd"] == dict.fromkeys(FIELDS)
    assert 0 < found["portable"]["median_us"] < found["hpipm_full"]["median_us"] < found["oracle"]["median_us"]
    assert found["best_hpipm"] == found["hpipm_full"]
    assert found["portable"]["max_error_degc"] < DOUBLE_DEGC
    assert "backends" in json.loads(details.read_text(encoding="utf-8"))
    assert "SQP + HPIPM, fully condensed" in doc.read_text(encoding="utf-8")


def test_instructions_are_counted_and_steady(segments: list[stream.Segment], bench: Bench) -> None:
    import shutil

    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed: instructions per step are NOT checked")
    place = next(k for k, c in enumerate(bench.configs) if c.name == "portable_2")
    chosen_segments = [s for s in segments if s.situation.name in ("lap, seed 0", "quadratic loss")]
    first = bench.count(place, chosen_segments)
    assert first is not None
    assert 50_000 < first < 400_000
    alone = bench.count(place, chosen_segments, ("timed_calls", "timed_solve"))
    assert alone is not None
    assert 0.5 * first < alone < first
    assert bench.count(place, chosen_segments) == first


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--backend", "qpoases"], "no backend 'qpoases'"),
        (["--doc", "nowhere.md"], "nowhere.md"),
        (["--weights", "no.json"], "no.json"),
    ],
)
def test_errors_are_one_line(words: list[str], said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench_solver", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_contraction_is_small_for_the_estimators_net() -> None:
    found = contraction_of(WEIGHTS, steps=40)
    assert 0 < found.median < found.largest < 0.05
    assert found.sweeps_max <= 5


def test_situations_have_names_of_their_own() -> None:
    names = [s.name for s in stream.situations()]
    assert len(set(names)) == len(names)
