"""Sensor faults and plant mismatch: text and data, each fault's reading, pairing of runs, chunking, refusals."""

import copy
import itertools
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim import faults as module
from plant_sim.cycles import CycleSpec
from plant_sim.errors import FaultError, ParameterError, PlantStateError
from plant_sim.faults import KINDS, Fault, active_faults, check_faults, load_catalogue, parse_fault
from plant_sim.mismatch import Mismatch, load_mismatches, mismatched
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.sensors import TemperatureSensor

PARAMS = load_params()
LAP_SAMPLES = 7141
ALL_TEXTS = [
    "offset:-20@3-12", "noise:5@4-9/wr", "stuck@6-7.5/r", "dropout:nan@8-8.5", "spike:20%@2-20/wr",
    "drift:-3@5-15", "slow:2@3-10/r", "delay:3@6-11/wr", "gain:-5%@2-14", "dropout:short@13-14/r", "stuck@15-15.4",
]  # fmt: skip


@st.composite
def some_faults(draw) -> Fault:
    kind = draw(st.sampled_from(KINDS))
    start = draw(st.floats(0, 1e4))
    end = start + draw(st.floats(0.01, 1e4))
    amplitude = None
    if kind == "dropout":
        amplitude = draw(st.sampled_from([None, -40.0, 200.0]))
    elif kind != "stuck":
        _, low, high = module._RANGES[kind]
        amplitude = draw(st.floats(low, high))
    return Fault(kind, amplitude, start, end, draw(st.sampled_from(["w", "r", "wr"])))


@given(some_faults())
def test_text_and_back(fault):
    assert parse_fault(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("offset:-20@430-550", Fault("offset", -20.0, 430.0, 550.0)),
        ("noise:5@430-550/r", Fault("noise", 5.0, 430.0, 550.0, "r")),
        ("stuck@430-490", Fault("stuck", None, 430.0, 490.0)),
        ("dropout:nan@1-2", Fault("dropout", None, 1.0, 2.0)),
        ("dropout:open@1-2", Fault("dropout", -40.0, 1.0, 2.0)),
        ("dropout:short@1-2/wr", Fault("dropout", 200.0, 1.0, 2.0, "wr")),
        ("spike:2%@0-2", Fault("spike", 2.0, 0.0, 2.0)),
        ("drift:-0.05@1-2", Fault("drift", -0.05, 1.0, 2.0)),
        ("slow:15@1-2", Fault("slow", 15.0, 1.0, 2.0)),
        ("delay:3@1-2", Fault("delay", 3.0, 1.0, 2.0)),
        ("gain:-5%@1.5-2.25", Fault("gain", -5.0, 1.5, 2.25)),
        (" offset:1e1@0-2 ", Fault("offset", 10.0, 0.0, 2.0)),
    ],
)
def test_texts(text, fault):
    assert parse_fault(text) == fault


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not understood"),
        ("offset", "not understood"),
        ("offset:-20", "KIND[:AMPLITUDE]@START-END"),
        ("offset:-20@430", "not understood"),
        ("offset:-20@430-550 stuck@1-2", "not understood"),
        ("wobble:1@1-2", "use one of offset, noise"),
        ("offset@1-2", "amplitude None must be -300 to 300 K"),
        ("offset:warm@1-2", "no number"),
        ("offset:nan@1-2", "no number"),
        ("offset:1e9@1-2", "must be -300 to 300"),
        ("noise:-1@1-2", "must be 0 to 300"),
        ("spike:2@1-2", "no number in %"),
        ("spike:200%@1-2", "0 to 100"),
        ("gain:-5@1-2", "no number in %"),
        ("slow:0@1-2", "time constant"),
        ("stuck:5@1-2", "no amplitude"),
        ("dropout@1-2:open", "not understood"),
        ("dropout:loose@1-2", "dropout:nan, dropout:open or dropout:short"),
        ("offset:1@2-2", "no window"),
        ("offset:1@-2-3", "no window"),
        ("offset:1@3-2", "no window"),
        ("offset:1@1-2/q", "channel 'q'"),
        ("offset:1@1-2/rw", "channel 'rw'"),
    ],
)
def test_what_is_no_fault_is_refused_in_one_line(text, says):
    with pytest.raises(FaultError) as caught:
        parse_fault(text)
    assert says in str(caught.value)
    assert f"fault '{text}'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_of_a_kind_at_once_are_refused():
    apart = [parse_fault(t) for t in ("offset:1@5-7", "offset:2@1-5", "noise:5@1-9", "offset:3@1-9/r")]
    assert [str(f) for f in check_faults(apart)] == ["offset:3@1-9/r", "offset:2@1-5", "noise:5@1-9", "offset:1@5-7"]
    with pytest.raises(FaultError, match="overlap"):
        TemperatureSensor(PARAMS.sensor, np.zeros(2), np.random.default_rng(0), [*apart, parse_fault("offset:1@6-9")])


