"""The result from hand-made frames: every figure is known beforehand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rt_runner.result import Limits, ResultAccumulator, RunFacts, Unwrapper


def feed_run(acc, seconds=30, error=0.1, raw=-1.2, first_tick=40_001, skip=(), late=(), warmup=5, cause=3):
    """A synthetic run: truth rises by 0.5 degC/s, estimate and sensor are off by constants."""
    release = 0
    counters = {}

    def put(t, name, values):
        counters[name] = (counters.get(name, -1) + 1) % 16
        acc.feed(t, name, {"counter": counters[name], **values})

    for k in range(seconds * 10):
        t = k * 100_000_000
        tick = first_tick + 9 + k * 10
        true_w, true_r = 150 + 0.05 * k, 100 - 0.02 * k
        put(t, "TruthTemp", {"theta_w_true_degc": true_w, "theta_r_true_degc": true_r, "tick": tick % 65536})
        put(t, "TempMeas", {"theta_w_meas_degc": true_w + raw, "theta_r_meas_degc": true_r + raw, "tick": tick % 65536})
        release += 1 + (k in skip)
        put(
            t + 1000,
            "Estimate",
            {"status": 2, "theta_w_est_degc": true_w + error, "theta_r_est_degc": true_r - error, "tick": tick % 65536},
        )
        put(
            t + 2000,
            "EstTimingA",
            {
                "miss_late": int(k in late),
                "warmup": int(k < warmup),
                "stale_input": 0,
                "after_skip": int(k in skip),
                "release_index": release % 2**24,
                "wake_lat_us": 20.0 + k % 7,
            },
        )
        put(
            t + 3000,
            "EstTimingB",
            {
                "miss_cause": (cause[k] if isinstance(cause, dict) else cause) if k in late or k + 1 in skip else 0,
                "exec_wall_us": 40.0,
                "resp_us": 70.0,
            },
        )
    return release


def facts(**more):
    return RunFacts(**{"bus": "hub", "scenario": "x", "limits": Limits(), **more})


def test_figures_of_a_good_run():
    acc = ResultAccumulator()
    feed_run(acc)
    r = acc.result(facts())
    assert r["verdict"] == "pass", r["findings"]
    for channel in ("theta_w", "theta_r"):
        assert r["accuracy"][channel]["raw_rmse_degc"] == pytest.approx(1.2)
        assert r["accuracy"][channel]["est_rmse_degc"] == pytest.approx(0.1)
        assert r["accuracy"][channel]["est_max_degc"] == pytest.approx(0.1)
        assert r["accuracy"][channel]["samples"] == 200  # 30 s less the first 10
    timing = r["timing"]["estimator"]
    assert (timing["jobs"], timing["miss_late"], timing["miss_skipped"]) == (300, 0, 0)
    assert timing["wake_lat_us"] == {"p50": 23.0, "p99": 26.0, "max": 26.0}
    assert r["log"]["dropped"] == 0


def test_ticks_wrap_in_the_middle_of_a_run():
    acc = ResultAccumulator()
    feed_run(acc, first_tick=65_536 - 700)
    assert acc.result(facts())["accuracy"]["theta_w"]["est_rmse_degc"] == pytest.approx(0.1)


def test_estimates_between_truth_samples_are_compared_with_the_line_between():
    acc = ResultAccumulator()
    for k in range(300):
        acc.feed(k, "TruthTemp", {"theta_w_true_degc": 0.5 * k, "theta_r_true_degc": 0.0, "tick": 10 * k})
        if k:
            acc.feed(k, "Estimate", {"theta_w_est_degc": 0.5 * (k - 0.4), "theta_r_est_degc": 0.0, "tick": 10 * k - 4})
    assert acc.result(facts())["accuracy"]["theta_w"]["est_max_degc"] == pytest.approx(0.0, abs=1e-9)


@given(st.sets(st.integers(20, 290), max_size=8), st.sets(st.integers(20, 290), max_size=8))
def test_every_release_is_accounted_for(skip, late):
    acc = ResultAccumulator()
    releases = feed_run(acc, skip=skip, late=late)
    t = acc.result(facts())["timing"]["estimator"]
    assert t["miss_skipped"] == len(skip)
    assert t["miss_late"] == len(late)
    assert t["jobs"] + t["miss_skipped"] == t["releases"] == releases


def test_own_misses_fail_and_the_machines_are_inconclusive():
    late = set(range(50, 150))
    for cause, expected in ((3, "fail"), (1, "inconclusive"), (2, "inconclusive")):
        acc = ResultAccumulator()
        feed_run(acc, late=late, cause=cause)
        r = acc.result(facts())
        assert r["verdict"] == expected
        assert sum(r["timing"]["estimator"]["causes"].values()) == 100


def test_misses_during_warm_up_are_shown_but_not_judged():
    acc = ResultAccumulator()
    feed_run(acc, late=set(range(40)), warmup=40)
    r = acc.result(facts())
    assert r["timing"]["estimator"]["miss_late"] == 40
    assert r["verdict"] == "pass"


def test_the_machines_misses_during_warm_up_do_not_excuse_our_own_later():
    acc = ResultAccumulator()
    feed_run(acc, late=set(range(20)), warmup=20, cause=1)
    more = ResultAccumulator()
    feed_run(more, late=set(range(20, 100)), warmup=20, cause=3)
    assert more.result(facts())["verdict"] == "fail"
    both = ResultAccumulator()
    feed_run(
        both, late=set(range(100)), warmup=20, cause={**dict.fromkeys(range(20), 1), **dict.fromkeys(range(20, 100), 3)}
    )
    assert both.result(facts())["verdict"] == "fail"


def test_timing_frames_lost_on_the_way_to_the_log_are_no_skipped_activations():
    acc, counters = ResultAccumulator(), {}
    for k in range(300):
        for name, values in (
            ("EstTimingA", {"release_index": k, "wake_lat_us": 5.0, "after_skip": 0, "miss_late": 0, "warmup": 0}),
            ("EstTimingB", {"miss_cause": 0, "exec_wall_us": 40.0, "resp_us": 50.0}),
        ):
            counters[name] = (counters.get(name, -1) + 1) % 16
            if k % 4:
                acc.feed(k, name, {"counter": counters[name], **values})
    r = acc.result(facts())
    assert r["timing"]["estimator"]["miss_skipped"] == 0
    assert r["log"]["dropped"] == 148  # of 75 lost pairs, the first before anything was known
    assert r["verdict"] == "inconclusive"


def test_frames_the_kernel_dropped_and_the_gaps_they_leave_are_the_same_frames():
    acc = ResultAccumulator()
    feed_run(acc)
    acc.feed(31 * 10**9, "Reference", {"counter": 3})
    acc.feed(31 * 10**9, "Reference", {"counter": 6})
    assert acc.result(facts(log_dropped=2))["log"]["dropped"] == 2
    assert acc.result(facts(log_dropped=5))["log"]["dropped"] == 5


def test_counters_at_their_last_code_prove_nothing():
    acc = ResultAccumulator()
    feed_run(acc)
    acc.feed(1, "EstReleases", {"releases": 900_000, "jobs": 800_000})
    acc.feed(1, "EstMisses", {"miss_late": 0, "miss_skipped": 65_534, "overrun": 0})
    assert not any(f["what"] == "conservation" for f in acc.result(facts())["findings"])


def test_a_logger_that_could_not_take_everything_makes_it_inconclusive():
    acc = ResultAccumulator()
    feed_run(acc)
    assert acc.result(facts(log_cut_short=True))["verdict"] == "inconclusive"


def test_wrong_temperatures_fail():
    acc = ResultAccumulator()
    feed_run(acc, error=0.6)
    assert acc.result(facts())["verdict"] == "fail"
    assert acc.result(facts(stopped_by="interrupt"))["verdict"] == "inconclusive"


def test_a_gap_in_a_counter_is_a_dropped_frame_and_nothing_is_certain():
    acc = ResultAccumulator()
    feed_run(acc)
    acc.feed(31 * 10**9, "Reference", {"counter": 3})
    acc.feed(31 * 10**9, "Reference", {"counter": 6})
    r = acc.result(facts())
    assert r["log"]["dropped"] == 2
    assert r["verdict"] == "inconclusive"


def test_a_damaged_frame_is_counted_and_not_believed():
    acc = ResultAccumulator()
    feed_run(acc)
    acc.feed(31 * 10**9, "Estimate", {"theta_w_est_degc": 999.0, "theta_r_est_degc": 999.0, "tick": 9}, e2e=4)
    r = acc.result(facts())
    assert r["log"]["damaged"] == 1
    assert r["accuracy"]["theta_w"]["est_max_degc"] == pytest.approx(0.1)


def test_counters_that_do_not_add_up_fail():
    acc = ResultAccumulator()
    feed_run(acc)
    acc.feed(1, "EstReleases", {"releases": 310, "jobs": 300})
    acc.feed(1, "EstMisses", {"miss_late": 0, "miss_skipped": 5, "overrun": 0})
    assert acc.result(facts())["verdict"] == "fail"


def test_short_run_empty_log_interrupt_and_crash():
    acc = ResultAccumulator()
    feed_run(acc, seconds=8)
    assert acc.result(facts())["verdict"] == "inconclusive"
    assert ResultAccumulator().result(facts())["verdict"] == "inconclusive"
    acc = ResultAccumulator()
    feed_run(acc)
    assert acc.result(facts(stopped_by="interrupt"))["verdict"] == "inconclusive"
    r = acc.result(facts(stopped_by="crash", crash="the plant was killed by SIGKILL"))
    assert r["verdict"] == "fail"
    assert "SIGKILL" in r["findings"][0]["evidence"]


def test_lock_step_has_no_wake_up_latency_and_judges_no_misses():
    acc = ResultAccumulator()
    feed_run(acc, seconds=12)
    r = acc.result(facts(lockstep=True))
    assert not any(f["what"] == "miss rate" for f in r["findings"])


def test_facts_survive_json_and_newer_keys():
    original = facts(seed=3, period_s=0.01)
    raw = {**vars(original), "limits": {**vars(original.limits), "later": 1}, "invented_later": True}
    assert RunFacts.from_dict(raw) == original


@given(st.lists(st.integers(-3000, 3000), max_size=60), st.integers(0, 65535))
def test_unwrapping_undoes_wrapping(steps, start):
    unwrap, value = Unwrapper(16), start
    assert unwrap(start) == start
    for step in steps:
        value += step
        assert unwrap(value % 65536) == value
    assert math.isfinite(value)
