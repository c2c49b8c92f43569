"""Cycles: the test lap's figures, the class-3-like cycle's regulation figures, and CSV files good and bad."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.class3 import PHASES, class3_trace
from plant_sim.csv_cycle import read_csv_cycle
from plant_sim.cycles import Cycle, CycleSpec, build_cycle
from plant_sim.errors import CycleError
from plant_sim.interpolation import gaussian_smooth, pchip
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.simulate import simulate
from plant_sim.track import LAP_ANCHORS_KM_M, LAP_LENGTH_M, corner_curvature, lap_grade, random_track

PARAMS = load_params()


@pytest.fixture(scope="module")
def lap():
    return simulate(PARAMS, CycleSpec("lap"))


def test_lap_figures(lap):
    assert 705.0 <= lap.finished_s <= 725.0
    assert 163.0 <= lap.theta_w_degc.max() <= 171.0
    assert 127.0 <= lap.theta_r_degc[-1] <= 137.0
    later = lap.t_s > 20.0
    assert 1.4 <= np.ptp(lap.dtheta_w_degc_s[later]) <= 1.8
    assert 0.26 <= np.ptp(lap.dtheta_r_degc_s[later]) <= 0.33
    assert np.sqrt(np.mean((lap.v_mps - lap.v_ref_mps) ** 2)) < 1.4
    assert lap.v_mps.max() * 3.6 < 133.0


def test_lap_geometry():
    grade = lap_grade()
    assert grade.size == 20833
    assert LAP_LENGTH_M == 20832.0
    assert -0.13 <= grade.min() < -0.08
    assert 0.10 < grade.max() <= 0.18
    assert abs(grade.sum()) < 1.0  # a lap ends where it began
    heights = dict((m, km) for km, m in LAP_ANCHORS_KM_M)
    assert min(heights) == 320.0
    assert 10.5 <= heights[320.0] <= 11.5
    assert max(heights) == 616.8


def test_lap_is_slower_under_derating_and_slope_follows_the_road(lap):
    derated = simulate(PARAMS, CycleSpec("lap"), rule_degc=(150.0, 155.0))
    assert derated.theta_w_degc.max() < 155.0
    assert lap.finished_s + 3.0 < derated.finished_s < lap.finished_s + 15.0
    at = np.arange(1000.0, 20000.0, 500.0)
    np.testing.assert_allclose(
        np.interp(at, lap.x_m, lap.slope_rad), np.interp(at, derated.x_m, derated.slope_rad), atol=0.004
    )


def test_plain_class3_cycle_stays_cool():
    run = simulate(PARAMS, CycleSpec("class3"))
    assert run.finished_s == pytest.approx(1800.0)
    assert 100.0 <= run.theta_w_degc.max() <= 115.0
    standing = (run.v_ref_mps < 0.02) & (run.v_mps < 0.02)
    assert standing.mean() > 0.08
    assert np.abs(run.torque_nm[standing]).max() < 20.0


@pytest.mark.parametrize("seed", [0, 1, 2, 100, 105])
def test_class3_keeps_the_regulation_figures(seed):
    v, borders = class3_trace(seed)
    assert v.size == 1801
    assert borders.tolist() == [0, 589, 1022, 1477, 1800]
    assert v.sum() == pytest.approx(23270.0, abs=10.0)
    assert np.diff(v).min() > -1.6
    assert np.diff(v).max() < 1.6
    for phase, begin, end in zip(PHASES, borders[:-1], borders[1:], strict=True):
        part = v[begin + 1 : end + 1]
        assert part.max() * 3.6 == pytest.approx(phase.v_top_kmh, abs=1e-6)
        assert part.sum() == pytest.approx(phase.distance_m, rel=1e-3)
        assert part[-1] == 0.0
        assert (part < 0.3).mean() >= 0.5 * phase.idle_s / phase.duration_s


def test_class3_seed_decides():
    np.testing.assert_array_equal(class3_trace(3)[0], class3_trace(3)[0])
    assert np.abs(class3_trace(3)[0] - class3_trace(4)[0]).max() > 5.0


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_random_tracks_are_drivable(seed):
    track = random_track(PARAMS, np.random.default_rng(seed), length_m=5000.0)
    assert track.v_ref_mps.min() >= 1.0
    assert track.v_ref_mps.max() <= 130.0 / 3.6 + 1e-9
    # Never asks for more than the brakes' 4.5 m/s2.
    braking = np.diff(track.v_ref_mps**2) / 2.0
    assert braking.min() >= -4.5 - 1e-6
    assert track.slope_rad.min() >= np.arctan(-0.13) - 1e-9


def test_random_tracks_differ_from_the_lap():
    lap_cycle = build_cycle(CycleSpec("lap"), PARAMS)
    track = random_track(PARAMS, np.random.default_rng(3), length_m=LAP_LENGTH_M)
    assert np.corrcoef(track.slope_rad, lap_cycle.slope_rad)[0, 1] < 0.5
    assert np.corrcoef(track.v_ref_mps, lap_cycle.v_ref_mps)[0, 1] < 0.5


def test_corners():
    curvature = corner_curvature(np.random.default_rng(1), 20000.0, 73, (15000.0, 17000.0))
    assert np.abs(curvature[15100:16900]).max() < 1e-6
    assert np.abs(curvature).max() <= 1.0 / 22.0
    assert (curvature < 0.0).any()
    assert (curvature > 0.0).any()


def test_pchip_keeps_shape_and_passes_through_the_knots():
    x, y = np.array([0.0, 1.0, 2.5, 3.0, 5.0]), np.array([0.0, 2.0, 2.0, 1.0, 7.0])
    np.testing.assert_allclose(pchip(x, y, x), y, atol=1e-14)
    fine = pchip(x, y, np.linspace(0.0, 5.0, 1001))
    assert fine.min() >= 0.0
    assert fine.max() <= 7.0
    np.testing.assert_allclose(
        pchip(x, 3.0 * x + 1.0, np.linspace(0, 5, 50)), 3.0 * np.linspace(0, 5, 50) + 1.0
    )
    with pytest.raises(ValueError, match="rising"):
        pchip(x[::-1], y, x)


def test_gaussian_smooth_keeps_mean_and_spreads_an_impulse():
    impulse = np.zeros(201)
    impulse[100] = 1.0
    smooth = gaussian_smooth(impulse, 8.0)
    assert smooth.sum() == pytest.approx(1.0)
    k = np.arange(201) - 100
    assert np.sqrt(np.sum(smooth * k**2)) == pytest.approx(8.0, rel=0.01)
    np.testing.assert_allclose(gaussian_smooth(np.full(50, 3.0), 5.0), 3.0)


def write(tmp_path, text, name="cycle.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_text(text, encoding=encoding)
    return path


def test_csv_time_with_byte_order_mark_and_foreign_headers(tmp_path):
    path = write(
        tmp_path,
        "cycSecs,cycMps,cycGrade,cycRoadType\n0,0,0,0\n1,5,0.1,0\n3,50,0.1,x\n",
        encoding="utf-8-sig",
    )
    cycle = read_csv_cycle(path, PARAMS)
    assert not cycle.by_distance
    assert cycle.end == pytest.approx(3.0)
    assert cycle.reference(0.5, 0.0, 2.0) == (pytest.approx(2.5), pytest.approx(np.arctan(0.1) / 2, rel=0.02))
    assert cycle.v_ref_mps.max() == PARAMS.vehicle.v_max_mps


def test_csv_distance_with_speed_in_kmh_and_percent(tmp_path):
    path = write(tmp_path, "distance_km,speed_kmh,grade_percent\n0,0,5\n1,72,5\n")
    cycle = read_csv_cycle(path, PARAMS, length_m=2000.0)
    assert cycle.by_distance
    assert cycle.end == 2000.0
    assert cycle.reference(99.0, 1000.0, 2.0)[1] == pytest.approx(np.arctan(0.05))
    plant = Plant(PARAMS, cycle)
    plant.advance(20.0)
    assert plant.step().x_m > 20.0  # it does start although the file begins at rest


def test_csv_distance_with_curvature_only(tmp_path):
    path = write(tmp_path, "s_m,kappa_1pm,phi_rad\n0,0,0\n500,0,0\n510,0.02,0\n600,0.02,0\n900,0,0\n")
    cycle = read_csv_cycle(path, PARAMS, a_lat_mps2=8.0)
    assert cycle.v_ref_mps[550] == pytest.approx(20.0, rel=1e-3)
    assert cycle.v_ref_mps[450] > 28.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r":1: empty file"),
        ("a,b\n1,2\n2,3\n", r":1: no time or distance column"),
        ("t_s,b\n1,2\n2,3\n", r":1: no speed column"),
        ("t_s,v_mps\n0,1\n1,fast\n", r":3: 'fast' in column 'v_mps' is not a finite number"),
        ("t_s,v_mps\n0,1\n1,nan\n", r":3: 'nan'"),
        ("t_s,v_mps\n0,1\n1\n", r":3: 1 cells but 2 columns"),
        ("t_s,v_mps\n0,1\n1,2\n1,3\n", r"does not rise at data row 3"),
        ("t_s,v_mps\n0,1\n", r"1 data lines"),
    ],
)
def test_csv_errors_say_file_line_and_remedy(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(CycleError, match=message) as error:
        read_csv_cycle(path, PARAMS)
    assert str(path) in str(error.value)
    assert ";" in str(error.value)


def test_csv_that_is_not_there_or_not_text(tmp_path):
    with pytest.raises(CycleError, match="check the path"):
        read_csv_cycle(tmp_path / "none.csv", PARAMS)
    (tmp_path / "latin.csv").write_bytes(b"t_s,v_mps\n0,\xff\n")
    with pytest.raises(CycleError, match="UTF-8"):
        read_csv_cycle(tmp_path / "latin.csv", PARAMS)


def test_impossible_cycles_are_refused():
    with pytest.raises(CycleError, match="unknown cycle kind 'wltp'"):
        build_cycle(CycleSpec("wltp"), PARAMS)
    with pytest.raises(CycleError, match="needs a file"):
        build_cycle(CycleSpec("csv"), PARAMS)
    with pytest.raises(CycleError, match="for ever"):
        Cycle("x", True, 1.0, np.array([0.0, 1.0]), np.zeros(2))
    with pytest.raises(CycleError, match="finite"):
        Cycle("x", False, 1.0, np.array([0.0, np.nan]), np.zeros(2))
    with pytest.raises(CycleError, match="negative"):
        Cycle("x", False, 1.0, np.array([0.0, -1.0]), np.zeros(2))
