"""The comparison's short way to an estimate gives what the processes give: bit for bit, as the bus carries it."""

import numpy as np
import pytest

from plant_sim.cycles import CycleSpec
from plant_sim.faults import parse_fault
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.publisher import Publisher
from rt_runner.codec import Decoder
from rt_runner.dbc import load_dbc
from rt_runner.log_reader import LogReader
from tests.support.runs import rt_runner
from tools.compare_drives import codes, drive_lap, sense
from tools.estimators.drive import run
from tools.estimators.registry import make

SCENARIO = """title = "twenty seconds of the lap"
duration_s = 20.0
faults = ["{fault}"]
[cycle]
kind = "lap"
start_s = 425.0
[estimator]
setting = "{setting}"
"""


@pytest.fixture(scope="module")
def lap():
    return drive_lap()


@pytest.mark.parametrize("fault", ["offset:-20@430-440", "dropout:nan@428-433/wr", "noise:5@427-445"])
@pytest.mark.parametrize("setting", ["default", "paper"])
def test_estimates_are_those_of_lock_step(tmp_path, lap, setting, fault):
    scenario = tmp_path / "stretch.toml"
    scenario.write_text(SCENARIO.format(fault=fault, setting=setting))
    log = tmp_path / "stretch.mcap"
    done = rt_runner("mil", scenario, "--seed", 5, "--log", log)
    assert done.returncode in (0, 2), done.stderr  # the limits are not what is tested
    carried = _decoded(log, ("TempMeas", "Estimate", "EstWinding", "EstRotor"))

    drive = sense(lap, 5, [parse_fault(fault)]).cut(4250, 4450)
    found = run(make(setting), drive)
    measured = carried["TempMeas"]
    assert len(measured) == len(drive)
    for column, name in enumerate(("theta_w_meas_degc", "theta_r_meas_degc")):
        np.testing.assert_array_equal(_column(measured, name), drive.y[:, column])

    published = carried["Estimate"]
    assert len(published) == len(drive)
    assert [int(v["tick"]) for v in published] == [(42500 + 10 * (k + 1)) % 65536 for k in range(len(drive))]
    np.testing.assert_array_equal(_column(published, "status"), found.status)
    signals = {s.name: s for m in load_dbc() for s in m.signals}
    for column, ch in enumerate("wr"):
        signal = signals[f"theta_{ch}_est_degc"]
        expected = codes(signal, found.theta_degc[:, column]) * signal.factor + signal.offset
        np.testing.assert_array_equal(_column(published, signal.name), expected)
        state = carried[("EstWinding", "EstRotor")[column]]
        np.testing.assert_array_equal(_column(state, f"sensor_{ch}_fault"), found.fault[:, column])
        for name, values in (("sigma", found.sigma_degc), ("upper", found.upper_degc)):
            signal = signals[f"{name}_{ch}_degc"]
            expected = codes(signal, values[:, column]) * signal.factor + signal.offset
            np.testing.assert_array_equal(_column(state, signal.name), expected)
    assert np.isfinite(found.theta_degc[-100:]).all()


def test_the_lap_is_the_plants_own(lap):
    """Inputs, truth and measurements of the arrays against the plant stepped live and its frames decoded."""
    seed, faults = 3, [parse_fault("offset:-20@1-2"), parse_fault("spike:50%@2-4"), parse_fault("dropout:nan@4-5/r")]
    drive = sense(lap, seed, faults)
    plant = Plant(load_params(), CycleSpec("lap"), seed=seed, faults=faults)
    publisher, decoder = Publisher(load_dbc(), "0" * 64, "0" * 64), Decoder(load_dbc())
    for k in range(60):
        for j in range(10):
            sample = plant.step()
            for message in publisher.frames(sample):
                decoded = decoder.decode(message.arbitration_id, bytes(message.data))
                assert decoded is not None
                if decoded.name == "MotorState":
                    assert decoded.values["torque_nm"] == drive.torque_nm[10 * k + j]
                    assert decoded.values["speed_rpm"] == drive.speed_rpm[10 * k + j]
                elif decoded.name == "TempMeas":
                    values = [decoded.values[f"theta_{ch}_meas_degc"] for ch in "wr"]
                    np.testing.assert_array_equal(np.array(values, dtype=float), drive.y[k])
                elif decoded.name == "Coolant":
                    assert drive.coolant_degc is not None
                    assert decoded.values["coolant_degc"] == drive.coolant_degc[k]
        assert (sample.theta_w_degc, sample.theta_r_degc) == tuple(lap.truth_degc[k])
    assert np.isnan(drive.y[40:49, 1]).all()


def _decoded(log, names):
    decoder, found = Decoder(load_dbc()), {name: [] for name in names}
    for frame in LogReader(log).raw():
        decoded = decoder.decode(frame.can_id, frame.data)
        if decoded is not None and decoded.name in found:
            found[decoded.name].append(decoded.values)
    return found


def _column(rows, name):
    return np.array([np.nan if row[name] is None else row[name] for row in rows])
