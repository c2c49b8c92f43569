"""The sensors' offset, measured at key-on: when, how well, and what prevents it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from tests.support.faulted_laps import library
from tests.support.libest_parts import OffsetCalibration
from tools.libest import Estimator, Out

DATASHEET, MEASURING, FROZEN, REFUSED = range(4)  # calibration_state_t
DELAY, VALUES = 15, 100
COOLANT_DEGC, OFFSET = 65.0, np.array([-1.62, -0.71])
SIGMA = np.sqrt(0.1)  # of the sensors' noise


def calibration(**arguments: object) -> OffsetCalibration:
    return OffsetCalibration(library(), **arguments)  # type: ignore[arg-type]


def values(count: int, seed: int = 0, offset: np.ndarray = OFFSET, sigma: float = SIGMA) -> np.ndarray:
    """What both sensors of a machine at coolant temperature read, (count, 2)."""
    return COOLANT_DEGC + offset + np.random.default_rng(seed).normal(0.0, sigma, (count, 2))


def feed(calib: OffsetCalibration, rows: np.ndarray, fresh: bool = True) -> list[bool]:
    """All rows; while it measures, the coolant's temperature once a second."""
    changed = []
    for k, row in enumerate(rows):
        if fresh and k % 10 == 0 and calib.result.state == MEASURING:
            calib.coolant(COOLANT_DEGC, True)
        changed.append(calib.measure(*row))
    return changed


def test_before_anything_the_datasheet_counts() -> None:
    found = calibration(datasheet_degc=-1.0, sigma_degc=0.2).result
    assert found.state == DATASHEET
    np.testing.assert_array_equal(found.offset_degc, [-1.0, -1.0])
    np.testing.assert_array_equal(found.sigma_degc, [0.2, 0.2])


@pytest.mark.parametrize("seed", range(10))
def test_ten_seconds_of_soak_give_the_offset_and_its_uncertainty(seed: int) -> None:
    """The first 15 values speak for the time before key-on; after a hundred more it is frozen, within 3 sigma."""
    calib, rows = calibration(), values(DELAY + VALUES + 50, seed)
    rows[:DELAY] += 40.0
    calib.coolant(COOLANT_DEGC, True)
    assert calib.result.state == MEASURING
    changed = feed(calib, rows)
    assert [k for k, c in enumerate(changed) if c] == [DELAY + VALUES - 1]
    found = calib.result
    assert found.state == FROZEN
    used = rows[DELAY : DELAY + VALUES] - COOLANT_DEGC
    np.testing.assert_allclose(found.offset_degc, used.mean(axis=0), rtol=0, atol=1e-12)
    expected = np.sqrt(used.var(axis=0, ddof=1) / VALUES + 0.05**2)
    np.testing.assert_allclose(found.sigma_degc, expected, rtol=1e-9)
    assert (np.abs(found.offset_degc - OFFSET) <= 3.0 * found.sigma_degc).all()
    assert (found.sigma_degc < 0.08).all(), "better than the datasheet's 0.2 degC"


def test_sigma_is_as_large_as_the_errors() -> None:
    """Two hundred calibrations: their scatter is that of a mean; the rest of sigma is for the soak."""
    errors = []
    for seed in range(200):
        calib = calibration()
        calib.coolant(COOLANT_DEGC, True)
        feed(calib, values(DELAY + VALUES, seed + 100))
        errors.append(calib.result.offset_degc - OFFSET)
    assert np.std(errors) == pytest.approx(SIGMA / 10.0, rel=0.15)
    assert abs(np.mean(errors)) < 0.01


@pytest.mark.parametrize(
    ("offset", "sigma"),
    [((-8.0, -1.0), SIGMA), ((-1.0, 7.0), SIGMA), ((-1.0, -1.0), 3.0), ((50.0, 50.0), SIGMA)],
    ids=["winding far off", "rotor far off", "noisy", "never soaked"],
)
def test_what_cannot_be_is_refused(offset: tuple[float, float], sigma: float) -> None:
    """The datasheet stays for the sensor concerned, as uncertain as what was measured; the other is calibrated."""
    calib = calibration()
    calib.coolant(COOLANT_DEGC, True)
    rows = values(DELAY + VALUES, 1, np.array(offset), sigma)
    refused = np.array([abs(o + 1.0) > 5.0 or sigma > 1.0 for o in offset])
    assert any(feed(calib, rows)) == (not refused.all())
    found = calib.result
    assert found.state == REFUSED
    away = np.abs(rows[DELAY:].mean(axis=0) - COOLANT_DEGC + 1.0)
    for ch in range(2):
        if refused[ch]:
            assert found.offset_degc[ch] == -1.0
            assert found.sigma_degc[ch] == pytest.approx(min(50.0, max(0.2, away[ch])))
        else:
            assert found.offset_degc[ch] == pytest.approx(offset[ch], abs=0.2)
            assert found.sigma_degc[ch] < 0.08


