"""The core on frames: bins, 16-bit ticks, gaps, starts, faults, and the accuracy it was built for."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from estimator_c.formulation.weights import LstmWeights, load_weights
from tests.support.twin import Recording, twin_estimates
from tools.libest import WEIGHTS, Estimator, Lib, Out, compile_library

INIT, STARTING, RUNNING, PREDICTING, INPUT_STALE, INVALID, OPEN_LOOP, FALLBACK = range(8)
SLOW = hypothesis_settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@cache
def library() -> Lib:
    return Lib(compile_library(WEIGHTS))


@cache
def weights() -> LstmWeights:
    return load_weights(WEIGHTS)


PLAIN = {"supervise": False, "loss": 0, "arrival_from": 0}


def estimator(setting: str = "default", **changes: float) -> Estimator:
    """An estimator that believes every value: the frames here are made up, no net agrees with them."""
    made = Estimator(library(), library().setting(setting, **{**PLAIN, **changes}))
    assert made.error == 0
    return made


def inputs(tick: int) -> tuple[float, float]:
    """Torque and speed at a tick: every tick differs, so a frame in the wrong bin shows."""
    return 60.0 * np.sin(0.013 * tick) + 0.5 * (tick % 7), 6000.0 + 2500.0 * np.sin(0.0071 * tick)


def temperatures(tick: int) -> tuple[float, float]:
    """What the sensor says: slow curves plus a reproducible noise."""
    noise = np.random.default_rng(tick).normal(0, 0.3, 2)
    return 130.0 + 8 * np.sin(tick / 900) + noise[0], 100.0 + 3 * np.sin(tick / 2000) + noise[1]


def feed_tick(est: Estimator, tick: int, *, motor: bool = True, temp: bool = True) -> None:
    """All frames of one tick, temperature first."""
    if temp and tick % 10 == 0:
        est.feed_temp(tick, *temperatures(tick))
    if motor:
        torque_nm, speed_rpm = inputs(tick)
        est.feed_motor(tick, torque_nm, speed_rpm)


def run(est: Estimator, first: int, last: int, every: int = 10, **kinds: bool) -> list[Out]:
    """Feed ticks first..last and step whenever the tick is a multiple of `every`."""
    outs = []
    for tick in range(first, last + 1):
        feed_tick(est, tick, **kinds)
        if tick % every == 0:
            outs.append(est.step())
    return outs


def test_statuses_from_nothing_to_running() -> None:
    est = estimator()
    out = est.step()
    assert (out.status, np.isnan(out.theta_w_degc)) == (INIT, True)
    outs = run(est, 1000, 1400)
    status = [o.status for o in outs]
    assert status == [STARTING] * 15 + [RUNNING] * 26
    assert outs[14].tick == 1140
    assert np.isnan(outs[14].theta_w_degc)
    assert outs[15].tick == 1150
    assert abs(outs[15].theta_w_degc - 131) < 10
    assert all(np.isfinite(o.innov_w_degc) for o in outs[15:])


@SLOW
@given(
    start=st.integers(0, 20_000), setting=st.sampled_from(["default", "paper"]), delay=st.integers(0, 15),
    lost=st.sets(st.integers(11, 599), max_size=150), dead=st.tuples(st.integers(11, 500), st.integers(0, 60)),
    lost_temp=st.sets(st.integers(1, 59), max_size=15), every=st.integers(1, 37),
)  # fmt: skip
def test_equals_its_plain_twin(
    start: int, setting: str, delay: int, lost: set[int], dead: tuple[int, int], lost_temp: set[int], every: int
) -> None:
    """Any start tick, lost frames, dead stretches and job period: the C publishes what its plain twin says."""
    first = 10 * start  # up to 200 000: three wraps of the tick on the bus
    gone = lost | set(range(dead[0], dead[0] + dead[1]))
    ticks = range(first, first + 601)
    recording = Recording(
        motor={t: inputs(t) for t in ticks if t > first and t - first not in gone},
        temp={t: temperatures(t) for t in ticks if t % 10 == 0 and (t - first) // 10 not in lost_temp},
        first_tick=first,
        last_tick=first + 600,
    )
    changes = {"delay_steps": delay, "tolerance_degc": 1e-10, "max_sweeps": 40, **PLAIN}
    expected = twin_estimates(library(), weights(), library().setting(setting, **changes), recording)
    est, compared = estimator(setting, **changes), 0
    for tick in ticks:
        if tick in recording.temp:
            est.feed_temp(tick, *recording.temp[tick])
        if tick in recording.motor:
            est.feed_motor(tick, *recording.motor[tick])
        if (tick - first) % every != 0:
            continue
        out = est.step()
        if tick in recording.motor and tick in expected:
            assert out.tick - tick == first % 65536 - first  # the C counts on from the first 16-bit tick it saw
            assert out.tick16 == tick % 65536
            found = np.array([out.theta_w_degc, out.theta_r_degc])
            np.testing.assert_allclose(found, expected[tick], rtol=0, atol=1e-7, err_msg=f"tick {tick - first}")
            compared += 1
    assert est.counters.restarts == 0
    asked = {t for t in expected if (t - first) % every == 0 and t in recording.motor}
    assert compared == len(asked)
    assert len(expected) > 100


def test_job_period_does_not_change_the_estimate() -> None:
    results = {}
    for every in (1, 2, 5, 10, 20, 40):
        outs = run(estimator(), 60_000, 68_000, every)  # across the wrap of the 16-bit tick
        results[every] = {o.tick: (o.theta_w_degc, o.theta_r_degc) for o in outs if o.status == RUNNING}
    for every, found in results.items():
        common = found.keys() & results[1].keys()
        assert len(common) >= (8000 - 200) // every
        assert all(found[tick] == results[1][tick] for tick in common)


def test_estimate_is_continuous_where_an_interval_completes() -> None:
    outs = [o for o in run(estimator(), 0, 1000, 1) if o.status == RUNNING]
    theta = np.array([o.theta_w_degc for o in outs])
    assert np.abs(np.diff(theta)).max() < 0.2
    assert [o.intervals for o in outs[10:30]].count(1) == 2
    assert all(o.sweeps == 0 for o in outs if o.intervals == 0)


def test_grid_follows_the_temperature_frames_beyond_the_wrap() -> None:
    """65536 is no multiple of 10: after a wrap the grid is not where tick % 10 is 0."""
    est = estimator()
    for tick in range(100_000, 100_400):
        feed_tick(est, tick)
    assert est.step().status == RUNNING
    assert est.counters.off_grid == 0


@pytest.mark.parametrize("new_tick", [1, 4990, 200])
def test_tick_going_backwards_restarts_cleanly(new_tick: int) -> None:
    est = estimator()
    assert run(est, 0, 5000)[-1].status == RUNNING
    feed_tick(est, new_tick, temp=False)
    assert (est.step().status, est.counters.restarts) == (RUNNING, 0)
    feed_tick(est, new_tick + 1, temp=False)
    out = est.step()
    assert (est.counters.restarts, est.counters.stray_ticks) == (1, 1)
    assert (out.status, out.tick) == (INIT, new_tick + 1)
    outs = run(est, new_tick + 2, new_tick + 400)
    assert outs[-1].status == RUNNING
    fresh = run(estimator(), new_tick + 2, new_tick + 400)
    assert outs[-1].theta_w_degc == pytest.approx(fresh[-1].theta_w_degc, abs=1e-9)


@pytest.mark.parametrize("stray", [1, 4990, 5000 + 900, 5000 + 40_000])
def test_one_old_frame_changes_nothing(stray: int) -> None:
    """A replay or a stray sender, as often as it likes, as long as the plant's own frames come between."""
    est, clean = estimator(), estimator()
    for e in (est, clean):
        run(e, 0, 5000)
    for tick in range(5001, 5201):
        for e in (est, clean):
            feed_tick(e, tick)
        if tick % 7 == 0:
            est.feed_motor(stray, 300.0, 12000.0)
        a, b = est.step(), clean.step()
        assert (a.status, a.tick, a.theta_w_degc, a.theta_r_degc) == (b.status, b.tick, b.theta_w_degc, b.theta_r_degc)
    assert (est.counters.restarts, est.counters.stray_ticks) == (0, 28)


