"""The judge of one sensor on made-up residuals, the slow observer beside it, and both on whatever may come."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from tests.support.faulted_laps import (
    DRIFT,
    DROPOUT,
    NOISE,
    OFFSET,
    OK,
    OPEN_LOOP,
    PREDICTING,
    SLOW,
    SPIKE,
    STUCK,
    library,
)
from tests.support.libest_parts import Monitor, SlowObserver, Verdict
from tools.libest import Estimator

SIGMA = math.sqrt(0.1)  # of a value
VARIANCE = 1e-3  # of its prediction
LEVEL = 100.0  # that prediction, degC


def monitor(**changes: object) -> Monitor:
    return Monitor(library(), library().setting("default", **changes))


def noise(count: int, seed: int = 0, sigma: float = SIGMA) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, sigma, count)


def feed(judge: Monitor, residuals: Iterable[float], **more: float) -> tuple[list[Verdict], list[int]]:
    """Verdicts and published classes, value by value."""
    verdicts, classes = [], []
    for residual in residuals:
        verdicts.append(judge.step(LEVEL + residual, LEVEL, variance=VARIANCE, **more))
        classes.append(judge.fault)
    return verdicts, classes


def healthy(seed: int = 0, count: int = 200) -> Monitor:
    """A judge that has seen twenty good seconds."""
    judge = monitor()
    _, classes = feed(judge, noise(count, seed))
    assert set(classes) == {OK}
    return judge


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_sensor_is_believed_in_full(seed: int) -> None:
    """A quarter of an hour of the sensor's own noise: every value counts in full, but a spike or two of 4.5 sigma."""
    judge = monitor()
    verdicts, classes = feed(judge, noise(9000, seed))
    shares = np.array([v.share for v in verdicts])
    assert set(shares) <= {0.0, 1.0}
    assert (shares == 0.0).sum() <= 2
    assert set(classes) <= {OK, SPIKE}
    assert not any(v.resume or v.creep or v.forget or v.offset for v in verdicts)
    assert judge.spread_r == pytest.approx(0.1)


@pytest.mark.parametrize("step", [-40.0, -20.0, -5.0, -3.0, 3.0, 10.0])
def test_a_step_is_an_offset_after_five_values_and_is_taken_back(step: float) -> None:
    judge = healthy()
    verdicts, classes = feed(judge, step + noise(40, 1))
    assert classes[:4] == [SPIKE] * 4
    assert set(classes[4:]) == {OFFSET}
    assert not judge.trusted
    assert all(v.share == 0.0 for v in verdicts[:5])
    assert [v.forget for v in verdicts[:6]] == [0, 0, 0, 0, 5, 0], "what counted since is taken back, once"


def test_a_stepped_sensor_counts_a_little_less_its_step() -> None:
    """Its size is the median of twenty values; then every value counts a two-hundredth, moved back by it."""
    judge = healthy()
    feed(judge, -20.0 + noise(5, 1))
    values = -20.0 + noise(60, 2)
    verdicts, _ = feed(judge, values)
    assert all(v.share == 0.0 for v in verdicts[:19])
    assert {v.share for v in verdicts[19:]} == {0.005}
    offsets = {v.offset for v in verdicts[19:]}
    assert len(offsets) == 1
    assert offsets.pop() == pytest.approx(-20.0, abs=3.0 * 1.25 * SIGMA / math.sqrt(20.0))


def test_a_second_step_is_measured_anew() -> None:
    judge = healthy()
    feed(judge, -20.0 + noise(60, 1))
    verdicts, classes = feed(judge, -28.0 + noise(60, 2))
    assert set(classes) == {OFFSET}
    assert all(v.share == 0.0 for v in verdicts[:20]), "neither the old size nor a guess"
    assert verdicts[-1].share == 0.005
    assert verdicts[-1].offset == pytest.approx(-28.0, abs=0.4)


def test_two_minutes_later_a_stepped_sensor_says_nothing_any_more() -> None:
    judge = healthy()
    verdicts, _ = feed(judge, -20.0 + noise(1400, 1))
    assert verdicts[1000].share == 0.005
    assert all(v.share == 0.0 for v in verdicts[1210:])


@pytest.mark.parametrize(("gone", "fault", "calm"), [("step", OFFSET, 30), ("nan", DROPOUT, 20), ("stuck", STUCK, 20)])
def test_it_is_believed_again_after_seconds_of_agreement(gone: str, fault: int, calm: int) -> None:
    """Two seconds, three after a step, not before and not much later; it takes the level the sensor then has."""
    judge = healthy()
    bad = {"step": -20.0 + noise(200, 1), "nan": np.full(200, np.nan), "stuck": np.full(200, 0.123)}[gone]
    _, classes = feed(judge, bad)
    assert classes[-1] == fault
    verdicts, classes = feed(judge, 0.15 + noise(120, 2))
    back = next(k for k, v in enumerate(verdicts) if v.resume)
    assert calm - 1 <= back <= calm + 40
    assert classes[back] == OK
    assert set(classes[back:]) == {OK}
    assert judge.trusted
    assert [v.resume for v in verdicts].count(True) == 1
    assert verdicts[back].level == pytest.approx(0.15, abs=0.25)
    assert verdicts[back].share == 1.0
    assert all(v.share <= 0.005 for v in verdicts[:back])


