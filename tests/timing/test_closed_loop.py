"""The loop closed over CAN: in lock-step it is the comparison's drive, in real time it survives whoever dies."""

import itertools
import json
import os
import signal
import subprocess
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from plant_sim.driver import TorqueCommand
from plant_sim.faults import parse_fault
from plant_sim.preview import fingerprint24
from plant_sim.state import ROW_THETA_W
from rt_runner import paths
from rt_runner.codec import Decoder
from rt_runner.config import load_scenario
from rt_runner.controller import preview
from rt_runner.dbc import load_dbc
from rt_runner.log_reader import LogReader
from rt_runner.records import CONTROL_ID, END, RECORD, control, job, pack
from tests.support.runs import load_result, rt_runner, start_rt_runner
from tools.compare_control_run import drive

DBC = load_dbc()
HEARD = ("MotorState", "Estimate", "EstWinding", "VehicleState")
SAID = ("TorqueCommand", "CtlState", "CtlSolve")
NAMES = {m.frame_id: m.name for m in DBC}


class Log:
    """Frames of a log by message: (stamp, values, data)."""

    def __init__(self, path: Path) -> None:
        decoder, self.frames = Decoder(DBC), defaultdict(list)
        for frame in LogReader(path).raw():
            decoded = decoder.decode(frame.can_id, frame.data)
            assert decoded is not None
            self.frames[decoded.name].append((frame.t_ns, decoded.values, frame.data))

    def column(self, name: str, signal: str) -> list[float | None]:
        return [values[signal] for _, values, _ in self.frames[name]]


def torques(log: Log) -> np.ndarray:
    rows = []
    for _, v, _ in log.frames["TorqueCommand"]:
        acc, brk, fric = v["torque_acc_nm"], v["torque_brk_nm"], v["torque_fric_nm"]
        rows.append((np.nan,) * 3 if acc is None or brk is None or fric is None else TorqueCommand(acc, -brk, -fric))
    return np.array(rows)


@pytest.mark.parametrize("controller", ["none", "rule-150-155", "mpc-S"])
def test_lock_step_drives_as_the_comparison_does(tmp_path, controller):
    log, fault = tmp_path / "x.mcap", "offset:-20@6-9"
    done = rt_runner("mil", "lap-mpc", "--controller", controller, "--duration", 14, "--fault", fault, "--log", log)
    assert done.returncode in (0, 2, 3), done.stderr
    over_bus = Log(log)
    lap = drive(controller, "default", (parse_fault(fault),), seconds=14.0)
    np.testing.assert_array_equal(torques(over_bus), lap.commands)
    truth = np.array(over_bus.column("TruthTemp", "theta_w_true_degc"), dtype=float)
    np.testing.assert_allclose(truth, lap.rows[9::10, ROW_THETA_W], atol=0.5 / 512 + 1e-9)
    assert np.nanmax(lap.commands[:, 0]) > 100.0
    last = over_bus.frames["PlantControl"][-1][1]
    assert last["refused"] == np.isnan(lap.commands[:, 0]).sum()
    assert last["obeys"] == 1


def test_lock_step_is_the_same_every_time(tmp_path):
    said = []
    for k in range(2):
        log = tmp_path / f"{k}.mcap"
        rt_runner("mil", "lap-mpc", "--duration", 4, "--log", log)
        said.append([data for name in (*HEARD, *SAID) for _, _, data in Log(log).frames[name]])
    assert said[0] == said[1]
    assert len(said[0]) > 400


def test_without_a_controller_there_is_nothing_of_it_on_the_bus(tmp_path):
    log = tmp_path / "x.mcap"
    rt_runner("mil", "lap-mpc", "--controller", "off", "--duration", 2, "--log", log)
    frames = Log(log).frames
    assert not any(name.startswith("Ctl") for name in frames)
    assert not {"TorqueCommand", "VehicleState", "PlantControl"} & set(frames)
    assert {v["derating_active"] for _, v, _ in frames["MotorState"]} == {0}


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--controller", "mpc-X"), "'mpc-X' is none of off, none, rule-150-155"),
        (("class3", "--controller", "mpc-M"), "drive a lap"),
    ],
)
def test_impossible_loops_are_refused_in_one_line(tmp_path, args, says):
    scenario = () if args[0] == "class3" else ("lap",)
    done = rt_runner("mil", *scenario, *args, "--log", tmp_path / "x.mcap")
    assert done.returncode == 1
    assert says in done.stderr.strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


# ---- real time ------------------------------------------------------------------------------------------------


SCENE = """
title = "The hottest part of the lap in closed loop"
duration_s = 26.0
[cycle]
kind = "lap"
start_s = 425.0
theta0_degc = 60.0
[controller]
name = "mpc-S"
[limits]
theta_w_rmse_max_degc = 2.0
theta_r_rmse_max_degc = 2.0
"""


