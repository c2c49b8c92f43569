"""A plant that obeys commands: within the envelope, the same in both engines, and handed back without a jump."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.cycles import CycleSpec, build_cycle
from plant_sim.driver import TorqueCommand
from plant_sim.errors import PlantStateError
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.state import ROW_SPEED, ROW_TORQUE, ROW_V
from plant_sim.vehicle import acceleration_mps2, motoring_limit_nm, regen_limit_nm

PARAMS = load_params()
LAP = build_cycle(CycleSpec("lap"), PARAMS)
PULL = TorqueCommand(120.0, 0.0, 0.0)
torques = st.floats(-600.0, 600.0)


def commands(seed: int, count: int) -> list[TorqueCommand]:
    rng = np.random.default_rng(seed)
    drawn = rng.normal(0.0, 150.0, (count, 3))
    return [TorqueCommand(max(a, 0.0), min(b, 0.0), min(c, 0.0) if k % 3 == 0 else 0.0)
            for k, (a, b, c) in enumerate(drawn.tolist())]  # fmt: skip


def test_both_engines_obey_alike():
    runs = []
    for engine in ("numba", "numpy"):
        plant = Plant(PARAMS, LAP, engine=engine)
        plant.drive(500)
        rows = [plant.drive(10, command=command)[0] for command in commands(1, 150)]
        rows.append(plant.drive(300)[0])  # the driver again, from the integrator that the commands left
        runs.append(np.concatenate(rows))
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9, rtol=1e-9)
    assert np.ptp(runs[0][:, ROW_TORQUE]) > 100.0


@settings(max_examples=60, deadline=None)
@given(st.builds(TorqueCommand, torques, torques, torques), st.integers(0, 40))
def test_no_command_leaves_the_envelope(command, seconds):
    plant = Plant(PARAMS, LAP)
    plant.advance(float(seconds))
    before = plant.step()
    rows, _ = plant.drive(100, command=command)
    speed, v = rows[:, ROW_SPEED], np.concatenate([[before.v_mps], rows[:-1, ROW_V]])
    drive = np.array([motoring_limit_nm(n, PARAMS.machine) for n in speed])
    regen = np.array([regen_limit_nm(n, w, PARAMS.machine) for n, w in zip(speed, v, strict=True)])
    assert np.all(rows[:, ROW_TORQUE] <= drive + 1e-9)
    assert np.all(rows[:, ROW_TORQUE] >= -regen - 1e-9)
    assert np.all(rows[:, ROW_V] >= 0.0)


def test_torque_and_friction_are_those_commanded():
    plant = Plant(PARAMS, LAP)
    plant.advance(30.0)
    rows, _ = plant.drive(100, command=TorqueCommand(30.0, 0.0, 0.0))
    assert rows[-1, ROW_TORQUE] == pytest.approx(30.0, abs=1e-6)  # the lag of 50 ms is over
    for friction, wanted in ((-100.0, -100.0), (-1000.0, PARAMS.driver.u_min_nm), (50.0, 0.0)):
        plant = Plant(PARAMS, LAP)
        plant.advance(30.0)
        before = plant.step()
        sample = plant.step(command=TorqueCommand(0.0, 0.0, friction))
        a = acceleration_mps2(before.v_mps, sample.torque_nm + wanted, sample.slope_rad, PARAMS.vehicle)
        assert sample.v_mps - before.v_mps == pytest.approx(0.01 * a, abs=1e-9)


def test_the_driver_takes_over_without_a_jump():
    plant = Plant(PARAMS, LAP)
    plant.advance(60.0)
    for _ in range(20):
        plant.step(command=TorqueCommand(40.0, 0.0, 0.0))
    held = plant.step(command=TorqueCommand(40.0, 0.0, 0.0))
    first = plant.step()
    error_nm = PARAMS.driver.kp_nm_per_mps * (held.v_ref_mps - held.v_mps)
    assert abs(40.0 - error_nm) < PARAMS.driver.integral_max_nm, "the scene must leave the integrator within its limit"
    assert first.torque_nm == pytest.approx(held.torque_nm, abs=3.0)


def test_drive_equals_stepping_and_gives_the_readings():
    stepped, driven = Plant(PARAMS, LAP, seed=4), Plant(PARAMS, LAP, seed=4)
    for command in [None, *commands(2, 20)]:
        samples = [stepped.step(command=command) for _ in range(10)]
        rows, readings = driven.drive(10, command=command)
        assert [s.torque_nm for s in samples] == rows[:, ROW_TORQUE].tolist()
        assert [(samples[-1].theta_w_meas_degc, samples[-1].theta_r_meas_degc)] == [tuple(r) for r in readings.tolist()]


def test_a_command_that_is_no_number_is_refused():
    plant = Plant(PARAMS, LAP)
    for bad in (math.nan, math.inf):
        with pytest.raises(PlantStateError, match="send no command"):
            plant.step(command=TorqueCommand(bad, 0.0, 0.0))


def test_at_key_on_the_car_stands_whatever_is_commanded():
    plant = Plant(PARAMS, LAP, key_on_s=0.5)
    for _ in range(50):
        assert plant.step(command=PULL).v_mps == 0.0
    assert [plant.step(command=PULL) for _ in range(20)][-1].v_mps > 0.1
