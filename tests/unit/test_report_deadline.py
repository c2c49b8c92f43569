"""The report's section on deadlines: every job is in a bar, the longest is named, a broken audit is not overlooked."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support import timing_logs as logs
from tools.report.osadl import BINS, Duration, bins_of, nice, panel, time_text
from tools.report.page import build_page
from tools.report.read import read_report


def duration(values, warmup=(), deadline_ns=None) -> Duration:
    values = np.array(values, dtype=np.int64)
    return Duration("x", "--wake", values, np.arange(1, values.size + 1), np.array(warmup, dtype=np.int64), deadline_ns)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(-1000, 10**11), min_size=1, max_size=300))
def test_no_job_is_lost_between_the_bars(values):
    b = bins_of(duration(values))
    assert b.counts.sum() + b.under + b.over == len(values)
    assert b.limit_ns >= BINS or b.limit_ns == nice(b.limit_ns)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=200), st.lists(st.integers(0, 10**9), max_size=50))
def test_the_picture_says_what_it_counts(values, warmup):
    """Bars, outlines and the overflow column as their tool tips tell."""
    svg = panel(duration(values, warmup))
    told = re.findall(r"<title>[^<]*?: ([\d\u202f]+) (jobs|in warm-up)</title>", svg)
    beyond = re.findall(r"<title>([\d\u202f]+) jobs beyond", svg)
    b = bins_of(duration(values, warmup))
    count = {kind: sum(int(n.replace("\u202f", "")) for n, k in told if k == kind) for kind in ("jobs", "in warm-up")}
    assert count["jobs"] + sum(int(n.replace("\u202f", "")) for n in beyond) == len(values)
    assert count["in warm-up"] + b.warmup_over == len(warmup)
    at = values.index(max(values)) + 1
    assert f"max {time_text(max(values))} @ release {at}<" in svg
    for number in re.findall(r'(?:x|y|width|height)="([-\d.]+)"', svg):
        assert -1 <= float(number) <= 560


def test_far_values_are_overflow_and_near_ones_stretch_the_axis():
    far = bins_of(duration([100_000] * 9995 + [50_000_000] * 5))
    assert far.over == 5
    assert far.limit_ns < 1_000_000
    near = bins_of(duration([100_000] * 9995 + [150_000] * 5))
    assert near.over == 0
    assert near.limit_ns >= 150_000


@pytest.mark.parametrize(("deadline", "drawn"), [(200_000, True), (10_000_000, False), (None, False)])
def test_the_deadline_is_drawn_where_the_axis_reaches_it(deadline, drawn):
    assert ('class="deadline"' in panel(duration([100_000, 300_000], deadline_ns=deadline))) == drawn


def test_nothing_to_show_is_said():
    assert "n/a" in panel(duration([]))


def page(path) -> str:
    return build_page(read_report(path))


def test_page_shows_misses_by_cause_and_the_audit(tmp_path):
    script = [replace(j, wall_ns=31_000_000, cause="steal") if j.release == 30 else j for j in logs.regular(40)]
    script = [j for j in script if j.release not in (31, 32, 33)]
    frames = logs.job_frames(script)
    final = logs.final_words(script, frames)
    html = page(logs.write(tmp_path / "a.mcap", frames, final, facts={}))
    assert "the books balance" in html
    assert re.search(r'<th scope="row">steal</th><td class="n hot">1</td><td class="n hot">3</td>', html)
    assert html.count('<figure class="hist"') == 3
    assert "@ release 30<" in html
    gone = ("Estimate", 20)
    html = page(logs.write(tmp_path / "b.mcap", frames, final, lambda name, n: (name, n) == gone, facts={}))
    assert "THE BOOKS DO NOT BALANCE" in html
    assert "Estimate: 1 frame missing after counter 4, release 20" in html


def test_page_of_a_log_without_a_real_time_process(tmp_path):
    frames = [f for f in logs.job_frames(logs.regular(20)) if logs.dbc()[f[1]].sender == "PLANT"]
    html = page(logs.write(tmp_path / "a.mcap", frames, facts={}))
    assert "Deadlines of" not in html
    assert "Frames on the bus" in html