def test_coolant_temperatures_that_stop_end_it() -> None:
    calib = calibration()
    calib.coolant(COOLANT_DEGC, True)
    assert not any(feed(calib, values(DELAY + VALUES), fresh=False))
    assert calib.result.state == DATASHEET
    assert not any(feed(calib, values(DELAY + VALUES)))


def test_a_channel_without_values_keeps_it_waiting_and_the_end_of_the_soak_ends_it() -> None:
    calib, rows = calibration(), values(500)
    rows[:, 1] = np.nan
    calib.coolant(COOLANT_DEGC, True)
    assert not any(feed(calib, rows))
    assert calib.result.state == MEASURING
    calib.coolant(COOLANT_DEGC, False)
    assert calib.result.state == DATASHEET
    assert not any(feed(calib, values(500)))
    np.testing.assert_array_equal(calib.result.offset_degc, [-1.0, -1.0])


def test_values_that_come_and_go_are_gathered() -> None:
    """Gaps cost time, nothing else."""
    calib, rows = calibration(), values(DELAY + 3 * VALUES, 2)
    rows[DELAY:][np.arange(3 * VALUES) % 3 != 0, 0] = np.nan
    calib.coolant(COOLANT_DEGC, True)
    changed = feed(calib, rows)
    assert sum(changed) == 1
    assert calib.result.state == FROZEN
    used = rows[DELAY:, 0][::3] - COOLANT_DEGC
    assert calib.result.offset_degc[0] == pytest.approx(used.mean(), abs=1e-12)


@pytest.mark.parametrize("count", [0, 1, DELAY, DELAY + VALUES - 1])
def test_a_soak_that_ends_too_early_leaves_the_datasheet(count: int) -> None:
    calib = calibration()
    calib.coolant(COOLANT_DEGC, True)
    assert not any(feed(calib, values(count)))
    calib.coolant(COOLANT_DEGC, False)
    calib.coolant(COOLANT_DEGC, True)  # standing at a light is no second key-on
    assert not any(feed(calib, values(500)))
    assert calib.result.state == DATASHEET
    np.testing.assert_array_equal(calib.result.offset_degc, [-1.0, -1.0])


def test_frozen_stays_frozen() -> None:
    calib = calibration()
    calib.coolant(COOLANT_DEGC, True)
    feed(calib, values(DELAY + VALUES))
    before = calib.result
    for soaked in (False, True):
        calib.coolant(20.0, soaked)
        assert not any(feed(calib, values(300, 9, np.array([3.0, 3.0]))))
    assert calib.result.state == FROZEN
    np.testing.assert_array_equal(calib.result.offset_degc, before.offset_degc)


@pytest.mark.parametrize("coolant", [np.nan, np.inf, -np.inf])
def test_coolant_that_is_no_number_starts_nothing(coolant: float) -> None:
    calib = calibration()
    calib.coolant(coolant, True)
    assert calib.result.state == DATASHEET
    assert not any(feed(calib, values(300)))
    calib.coolant(COOLANT_DEGC, True)
    assert sum(feed(calib, values(300))) == 1


def test_a_setting_without_it_never_measures() -> None:
    calib = calibration(datasheet_degc=0.0, sigma_degc=0.0, enabled=False)
    calib.coolant(COOLANT_DEGC, True)
    assert not any(feed(calib, values(300)))
    assert calib.result.state == DATASHEET


NUMBERS = st.one_of(
    st.floats(60.0, 70.0), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e6, 0.0]), st.floats()
)
EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("coolant"), NUMBERS, st.booleans()),
        st.tuples(st.just("values"), NUMBERS, NUMBERS),
        st.tuples(st.just("sound"), st.integers(1, 130), st.integers(0, 99)),
    ),
    max_size=40,
)


