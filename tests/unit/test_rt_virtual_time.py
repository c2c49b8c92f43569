"""The real-time task in virtual time: every figure of every job equals the definitions, whatever the machine does.

The C runs in a scripted machine (rt_world_shim.c); tests/support/timing_model.py is told what the clock said and knows
what should have come of it.
"""

from __future__ import annotations

import math
from itertools import pairwise, product

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support import timing_model as tm
from tests.unit import rt_shim

US = 1_000
MS = 1_000_000
OVERRUN = {"skip": 0, "queue": 1, "rebase": 2, "cut": 0, "stop": 0}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return rt_shim.World(rt_shim.build(tmp_path_factory.mktemp("rt_world")))


def config_of(setting: tm.Setting):
    policy, (m, k) = setting.policy, setting.mk or (0, 0)
    reaction = rt_shim.Reaction(
        OVERRUN[policy.name], policy.queue, policy.budget_ns, policy.stop_total, policy.stop_row
    )
    return rt_shim.Config(
        setting.period_ns, setting.deadline_ns, setting.t0_ns, setting.warmup, False, False, reaction, m, k
    )


def machine(setting: tm.Setting, start_ns: int = 0, canary_lat_ns: int = 0, theft_is_cpu: int = 0) -> dict:
    return {
        "start_ns": setting.t0_ns + start_ns,
        "canary": setting.canary,
        "canary_lat_ns": canary_lat_ns,
        "theft_is_cpu": theft_is_cpu,
    }


def quiet(**changes: int) -> dict:
    step = dict.fromkeys(rt_shim.STEP_FIELDS, 0) | {"iterations": 1, "cpu_ns": 1000, "sent": 1}
    return step | changes


TRACE = tuple(tm.Trace.__dataclass_fields__)


def model_of(setting: tm.Setting, jobs: list[dict], heard: list[tuple[int, int]], steps: list[dict]) -> tm.Model:
    """Runs the model over what the clock said and compares every job as it goes."""
    model, known = tm.Model(setting), 0
    for job, step in zip(jobs, steps, strict=False):
        assert not model.stopped(), "ran on after its policy's number of misses"
        assert job["broken"] == 0, "releases = jobs + skipped + queued does not hold at every instant"
        upto = known
        while upto < len(heard) and heard[upto][1] <= job["published_ns"]:
            upto += 1
        stimulus = {name: step[name] if name in ("sent", "stale") else job[name] for name in TRACE}
        due_ns = heard[upto][0] if upto < len(heard) else None
        expected = model.run(tm.Trace(**stimulus), heard[known:upto], due_ns)
        known = upto
        want = vars(expected) | {"cause": tm.CAUSES.index(expected.cause)}
        assert {name: job[name] for name in want} == want
        assert job["slept_until_ns"] == want["release_ns"]
        assert job["expired"] == want["cut"]
        fates = list(model.fate.values())
        running = {
            "releases": len(fates),
            "jobs": len(model.jobs),
            "miss_skipped": fates.count("skipped"),
            "queued_now": fates.count("waiting"),
            "overrun": len(model.overruns),
            "phase_ns": model.phase_ns,
        }
        assert {name: job[name] for name in running} == running
    return model


def check_histogram(world, metric: int, warmup: bool, model: tm.Model) -> int:
    name, summary, buckets = world.histogram(metric, warmup)
    samples = model.samples.get((name, warmup), [])
    values = [value for value, _ in samples]
    assert summary.count == len(values), name
    assert (summary.underflow, summary.overflow, buckets) == tm.histogram(values), name
    if values:
        assert (summary.min_ns, summary.max_ns) == (min(values), max(values)), name
        by_value = {value: index for value, index in reversed(samples)}
        assert (summary.min_index, summary.max_index) == (by_value[min(values)], by_value[max(values)]), name
        scale = max(1, max(map(abs, values)))
        mean = sum(values) / len(values)
        assert math.isclose(summary.mean_ns, mean, rel_tol=1e-9, abs_tol=1e-9 * scale)
        if len(values) > 1:
            std = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1))
            assert math.isclose(summary.std_ns, std, rel_tol=1e-6, abs_tol=1e-6 * scale)
    return len(values)


