"""``rt-runner run`` with a [timing] table: a run that its policy stops, what the log keeps of it, and mil's refusal."""

import json

import pytest

from rt_runner.log_reader import LogReader
from tests.support.runs import load_result, one_line, rt_runner

SCENARIO = """
title = "a job of three and a tenth periods"
duration_s = {duration}
[cycle]
kind = "lap"
start_s = 400.0
[estimator]
period_s = 0.05
{estimator}
[timing]
grace_s = 0.5
inject = ["compute:155000@20"]
{timing}
"""


def run(tmp_path, timing: str, duration: float = 3.0, estimator: str = "", verb: str = "run"):
    path, log, result = tmp_path / "s.toml", tmp_path / "s.mcap", tmp_path / "s.json"
    path.write_text(SCENARIO.format(duration=duration, timing=timing, estimator=estimator))
    bus = ("--bus", "hub") if verb == "run" else ()
    return rt_runner(verb, path, *bus, "--log", log, "--json", result), log, result


def test_a_run_that_its_policy_stops_fails_and_has_its_figures(tmp_path):
    done, log, result = run(tmp_path, 'policy = "stop:total:4"', duration=60.0)
    assert done.returncode == 2, done.stderr
    figures = load_result(result)
    assert [f["verdict"] for f in figures["findings"] if f["what"] == "policy"] == ["fail"]
    assert figures["duration_s"] < 30
    final = json.loads(LogReader(log).attachments["estimator_final.json"])
    assert final["stopped_by"] == "misses"
    timing = figures["timing"]["estimator"]
    assert timing["jobs"] == final["jobs"]
    assert timing["overrun"] == final["overrun"] >= 3
    histogram = final["histograms"]["judged"]["resp_us"]
    assert histogram["count"] == final["judged"]["jobs"] == sum(n for _, _, n in histogram["buckets"])
    assert all(low < high for low, high, _ in histogram["buckets"])
    assert histogram["buckets"][-1][0] <= histogram["max_ns"] < histogram["buckets"][-1][1]
    assert histogram["max_index"] == 20


def test_misses_of_the_run_are_judged_by_m_in_k(tmp_path):
    done, _, result = run(tmp_path, 'policy = "queue:3"\non_miss = "invalid"\nmk = [2, 10]')
    figures = load_result(result)
    finding = next(f for f in figures["findings"] if f["what"] == "(m, K)")
    assert finding["verdict"] == "fail", done.stdout
    timing = figures["timing"]["estimator"]
    assert timing["mk"]["worst"] >= 3
    assert timing["queued"] == timing["queued_jobs"] >= 2
    assert timing["outputs"]["invalid"] == timing["invalidated"] >= 3
    assert "policy" in done.stdout
    assert done.returncode == 2


@pytest.mark.parametrize(("timing", "estimator"), [("", ""), ("", 'trigger = "frame"')])
def test_mil_refuses_what_needs_time(tmp_path, timing, estimator):
    done, log, _ = run(tmp_path, timing, estimator=estimator, verb="mil")
    assert done.returncode == 1
    assert "use rt-runner run" in one_line(done.stderr)
    assert not log.exists()
