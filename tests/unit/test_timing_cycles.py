"""The cycle check: figures known by construction, silences at the ends, messages that never came, any DBC."""

import statistics

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rt_runner.dbc import load_dbc
from rt_runner.timing.cycles import CycleCheck, Expected, cycle_rows, expected_cycles

MS = 1_000_000
FAST = Expected("Fast", 0x10, "A", cycle_ms=10.0, timeout_ms=30.0)
SLOW = Expected("Slow", 0x20, "A", cycle_ms=100.0, timeout_ms=300.0)
OTHER = Expected("Other", 0x30, "B", cycle_ms=10.0, timeout_ms=50.0)


def grid(start_ms: float, stop_ms: float, step_ms: float) -> list[int]:
    return [round((start_ms + k * step_ms) * MS) for k in range(round((stop_ms - start_ms) / step_ms))]


def row_of(stamps, expected=FAST, **others):
    also, watch = others.pop("also", {}), others.pop("watch", [])
    return cycle_rows({expected.frame_id: stamps, **also}, [expected, *watch], **others)[0]


def test_an_even_message_has_its_cycle_and_nothing_else():
    row = row_of(grid(0, 1000, 10))
    assert (row.frames, row.mean_ms, row.typical_ms, row.min_ms, row.max_ms) == (100, 10.0, 10.0, 10.0, 10.0)
    assert (row.std_ms, row.missing, row.timeouts, row.longest_ms) == (0.0, 0, 0, 10.0)
    assert row.rate_ok(0.0)