def check(world, setting: tm.Setting, steps: list[dict], thefts: list[tuple[int, int]], **how: int) -> tm.Model:
    """Runs the C and the model and compares all they say. Returns the model."""
    jobs, heard = world.run(config_of(setting), machine(setting, **how), thefts, steps)
    assert jobs is not None, "refused"
    model = model_of(setting, jobs, heard, steps)
    assert model.stopped() or len(jobs) == len(steps)
    tallies, causes, (cut, rebased, phase_ns, migrations) = world.counters()
    assert tallies == {name: model.counters(name) for name in tallies}
    for found, want in zip(causes, model.causes(), strict=True):
        assert dict(zip(tm.CAUSES, found, strict=True)) == {name: want[name] for name in tm.CAUSES}
    assert (cut, rebased, phase_ns) == (sum(job.cut for job in model.jobs), model.rebased, model.phase_ns)
    cores = [step["core"] for step in steps[: len(jobs)]]
    assert migrations == sum(a != b for a, b in pairwise(cores))
    windows = product(range(rt_shim.METRICS), (False, True))
    counts = [check_histogram(world, metric, warmup, model) for metric, warmup in windows]
    assert sum(counts) >= 7 * len(jobs)
    return model


# ---- any machine ----------------------------------------------------------------------------------------------------

amount = st.one_of(
    st.integers(0, 2 * MS),
    st.sampled_from([0, 1, MS - 1, MS, MS + 1, 2 * MS, 3 * MS, 3 * MS + 100 * US]),
    st.integers(0, 9 * MS),
)
policies = st.one_of(
    st.just(tm.Policy()),
    st.builds(tm.Policy, st.just("queue"), st.integers(1, 4)),
    st.just(tm.Policy("rebase")),
    st.builds(tm.Policy, st.just("cut"), budget_ns=st.integers(1, MS // 2)),
    st.builds(tm.Policy, st.just("stop"), stop_total=st.integers(1, 12)),
    st.builds(tm.Policy, st.just("stop"), stop_row=st.integers(1, 8)),
)


kinds = st.sampled_from(
    ("wake_ns", "wake_ns", "cpu_ns", "away_ns", "publish_ns", "rest_ns", "sent", "stale", "core", "interrupts")
)
troubles = st.lists(st.tuples(st.integers(0, 47), kinds, amount), max_size=10)
gaps_and_lengths = st.lists(
    st.tuples(st.integers(0, 12 * MS), st.one_of(st.integers(1, 300 * US), st.integers(1, 4 * MS))), max_size=6
)
timing_settings = st.builds(
    tm.Setting,
    period_ns=st.just(MS),
    deadline_ns=st.one_of(st.just(MS), st.integers(MS // 2, MS)),
    t0_ns=st.sampled_from([0, -3 * MS, 10**15 + 7]),
    warmup=st.integers(0, 12),
    policy=policies,
    mk=st.one_of(st.none(), st.tuples(st.integers(0, 5), st.integers(6, 40))),
    canary=st.integers(0, 2),
)
ordinary_step = st.builds(
    quiet,
    cpu_ns=st.sampled_from([1000, 100 * US, 300 * US]),
    iterations=st.integers(1, 4),
    publish_ns=st.sampled_from([0, 5 * US]),
    rest_ns=st.sampled_from([0, 5 * US]),
)
habits = st.fixed_dictionaries(
    {
        "start_ns": st.sampled_from([0, -2 * MS, 500 * US, 5 * MS]),
        "canary_lat_ns": st.sampled_from([0, 30 * US, 100 * US, 400 * US]),
        "theft_is_cpu": st.integers(0, 1),
    }
)


def spoilt(ordinary: dict, count: int, things: list[tuple[int, str, int]]) -> list[dict]:
    """`count` ordinary steps, in which a few things go wrong."""
    steps = [dict(ordinary) for _ in range(count)]
    for at, kind, value in things:
        step = steps[at % count]
        step[kind] = step[kind] + value if kind.endswith("_ns") else 1 - step[kind]
    return steps


def spans(t0_ns: int, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """When the core is stolen, from gaps and lengths."""
    result, at_ns = [], t0_ns
    for gap, length in pairs:
        result.append((at_ns + gap, at_ns + gap + length))
        at_ns += gap + length + 1
    return result


@settings(max_examples=1000, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(timing_settings, ordinary_step, st.integers(1, 48), troubles, gaps_and_lengths, habits)
def test_every_figure_equals_the_definitions(world, setting, ordinary, count, things, pairs, how):
    check(world, setting, spoilt(ordinary, count, things), spans(setting.t0_ns, pairs), **how)