def pid_of(parent: int, needle: str) -> int | None:
    for p in Path("/proc").glob("[0-9]*"):
        try:
            if (
                int((p / "stat").read_text().rsplit(")", 1)[1].split()[1]) == parent
                and needle in (p / "cmdline").read_text()
            ):
                return int(p.name)
        except OSError:
            continue
    return None


def kill(parent: int, needle: str, deadline: float) -> int:
    while time.monotonic() < deadline:
        pid = pid_of(parent, needle)
        if pid is not None:
            os.kill(pid, signal.SIGKILL)
            return pid
        time.sleep(0.05)
    raise AssertionError(f"no {needle} to kill")


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A run whose controller dies after a third and whose estimator dies after two thirds."""
    folder = tmp_path_factory.mktemp("killed")
    scenario, log, result = folder / "hot.toml", folder / "hot.mcap", folder / "hot.json"
    scenario.write_text(SCENE)
    process = start_rt_runner("run", scenario, "--bus", "hub", "--log", log, "--json", result)
    deadline = time.monotonic() + 120
    while pid_of(process.pid, "rt_controller") is None:
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.1)
    time.sleep(8.0)
    kill(process.pid, "rt_controller", deadline)
    time.sleep(8.0)
    kill(process.pid, "rt_estimator", deadline)
    _, words = process.communicate(timeout=120)
    return Log(log), load_result(result), words, process.returncode


def test_the_winding_stays_below_160_whoever_dies(killed):
    log, _, _, _ = killed
    truth = log.column("TruthTemp", "theta_w_true_degc")
    assert len(truth) > 250
    assert max(truth) < 160.0
    assert max(truth) > 145.0, "the scene is hot"


def test_whoever_dies_is_started_again_and_the_log_shows_it(killed):
    log, result, words, status = killed
    assert status == 1, words  # as for every process that died
    findings = [f["evidence"] for f in result["findings"] if f["what"] == "run"]
    assert len(findings) == 2
    for name, says in zip(("controller", "estimator"), findings, strict=True):
        assert f"the {name} was killed by SIGKILL" in says
        assert f"warning: the {name} was killed" in words
    for identity in ("CtlBuild", "EstBuild"):  # sent with a process's first job
        stamps = [t for t, _, _ in log.frames[identity]]
        assert any((b - a) % 10_000_000_000 > 50_000_000 for a, b in itertools.pairwise(stamps)), identity
    obeyed = log.column("PlantControl", "obeys")
    fallback = log.column("PlantControl", "fallback_ticks")
    assert obeyed[-1] == 1, "in the end the plant obeys again"
    assert fallback[-1] > fallback[4] > 0, "between the lives of the controller it drove by its rule"


def test_plant_obeys_until_two_periods_after_the_last_command(killed):
    """What the log says of the gap: the command holds for 0.2 s, then the driver is back."""
    log, _, _, _ = killed
    stamps = [t for t, _, _ in log.frames["TorqueCommand"]]
    gap = max(itertools.pairwise(stamps), key=lambda pair: pair[1] - pair[0])
    assert gap[1] - gap[0] > 200_000_000
    first = next(v for t, v, _ in log.frames["PlantControl"] if t > gap[0])
    assert first["commands"] > 0


def replayed(log: Log, shift_ns: int) -> list[bytes]:
    """What rt_controller --replay says to a log's inputs, its jobs beginning where the log's ages put them."""
    starts = []
    motors = log.frames["MotorState"]
    for (t_ns, *_), (_, a, _), (_, b, _), (_, c, _) in zip(
        *(log.frames[name] for name in ("TorqueCommand", "CtlTimingA", "CtlTimingB", "CtlTimingC")), strict=False
    ):
        about = t_ns - round(1e3 * (b["resp_us"] - a["wake_lat_us"]))
        if c["in_age_motor_us"] is not None:  # the newest MotorState it had read says where on the log's clock it began
            age = round(1e3 * c["in_age_motor_us"])
            nearest = min((m[0] for m in motors), key=lambda stamp: abs(stamp + age - about))
            about = nearest + age
        starts.append((about + shift_ns, int(a["release_index"])))
    origin = starts[0][0]
    events = [(t, 0, pack(t - origin, can_id, data)) for can_id, t, data in inputs(log)]
    events += [(t, 1, job(t - origin, index)) for t, index in starts]
    records = b"".join(e[2] for e in sorted(events, key=lambda e: e[:2])) + control(0, END)
    with preview(load_scenario("lap-mpc")) as road:
        command = [str(paths.binary("rt_controller")), "--replay", "--preview", str(road), "--controller", "mpc-S"]
        done = subprocess.run(command, input=records, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    answers = [(can_id, data[:n]) for _, can_id, n, data in RECORD.iter_unpack(done.stdout) if can_id != CONTROL_ID]
    return [data for can_id, data in answers if NAMES[can_id] in SAID]


def inputs(log: Log):
    for name in HEARD:
        for t_ns, _, data in log.frames[name]:
            yield DBC[name].frame_id, t_ns, data


def speaks_for_itself(path: Path) -> None:
    """The log has the controller's road and its last line, and the latter holds every value of its frames."""
    reader, log = LogReader(path), Log(path)
    road = reader.attachments["preview.txt"]
    assert log.column("CtlBuild", "preview_hash")[-1] == fingerprint24(road)
    final = json.loads(reader.attachments["controller_final.json"])
    jobs = log.column("CtlTimingA", "warmup")
    for window, count in (("warmup", sum(map(bool, jobs))), ("judged", len(jobs) - sum(map(bool, jobs)))):
        told = final["histograms"][window]["resp_us"]
        assert told["count"] == count > 0
        assert told["underflow"] + told["overflow"] + sum(n for _, _, n in told["buckets"]) == count
    counted = json.loads(reader.metadata["result"]["json"])["timing"]["controller"]
    assert (counted["jobs"], counted["releases"]) == (final["jobs"], final["releases"])
    machine = log.frames["CtlMachine"][-1][1]
    assert machine["run_delay_ms"] is not None, "the kernel is asked for the controller, too"
    if len(os.sched_getaffinity(0)) > 1:  # on the estimator's core there is no canary
        assert log.column("CtlCanary", "canary_max_us")[-1] is not None
        assert any(v is not None for v in log.column("CtlTimingD", "canary_us"))