def test_the_catalogue_is_the_specification_s():
    catalogue = load_catalogue()
    assert list(catalogue) == ["F1", "F1+", "F2", "F3", "F4", "F4-open", "F4-short", *(f"F{i}" for i in range(5, 11))]
    expected = {
        "F1": (-5, -20, -40), "F2": (2, 5, 10), "F6": (-0.02, -0.05, -0.1), "F7": (5, 15, 30), "F8": (0.5, 3, 5),
        "F9": (-2, -5, -10),
    }  # fmt: skip
    for name, amplitudes in expected.items():
        entry = catalogue[name]
        assert tuple(entry[s][0].amplitude for s in ("mild", "paper", "severe")) == amplitudes
        assert {(f.start_s, f.end_s) for fs in entry.values() for f in fs} == {(430.0, 550.0)}
    assert [catalogue["F3"][s][0].end_s - 430 for s in ("mild", "paper", "severe")] == [30, 120, 300]
    for name in ("F4", "F4-open", "F4-short"):
        assert [catalogue[name][s][0].end_s - 430 for s in ("mild", "paper", "severe")] == [1, 10, 60]
    assert [f.kind for f in catalogue["F10"]["paper"]] == ["offset", "noise"]
    assert {f.kind for e in catalogue.values() for fs in e.values() for f in fs} == set(KINDS)
    for entry in catalogue.values():
        for faults in entry.values():
            check_faults(faults)


# ---- readings ---------------------------------------------------------------------------------------------------


def truth(count: int = 200) -> np.ndarray:
    """Two channels that move differently, at 10 Hz."""
    t = 0.1 * np.arange(1, count + 1)
    return np.column_stack([100 + 20 * np.sin(t / 4.0), 60 + 0.8 * t])


def read(*texts: str, theta: np.ndarray | None = None, seed: int = 3) -> np.ndarray:
    theta = truth() if theta is None else theta
    sensor = TemperatureSensor(
        PARAMS.sensor, theta[0], np.random.default_rng(seed), [parse_fault(t) for t in texts]
    )
    return sensor.sample(theta)


def window(start_s: float, end_s: float) -> slice:
    """Rows of samples 1, 2, ... whose time lies in [start, end)."""
    return slice(round(start_s * 10) - 1, round(end_s * 10) - 1)


