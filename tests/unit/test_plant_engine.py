"""The plant as an object: compiled step against the readable one, advance against stepping, what never happens."""

import copy
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.cycles import Cycle, CycleSpec, GradeServo, build_cycle
from plant_sim.errors import PlantStateError
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.sensors import TemperatureSensor
from plant_sim.simulate import simulate
from plant_sim.state import ROW_SPEED, ROW_THETA_W, ROW_TORQUE, ROW_V, ROW_X
from plant_sim.vehicle import motor_speed_rpm, motoring_limit_nm, regen_limit_nm

PARAMS = load_params()
LAP = build_cycle(CycleSpec("lap"), PARAMS)
STEP_LIMIT_US = 20.0


def servo_cycle() -> Cycle:
    t = np.arange(91.0)
    servo = GradeServo(np.full(91, 155.0), 0.02 * np.sin(t))
    return Cycle("servo", False, 1.0, 15.0 + 10.0 * np.sin(t / 9.0), np.zeros(91), servo)


@pytest.mark.parametrize(
    ("cycle", "derate", "rule"),
    [
        (LAP, 1.0, (0.0, 0.0)),
        (LAP, 0.6, (50.0, 80.0)),
        (servo_cycle(), 1.0, (0.0, 0.0)),
        (CycleSpec("class3"), 1.0, (0.0, 0.0)),
    ],
    ids=["lap", "derated", "servo", "class3"],
)
def test_compiled_step_equals_the_reference(cycle, derate, rule):
    runs = []
    for engine in ("numba", "numpy"):
        plant = Plant(PARAMS, cycle, theta0_degc=60.0, engine=engine)
        runs.append((plant.record(7000, derate, rule), plant.theta_degc))
    (fast, theta_fast), (slow, theta_slow) = runs
    assert fast.shape == slow.shape == (7000, 8)
    np.testing.assert_allclose(fast[:, ROW_THETA_W:], slow[:, ROW_THETA_W:], atol=1e-9, rtol=0.0)
    np.testing.assert_allclose(fast, slow, atol=1e-9, rtol=1e-9)
    np.testing.assert_allclose(theta_fast, theta_slow, atol=1e-9, rtol=0.0)
    assert np.ptp(fast[:, ROW_THETA_W]) > 0.5


@pytest.mark.parametrize("seconds", [0.0, 7.3, 40.07])
def test_advance_leaves_the_state_that_stepping_leaves(seconds):
    jumped, walked = (Plant(PARAMS, LAP, seed=5) for _ in range(2))
    jumped.advance(seconds)
    for _ in range(round(seconds * 100)):
        walked.step()
    assert jumped.tick == walked.tick == round(seconds * 100)
    for _ in range(250):
        assert jumped.step(0.9) == walked.step(0.9)


def test_samples_tell_what_they_say():
    plant = Plant(PARAMS, LAP, seed=1)
    plant.advance(400.0)
    sample, before = plant.step(), None
    assert sample.tick == 40001
    assert sample.t_s == pytest.approx(400.01)
    for _ in range(60):
        before, sample = sample, plant.step()
        assert sample.tick == before.tick + 1
        # Speed is that at the start of the step which ended here; position moved with it.
        assert sample.speed_rpm == pytest.approx(motor_speed_rpm(before.v_mps, PARAMS.vehicle), rel=1e-12)
        assert sample.x_m == pytest.approx(before.x_m + 0.01 * before.v_mps, abs=1e-9)
        assert (sample.theta_w_meas_degc is not None) == (sample.tick % 10 == 0)
        assert (sample.theta_r_meas_degc is None) == (sample.theta_w_meas_degc is None)
    assert plant.hot_spot_degc > sample.theta_w_degc


def test_seed_decides_the_noise_and_nothing_else():
    def run(seed):
        plant = Plant(PARAMS, LAP, seed=seed)
        return [plant.step() for _ in range(100)]

    one, same, other = run(1), run(1), run(2)
    assert one == same
    assert [s.theta_w_degc for s in one] == [s.theta_w_degc for s in other]
    assert one[9].theta_w_meas_degc != other[9].theta_w_meas_degc


def test_copies_are_independent():
    plant = Plant(PARAMS, LAP)
    plant.advance(3.0)
    twin = copy.deepcopy(plant)
    expected = [plant.step() for _ in range(20)]
    assert [twin.step() for _ in range(20)] == expected


def test_sensor_statistics():
    sensor = TemperatureSensor(PARAMS.sensor, np.array([60.0, 60.0]), np.random.default_rng(3))
    error = sensor.sample(np.full((40_000, 2), 60.0)) - 60.0
    np.testing.assert_allclose(error.mean(axis=0), -1.0, atol=0.01)
    np.testing.assert_allclose(error.var(axis=0), 0.1, atol=0.004)
    assert abs(np.corrcoef(error.T)[0, 1]) < 0.02