def test_gap_up_to_the_limit_is_bridged_beyond_it_restarts() -> None:
    for gap_ticks, restarts in ((490, 0), (510, 1)):
        est = estimator()
        run(est, 0, 3000)
        outs = run(est, 3000 + gap_ticks, 3000 + gap_ticks)
        assert est.counters.restarts == 0
        if restarts == 1:
            feed_tick(est, 3001 + gap_ticks)
        assert est.counters.restarts == restarts
        if restarts == 0:
            assert outs[-1].intervals == gap_ticks // 10
            assert outs[-1].stale_input
            assert est.counters.held_intervals == gap_ticks // 10 - 1


def test_an_old_temperature_frame_starts_no_grid_far_back() -> None:
    est = estimator()
    for tick in range(5900, 6001):
        est.feed_motor(tick, *inputs(tick))
    est.feed_temp(1000, *temperatures(1000))
    assert (est.step().intervals, est.counters.late_measurements) == (0, 1)
    assert run(est, 6001, 6200)[-1].status == RUNNING


def test_backlog_is_bounded_when_nobody_steps() -> None:
    est = estimator()
    run(est, 0, 3000)
    for tick in range(3001, 9000):
        feed_tick(est, tick)
    out = est.step()
    assert est.counters.restarts >= 1
    assert out.intervals <= library().setting("default").max_gap_steps + 1
    assert run(est, 9000, 9400)[-1].status == RUNNING