@pytest.mark.parametrize("level", [-2.0, 1.0, 5.0])
def test_a_level_that_cannot_be_is_not_believed(level: float) -> None:
    """Back from a dropout, but somewhere else: the prediction has not lost so much."""
    judge = healthy()
    feed(judge, np.full(50, np.nan))
    verdicts, classes = feed(judge, level + noise(300, 3))
    assert not any(v.resume for v in verdicts)
    assert OK not in classes


def test_what_the_prediction_may_have_lost_is_allowed_for() -> None:
    """The same level after a long dropout, where the prediction has 0.5 K of its own."""
    judge = healthy()
    feed(judge, np.full(50, np.nan))
    verdicts = [judge.step(LEVEL + 1.0 + e, LEVEL, variance=0.25) for e in noise(300, 3)]
    assert any(v.resume for v in verdicts)
    assert judge.fault == OK


def test_a_spike_is_left_out_and_shown_for_a_second() -> None:
    judge = healthy()
    verdicts, classes = feed(judge, [*noise(5, 1), 25.0, *noise(30, 2)])
    assert [v.share for v in verdicts] == [1.0] * 5 + [0.0] + [1.0] * 30
    assert classes[:5] == [OK] * 5
    assert classes[5:15] == [SPIKE] * 10
    assert set(classes[15:]) == {OK}
    assert judge.trusted


@pytest.mark.parametrize("pattern", [(25.0, -25.0), (30.0, 0.1), (-20.0, 0.0, 0.0)])
def test_spikes_that_come_often_are_no_step(pattern: tuple[float, ...]) -> None:
    """Alternating or interrupted, however many: no offset, and what lies inside counts."""
    judge = healthy()
    verdicts, classes = feed(judge, np.tile(pattern, 20) + noise(20 * len(pattern), 1))
    assert OFFSET not in classes
    assert judge.trusted
    assert all(v.share < 0.01 for v, y in zip(verdicts, np.tile(pattern, 20), strict=True) if abs(y) > 5.0)


def test_noise_is_noticed_weighed_and_forgotten() -> None:
    """Fifteen times as noisy: seen within two seconds, used with a fraction of its weight, then as before."""
    judge = healthy()
    verdicts, classes = feed(judge, noise(300, 1, 5.0))
    assert NOISE in classes[:20]
    first = classes.index(NOISE)
    assert set(classes[first:]) == {NOISE}
    assert judge.trusted
    used = [v.share for v in verdicts[first + 40 :] if v.share > 0.0]
    assert len(used) > 150
    assert max(used) < 0.05
    assert min(used) > 0.0005
    verdicts, classes = feed(judge, noise(200, 2))
    off = classes.index(OK)
    assert 10 <= off <= 90
    assert set(classes[off:]) == {OK}
    assert verdicts[off + 1].share == 1.0
    assert judge.spread_r == pytest.approx(0.1)


def test_twice_the_noise_is_not_called_so() -> None:
    """Spread is a median's: it takes three times what it should be."""
    _, classes = feed(healthy(), noise(600, 1, 1.7 * SIGMA))
    assert NOISE not in classes
    assert OFFSET not in classes


@pytest.mark.parametrize("missing", [1, 2])
def test_one_or_two_missing_values_are_nothing(missing: int) -> None:
    judge = healthy()
    verdicts, classes = feed(judge, [*np.full(missing, np.nan), *noise(20, 1)])
    assert set(classes) == {OK}
    assert [v.share for v in verdicts] == [0.0] * missing + [1.0] * 20


@pytest.mark.parametrize("raw", [-40.0, 200.0, -38.1, 195.1, 1e300, -1e300])
def test_three_values_no_winding_can_have_are_a_dropout(raw: float) -> None:
    judge = healthy()
    for k in range(3):
        verdict = judge.step(LEVEL, LEVEL, raw=raw)
        assert verdict.share == 0.0
        assert judge.fault == (DROPOUT if k == 2 else OK)
    assert not judge.trusted


def test_five_equal_values_are_stuck_wherever_the_prediction_is() -> None:
    judge = healthy()
    verdicts, classes = feed(judge, [0.2] * 10)
    assert classes[:4] == [OK] * 4
    assert set(classes[4:]) == {STUCK}
    assert verdicts[4].forget == 5
    assert [v.forget for v in verdicts[5:]] == [0] * 5
    assert all(v.share == 0.0 for v in verdicts[4:])