def differs_only_in(text: str, channel: int, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Readings with and without one fault, in its rows; everywhere else they are the same bytes."""
    bad, good = read(text), read()
    outside = np.ones(bad.shape, dtype=bool)
    outside[rows, channel] = False
    assert bad[outside].tobytes() == good[outside].tobytes(), "a fault touches more than its window"
    assert not np.array_equal(bad[rows, channel], good[rows, channel])
    return bad[rows, channel], good[rows, channel]


def test_offset():
    bad, good = differs_only_in("offset:-20@5-8", 0, window(5, 8))
    np.testing.assert_allclose(bad - good, -20.0, atol=1e-12)


def test_noise_scales_the_same_numbers():
    bad, good = differs_only_in("noise:5@5-8/r", 1, window(5, 8))
    clean = truth()[window(3.5, 6.5), 1] + PARAMS.sensor.mean_k
    np.testing.assert_allclose((bad - clean) / 5.0, (good - clean) / np.sqrt(PARAMS.sensor.variance_k2), atol=1e-9)


def test_stuck_holds_the_last_reading():
    bad, _ = differs_only_in("stuck@5-8", 0, window(5, 8))
    assert set(bad) == {read()[48, 0]}
    assert set(read("stuck@0-2")[:19, 0]) == {read()[0, 0]}, "nothing before: the first reading"


@pytest.mark.parametrize(("text", "value"), [("nan", np.nan), ("open", -40.0), ("short", 200.0)])
def test_dropout(text, value):
    bad, _ = differs_only_in(f"dropout:{text}@5-8", 0, window(5, 8))
    np.testing.assert_array_equal(bad, value)


def test_spikes_are_rare_high_and_independent_of_the_noise():
    theta = np.tile(truth(), (100, 1))
    jumps = (read("spike:2%@0-1e5/wr", theta=theta) - read(theta=theta)).ravel()
    hit = jumps[np.abs(jumps) > 1e-9]
    assert 0.017 < hit.size / jumps.size < 0.023
    assert 10.0 - 1e-9 <= np.abs(hit).min() < 11.0
    assert 39.0 < np.abs(hit).max() <= 40.0 + 1e-9
    assert 0.4 < (hit > 0).mean() < 0.6
    assert abs(np.corrcoef(np.abs(hit), np.arange(hit.size))[0, 1]) < 0.1
    assert np.count_nonzero(np.abs(read("spike:100%@5-8") - read())[window(5, 8), 0] < 10 - 1e-9) == 0


def test_drift_grows_from_nothing_and_stops():
    bad, good = differs_only_in("drift:-5@5-12", 0, window(5, 12))
    np.testing.assert_allclose(bad - good, np.maximum(-5.0 * 0.1 * np.arange(70), -20.0), atol=1e-9)
    up = read("drift:0.5@5-12/r") - read()
    np.testing.assert_allclose(up[window(5, 12), 1], 0.05 * np.arange(70), atol=1e-9)


def test_slow_is_a_first_order_lag_from_the_present_temperature():
    bad, good = differs_only_in("slow:2@5-8", 0, window(6.5, 9.5))  # seen one delay later
    values, lagged = truth()[window(5, 8), 0], truth()[49, 0]
    expected = []
    for value in values:
        lagged += (1 - np.exp(-0.05)) * (value - lagged)
        expected.append(lagged - value)
    np.testing.assert_allclose(bad - good, expected, atol=1e-9)


def test_delay_reads_further_back_and_returns():
    bad, good = differs_only_in("delay:3@6-8", 0, window(6, 8))
    theta = truth()[:, 0]
    np.testing.assert_allclose(bad - good, theta[window(1.5, 3.5)] - theta[window(4.5, 6.5)], atol=1e-9)


def test_gain_error_is_about_25_degc():
    bad, good = differs_only_in("gain:-5%@5-8", 0, window(6.5, 9.5))
    np.testing.assert_allclose(bad - good, -0.05 * (truth()[window(5, 8), 0] - 25.0), atol=1e-9)


def test_offset_and_noise_together():
    both, noise = read("offset:-20@5-8", "noise:5@5-8"), read("noise:5@5-8")
    np.testing.assert_allclose((both - noise)[window(5, 8), 0], -20.0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 60), max_size=12), st.sets(st.sampled_from(ALL_TEXTS)))
def test_any_chunking_gives_the_same_bytes(cuts, texts):
    theta, whole = truth(), read(*texts)
    sensor = TemperatureSensor(
        PARAMS.sensor, theta[0], np.random.default_rng(3), [parse_fault(t) for t in sorted(texts)]
    )
    edges = [*np.minimum(np.cumsum([0, *cuts]), len(theta)), len(theta)]
    parts = [sensor.sample(theta[a:b]) for a, b in itertools.pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def test_single_samples_and_a_copy_in_between_give_the_same_bytes():
    theta, whole = truth(), read(*ALL_TEXTS)
    sensor = TemperatureSensor(PARAMS.sensor, theta[0], np.random.default_rng(3), [parse_fault(t) for t in ALL_TEXTS])
    rows = []
    for i, row in enumerate(theta):
        if i % 50 == 20:
            copy.deepcopy(sensor).sample(theta[:7])
        rows.append(sensor.sample(row[None, :]))
    assert np.concatenate(rows).tobytes() == whole.tobytes()
    assert np.isnan(whole[window(8, 8.5), 0]).all()


def test_a_lap_of_readings_costs_less_than_a_twentieth_of_it_sample_by_sample():
    theta = np.tile(truth(), (36, 1))[:LAP_SAMPLES]
    texts = [
        "offset:-20@1-714", "noise:5@1-714", "spike:2%@1-714", "drift:-0.05@1-714", "slow:15@1-714/wr", "delay:3@1-714"
    ]  # fmt: skip
    whole_s = np.inf
    for _ in range(5):
        start = time.perf_counter()
        assert read(*texts, theta=theta).shape == (LAP_SAMPLES, 2)
        whole_s = min(whole_s, time.perf_counter() - start)
    sensor = TemperatureSensor(PARAMS.sensor, theta[0], np.random.default_rng(3), [parse_fault(t) for t in texts])
    start = time.perf_counter()
    for row in theta[: LAP_SAMPLES // 20]:
        sensor.sample(row[None, :])
    assert whole_s < time.perf_counter() - start


# ---- the plant --------------------------------------------------------------------------------------------------


def test_masks_follow_the_windows():
    faults = [parse_fault(t) for t in ("offset:1@1-2", "gain:1%@1.5-3/wr", "stuck@2-3/r")]
    assert active_faults(faults, 0.99) == (0, 0)
    assert active_faults(faults, 1.0) == (1 << 0, 0)
    assert active_faults(faults, 1.5) == (1 << 0 | 1 << 8, 1 << 8)
    assert active_faults(faults, 2.0) == (1 << 8, 1 << 8 | 1 << 2)
    assert active_faults(faults, 3.0) == (0, 0)


def test_the_plant_says_what_is_wrong_and_reads_accordingly():
    faults = [parse_fault("offset:-20@0.5-0.8"), parse_fault("dropout:nan@0.6-0.7/r")]
    bad, good = Plant(PARAMS, CycleSpec(), seed=4, faults=faults), Plant(PARAMS, CycleSpec(), seed=4)
    for tick in range(1, 101):
        a, b = bad.step(), good.step()
        assert (a.fault_w, a.fault_r) == (int(50 <= tick < 80), 8 * int(60 <= tick < 70))
        assert (b.fault_w, b.fault_r) == (0, 0)
        assert (a.theta_w_degc, a.torque_nm) == (b.theta_w_degc, b.torque_nm)
        if tick % 10:
            assert a.theta_w_meas_degc is None
            continue
        assert a.theta_w_meas_degc - b.theta_w_meas_degc == pytest.approx(-20.0 * (50 <= tick < 80), abs=1e-9)
        assert np.isnan(a.theta_r_meas_degc) == (tick == 60)
    assert bad.active_faults(0.65) == (1, 8)


def test_advancing_through_a_fault_leaves_what_stepping_leaves():
    faults = [parse_fault(t) for t in ("stuck@2-6", "slow:5@1-4/r", "spike:30%@1-9/wr")]
    jumped, walked = (Plant(PARAMS, CycleSpec(), seed=5, faults=faults) for _ in range(2))
    jumped.advance(3.07)
    for _ in range(307):
        walked.step()
    for _ in range(500):
        assert jumped.step() == walked.step()


def test_key_on_stands_still_then_drives_the_same_cycle():
    keyed = Plant(PARAMS, CycleSpec(theta0_degc=65.0), key_on_s=15.0)
    plain = Plant(PARAMS, CycleSpec(theta0_degc=65.0))
    for tick in range(1, 1501):
        s = keyed.step()
        assert (s.tick, s.torque_nm, s.speed_rpm, s.v_mps, s.x_m, s.v_ref_mps, s.done) == (tick, 0, 0, 0, 0, 0, False)
        assert (s.soaked, s.coolant_degc, s.ambient_degc) == (True, 65.0, 25.0)
    assert max(abs(s.theta_w_degc - 65.0), abs(s.theta_r_degc - 65.0)) < 0.01
    for _ in range(3000):
        a, b = keyed.step(), plain.step()
        assert (a.v_mps, a.x_m, a.torque_nm, a.v_ref_mps) == (b.v_mps, b.x_m, b.torque_nm, b.v_ref_mps)
        assert not a.soaked
        assert a.tick == b.tick + 1500
    assert a.theta_w_degc == pytest.approx(b.theta_w_degc, abs=0.05)


def test_key_on_jumped_over_equals_key_on_walked_through():
    jumped, walked = (Plant(PARAMS, CycleSpec("class3", theta0_degc=60.0), seed=2, key_on_s=3.0) for _ in range(2))
    jumped.advance(25.07)
    rows = [walked.step() for _ in range(2507)]
    assert not any(r.soaked for r in rows), "60 degC is not the coolant's temperature"
    assert jumped.step() == walked.step()
    np.testing.assert_array_equal(jumped.theta_degc, walked.theta_degc)
    assert walked.record(200_000)[-1] is not None
    assert walked.tick * 0.01 == pytest.approx(1803.0), "the cycle's end moves by the standstill"
    for bad in (-1.0, 0.005, 1e4, float("nan")):
        with pytest.raises((PlantStateError, ValueError)):
            Plant(PARAMS, CycleSpec(), key_on_s=bad)


# ---- mismatch ---------------------------------------------------------------------------------------------------


def test_mismatches_change_what_they_say_and_nothing_else():
    assert Mismatch().apply(PARAMS) == PARAMS
    assert mismatched(PARAMS, "coolant-50") == PARAMS.varied(boundary__coolant_degc=50.0)
    assert mismatched(PARAMS, "flow-half") == PARAMS.varied(coolant__flow_lpm=3.0)
    assert mismatched(PARAMS, "ac-1.5") == PARAMS.varied(loss__k_ac=1.1 * 1.5)
    assert mismatched(PARAMS, "resistance-1.05") == PARAMS.varied(material__rho_el20_ohm_m=1.72e-08 * 1.05)
    assert mismatched(PARAMS, "liner-2") == PARAMS.varied(contact__t_liner_gap_m=8e-05)
    assert len(load_mismatches()) == 5
    with pytest.raises(ParameterError, match="use one of coolant-50"):
        mismatched(PARAMS, "coolant-51")
    for bad in ({"coolant_flow_share": 0.0}, {"coolant_degc": 200.0}, {"ac_loss_scale": float("nan")}):
        with pytest.raises(ParameterError):
            Mismatch(**bad).apply(PARAMS)


@pytest.mark.parametrize("name", list(load_mismatches()))
def test_a_mismatched_plant_gets_hotter_or_cooler(name):
    """Each differs visibly at second 400 of the lap; nodes start where they always do."""
    ends = []
    for params in (PARAMS, mismatched(PARAMS, name)):
        plant = Plant(params, CycleSpec(theta0_degc=65.0))
        assert set(plant.theta_degc) == {65.0}
        plant.advance(400.0)
        ends.append(plant.theta_degc.max())
    assert (ends[1] - ends[0]) * (-1 if name == "coolant-50" else 1) > 0.2