def test_missing_temperatures_predict_and_say_so() -> None:
    est = estimator()
    run(est, 0, 3000)
    outs = run(est, 3001, 4000, temp=False)
    status = [o.status for o in outs]
    assert status == [RUNNING] * 5 + [PREDICTING] * 95
    assert all(np.isfinite(o.theta_w_degc) and np.isnan(o.innov_w_degc) for o in outs)
    assert run(est, 4001, 4100)[-1].status == RUNNING


def test_one_channel_missing_is_predicting_too() -> None:
    est = estimator()
    run(est, 0, 3000)
    for tick in range(3001, 3101):
        if tick % 10 == 0:
            est.feed_temp(tick, *temperatures(tick), r_valid=False)
        est.feed_motor(tick, *inputs(tick))
    out = est.step()
    assert out.status == PREDICTING
    assert np.isfinite(out.innov_w_degc)
    assert np.isnan(out.innov_r_degc)


@pytest.mark.parametrize(("dead", "setting"), [("w", "default"), ("r", "default"), ("r", "paper")])
def test_a_channel_missing_from_the_start_does_not_keep_back_the_other(dead: str, setting: str) -> None:
    """Two seconds of waiting, then an estimate called predicting; the channel is right as soon as it is measured."""
    est, whole = estimator(setting), run(estimator(setting), 0, 5000)
    outs = []
    for tick in range(5001):
        if tick % 10 == 0:
            back = tick > 3000
            est.feed_temp(tick, *temperatures(tick), w_valid=dead != "w" or back, r_valid=dead != "r" or back)
        est.feed_motor(tick, *inputs(tick))
        if tick % 10 == 0:
            outs.append(est.step())
    opens = 35 if setting == "default" else 20  # the paper's setting knows no delay
    status = [o.status for o in outs]
    assert status[1:opens] == [STARTING] * (opens - 1)
    assert set(status[opens:301]) == {PREDICTING}
    assert set(status[301:]) == {RUNNING}
    alive = "theta_r_degc" if dead == "w" else "theta_w_degc"
    known = [abs(getattr(o, alive) - getattr(o_whole, alive)) for o, o_whole in zip(outs, whole, strict=True)]
    assert max(known[opens + 20 : 301]) < 3.0, "the channel that is measured is as good as ever"
    for channel in ("theta_w_degc", "theta_r_degc"):
        assert all(np.isfinite(getattr(o, channel)) for o in outs[opens:])
        error = [abs(getattr(o, channel) - getattr(o_whole, channel)) for o, o_whole in zip(outs, whole, strict=True)]
        assert max(error[340:]) < 1.5, "not held at the made-up start"
    assert est.counters.restarts == 0
    assert est.counters.unconverged <= 1