@given(st.lists(st.integers(1, 10_000 * 1000), min_size=2, max_size=200))
@settings(max_examples=200, deadline=None)
def test_figures_are_those_of_the_periods(periods_us):
    stamps = [0]
    for period in periods_us:
        stamps.append(stamps[-1] + period * 1000)
    row, ms = row_of(stamps, end_grace_s=1e6), [p / 1e3 for p in periods_us]
    assert row.mean_ms == pytest.approx(statistics.fmean(ms))
    assert row.std_ms == pytest.approx(statistics.stdev(ms), abs=1e-6)
    assert (row.min_ms, row.max_ms, row.longest_ms) == (min(ms), max(ms), max(ms))
    kept = sorted(ms)[1:-1] if len(ms) >= 5 else [sorted(ms)[len(ms) // 2]]
    assert row.typical_ms == pytest.approx(statistics.fmean(kept))
    assert row.timeouts == sum(p > 30 for p in ms)
    assert row.missing == sum((2 * round(p * MS) + 10 * MS) // (20 * MS) - 1 for p in ms if p > 15)
    assert stamps[ms.index(max(ms))] == row.longest_from_ns


def test_a_gap_is_found_with_its_place_and_the_rate_is_still_right():
    stamps = [t for t in grid(0, 1000, 10) if not 500 * MS < t < 600 * MS]
    row = row_of(stamps)
    assert (row.missing, row.timeouts, row.longest_ms, row.longest_from_ns) == (9, 1, 100.0, 500 * MS)
    assert row.rate_ok(0.01)
    assert row.mean_ms > 10.5


def test_a_rate_that_is_off_is_not_ok():
    assert row_of(grid(0, 1000, 10.4)).rate_ok(0.05)
    assert row_of(grid(0, 1000, 10.6)).rate_ok(0.05) is False
    assert row_of(grid(0, 1000, 9.4)).rate_ok(0.05) is False


def test_last_words_and_one_interruption_do_not_change_a_rate():
    row = row_of([*grid(0, 200, 10), 191 * MS, 391 * MS, 401 * MS])
    assert row.rate_ok(0.001)


def test_of_few_periods_the_upper_median_is_judged():
    last_words = row_of([0, 10 * MS, 12 * MS])
    assert (last_words.typical_ms, last_words.rate_ok(0.01)) == (10.0, True)
    interrupted = row_of([0, 10 * MS, 27 * MS, 29 * MS])
    assert (interrupted.typical_ms, interrupted.rate_ok(0.01)) == (10.0, True)
    assert row_of([0, 10 * MS, 22 * MS]).rate_ok(0.05) is False


def test_who_stops_before_its_node_or_the_log_does_is_timed_out():
    stops, goes_on = grid(0, 500, 10), grid(0, 1000, 100)
    row = row_of(stops, also={0x20: goes_on}, watch=[SLOW])
    assert (row.timeouts, row.missing, row.longest_ms, row.longest_from_ns) == (1, 41, 410.0, 490 * MS)
    also = {0x30: grid(0, 4000, 10)}
    row = row_of(stops, also=also, watch=[OTHER])  # the whole node is gone, another one is still there
    assert (row.timeouts, row.longest_ms) == (1, 3990.0 - 1000.0 - 490.0)
    assert row_of(stops, also=also, watch=[OTHER], end_grace_s=3.5).timeouts == 0


def test_who_starts_long_after_its_node_is_timed_out():
    row = row_of(grid(500, 1000, 10), also={0x20: grid(0, 1000, 100)}, watch=[SLOW])
    assert (row.timeouts, row.longest_ms, row.longest_from_ns) == (1, 500.0, 0)
    assert row_of(grid(20, 1000, 10), also={0x20: grid(0, 1000, 100)}, watch=[SLOW]).timeouts == 0


def test_a_message_that_never_came_is_one_timeout_if_there_was_time_for_it():
    row = row_of([], also={0x20: grid(0, 1000, 100)}, watch=[SLOW])
    assert (row.frames, row.timeouts, row.longest_ms, row.rate_ok(0.1)) == (0, 1, 900.0, None)
    short = row_of([], SLOW, also={0x10: grid(0, 200, 10)}, watch=[FAST])
    assert (short.frames, short.timeouts, short.longest_ms) == (0, 0, None)
    silent_node = row_of([], also={0x30: grid(0, 1000, 10)}, watch=[OTHER])
    assert (silent_node.frames, silent_node.timeouts) == (0, 0)


@pytest.mark.parametrize("frames", [0, 1])
def test_too_few_frames_are_not_available(frames):
    row = row_of(grid(0, frames * 10, 10))
    assert row.frames == frames
    assert (row.mean_ms, row.typical_ms, row.min_ms, row.max_ms, row.std_ms, row.rate_ok(1.0)) == (None,) * 6


def test_long_and_short_ids_are_two_messages():
    extended = Expected("Extended", 0x10, "A", 10.0, 30.0, extended=True)
    check = CycleCheck([FAST, extended])
    for t in grid(0, 100, 10):
        check.add(t, 0x10)
        check.add(t, 0x10, extended=True)
        check.add(t, 0x99)
    assert [r.frames for r in check.rows()] == [10, 10]
    assert check.span_s == pytest.approx(0.09)


def test_our_dbc_says_what_it_says():
    dbc = load_dbc()
    everything = {e.name: e for e in expected_cycles(dbc.database)}
    assert set(everything) == {m.name for m in dbc}
    for m in dbc:
        e = everything[m.name]
        assert (e.frame_id, e.sender, e.cycle_ms, e.timeout_ms, e.per_job) == (
            m.frame_id, m.sender, m.cycle_ms, m.timeout_ms, m.per_job,
        )  # fmt: skip
    assert {e.sender for e in expected_cycles(dbc.database, "PLANT")} == {"PLANT"}
    assert expected_cycles(dbc.database, "NOBODY") == ()


@pytest.mark.parametrize(("period_s", "cycle_ms", "timeout_ms"), [(0.01, 10.0, 350.0), (1.0, 1000.0, 3000.0)])
def test_frames_per_job_have_the_period_of_the_loop(period_s, cycle_ms, timeout_ms):
    found = {e.name: e for e in expected_cycles(load_dbc().database, "ESTIMATOR", period_s)}
    assert (found["Estimate"].cycle_ms, found["Estimate"].timeout_ms) == (cycle_ms, timeout_ms)
    assert found["EstReleases"].cycle_ms == 1000.0


FOREIGN = """VERSION ""
NS_ :
BS_:
BU_: GATEWAY
BO_ 256 Wheel: 8 GATEWAY
 SG_ speed : 0|16@1+ (0.01,0) [0|0] "m/s" Vector__XXX
BO_ 2566844672 Door: 2 GATEWAY
 SG_ open : 0|1@1+ (1,0) [0|0] "" Vector__XXX
BO_ 512 Event: 2 GATEWAY
 SG_ code : 0|8@1+ (1,0) [0|0] "" Vector__XXX
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 60000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 20;
BA_ "GenMsgCycleTime" BO_ 2566844672 500;
"""


def test_somebody_elses_dbc_without_our_attributes():
    database = cantools.database.load_string(FOREIGN, "dbc")
    assert expected_cycles(database) == (
        Expected("Wheel", 0x100, "GATEWAY", 20.0, 60.0),
        Expected("Door", 2566844672 & 0x1FFFFFFF, "GATEWAY", 500.0, 1500.0, extended=True),
    )