def test_sensor_delays_by_fifteen_samples_however_it_is_fed():
    quiet = PARAMS.varied(sensor__mean_k=0.0, sensor__variance_k2=0.0).sensor
    truth = np.cumsum(np.ones((100, 2)), axis=0)
    whole = TemperatureSensor(quiet, np.zeros(2), np.random.default_rng(0)).sample(truth)
    parts = TemperatureSensor(quiet, np.zeros(2), np.random.default_rng(0))
    pieces = np.concatenate([parts.sample(p) for p in np.split(truth, [1, 7, 8, 40])])
    np.testing.assert_array_equal(whole, pieces)
    np.testing.assert_array_equal(whole[:15], 0.0)
    np.testing.assert_array_equal(whole[15:], truth[:-15])


@settings(max_examples=40, deadline=None)
@given(
    speeds=st.lists(st.floats(0.0, 36.0), min_size=4, max_size=12),
    grade=st.floats(-0.15, 0.2),
    derate=st.floats(0.0, 1.0),
    theta0=st.floats(-20.0, 170.0),
)
def test_envelope_holds_and_the_car_never_rolls_back(speeds, grade, derate, theta0):
    n = len(speeds)
    cycle = Cycle("random", False, 3.0, np.array(speeds), np.full(n, np.arctan(grade)))
    rows = Plant(PARAMS, cycle, theta0_degc=theta0).record(300 * (n - 1), derate)
    assert np.isfinite(rows).all()
    assert (rows[:, ROW_V] >= 0.0).all()
    assert (np.diff(rows[:, ROW_X]) >= 0.0).all()
    held = np.concatenate([[0.0], rows[:-1, ROW_V]])
    for torque, speed, v in zip(rows[::7, ROW_TORQUE], rows[::7, ROW_SPEED], held[::7], strict=True):
        assert torque <= motoring_limit_nm(speed, PARAMS.machine) + 1e-9
        assert torque >= -regen_limit_nm(speed, v, PARAMS.machine) - 1e-9
        assert torque * speed * np.pi / 30.0 <= 60e3 + 1e-6


def test_full_derating_takes_all_torque():
    plant = Plant(PARAMS, LAP)
    plant.advance(30.0)
    for _ in range(100):
        sample = plant.step(derate=0.0)
    assert abs(sample.torque_nm) < 160.0 * np.exp(-20.0) + 1e-6


def test_acceleration_of_the_class():
    """0-60 km/h in 4.2 s and 0-100 km/h in 9.7 s on the flat."""
    cycle = Cycle("sprint", False, 1.0, np.full(16, 36.0), np.zeros(16))
    v = Plant(PARAMS, cycle).record(1500)[:, ROW_V] * 3.6
    assert np.argmax(v > 60.0) * 0.01 == pytest.approx(4.2, abs=0.15)
    assert np.argmax(v > 100.0) * 0.01 == pytest.approx(9.7, abs=0.2)


def test_boundaries_may_change_in_time():
    cold, warm = Plant(PARAMS, LAP), Plant(PARAMS, LAP)
    cold.set_boundary(40.0, -10.0, 70.0)
    cold.advance(60.0)
    warm.advance(60.0)
    assert cold.theta_degc.mean() < warm.theta_degc.mean() - 2.0


def test_simulate_decimates_to_interval_means_and_forward_differences():
    fine, coarse = (simulate(PARAMS, LAP, 20.0, rate_hz=rate) for rate in (100, 10))
    assert coarse.t_s.size == 200
    np.testing.assert_allclose(coarse.n_rpm, fine.n_rpm.reshape(-1, 10).mean(axis=1))
    np.testing.assert_allclose(coarse.torque_nm, fine.torque_nm.reshape(-1, 10).mean(axis=1))
    np.testing.assert_array_equal(coarse.theta_w_degc, fine.theta_w_degc[::10])
    np.testing.assert_allclose(
        coarse.theta_w_degc[:-1] + 0.1 * coarse.dtheta_w_degc_s[:-1], coarse.theta_w_degc[1:], atol=1e-10
    )
    assert coarse.theta_w_degc[0] == 60.0


def test_misuse_is_refused():
    plant = Plant(PARAMS, LAP)
    with pytest.raises(PlantStateError, match=r"outside 0\.\.1"):
        plant.step(derate=1.2)
    with pytest.raises(PlantStateError, match="multiple of"):
        plant.advance(0.0123)
    with pytest.raises(PlantStateError, match="numba"):
        Plant(PARAMS, LAP, engine="fortran")
    with pytest.raises(PlantStateError, match="10 or 100"):
        simulate(PARAMS, LAP, 1.0, rate_hz=50)
    assert plant.tick == 0


def test_step_time(capsys):
    """CPU time, best of several runs, because other work may share the core; the mean is printed."""
    plant = Plant(PARAMS, LAP)
    plant.record(10)
    times = []
    for _ in range(20):
        start = time.thread_time()
        plant.record(2000, stop=False)
        times.append((time.thread_time() - start) / 2000 * 1e6)
    with capsys.disabled():
        print(f"\nplant step in bulk: best {min(times):.1f} us, mean {np.mean(times):.1f} us of CPU time")
    assert min(times) <= STEP_LIMIT_US