def test_without_any_measurement_there_is_no_estimate() -> None:
    est = estimator()
    for tick in range(1001):
        if tick % 10 == 0:
            est.feed_temp(tick, *temperatures(tick), w_valid=False, r_valid=False)
        est.feed_motor(tick, *inputs(tick))
        out = est.step()
    assert (out.status, np.isnan(out.theta_w_degc)) == (STARTING, True)


def test_motor_frames_that_stop_are_stale_input() -> None:
    est = estimator()
    run(est, 0, 3000)
    outs = run(est, 3001, 3100, motor=False)
    assert [o.status for o in outs] == [RUNNING] * 2 + [INPUT_STALE] * 8
    assert outs[-1].stale_input
    assert outs[-1].tick == 3000
    assert run(est, 3101, 3200)[-1].status == RUNNING


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_values_are_not_used(bad: float) -> None:
    est, clean = estimator(), estimator()
    run(est, 0, 3000)
    run(clean, 0, 3000)
    for tick in range(3001, 3010):
        clean.feed_motor(tick, *inputs(tick), tick % 2 == 0)
        est.feed_motor(tick, inputs(tick)[0] if tick % 2 == 0 else bad, inputs(tick)[1])
    for e in (est, clean):
        e.feed_motor(3010, *inputs(3010))
    clean.feed_temp(3010, *temperatures(3010), w_valid=False)
    est.feed_temp(3010, bad, temperatures(3010)[1])
    a, b = est.step(), clean.step()
    assert (a.theta_w_degc, a.theta_r_degc) == (b.theta_w_degc, b.theta_r_degc)
    assert est.counters.invalid_inputs == 5


@pytest.mark.parametrize(("motor", "temp"), [((1e300, -1e300), (1e300, -1e300)), ((327.0, 16383.0), (923.0, -100.0))])
def test_absurd_values_do_not_stay(motor: tuple[float, float], temp: tuple[float, float]) -> None:
    """What no sensor can mean is not used; the ends of the frame's ranges ruin the estimate for a while only."""
    est = estimator()
    run(est, 0, 3000)
    for tick in range(3001, 3050):
        est.feed_motor(tick, *motor)
        if tick % 10 == 0:
            est.feed_temp(tick, *temp)
        est.step()
    outs = run(est, 3050, 6000)
    assert outs[-1].status == RUNNING
    assert abs(outs[-1].theta_w_degc - 131) < 12


def test_late_temperature_frame_is_used_where_it_belongs() -> None:
    est, on_time = estimator(), estimator()
    for e in (est, on_time):
        run(e, 0, 3000)
    est.feed_motor(3001, *inputs(3001))
    for tick in range(3001, 3011):
        on_time.feed_motor(tick, *inputs(tick))
        est.feed_motor(tick, *inputs(tick))
    on_time.feed_temp(3010, *temperatures(3010))
    on_time_out = on_time.step()
    assert np.isnan(est.step().innov_w_degc)
    est.feed_temp(3010, *temperatures(3010))
    out = est.step()
    assert (out.intervals, out.sweeps > 0) == (0, True)
    assert out.innov_w_degc == pytest.approx(on_time_out.innov_w_degc, abs=0.05)
    assert out.theta_w_degc == pytest.approx(on_time_out.theta_w_degc, abs=1e-6)


def test_very_late_temperature_frame_is_counted() -> None:
    est = estimator()
    run(est, 0, 3000)
    est.feed_temp(2800, 500.0, 500.0)
    assert est.counters.late_measurements == 2
    assert est.counters.restarts == 0


def test_frames_off_the_grid_are_counted_and_a_moved_grid_restarts() -> None:
    est = estimator()
    run(est, 0, 3000)
    est.feed_temp(3003, 130.0, 100.0)
    assert (est.counters.off_grid, est.counters.restarts) == (1, 0)
    for tick in range(3001, 3500):
        if tick % 10 == 4:
            est.feed_temp(tick, *temperatures(tick))
        est.feed_motor(tick, *inputs(tick))
        est.step()
    assert est.counters.restarts == 1
    assert est.step().status == RUNNING