def test_a_sensor_without_noise_repeats_itself_and_is_not_stuck() -> None:
    """Known by its repeats in threes: then stuck only when the prediction moves a degree and the sensor does not."""
    judge = monitor()
    for k in range(300):  # repeats in threes: never five in a row
        judge.step(float(LEVEL + 0.1 * (k // 3 % 3)), LEVEL, variance=0.01)
    assert judge.fault == OK
    calm = [judge.step(LEVEL, LEVEL, variance=0.01) and judge.fault for _ in range(100)]
    assert set(calm) == {OK}, "as still as its prediction"
    moving = []
    for k in range(80):
        judge.step(LEVEL, LEVEL + 0.02 * k, variance=0.01)
        moving.append(judge.fault)
    assert STUCK in moving
    assert moving.index(STUCK) == pytest.approx(50, abs=3), "one degree of the prediction"


def test_a_drift_is_what_the_slow_innovation_has_not_been_before() -> None:
    """Beyond 1.05 degC and half more than usual, after a minute of record; then ten calm seconds bring it back."""
    judge = healthy(count=700)
    _, classes = feed(judge, noise(100, 1), slow=1.0)
    assert set(classes) == {OK}
    verdicts, classes = feed(judge, noise(5, 2), slow=1.2)
    assert classes[0] == DRIFT
    assert verdicts[0].creep
    assert verdicts[0].forget == 30
    assert not judge.trusted
    verdicts, _ = feed(judge, noise(200, 3), slow=1.2)
    back = next(k for k, v in enumerate(verdicts) if v.resume)
    assert 94 <= back <= 130


def test_the_first_minute_knows_no_drift() -> None:
    judge = monitor()
    _, classes = feed(judge, noise(590), slow=3.0)
    assert set(classes) == {OK}


def test_a_plant_that_has_always_been_off_is_no_drift() -> None:
    """Two degrees from the first minute on, as a mismatch shows: usual for this drive."""
    judge = monitor()
    _, classes = feed(judge, noise(599), slow=2.0)
    _, classes = feed(judge, noise(600, 1), slow=2.2)
    assert set(classes) == {OK}
    _, classes = feed(judge, noise(5, 2), slow=3.3)
    assert DRIFT in classes


def test_an_innovation_that_follows_the_rate_is_a_late_sensor() -> None:
    """Three seconds late under rates of half a degree per second: called slow within the memory of 15 s; the same size
    without any relation to the rate is not."""
    rng = np.random.default_rng(4)
    rates = np.repeat(rng.uniform(-0.6, 0.6, 60), 5)

    def classes_of(lag_s: float, shuffled: bool) -> list[int]:
        judge, found = healthy(), []
        slow = -lag_s * rates
        if shuffled:
            rng.shuffle(slow)
        for rate, raw, e in zip(rates, slow, noise(len(rates), 5), strict=True):
            judge.step(LEVEL + e, LEVEL, variance=VARIANCE, slow=0.0, slow_raw=raw, rate=rate)
            found.append(judge.fault)
        return found

    late = classes_of(3.0, False)
    assert SLOW in late
    assert late.index(SLOW) < 150
    assert set(classes_of(1.0, False)) == {OK}, "less than 1.5 s is the net's own doing"
    assert SLOW not in classes_of(-3.0, False), "an early sensor there is not"
    assert SLOW not in classes_of(3.0, True)


def test_a_late_value_counts_if_it_fits_and_changes_nothing() -> None:
    """One job later than its step: with the share that the judge would have given it now."""
    judge = healthy()
    before = judge.bytes
    assert judge.late(LEVEL + 0.3) == 1.0
    assert judge.late(LEVEL + 20.0) == 0.0, "outside the gate"
    assert judge.late(200.0, 200.0) == 0.0, "out of range"
    assert judge.late(np.nan) == 0.0
    assert judge.late(np.inf) == 0.0
    assert judge.bytes == before
    feed(judge, noise(100, 1, 5.0))
    assert judge.fault == NOISE
    assert judge.late(LEVEL + 0.3) == pytest.approx(0.1 / judge.spread_r)
    feed(judge, np.full(3, np.nan))
    assert judge.late(LEVEL + 0.3) == 0.0, "not believed"


WILD = st.one_of(
    st.floats(-60.0, 220.0), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 4.9e-324, 0.0]), st.floats()
)
SANE = st.floats(-5.0, 5.0)
FAST = hypothesis_settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@FAST
@given(
    steps=st.lists(st.tuples(WILD, st.integers(1, 12), SANE, SANE, st.floats(1e-6, 1e3)), max_size=40),
    predictions=st.lists(st.floats(-40.0, 200.0), min_size=1, max_size=5), channel=st.integers(0, 1),
)  # fmt: skip
def test_whatever_is_measured_the_verdict_is_one(steps: list, predictions: list[float], channel: int) -> None:
    """Any value, again and again, against any prediction: a share of 0 to 1, a class that exists, no NaN that stays."""
    judge = Monitor(library(), library().setting("default"), channel)
    for k, (y, times, slow, rate, variance) in enumerate(steps):
        for _ in range(times):
            verdict = judge.step(y, predictions[k % len(predictions)], variance=variance, slow=slow, rate=rate)
            assert 0.0 <= verdict.share <= 1.0
            assert math.isfinite(verdict.offset)
            assert math.isfinite(verdict.level)
            assert 0 <= verdict.forget <= 30
            assert OK <= judge.fault <= SLOW
            assert judge.trusted == (judge.fault in (OK, NOISE, SPIKE))
            assert math.isfinite(judge.spread_r)
            assert judge.spread_r >= 0.1 - 1e-12
            if not math.isfinite(y) or not -38.0 <= y <= 195.0:
                assert verdict.share == 0.0
            assert 0.0 <= judge.late(y, predictions[0], variance) <= 1.0
    _, classes = feed(judge, noise(700, 9))
    assert classes[-1] in (OK, SPIKE), "a sound sensor is believed again, whatever was before"


@FAST
@given(
    events=st.lists(
        st.one_of(
            st.tuples(st.just("predict"), st.floats(0.0, 12_000.0), st.floats(-200.0, 200.0)),
            st.tuples(st.just("measure"), st.integers(0, 1), WILD),
            st.tuples(st.just("shift"), st.integers(0, 1), SANE),
        ),
        max_size=120,
    )
)
def test_the_slow_observer_stays_finite_and_creeps_nowhere(events: list) -> None:
    """One value, however wild, moves it by at most 1.5 K's pull: 15 mK; its bias stays within 0.1 K/s."""
    observer = SlowObserver(library(), [90.0, 80.0])
    for kind, a, b in events:
        if kind == "predict":
            observer.predict([a, b])
        elif kind == "shift":
            observer.shift(a, b)
        else:
            before = observer.theta[a]
            innovation = observer.innovation[a]
            observer.measure(a, b)
            observer.follow(a)
            assert abs(observer.innovation[a] - innovation) <= 0.05 * 1.5 + 1e-12
            assert abs(observer.theta[a] - before) <= 0.01 * (abs(innovation) + 1.5) + 1e-12
        assert np.isfinite(observer.state).all()
        assert (np.abs(observer.bias) <= 0.1).all()


@hypothesis_settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**32 - 1), setting=st.sampled_from(["default", "ekf", "paper"]), supervise=st.booleans(),
    shuffled=st.booleans(),
)  # fmt: skip
def test_the_core_says_why(seed: int, setting: str, supervise: bool, shuffled: bool) -> None:
    """Frames late, shuffled, wild, missing: finite throughout; where a sensor is not believed the status says so."""
    rng = np.random.default_rng(seed)
    core = Estimator(library(), library().setting(setting, supervise=supervise))
    wild = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 200.0, -40.0])
    for start in range(0, 4000, 10):
        frames = [("motor", t) for t in range(start + 1, start + 11)] + [("temp", start + 10), ("coolant", start + 10)]
        if shuffled:
            frames = [frames[k] for k in np.argsort(np.arange(12) + rng.uniform(0, 3, 12))]
        bad = start > 1000 and rng.random() < 0.3
        for kind, tick in frames:
            if kind == "motor":
                core.feed_motor(tick, rng.uniform(20, 60), 5000.0, bool(rng.random() > 0.02))
            elif kind == "coolant":
                core.feed_coolant(float(rng.choice([65.0, *wild])), bool(rng.random() < 0.2), bool(rng.random() < 0.9))
            elif rng.random() < 0.95:
                late = 10 * int(rng.integers(0, 20)) if rng.random() < 0.1 else 0
                values = rng.choice(wild, 2) if bad else 90.0 + rng.normal(0, 0.3, 2)
                core.feed_temp(tick - late if tick > late else tick, *values)
        out = core.step()
        if out.status < 2:
            continue
        assert np.isfinite([out.theta_w_degc, out.theta_r_degc]).all() or out.status == 5
        for channel in out.channel:
            assert OK <= channel.fault <= SLOW
            if out.status != 5:
                assert channel.sigma_degc > 0.0
                assert channel.upper_degc > -273.15
                assert math.isfinite(channel.upper_degc)
            if channel.fault in (OFFSET, STUCK, DROPOUT, DRIFT, SLOW):
                assert out.status in (PREDICTING, OPEN_LOOP, 4, 5, 7)
            if not supervise:
                assert channel.fault == OK
