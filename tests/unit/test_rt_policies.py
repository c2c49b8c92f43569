"""Each policy's reaction to a job of 3.1 T, each cause with and without the canary, the (m, K) monitor: by name."""

from __future__ import annotations

import ctypes as ct

import pytest

from tests.support import timing_model as tm
from tests.unit import rt_shim
from tests.unit.test_rt_virtual_time import MS, US, check, config_of, quiet

LONG = quiet(cpu_ns=3_100 * US)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return rt_shim.build(tmp_path_factory.mktemp("rt_policies"))


@pytest.fixture(scope="module")
def world(library):
    return rt_shim.World(library)


SKIP = tm.Policy()


def setting(policy: tm.Policy = SKIP, **changes) -> tm.Setting:
    return tm.Setting(**{"period_ns": MS, "deadline_ns": MS, "policy": policy} | changes)


@pytest.mark.parametrize(
    ("policy", "ran", "late", "skipped"),
    [
        (tm.Policy(), [1, 2, 6, 7], 1, 3),
        (tm.Policy("queue", 1), [1, 2, 3, 6], 2, 2),
        (tm.Policy("queue", 2), [1, 2, 3, 4], 3, 1),
        (tm.Policy("queue", 3), [1, 2, 3, 4], 3, 0),
        (tm.Policy("rebase"), [1, 2, 3, 4], 1, 0),
        (tm.Policy("stop", stop_total=5), [1, 2, 6, 7], 1, 3),
    ],
)
def test_a_job_of_3_1_periods_is_3_overruns_under_every_policy(world, policy, ran, late, skipped):
    model = check(world, setting(policy), [quiet(), LONG, quiet(), quiet()], [])
    total = model.counters("total")
    assert [job.index for job in model.jobs] == ran
    assert (total["overrun"], total["miss_late"], total["miss_skipped"]) == (3, late, skipped)


def test_queue_catches_up_and_says_so(world):
    model = check(world, setting(tm.Policy("queue", 3)), [LONG, *[quiet(cpu_ns=200 * US)] * 5], [])
    assert [job.queued for job in model.jobs] == [False, True, True, True, False, False]
    assert [job.cause for job in model.jobs] == ["long_compute"] * 3 + ["none"] * 3
    assert [job.resp_ns for job in model.jobs[1:4]] == [2_300 * US, 1_500 * US, 700 * US]


def test_rebase_moves_the_grid_and_tells_by_how_much(world):
    model = check(world, setting(tm.Policy("rebase")), [LONG, quiet(), quiet()], [])
    assert [job.release_ns for job in model.jobs] == [MS, 4_100 * US, 5_100 * US]
    assert (model.phase_ns, model.rebased) == (2_100 * US, 1)


def test_cut_ends_the_solver_at_the_budget_counted_from_the_release(world):
    long = quiet(cpu_ns=100 * US, iterations=10, wake_ns=150 * US)
    model = check(world, setting(tm.Policy("cut", budget_ns=600 * US)), [long, quiet(iterations=10)], [])
    assert [(job.cut, job.resp_ns, job.miss_late) for job in model.jobs] == [
        (True, 650 * US, False),
        (False, 10 * US, False),
    ]


@pytest.mark.parametrize(
    ("policy", "last"), [(tm.Policy("stop", stop_total=2), 10), (tm.Policy("stop", stop_row=3), 12)]
)
def test_stop_after_misses_in_total_or_in_a_row_but_not_in_the_start_up_grace(world, policy, last):
    late = quiet(cpu_ns=1_200 * US)  # and takes the release behind it
    steps = [*[late] * 4, quiet(), *[late] * 5]
    model = check(world, setting(policy, warmup=8), steps, [])
    assert [job.index for job in model.jobs] == [1, 3, 5, 7, 9, 10, 12][: 6 if last == 10 else 7]
    assert model.counters("warmup")["consec_miss_max"] == 8


def test_stop_counts_skipped_releases(world):
    model = check(world, setting(tm.Policy("stop", stop_row=4)), [quiet(), LONG, quiet()], [])
    assert len(model.jobs) == 2


STOLEN = [(900 * US, 3_400 * US)]  # around the first release at 1 ms; the canary is due at 1.25 ms


@pytest.mark.parametrize(
    ("canary", "steps", "thefts", "theft_is_cpu", "cause"),
    [
        (0, [quiet()], STOLEN, 0, "late_wake"),
        (1, [quiet()], STOLEN, 0, "late_wake"),
        (2, [quiet(wake_ns=50 * US)], STOLEN, 0, "steal"),  # the canary is the first to get the core back
        (2, [quiet(wake_ns=2 * MS)], [], 0, "late_wake"),
        # stolen while computing: gone from the clock of the processor, or hidden in it
        (2, [quiet(cpu_ns=100 * US)], [(1_050 * US, 3_400 * US)], 0, "steal"),
        (2, [quiet(cpu_ns=100 * US)], [(1_050 * US, 3_400 * US)], 1, "steal"),
        (0, [quiet(cpu_ns=100 * US)], [(1_050 * US, 3_400 * US)], 0, "preempted"),
        (0, [quiet(cpu_ns=100 * US)], [(1_050 * US, 3_400 * US)], 1, "long_compute"),
        # stolen while sending
        (2, [quiet(publish_ns=100 * US)], [(1_050 * US, 3_400 * US)], 1, "steal"),
        # late anyhow: what was stolen is no excuse
        (2, [quiet(cpu_ns=1_500 * US)], [(1_200 * US, 3_400 * US)], 1, "long_compute"),
        (2, [quiet(away_ns=2 * MS)], [], 0, "preempted"),
        (2, [quiet(cpu_ns=2 * MS)], [], 0, "long_compute"),
        (2, [quiet(publish_ns=2 * MS)], [], 0, "blocked_send"),
        # between two wake-ups of the canary: nobody saw it
        (2, [quiet(cpu_ns=700 * US)], [(1_260 * US, 1_740 * US)], 1, "long_compute"),
        (2, [quiet(stale=1)], [], 0, "stale_input"),
        (2, [quiet(sent=0, stale=1)], [], 0, "blocked_send"),
    ],
)
def test_cause_of_a_miss_with_and_without_the_canary(world, canary, steps, thefts, theft_is_cpu, cause):
    model = check(world, setting(canary=canary), steps, thefts, theft_is_cpu=theft_is_cpu, canary_lat_ns=30 * US)
    assert model.jobs[0].cause == cause