def test_a_plant_restarted_just_before_the_wrap_is_noticed_by_its_grid() -> None:
    """Tick 65502, then 0: to the motor frames that is a gap of 0.34 s; three temperature frames later it is known."""
    est = estimator()
    run(est, 64_000, 65_502)
    outs = run(est, 0, 300)
    assert (est.counters.restarts, est.counters.off_grid) == (1, 3)
    assert [o.status for o in outs[3:5]] == [STARTING] * 2
    assert outs[-1].status == RUNNING


def test_repeated_motor_tick_counts_once() -> None:
    est = estimator()
    run(est, 0, 3000)
    est.feed_motor(3000, 1e3, 1e5)
    assert est.counters.repeated_ticks == 1


def test_setting_the_ring_cannot_hold_is_refused() -> None:
    assert Estimator(library(), library().setting("default", delay_steps=100)).error == 1
    assert Estimator(library(), library().setting("default", max_sweeps=0)).error == 1


@SLOW
@given(
    seed=st.integers(0, 2**32 - 1), setting=st.sampled_from(["default", "paper", "ekf"]), plain=st.booleans(),
    frames=st.integers(50, 800),
)  # fmt: skip
def test_any_frames_leave_a_sane_estimator(seed: int, setting: str, plain: bool, frames: int) -> None:
    """Random ticks, values and order: never a NaN that is called valid, always back to work afterwards."""
    rng = np.random.default_rng(seed)
    est = estimator(setting) if plain else Estimator(library(), library().setting(setting))
    tick = int(rng.integers(0, 65536))
    for _ in range(frames):
        tick += int(
            rng.choice(
                [0, 1, 1, 1, 1, 1, 2, 10, 300, -1, 30000],
                p=[0.05, 0.2, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05, 0.02, 0.02, 0.01],
            )
        )
        kind = rng.integers(0, 4)
        if kind <= 1:
            est.feed_motor(tick, rng.normal(0, 100), rng.uniform(0, 12000), bool(rng.random() < 0.9))
        elif kind == 2:
            shift = int(rng.choice([0, 0, 0, -10, 10, 3]))
            valid = rng.random(2) < 0.9
            est.feed_temp(
                10 * (tick // 10) + shift, rng.uniform(-40, 250), rng.uniform(-40, 250), bool(valid[0]), bool(valid[1])
            )
        else:
            out = est.step()
            if out.status in (RUNNING, PREDICTING, INPUT_STALE, OPEN_LOOP, FALLBACK):
                assert np.isfinite([out.theta_w_degc, out.theta_r_degc]).all()
                assert all(ch.sigma_degc > 0 and np.isfinite(ch.upper_degc) for ch in out.channel)
            else:
                assert np.isnan([out.theta_w_degc, out.theta_r_degc]).all() or out.status == INVALID
            assert out.intervals <= 51
    first = tick % 65536 + 40_000
    outs = run(est, first, first + 1000)
    assert outs[-1].status == RUNNING if plain else np.isfinite(outs[-1].theta_w_degc)


@pytest.mark.parametrize(("start_s", "limit_w", "limit_r"), [(400.0, 0.25, 0.25), (520.0, 0.25, 0.25)])
def test_hot_lap_accuracy(start_s: float, limit_w: float, limit_r: float) -> None:
    """Started in the middle of a hot lap with an empty net: from 10 s on within 0.25 degC of the plant, raw above 1."""
    from plant_sim.cycles import CycleSpec
    from tools.check_estimator import check

    w, r, data, core = check(library(), library().setting("default"), CycleSpec("lap"), start_s, 60.0, seed=4)
    assert w.raw_rmse_degc > 1.0
    assert w.est_rmse_degc <= limit_w
    assert r.est_rmse_degc <= limit_r
    assert w.first_10_s_max_degc < 1.5
    assert len(data) >= 580
    assert core.counters.restarts == 0
    assert core.counters.unconverged == 0
