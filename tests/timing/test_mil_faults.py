"""Faults, plant mismatch and key-on through the verb, in lock-step: what was asked for is what is on the bus."""

import json

import pytest

from plant_sim.faults import KINDS
from rt_runner.dbc import load_dbc
from rt_runner.log_reader import LogReader
from tests.support.runs import load_result, one_line, rt_runner

LAP = """
duration_s = {duration}
faults = [{faults}]
[cycle]
kind = "lap"
start_s = {start}
theta0_degc = {theta0}
key_on_s = {key_on}
[plant]
{plant}
"""


def scenario(folder, *faults, duration=20.0, start=425.0, theta0=60.0, key_on=0.0, plant=""):
    path = folder / "mine.toml"
    quoted = ", ".join(f'"{f}"' for f in faults)
    values = {"duration": duration, "start": start, "theta0": theta0, "key_on": key_on, "plant": plant}
    path.write_text(LAP.format(faults=quoted, **values))
    return path


def mil(folder, name, *args):
    log, result = folder / f"{name}.mcap", folder / f"{name}.json"
    done = rt_runner("mil", *args, "--log", log, "--json", result)
    assert done.returncode in (0, 2, 3), done.stdout + done.stderr
    return LogReader(log), load_result(result)


def by_tick(reader, name):
    return {int(f.values["tick"]): f.values for f in reader.frames() if f.name == name}


def test_an_offset_of_the_command_line_is_in_the_measurement_and_in_the_truth(tmp_path):
    path = scenario(tmp_path)
    good, _ = mil(tmp_path, "good", path)
    bad, result = mil(tmp_path, "bad", path, "--fault", "offset:-20@430-440")
    measured, plain = by_tick(bad, "TempMeas"), by_tick(good, "TempMeas")
    truth, faults = by_tick(bad, "TruthTemp"), by_tick(bad, "TruthFault")
    assert sorted(measured) == sorted(faults) == list(range(42510, 44501, 10))
    for tick, y in measured.items():
        inside = 43000 <= tick < 44000
        assert y["theta_w_meas_degc"] - plain[tick]["theta_w_meas_degc"] == -20.0 * inside
        assert y["theta_r_meas_degc"] == plain[tick]["theta_r_meas_degc"]
        assert (faults[tick]["fault_w"], faults[tick]["fault_r"]) == (inside, 0)
        if inside:
            assert y["theta_w_meas_degc"] - truth[tick]["theta_w_true_degc"] == pytest.approx(-21.0, abs=3.0)
    assert {m["fault_w"] for m in by_tick(good, "TruthFault").values()} == {0}
    assert result["faults"] == ["offset:-20@430-440"]
    assert bad.metadata["run"]["faults"] == "offset:-20@430-440"
    assert json.loads(bad.attachments["scenario_as_run.json"])["added_faults"] == ["offset:-20@430-440"]
    said = next(f.values["scenario_hash"] for f in bad.frames() if f.name == "PlantIdentity")
    assert int(said) == int(json.loads(bad.attachments["hashes.json"])["scenario_sha256"][:6], 16)
    assert said != next(f.values["scenario_hash"] for f in good.frames() if f.name == "PlantIdentity")
    inspected = rt_runner("inspect", tmp_path / "bad.mcap")
    assert inspected.returncode == 0, inspected.stderr
    assert "recomputed from the frames: the same result" in inspected.stdout


def test_the_estimator_notices_says_so_and_stays_right(tmp_path):
    path = scenario(tmp_path, "offset:-20@430-440", duration=30.0, start=415.0)
    reader, result = mil(tmp_path, "seen", path)
    s = result["sensors"]["theta_w"]
    assert (s["true_faults"], s["fault_start_s"]) == (["offset"], 430.0)
    assert s["detection_s"] <= 2.0
    assert 0.2 < s["class_share"]["offset"] < 0.7
    assert s["fault_max_error_degc"] <= 1.0
    assert result["sensors"]["theta_r"]["class_share"] == {"ok": 1.0}
    estimates, uppers = by_tick(reader, "Estimate"), by_tick(reader, "EstWinding")
    assert {v["sensor_w_trusted"] for t, v in uppers.items() if 43050 <= t < 43150} == {0.0}
    assert {v["sensor_w_trusted"] for t, v in uppers.items() if 42600 <= t < 43000} == {1.0}
    assert all(uppers[t]["upper_w_degc"] > estimates[t]["theta_w_est_degc"] for t in estimates if t > 42600)
    assert all(0 < v["sigma_w_degc"] < 2 for t, v in uppers.items() if t > 42600)


def test_key_on_finds_the_offset_that_the_datasheet_does_not_know(tmp_path):
    reader, result = mil(tmp_path, "key", "key-on", "--duration", 30)
    found = result["sensors"]["calibration"]
    assert found["state"] == "frozen"
    for c in "wr":
        assert found[f"offset_{c}_degc"] == pytest.approx(-1.5, abs=0.15)
        assert 0.005 < found[f"offset_sigma_{c}_degc"] < 0.2
    states = [int(f.values["calibration_state"]) for f in reader.frames() if f.name == "EstCalibration"]
    assert states == sorted(states), "measured once, then frozen"
    assert {1, 2} <= set(states)