def test_a_canary_that_is_overdue_when_the_job_is_out_is_evidence_too(world):
    # The canary gets the core back after the job: what it sleeps for, since 1.25 ms, is known all the same.
    model = check(world, setting(canary=2), [quiet()], STOLEN, canary_lat_ns=90 * US)
    assert (model.jobs[0].cause, model.jobs[0].stolen_ns) == ("steal", 3_400 * US - 1_250 * US)


def test_an_ordinary_wake_up_of_the_canary_excuses_nothing(world):
    model = check(world, setting(canary=2), [quiet(cpu_ns=1_050 * US)], [], canary_lat_ns=100 * US)
    assert (model.jobs[0].cause, model.jobs[0].stolen_ns) == ("long_compute", 0)


def test_what_waits_behind_a_theft_was_stolen_too_and_so_are_the_releases_it_took(world):
    model = check(world, setting(tm.Policy("queue", 1), canary=2), [quiet(), quiet()], [(900 * US, 3_400 * US)])
    assert [(job.index, job.cause) for job in model.jobs] == [(1, "steal"), (2, "steal")]
    assert model.causes()[1] == {"steal": 1}


def test_mk_monitor_in_order_of_release(world):
    late = quiet(cpu_ns=1_500 * US)
    # late, skipped, in time, in time, …: windows of three that end on a skipped release or on the next one hold two
    model = check(world, setting(mk=(1, 3)), [late, quiet(), quiet()] * 5, [])
    judged = model.counters("judged")
    assert (judged["mk_misses_max"], judged["mk_violations"]) == (2, 10)


@pytest.mark.parametrize(
    ("changes", "accepted"),
    [
        ({"policy": tm.Policy("queue", 64)}, True),
        ({"policy": tm.Policy("queue", 65)}, False),
        ({"policy": tm.Policy("queue", 0)}, False),
        ({"policy": tm.Policy("skip", 1)}, False),
        ({"policy": tm.Policy("cut", budget_ns=MS)}, True),
        ({"policy": tm.Policy("cut", budget_ns=MS + 1)}, False),
        ({"policy": tm.Policy("cut", budget_ns=-1)}, False),
        ({"mk": (0, 100)}, True),
        ({"mk": (4, 4)}, False),
        ({"mk": (1, 101)}, False),
    ],
)
def test_impossible_reactions_are_refused(library, changes, accepted):
    config = config_of(setting(**changes))
    assert library.shim_init(ct.byref(config)) == (0 if accepted else 2)


POLICY_TEXTS = {
    "skip": (0, 0, 0, 0, 0),
    "rebase": (2, 0, 0, 0, 0),
    "queue:1": (1, 1, 0, 0, 0),
    "queue:64": (1, 64, 0, 0, 0),
    "cut:250": (0, 0, 250_000, 0, 0),
    "stop:total:3": (0, 0, 0, 3, 0),
    "stop:row:1000000000": (0, 0, 0, 0, 10**9),
}


@pytest.mark.parametrize("text", POLICY_TEXTS)
def test_policies_as_text(library, text):
    out = rt_shim.Reaction()
    assert library.rt_reaction_parse(text.encode(), ct.byref(out)) & 1
    fields = ("overrun", "queue_limit", "budget_ns", "stop_total", "stop_row")
    assert tuple(getattr(out, name) for name in fields) == POLICY_TEXTS[text]


@pytest.mark.parametrize(
    "text",
    ["", "Skip", "skip ", "queue", "queue:", "queue:0", "queue:65", "queue:-1", "queue:1x", "cut:0", "cut:1.5",
     "cut:1000000001", "stop:3", "stop:total:", "stop:row:0", "stop:row:99999999999999999999", "rebase:1"],
)  # fmt: skip
def test_what_is_no_policy_is_refused(library, text):
    out = rt_shim.Reaction(9, 9, 9, 9, 9)
    assert library.rt_reaction_parse(text.encode(), ct.byref(out)) & 1 == 0
    assert out.overrun == out.queue_limit == out.budget_ns == out.stop_total == out.stop_row == 9


@pytest.mark.parametrize(
    ("text", "mk"),
    [("0,1", (0, 1)), ("5,100", (5, 100)), ("5:100", (5, 100)), ("5,5", None), ("5,101", None), ("5", None),
     ("5,", None), ("-1,5", None), ("1,5 ", None), ("100,101", None)],
)  # fmt: skip
def test_mk_as_text(library, text, mk):
    m, k = ct.c_uint32(7), ct.c_uint32(7)
    accepted = library.rt_mk_parse(text.encode(), ct.byref(m), ct.byref(k)) & 1
    assert (accepted, (m.value, k.value)) == ((1, mk) if mk else (0, (7, 7)))