@hypothesis_settings(max_examples=150, deadline=None)
@given(events=EVENTS)
def test_whatever_comes_the_offset_is_the_datasheets_or_a_believable_one(events: list) -> None:
    """Any order of anything: finite, within 5 degC of the datasheet, changed once at most, a frozen one never again."""
    calib, changes, frozen = calibration(), 0, None
    for kind, a, b in events:
        before = calib.result
        if kind == "coolant":
            calib.coolant(a, b)
            changed = 0
        else:
            changed = sum(feed(calib, values(a, b) if kind == "sound" else np.array([[a, b]])))
        changes += changed
        found = calib.result
        assert np.isfinite(found.offset_degc).all()
        assert np.isfinite(found.sigma_degc).all()
        assert (found.sigma_degc > 0.0).all()
        assert (np.abs(found.offset_degc + 1.0) <= 5.0).all()
        one = found.state == REFUSED and (found.offset_degc != -1.0).any()  # of the two sensors
        assert (found.state == FROZEN or one) == (changes > 0)
        assert (found.sigma_degc <= 50.0).all()
        if not changed:
            np.testing.assert_array_equal(found.offset_degc, before.offset_degc)
        if frozen is not None:
            np.testing.assert_array_equal(found.offset_degc, frozen)
        if found.state == FROZEN:
            frozen = found.offset_degc
    assert changes <= 1


# ---- in the core ----------------------------------------------------------------------------------------------------


def standing(core: Estimator, first: int, last: int, *, soaked: bool = True, seed: int = 5) -> list[Out]:
    """Ticks of a machine at coolant temperature that stands still."""
    rows, outs = values((last - first) // 10 + 1, seed), []
    for tick in range(first, last):
        if tick % 100 == 0:
            core.feed_coolant(COOLANT_DEGC, soaked)
        if tick % 10 == 0:
            core.feed_temp(tick, *rows[(tick - first) // 10])
        core.feed_motor(tick, 0.0, 0.0)
        if tick % 10 == 9:
            outs.append(core.step())
    return outs


def test_the_core_uses_it_from_then_on_and_through_restarts() -> None:
    """Published as measuring, then frozen; the estimate loses its error; a restart of the plant changes nothing."""
    core = Estimator(library(), library().setting("default"))
    outs = standing(core, 0, 2000)
    states = [o.calibration.state for o in outs]
    assert states == sorted(states)
    assert states.count(MEASURING) >= VALUES
    assert states[-1] == FROZEN
    last = outs[-1]
    found = np.array(last.calibration.offset_degc[:])
    assert (np.abs(found - OFFSET) <= 3.0 * np.array(last.calibration.sigma_degc[:])).all()
    early = [o for o in outs if o.calibration.state == MEASURING and np.isfinite(o.theta_w_degc)]
    assert abs(early[-1].theta_w_degc - COOLANT_DEGC) > 0.4, "the datasheet is wrong for this sensor"
    assert abs(last.theta_w_degc - COOLANT_DEGC) < 0.2
    assert abs(last.theta_r_degc - COOLANT_DEGC) < 0.2
    assert last.channel[0].upper_degc > COOLANT_DEGC
    for first in (50_000, 10):  # the plant starts anew, twice; once it even says soaked
        again = standing(core, first, first + 500, soaked=first == 10, seed=first)
        assert again[-1].calibration.state == FROZEN
        np.testing.assert_array_equal(again[-1].calibration.offset_degc[:], found)
        assert abs(again[-1].theta_w_degc - COOLANT_DEGC) < 0.3
    assert core.counters.restarts >= 2


def test_the_core_without_a_soak_keeps_the_datasheet() -> None:
    core = Estimator(library(), library().setting("default"))
    out = standing(core, 0, 2000, soaked=False)[-1]
    assert out.calibration.state == DATASHEET
    assert list(out.calibration.offset_degc) == [-1.0, -1.0]
    assert out.theta_w_degc == pytest.approx(COOLANT_DEGC + OFFSET[0] + 1.0, abs=0.3)


def test_the_uncertainty_is_part_of_the_upper_bound() -> None:
    """A measured offset is better known than the datasheet's: the bound comes nearer."""
    measured = standing(Estimator(library(), library().setting("default")), 0, 4000)[-1]
    assumed = standing(Estimator(library(), library().setting("default")), 0, 4000, soaked=False)[-1]
    width = [o.channel[0].upper_degc - o.theta_w_degc for o in (measured, assumed)]
    assert 0.0 < width[0] < width[1] - 0.1