def test_the_same_frames_give_the_same_commands_bit_for_bit(tmp_path):
    scenario, path = tmp_path / "hot.toml", tmp_path / "live.mcap"
    scenario.write_text(SCENE.replace("26.0", "8.0"))
    done = rt_runner("run", scenario, "--bus", "hub", "--log", path)
    assert done.returncode in (0, 2, 3), done.stderr
    speaks_for_itself(path)
    log = Log(path)
    count = min(len(log.frames[name]) for name in ("TorqueCommand", "CtlTimingC"))
    in_order = sorted((t, data) for name in SAID for t, _, data in log.frames[name][:count])
    live = [data for _, data in in_order]
    assert count > 60
    assert {v["origin"] for _, v, _ in log.frames["TorqueCommand"]} >= {1}, "the MPC drove"
    readings = []
    for shift_ns in (0, 100_000, -100_000, 300_000, -300_000):  # a frame that came while a job began is read or not
        again = replayed(log, shift_ns)[: len(live)]
        readings.append(sum(a != b for a, b in zip(live, again, strict=True)))
        if readings[-1] == 0:
            return
    pytest.fail(f"frames that differ, by reading: {readings}")


# ---- the process alone ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((), "give either --bus"),
        (("--lockstep",), "--preview FILE is needed"),
        (("--lockstep", "--preview", "/nonexistent"), "No such file"),
        (("--lockstep", "--preview", "{bad}"), "line 4 is not that of a preview"),
        (("--lockstep", "--preview", "{good}", "--controller", "x"), "none is called 'x'"),
        (("--lockstep", "--preview", "{good}", "--period-us", "33000"), "'33000' is no period"),
    ],
)
def test_the_process_refuses_in_one_line(tmp_path, args, says):
    good, bad = tmp_path / "good", tmp_path / "bad"
    good.write_text("rt-preview 1\n1.0 3 2.0\n10.0 0.0\n11.0 0.01\n12.0 0.0\n")
    bad.write_text("rt-preview 1\n1.0 3 2.0\n10.0 0.0\n11.0 nan\n12.0 0.0\n")
    words = [a.format(good=good, bad=bad) for a in args]
    command = [paths.binary("rt_controller"), *words]
    done = subprocess.run(command, capture_output=True, text=True, input="", check=False)
    assert done.returncode == 1
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1
    assert says in lines[0]


def test_the_road_it_loaded_is_the_one_that_was_written(tmp_path):
    road = tmp_path / "road"
    road.write_text("rt-preview 1\n1.0 3 2.0\n10.0 0.0\n11.0 0.01\n12.0 0.0\n")
    command = [paths.binary("rt_controller"), "--lockstep", "--preview", road, "--controller", "none"]
    done = subprocess.run(command, capture_output=True, input=control(0, END), check=False)
    ready = json.loads(done.stderr.splitlines()[0])
    assert ready["preview_hash"] == f"{fingerprint24(road.read_bytes()):06x}"
    final = json.loads(done.stderr.splitlines()[-1])
    assert final["releases"] == final["jobs"] + final["miss_skipped"]
    assert set(final["histograms"]) == {"warmup", "judged"}

