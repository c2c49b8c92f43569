"""The comparison: its cases, its judge on made-up errors with known figures, its table, and the verb."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rt_runner.dbc import load_dbc
from tests.support.runs import ROOT, one_line, rt_runner
from tools import compare_table
from tools.compare_cases import UnknownCase, cases, chosen
from tools.compare_drives import codes
from tools.compare_judge import judge, pooled
from tools.compare_run import compare
from tools.estimators.drive import Estimates
from tools.rows import DataError

KEYS = {"rmse", "max", "rmse_hot", "detection_s", "false_alarms_per_h", "recovery_s"}
QUICK = "raw,average,lptn-kf"  # no net, no C: a second


# ---- cases ----------------------------------------------------------------------------------------------------------
def test_the_cases_are_those_asked_for():
    names = [case.name for case in cases()]
    assert names == ["nominal", "offset", "noise", "stuck", "dropout", "spike", "drift", "slow", "delay", "gain",
                     "combined", "mismatch"]  # fmt: skip
    labels = [variant.label for case in cases() for variant in case.variants]
    assert len(labels) == len(set(labels)) == 17
    offset = chosen(["offset"])[0]
    assert [(v.faults, v.window_s) for v in offset.variants] == [
        (("offset:-20@430-550",), (430.0, 550.0)), (("offset:-30@430-490",), (430.0, 490.0))]  # fmt: skip
    assert [f.channel for f in offset.variants[0].on("rotor")] == ["r"]
    assert [v.window_s for v in chosen(["mismatch"])[0].variants] == [None] * 3
    with pytest.raises(UnknownCase, match="no case 'ofset': choose from nominal, offset"):
        chosen(["ofset"])


# ---- the judge ------------------------------------------------------------------------------------------------------
TRUTH = np.column_stack([np.where(np.arange(1000) < 500, 120.0, 150.0), np.full(1000, 90.0)])  # 100 s, hot from 50.1 s


def estimates(error, fault=None, **more):
    theta = TRUTH.copy()
    theta[:, 0] += error
    return Estimates(theta, None if fault is None else np.column_stack([fault, np.zeros(1000, int)]), **more)


def seconds(*spans, n=1000):
    """1 in the half-open spans of seconds, 0 elsewhere; row k is at (k + 1) / 10 s."""
    t = np.arange(1, n + 1) * 0.1 + 1e-9
    return sum(((t >= a) & (t < b)).astype(int) for a, b in spans)


def test_errors_are_judged_from_ten_seconds_on_in_the_window_and_where_it_is_hot():
    error = 5.0 * seconds((0, 9.95)) + 1.0 * seconds((30, 40)) - 2.0 * seconds((60, 70))
    f = judge(estimates(error), TRUTH, 0, (30.0, 40.0))
    assert (f.count, f.window_count, f.hot_count) == (901, 100, 500)
    assert f.squares == pytest.approx(100 + 400)
    assert (f.most, f.window_most) == (pytest.approx(2.0), pytest.approx(1.0))
    assert f.window_squares == pytest.approx(100)
    assert f.hot_squares == pytest.approx(400)
    other = judge(estimates(error), TRUTH, 1, (30.0, 40.0))
    assert other.squares == 0.0


def test_a_silent_estimator_has_an_infinite_error_and_no_finite_figures():
    error = np.where(seconds((50, 50.15)) > 0, np.nan, 0.0)
    f = judge(estimates(error), TRUTH, 0, None)
    assert f.most == math.inf
    p = pooled([[f]])
    assert p["rmse"] is None
    assert p["max"] is None
    json.dumps(p, allow_nan=False)


def test_detection_counts_from_the_faults_start_and_alarms_outside_window_and_grace():
    fault = seconds((20, 21), (31.2, 45), (65, 66), (75, 76), (77, 78))
    f = judge(estimates(np.zeros(1000), fault), TRUTH, 0, (30.0, 40.0))
    assert f.detection_s == pytest.approx(1.2)
    assert f.alarms == 3  # 20, 75 and 77 s; 65 s lies within 30 s after the fault
    assert f.clear_h == pytest.approx((1000 - 99 - 400) * 0.1 / 3600)
    assert dict(f.classes) == {0: 12, 1: 88}
    assert (f.faulty, f.publishes, f.other_alarms) == (True, True, 0)
    missed = judge(estimates(np.zeros(1000), seconds((20, 21))), TRUTH, 0, (30.0, 40.0))
    assert missed.detection_s is None
    both = [[f, missed]]
    p = pooled(both)
    assert (p["detection_s"], p["missed"]) == (pytest.approx(1.2), 0.5)
    assert p["false_alarms_per_h"] == pytest.approx(4 / (2 * f.clear_h))
    assert p["classes_in_window"] == {"offset": pytest.approx(0.44), "ok": pytest.approx(0.56)}


def test_an_alarm_that_was_there_before_the_fault_is_a_detection_at_once_and_no_second_alarm():
    f = judge(estimates(np.zeros(1000), seconds((20, 35))), TRUTH, 0, (30.0, 40.0))
    assert (f.detection_s, f.alarms) == (pytest.approx(0.0, abs=1e-9), 1)


def test_alarms_of_the_healthy_channel_are_counted_apart():
    found = estimates(np.zeros(1000), seconds((31, 35)))
    f = judge(found, TRUTH, 1, (30.0, 40.0))  # the rotor has the fault, the winding is blamed
    assert (f.detection_s, f.alarms, f.other_alarms) == (None, 0, 1)


def test_without_a_class_nothing_is_said_about_detection_and_alarms():
    p = pooled([[judge(estimates(np.zeros(1000)), TRUTH, 0, (30.0, 40.0))]])
    assert (p["detection_s"], p["false_alarms_per_h"], p["missed"]) == (None, None, None)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (5.0 * seconds((30, 46)), 6.0),
        (5.0 * seconds((30, 40), (45, 45.95)), 6.0),  # five good seconds are no recovery
        (5.0 * seconds((30, 40), (60, 61)), 0.0),  # ten are
        (5.0 * seconds((30, 95)), None),  # the lap ends too early to know
    ],
)
def test_recovery_is_when_the_error_stays_small_for_ten_seconds(error, expected):
    found = judge(estimates(error), TRUTH, 0, (30.0, 40.0)).recovery_s
    assert found == (None if expected is None else pytest.approx(expected, abs=0.051))


def test_bound_and_uncertainty_are_held_against_the_truth():
    upper = TRUTH + 1.0 - 3.0 * seconds((60, 70))[:, None]
    sigma = np.full((1000, 2), 0.5)
    f = judge(estimates(np.full(1000, 1.0), sigma_degc=sigma, upper_degc=upper), TRUTH, 0, None)
    assert f.above_upper == 100
    assert f.nees == pytest.approx(4.0)
    assert pooled([[f]])["above_upper_share"] == pytest.approx(100 / 901)


@given(st.lists(st.tuples(st.floats(0.01, 9), st.floats(0.01, 9)), min_size=1, max_size=5))
@settings(max_examples=50, deadline=None)
def test_pooling_takes_squares_over_variants_and_means_over_seeds(sizes):
    base = judge(estimates(np.zeros(1000)), TRUTH, 0, None)
    runs = [[replace(base, squares=a**2 * base.count, most=2 * a), replace(base, squares=b**2 * base.count, most=b)]
            for a, b in sizes]  # fmt: skip
    p = pooled(runs)
    rmse = [math.sqrt((a**2 + b**2) / 2) for a, b in sizes]
    assert p["rmse"] == pytest.approx(np.mean(rmse))
    assert p["rmse_std"] == pytest.approx(np.std(rmse, ddof=1) if len(rmse) > 1 else 0.0, abs=1e-9)
    assert p["max"] == pytest.approx(np.mean([max(2 * a, b) for a, b in sizes]))
    assert p["max_worst"] == pytest.approx(max(max(2 * a, b) for a, b in sizes))


# ---- what the bus carries -------------------------------------------------------------------------------------------
@given(st.lists(st.one_of(st.floats(-1e4, 1e4), st.sampled_from([1e308, -1e308, math.inf, -math.inf])), min_size=1))
@settings(max_examples=25, deadline=None)
def test_codes_of_arrays_are_codes_of_numbers(values):
    for message in ("MotorState", "TempMeas", "Estimate"):
        for s in load_dbc()[message].payload:
            half = [(k + 0.5) * s.factor + s.offset for k in (-3, -1, 0, 1, 2)]  # ties
            everything = [*values, *half]
            np.testing.assert_array_equal(codes(s, np.array(everything)), [s.to_raw(v) for v in everything])
            assert np.isnan(codes(s, np.array([math.nan]))).all()


# ---- the table ------------------------------------------------------------------------------------------------------
def found_with(rmse_by_name):
    base = judge(estimates(np.zeros(1000)), TRUTH, 0, None)
    return {name: {"nominal": pooled([[replace(base, squares=r**2 * base.count, most=4 * r)]])}
            for name, r in rmse_by_name.items()}  # fmt: skip


def test_the_table_says_which_target_is_missed_and_who_is_better():
    nominal = chosen(["nominal"])
    good = compare_table.plain(found_with({"default": 0.1, "ukf": 0.096, "raw": 1.3}), nominal, 1, "winding")
    assert "default meets all 1 targets." in good
    assert "No baseline is more than 5 % better" in good
    bad = compare_table.markdown(found_with({"default": 0.13, "ukf": 0.12}), nominal, 1, "winding")
    assert "- default misses the target of nominal: 0.130 / 0.52, asked for 0.12 / 0.5" in bad
    assert "- nominal, RMSE: ukf 0.120 against default 0.130 °C" in bad
    assert "| **nominal**: nothing wrong | ≤ 0.12 / 0.5, **missed** | 0.130 ± 0.000 / 0.52 ± 0.00 | 0.120" in bad
    rotor = compare_table.plain(found_with({"default": 0.13}), nominal, 1, "rotor")
    assert "target" not in rotor


def test_only_what_lies_between_the_markers_is_rewritten(tmp_path):
    path = tmp_path / "doc.md"
    path.write_text(f"before\n{compare_table.BEGIN}\nold\n{compare_table.END}\nafter\n")
    text = compare_table.inserted(path, "new")
    assert text == f"before\n{compare_table.BEGIN}\nnew\n{compare_table.END}\nafter\n"
    path.write_text(text)
    assert compare_table.inserted(path, "new") == text
    for broken in ("none", compare_table.BEGIN, f"{compare_table.END} {compare_table.BEGIN}", text + text):
        path.write_text(broken)
        with pytest.raises(DataError, match="needs one line"):
            compare_table.check_document(path)


# ---- the verb -------------------------------------------------------------------------------------------------------
def test_the_number_of_processes_does_not_change_a_figure():
    some = chosen(["nominal", "offset"])
    alone = compare(["raw", "lptn-kf"], some, 2, "winding", lambda *_: None, workers=0)
    assert compare(["raw", "lptn-kf"], some, 2, "winding", lambda *_: None, workers=3) == alone
    assert alone["raw"]["nominal"]["rmse"] == pytest.approx(1.3, abs=0.1)
    assert alone["lptn-kf"]["nominal"]["rmse"] < 0.3


def test_the_document_on_standard_output_has_the_promised_form():
    done = rt_runner("compare", "--seeds", 1, "--estimators", f"default,{QUICK}", "--cases", "nominal,offset,mismatch",
                     "--json", "-")  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert list(found) == ["default", "raw", "average", "lptn-kf"]
    for row in found.values():
        assert list(row) == ["nominal", "offset", "mismatch"]
        for figures in row.values():
            assert set(figures) >= KEYS
            assert all(figures[k] is None or isinstance(figures[k], float | int) for k in KEYS)
    assert found["default"]["nominal"]["rmse"] < 0.25 < found["raw"]["nominal"]["rmse"]
    assert found["raw"]["offset"]["max"] > 25.0
    assert found["raw"]["nominal"]["detection_s"] is None


def test_the_rotors_sensor_can_have_the_faults():
    options = ("--seeds", 1, "--estimators", "raw", "--cases", "offset", "--json", "-")
    done = rt_runner("compare", *options, "--channel", "rotor")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)["raw"]["offset"]
    assert figures["max"] > 25.0
    winding = rt_runner("compare", *options)
    assert json.loads(winding.stdout)["raw"]["offset"]["rmse"] != figures["rmse"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--estimators", "defualt"), "no estimator 'defualt': choose from"),
        (("--cases", "ofset"), "no case 'ofset': choose from nominal"),
        (("--estimators", ","), "an empty list of names"),
        (("--seeds", "0"), "--seeds 0: give 1 to"),
        (("--workers", "0"), "--workers 0: give 1 or more"),
        (("--doc", "nowhere.md"), "--doc nowhere.md: No such file"),
    ],
)
def test_what_cannot_be_is_one_line_and_status_1(arguments, words):
    done = rt_runner("compare", *arguments)
    assert done.returncode == 1
    assert words in one_line(done.stderr)
    assert done.stdout == ""


def _workers(process):
    children, until = Path(f"/proc/{process.pid}/task/{process.pid}/children"), time.monotonic() + 60.0
    while not children.read_text().split():
        assert time.monotonic() < until
        time.sleep(0.1)
    return [int(pid) for pid in children.read_text().split()]


def test_interrupted_it_says_so_and_leaves_nobody_behind(tmp_path):
    out = tmp_path / "never.json"
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.compare", "--seeds", "900", "--estimators", "lptn-kf,raw", "--json", str(out)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a test run in the background ignores it
    )  # fmt: skip
    try:
        workers = _workers(process)
        time.sleep(1.0)  # at work
        os.killpg(process.pid, signal.SIGINT)
        _, words = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert one_line(words) == "compare: stopped, nothing is written"
    assert not out.exists()
    assert len(workers) > 0
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # the group is empty


def test_a_killed_worker_is_one_line_and_no_wait(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.compare", "--seeds", "900", "--estimators", "lptn-kf,raw"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        os.kill(_workers(process)[0], signal.SIGKILL)
        _, words = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 1
    assert one_line(words) == "compare: a worker process was killed; --workers 1 needs the least memory"


def test_figures_and_document_are_written(tmp_path):
    doc = tmp_path / "estimator.md"
    doc.write_text(f"# Title\n{compare_table.BEGIN}\n{compare_table.END}\n")
    done = rt_runner("compare", "--seeds", 1, "--estimators", "raw,average,lptn-kf", "--cases", "nominal,offset",
                     "--doc", doc, "--figures", tmp_path / "figures")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "| **nominal**: nothing wrong | ≤ 0.12 / 0.5 |" in doc.read_text()
    drawn = sorted(p.name for p in (tmp_path / "figures").iterdir())
    assert drawn == [f"estimator_{name}.svg" for name in ("lap", "noise", "offset", "zoom")]
    for path in (tmp_path / "figures").iterdir():
        assert path.read_text().count("<path") > 20
