"""What is read from a log's timing frames, against scripts whose every figure is known."""

import json
import math
import random
import statistics
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rt_runner.log_reader import LogReader
from rt_runner.result import CAUSES
from rt_runner.timing.age import PARTS
from rt_runner.timing.analyse import analyse
from rt_runner.timing.columns import read_columns
from rt_runner.timing.figures import as_json
from rt_runner.timing.jobs import NO_NS
from rt_runner.timing_config import grace_releases
from tests.support import timing_logs as logs
from tests.support.timing_logs import PERIOD_NS, Job

TIMES = st.integers(0, 150_000).map(lambda tenths: tenths * 100)  # up to 15 ms
IN_TIME = ("none", "stale_input", "blocked_send")
LATE = ("late_wake", "preempted", "long_compute", "blocked_send", "steal")


@st.composite
def scripts(draw) -> list[Job]:
    """Any sequence of jobs: gaps, late ones, all causes and outputs."""
    release, out = draw(st.sampled_from((1, 2, (1 << 24) - 10))), []  # the index wraps on the bus
    warm = draw(st.integers(0, 6))
    for k in range(draw(st.integers(2, 40))):
        release += draw(st.sampled_from((0, 0, 0, 0, 1, 3, 120))) if k else 0
        wall = draw(TIMES)
        job = Job(
            release=release, wake_ns=draw(TIMES), wall_ns=wall, cpu_ns=min(wall, draw(TIMES)), publish_ns=draw(TIMES),
            warmup=k < warm, output=draw(st.integers(0, 3)), canary_ns=draw(st.none() | TIMES),
            stale=draw(st.booleans()),
        )  # fmt: skip
        out.append(replace(job, cause=draw(st.sampled_from(LATE if job.late else IN_TIME))))
        release += max(1, -(-job.resp_ns // PERIOD_NS))  # the next release that this job does not run over
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("logs")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(script=scripts())
def test_summaries_and_counts_are_those_of_the_script(folder, script):
    frames = [f for f in logs.job_frames(script, plant=False)]
    report = analyse(logs.write(folder / "x.mcap", frames, facts={}))
    figures = as_json(report)
    timing = report.processes[0]
    assert list(timing.jobs.release) == [j.release for j in script]
    for window, part in (
        ("warmup", [j for j in script if j.warmup]),
        ("since_start", [j for j in script if not j.warmup]),
        ("last_second", [j for j in script if (script[-1].release - j.release) * PERIOD_NS < 10**9]),
    ):
        rows = figures["estimator"]["windows"][window]
        for metric, value in (
            ("wake_lat", lambda j: j.wake_ns), ("exec_wall", lambda j: j.wall_ns), ("exec_cpu", lambda j: j.cpu_ns),
            ("resp", lambda j: j.resp_ns), ("slack", lambda j: PERIOD_NS - j.resp_ns),
            ("canary", lambda j: j.canary_ns),
            ("preempt", lambda j: max(0, j.wall_ns - j.cpu_ns)), ("publish", lambda j: j.publish_ns),
        ):  # fmt: skip
            values = [value(j) for j in part if value(j) is not None]
            check_summary(rows[metric], values, [j.release for j in part if value(j) is not None])
    starts = [j.release * PERIOD_NS + j.wake_ns for j in script]
    deviations = [
        b - a - (y.release - x.release) * PERIOD_NS
        for a, b, x, y in zip(starts, starts[1:], script, script[1:], strict=False)
    ]
    assert list(timing.jobs.times["period_dev"][1:]) == deviations
    check_misses(figures["estimator"]["misses"], script)


def check_summary(row: dict, values: list[int], releases: list[int]) -> None:
    assert row["count"] == len(values)
    if not values:
        assert row["min_us"] is row["max_us"] is row["mean_us"] is row["p50_us"] is None
        return
    assert row["min_us"] * 1e3 == pytest.approx(min(values))
    assert row["max_us"] * 1e3 == pytest.approx(max(values))
    assert row["max_release"] == releases[values.index(max(values))]
    assert row["min_release"] == releases[values.index(min(values))]
    assert row["mean_us"] * 1e3 == pytest.approx(statistics.fmean(values), abs=0.1)
    if len(values) > 1:
        assert row["std_us"] * 1e3 == pytest.approx(statistics.stdev(values), abs=0.1)
    ordered = sorted(values)
    for name, share in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("p99.9", 0.999)):
        if len(values) * (1 - share) < 1 - 1e-9:
            assert row[f"{name}_us"] is None
        else:
            at_least = next(v for v in ordered if sum(w <= v for w in values) >= share * len(values) - 1e-9)
            assert row[f"{name}_us"] * 1e3 == pytest.approx(at_least)


def check_misses(found: dict, script: list[Job]) -> None:
    late, skipped, before = Counter(), Counter(), None
    for job in script:
        if not job.warmup:
            late[job.cause] += job.late
            if before is not None:
                grace = grace_releases(None, PERIOD_NS / 1e9) if before.warmup else 0
                skipped[before.cause] += job.release - max(before.release, min(grace, job.release - 1)) - 1
        before = job
    judged = found["since_start"]
    assert {c: r["late"] for c, r in judged["by_cause"].items() if r["late"]} == +late
    assert {c: r["skipped"] for c, r in judged["by_cause"].items() if r["skipped"]} == +skipped
    assert judged["misses"] == late.total() + skipped.total()
    first = script[0].release
    seen = [n for n in range(first, script[-1].release + 1)]
    done = {j.release: j.late for j in script}
    misses = [done.get(n, True) for n in seen]
    assert found["mk_worst"] == max(sum(misses[i : i + 100]) for i in range(len(misses)))
    runs = "".join("x" if m else " " for m in misses).split()
    assert found["consec_miss_max"] == max(map(len, runs), default=0)


def test_all_percentiles_of_a_long_log(folder):
    """From 10 000 jobs on there is a p99.99; it is the nearest rank, no floating-point neighbour of it."""
    script = [Job(n, wake_ns=100 * n) for n in range(1, 10_001)]
    keep = {"Estimate", "EstTimingA"}
    frames = [f for f in logs.job_frames(script, plant=False) if f[1] in keep]
    row = as_json(analyse(logs.write(folder / "long.mcap", frames)))["estimator"]["windows"]["since_start"]["wake_lat"]
    got = [row[f"{p}_us"] for p in ("p50", "p90", "p99", "p99.9", "p99.99")]
    assert got == pytest.approx([500.0, 900.0, 990.0, 999.0, 999.9])
    assert row["max_release"] == 10_000


def test_the_age_of_an_estimate_is_the_sum_of_its_parts(folder):
    script = logs.regular(120)
    report = analyse(logs.write(folder / "age.mcap", logs.job_frames(script), facts={}))
    ages = report.processes[0].ages
    known = 0
    for k, job in enumerate(script):
        start = logs.T0_NS + job.release * PERIOD_NS + job.wake_ns
        tick = logs.heard_tick(start)
        if tick is None:
            assert ages["e2e"][k] == NO_NS
            continue
        known += 1
        stamp = start + job.wall_ns + job.publish_ns
        assert ages["e2e"][k] == stamp - logs.sample_ns(tick)
        parts = {p: ages[f"e2e_{p}"][k] for p in PARTS}
        assert parts == {"send": logs.SEND_NS, "bus": logs.BUS_NS, "wait": start - logs.motor_ns(tick),
                         "compute": job.wall_ns, "publish": job.publish_ns, "rest": 0}  # fmt: skip
        assert sum(parts.values()) == ages["e2e"][k]
    assert known == len(script)  # the first sample came before the first release
    used = [logs.heard_tick(logs.T0_NS + j.release * PERIOD_NS + j.wake_ns) for j in script]
    firsts = [k for k in range(len(used)) if k == 0 or (used[k] or 0) // 10 != (used[k - 1] or 0) // 10]
    assert [k for k, v in enumerate(ages["sensor_to_estimate"]) if v != NO_NS] == firsts


def test_a_held_output_has_an_age_but_no_parts(folder):
    script = [replace(j, output=1) if j.release == 50 else j for j in logs.regular(60)]
    ages = analyse(logs.write(folder / "held.mcap", logs.job_frames(script), facts={})).processes[0].ages
    assert ages["e2e"][49] != NO_NS
    assert ages["e2e_wait"][49] == NO_NS
    assert ages["e2e_wait"][48] != NO_NS


def test_jobs_after_the_plants_last_sample_are_not_older_every_time(folder):
    """The plant ends, the estimator runs on: the first job with the last sample counts, the others tell nothing."""
    script = logs.regular(60)
    frames = [f for f in logs.job_frames(script[:40]) if f[1] in ("MotorState", "PlantSample", "TempMeas")]
    last = max(f[0] for f in frames if f[1] == "MotorState")
    own = [f for f in logs.job_frames(script) if logs.dbc()[f[1]].sender == "ESTIMATOR"]
    tick = max(f[2]["tick"] for f in frames if f[1] == "MotorState" and f[0] == last)
    own = [(t, n, {**v, "tick": tick} if n == "Estimate" and t > last else v) for t, n, v in own]
    log = logs.write(folder / "end.mcap", sorted(frames + own, key=lambda f: f[0]), facts={})
    ages = analyse(log).processes[0].ages["e2e"]
    assert [k for k, v in enumerate(ages) if v == NO_NS] == list(range(41, 60))


def test_a_late_estimate_is_as_old_as_it_is(folder):
    """The plant's tick, not the nearest stamp, says which sample was used: a job that took 47 ms used an old one."""
    script = [replace(j, wall_ns=47_000_000, cause="long_compute") if j.release == 30 else j for j in logs.regular(30)]
    ages = analyse(logs.write(folder / "late.mcap", logs.job_frames(script), facts={})).processes[0].ages
    longer = 47_000_000 - script[28].wall_ns + script[29].wake_ns - script[28].wake_ns
    assert ages["e2e"][29] == ages["e2e"][28] + longer


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_jobs_find_their_frames_whatever_is_missing(folder, data):
    """Each frame of a job may be missing; what is there still lands in its own job."""
    script = [Job(n, wake_ns=100 * n, wall_ns=200 * n, cpu_ns=0, publish_ns=300 * n) for n in range(1, 41)]
    gone = data.draw(st.sets(st.tuples(st.sampled_from(logs.PER_JOB), st.integers(0, 39)), max_size=60))
    frames = logs.job_frames(script, plant=False)
    log = logs.write(folder / "holes.mcap", frames, facts={}, lost=lambda name, n: (name, n) in gone)
    jobs = analyse(log).processes[0].jobs
    numbers = [n for n in range(40) if any((m, n) not in gone for m in logs.PER_JOB)]
    expected = {
        "wake_lat": [NO_NS if ("EstTimingA", n) in gone else script[n].wake_ns for n in numbers],
        "exec_wall": [NO_NS if ("EstTimingB", n) in gone else script[n].wall_ns for n in numbers],
        "exec_cpu": [NO_NS if ("EstTimingD", n) in gone else 0 for n in numbers],
    }
    for name, values in expected.items():
        assert list(jobs.times[name]) == values
    assert list(jobs.release) == [-1 if ("EstTimingA", n) in gone else n + 1 for n in numbers]


def test_columns_are_what_the_frame_reader_reads(folder):
    script = logs.regular(40, canary_ns=None)
    path = logs.write(folder / "columns.mcap", logs.job_frames(script), facts={})
    reader = LogReader(path)
    columns = read_columns(reader, {}, default=[s.name for m in logs.dbc() for s in m.signals])
    at: Counter = Counter()
    for t_ns, name, values, e2e in reader.frames():
        column, i = columns[name], at[name]
        at[name] += 1
        assert column.t_ns[i] == t_ns
        assert column.e2e[i] == e2e
        assert column.counter[i] == values["counter"]
        for signal, value in values.items():
            if signal != "counter":
                got = column.signal(signal)[i]
                assert got == value or (value is None and math.isnan(got))
    assert at == {n: len(c) for n, c in columns.columns.items() if len(c)}
    assert columns.raw_frames == sum(at.values())


def test_figures_are_json_and_name_every_cause(folder):
    rng = random.Random(5)
    script = [replace(j, cause=rng.choice(CAUSES[1:]), wall_ns=11_000_000) for j in logs.regular(40)]
    figures = as_json(analyse(logs.write(folder / "json.mcap", logs.job_frames(script), facts={})))
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    table = figures["estimator"]["misses"]["since_start"]["by_cause"]
    assert {c: row["late"] for c, row in table.items()} == dict(Counter(j.cause for j in script if not j.warmup))
