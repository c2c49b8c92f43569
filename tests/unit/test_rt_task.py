"""Every counter of the real-time task is exact: scripted delays against the definitions."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit import rt_shim

MS = 1_000_000
CAUSE = {"none": 0, "late_wake": 1, "preempted": 2, "long_compute": 3, "stale_input": 4, "blocked_send": 5}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return rt_shim.build(tmp_path_factory.mktemp("rt_task"))


def step(**values) -> dict:
    return dict.fromkeys(rt_shim.SCRIPT_FIELDS, 0) | {"cpu_ns": 1000, "sent": 1} | values


def config(period_ns=MS, deadline_ns=None, t0_ns=0, warmup=0, virtual=False):
    return rt_shim.Config(period_ns, deadline_ns or period_ns, t0_ns, warmup, virtual)


def by_definition(period_ns, deadline_ns, t0_ns, warmup, jobs) -> dict[str, dict[str, int]]:
    """The counters straight from the definitions, release by release. Slow and obvious on purpose."""
    executed = {job["index"]: job for job in jobs}
    last = jobs[-1]["index"]
    while t0_ns + (last + 1) * period_ns < jobs[-1]["done_ns"]:
        last += 1
    windows = {
        "total": range(1, last + 1),
        "warmup": range(1, min(warmup, last) + 1),
        "judged": range(warmup + 1, last + 1),
    }
    result = {}
    for name, window in windows.items():
        miss = [
            n not in executed or executed[n]["published_ns"] - (t0_ns + n * period_ns) > deadline_ns
            for n in window
        ]
        run = best = 0
        for m in miss:
            run = run + 1 if m else 0
            best = max(best, run)
        hit = 0
        for n in window:
            if n in executed:
                job = executed[n]
                hit += sum(
                    job["start_ns"] <= t0_ns + m * period_ns < job["done_ns"] for m in range(n + 1, last + 2)
                )
        jobs_in = sum(n in executed for n in window)
        result[name] = {
            "releases": len(window),
            "jobs": jobs_in,
            "miss_late": sum(miss) - (len(window) - jobs_in),
            "miss_skipped": len(window) - jobs_in,
            "overrun": hit,
            "consec_miss_max": best,
            "mk_worst": max((sum(miss[max(0, i - 99) : i + 1]) for i in range(len(miss))), default=0),
        }
    return result


duration = st.one_of(
    st.just(0), st.integers(0, 2 * MS), st.sampled_from([MS, 2 * MS, 3 * MS]), st.integers(0, 9 * MS)
)
scripted = st.builds(
    step,
    interrupts=st.integers(0, 2),
    interrupt_ns=st.integers(0, MS),
    wake_ns=duration,
    cpu_ns=duration,
    away_ns=duration,
    publish_ns=duration,
    rest_ns=duration,
    sent=st.integers(0, 1),
    stale=st.integers(0, 1),
)
quiet = st.just(step())


@settings(max_examples=300, deadline=None)
@given(
    steps=st.lists(st.one_of(quiet, quiet, scripted), min_size=1, max_size=160),
    t0_ns=st.integers(-5 * MS, 10**15),
    start_ns=st.integers(-3 * MS, 7 * MS),
    warmup=st.integers(0, 40),
    deadline_ns=st.integers(1, MS),
)
def test_counters_equal_the_definitions(library, steps, t0_ns, start_ns, warmup, deadline_ns):
    cfg = config(deadline_ns=deadline_ns, t0_ns=t0_ns, warmup=warmup)
    status, jobs, counters, wake = rt_shim.run(library, cfg, t0_ns + start_ns, steps)
    assert status == 0, f"releases = jobs + skipped broke in step {status}"
    assert counters == by_definition(MS, deadline_ns, t0_ns, warmup, jobs)
    judged = [job["wake_lat_ns"] for job in jobs if job["index"] > warmup]
    assert wake.count == len(judged)
    if judged:
        assert (wake.min_ns, wake.max_ns) == (min(judged), max(judged))
    previous = None
    for job, script in zip(jobs, steps, strict=True):
        assert job["release_ns"] == t0_ns + job["index"] * MS, "the grid moved"
        assert job["wake_lat_ns"] == job["start_ns"] - job["release_ns"] >= 0
        assert job["resp_ns"] == job["published_ns"] - job["release_ns"]
        assert job["miss_late"] == (job["resp_ns"] > deadline_ns)
        assert job["after_skip"] == (job["index"] != (previous["index"] + 1 if previous else 1))
        if previous:  # the first release that had not passed when the job before was done, and no other
            assert job["release_ns"] >= previous["done_ns"] or job["index"] == previous["index"] + 1
            assert job["release_ns"] - MS < max(previous["done_ns"], previous["release_ns"] + 1)
        parts = [job["wake_lat_ns"], script["away_ns"], script["cpu_ns"], script["publish_ns"]]
        if job["miss_late"]:
            causes = (CAUSE["late_wake"], CAUSE["preempted"], CAUSE["long_compute"], CAUSE["blocked_send"])
            assert job["cause"] == causes[parts.index(max(parts))]
        else:
            expected = "blocked_send" if not script["sent"] else "stale_input" if script["stale"] else "none"
            assert job["cause"] == CAUSE[expected]
        previous = job


@pytest.mark.parametrize(
    ("busy_ms", "overrun", "next_index"),
    [(0.9, 0, 2), (1.0, 0, 2), (1.1, 1, 3), (3.0, 2, 4), (3.1, 3, 5)],
)
def test_overrun_counts_activations_not_events(library, busy_ms, overrun, next_index):
    steps = [step(cpu_ns=int(busy_ms * MS)), step()]
    status, jobs, counters, _ = rt_shim.run(library, config(), 0, steps)
    assert status == 0
    assert counters["total"]["overrun"] == overrun == counters["total"]["miss_skipped"]
    assert jobs[1]["index"] == next_index
    assert jobs[1]["wake_lat_ns"] == 0, "the phase is kept"
    assert counters["total"]["miss_late"] == (busy_ms > 1.0)


def test_late_wake_is_counted_from_the_intended_release(library):
    status, jobs, counters, _ = rt_shim.run(library, config(), 0, [step(wake_ns=2_300_000), step()])
    assert status == 0
    assert jobs[0]["index"] == 1
    assert jobs[0]["wake_lat_ns"] == 2_300_000
    assert (jobs[0]["miss_late"], jobs[0]["cause"]) == (1, CAUSE["late_wake"])
    assert jobs[1]["index"] == 4
    assert jobs[1]["after_skip"] == 1
    assert counters["total"]["miss_skipped"] == 2
    assert counters["total"]["overrun"] == 0, "nothing was running when those releases passed"


def test_a_day_of_suspension_costs_nothing_and_is_counted(library):
    day = 86_400 * 1000
    status, jobs, counters, _ = rt_shim.run(library, config(), 0, [step(wake_ns=day * MS), step()])
    assert status == 0
    # Woken exactly on release 1 + day, which then passes while the job runs.
    assert counters["total"]["miss_skipped"] == day
    assert counters["total"]["overrun"] == 1
    assert counters["total"]["mk_worst"] == 100
    assert counters["total"]["consec_miss_max"] == day + 1
    assert jobs[1]["index"] == day + 2


def test_virtual_time_runs_every_release_and_has_no_wake_latency(library):
    steps = [step(cpu_ns=5 * MS) for _ in range(20)]
    status, jobs, counters, wake = rt_shim.run(library, config(virtual=True), 10**12, steps)
    assert status == 0
    assert [job["index"] for job in jobs] == list(range(1, 21))
    assert {job["wake_lat_ns"] for job in jobs} == {-1}
    assert {job["resp_ns"] for job in jobs} == {5 * MS}
    assert counters["total"]["miss_skipped"] == counters["total"]["overrun"] == 0
    assert counters["total"]["miss_late"] == 0, "record time stands still while a job runs: it cannot be late"
    assert wake.count == 0


@pytest.mark.parametrize(("period_ns", "deadline_ns"), [(0, 1), (-1, 1), (MS, 0), (MS, MS + 1), (MS, -5)])
def test_impossible_configurations_are_refused(library, period_ns, deadline_ns):
    bad = rt_shim.Config(period_ns, deadline_ns, 0, 0, False)
    assert library.shim_init(rt_shim.ct.byref(bad)) == 2