def test_every_kind_of_a_scenario_file_is_on_the_bus_bit_by_bit(tmp_path):
    faults = ["offset:-20@426-427", "noise:5@427-428/r", "stuck@428-429", "dropout:nan@429-430/wr", "spike:50%@430-431",
              "drift:-1@431-432", "slow:5@432-433/r", "delay:2@433-434", "gain:-5%@434-435"]  # fmt: skip
    reader, result = mil(tmp_path, "all", scenario(tmp_path, *faults, duration=12.0))
    truth, measured = by_tick(reader, "TruthFault"), by_tick(reader, "TempMeas")
    for bit, (kind, text) in enumerate(zip(KINDS, faults, strict=True)):
        assert text.startswith(kind)
        inside = range(42600 + 100 * bit, 42700 + 100 * bit, 10)
        channels = text.partition("/")[2] or "w"
        for tick in inside:
            assert truth[tick]["fault_w"] == (1 << bit if "w" in channels else 0)
            assert truth[tick]["fault_r"] == (1 << bit if "r" in channels else 0)
    for tick, y in measured.items():
        assert (y["theta_w_meas_degc"] is None) == (y["theta_r_meas_degc"] is None) == (42900 <= tick < 43000)
    assert result["faults"] == faults


def test_key_on_is_a_standstill_that_says_soaked(tmp_path):
    path = scenario(tmp_path, "offset:3@1-2/r", duration=20.0, start=0.0, theta0=65.0, key_on=15.0)
    reader, _ = mil(tmp_path, "key", path)
    coolant, motor = by_tick(reader, "Coolant"), by_tick(reader, "MotorState")
    assert {t: v["soaked"] for t, v in coolant.items()} == {t: t <= 1500 for t in range(100, 2001, 100)}
    assert {(v["coolant_degc"], v["ambient_degc"]) for v in coolant.values()} == {(65.0, 25.0)}
    assert {(v["torque_nm"], v["speed_rpm"]) for t, v in motor.items() if t <= 1500} == {(0.0, 0.0)}
    assert max(v["speed_rpm"] for v in motor.values()) > 500
    assert sorted(motor) == list(range(1, 2001)), "ticks count through the standstill"
    faulty = [t for t, v in by_tick(reader, "TruthFault").items() if v["fault_r"]]
    assert faulty == list(range(100, 200, 10)), "and so does the faults' time"


def test_in_real_time_the_plant_says_the_same_bytes(tmp_path):
    """A standstill, then driving, two faults: every frame of the plant but its lateness is that of lock-step."""
    path = scenario(tmp_path, "spike:40%@1-4/wr", "offset:-20@2-3", duration=5.0, start=0.0, theta0=65.0, key_on=2.0)
    reader, _ = mil(tmp_path, "mil", path, "--seed", 7)
    log = tmp_path / "run.mcap"
    done = rt_runner("run", path, "--bus", "hub", "--no-rt", "--seed", 7, "--log", log)
    assert done.returncode in (0, 2, 3), done.stderr
    said = {m.frame_id for m in load_dbc() if m.sender == "PLANT" and m.name not in ("PlantStatus", "PlantSample")}

    def frames(log):
        return [(f.can_id, f.data) for f in log.raw() if f.can_id in said]

    expected = frames(reader)
    assert len(expected) > 500 + 50 * 4
    assert frames(LogReader(log)) == expected


def test_a_mismatched_plant_has_another_identity_and_coolant(tmp_path):
    def identity(reader):
        return next(f.values["params_hash"] for f in reader.frames() if f.name == "PlantIdentity")

    nominal, _ = mil(tmp_path, "nominal", scenario(tmp_path, duration=15.0, start=0.0, theta0=65.0))
    other, _ = mil(tmp_path, "other", scenario(tmp_path, duration=15.0, start=0.0, theta0=65.0,
                                                plant="coolant_degc = 50\ncoolant_flow_share = 0.5"))  # fmt: skip
    assert identity(nominal) != identity(other)
    assert {v["coolant_degc"] for v in by_tick(other, "Coolant").values()} == {50.0}
    start = by_tick(other, "TruthTemp")[10]
    assert start["theta_w_true_degc"] == pytest.approx(65.0, abs=0.5), "the nodes start where they are told to"


@pytest.mark.parametrize("verb", ["run", "mil"])
def test_a_fault_that_cannot_be_is_one_line_and_leaves_no_log(tmp_path, verb):
    log = tmp_path / "none.mcap"
    for fault, says in (("offset@410-420", "amplitude"), ("stuck@10-20", "outside the run")):
        done = rt_runner(verb, "hot-lap", "--fault", fault, "--log", log)
        assert done.returncode == 1
        assert says in one_line(done.stderr)
        assert f"fault '{fault}'" in done.stderr
        assert not log.exists()


def test_help_names_every_setting(tmp_path):
    for verb in ("run", "mil"):
        text = " ".join(rt_runner(verb, "--help").stdout.split())
        listed = text.partition("estimator setting: ")[2].partition(" --")[0].split(", ")
        assert {"default", "paper"} <= set(listed)
        for name in listed:
            done = rt_runner("mil", "hot-lap", "--duration", "0.2", "--setting", name, "--log", tmp_path / "s.mcap")
            assert "no setting is called" not in done.stderr
