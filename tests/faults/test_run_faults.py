"""Each fault has one expected reaction: one clear line, a non-zero exit status, and a log that can be read."""

import fcntl
import itertools
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest

from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.hub_bus import HubBus
from rt_runner.log_reader import LogReader
from rt_runner.mcap_log import read_log, summarise
from tests.support.runs import load_result, one_line, rt_runner, start_rt_runner

RUN = ("run", "hot-lap", "--bus", "hub")
LATE_NS = 50e6  # what a busy machine may add to a job, or take from a frame


class LiveRun:
    """A run in progress: its lines as they come, its processes by name."""

    def __init__(self, log: Path, seconds: float, *more: str, env: dict | None = None) -> None:
        self.log, self.json = log, log.with_suffix(".json")
        self.process = start_rt_runner(*RUN, "--duration", seconds, "--log", log, "--json", self.json, *more, env=env)
        self.lines: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    def hub_path(self, timeout_s: float = 60) -> str:
        """The socket a stranger would attach to, as the run prints it."""
        return self._wait(
            lambda: next((x.split("-c ")[1].split()[0] for x in self.lines if "-i rt_hub -c " in x), None), timeout_s
        )

    def pid(self, needle: str, timeout_s: float = 60) -> int:
        """Process of this run whose command line contains ``needle``."""

        def find():
            for p in Path("/proc").glob("[0-9]*"):
                try:
                    parent = int((p / "stat").read_text().rsplit(")", 1)[1].split()[1])
                    if parent == self.process.pid and needle in (p / "cmdline").read_text():
                        return int(p.name)
                except OSError:
                    continue
            return None

        return self._wait(find, timeout_s)

    def wait_for_estimates(self) -> None:
        """Until the estimator has published temperatures."""
        with HubBus(self.hub_path()) as bus:
            deadline = time.monotonic() + 90
            while time.monotonic() < deadline:
                m = bus.recv(1.0)
                if m is not None and m.arbitration_id == DBC["Estimate"].frame_id and m.data[2:4] != b"\xff\xff":
                    return
        pytest.fail("no estimate came: " + "\n".join(self.lines))

    def end(self, timeout_s: float = 60) -> tuple[int, str]:
        self.process.wait(timeout_s)
        time.sleep(0.1)
        return self.process.returncode, "\n".join(self.lines)

    @staticmethod
    def _wait(look, timeout_s):
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            found = look()
            if found:
                return found
            time.sleep(0.02)
        pytest.fail("waited in vain")


DBC = load_dbc()


@pytest.fixture
def live(tmp_path):
    runs = []

    def start(seconds, *more, log=None, env=None):
        runs.append(LiveRun(log or tmp_path / "run.mcap", seconds, *more, env=env))
        return runs[-1]

    yield start
    for run in runs:
        if run.process.poll() is None:
            run.process.send_signal(signal.SIGTERM)
            run.process.wait(30)


# ---- refused before anything starts -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("run", "no-such-scenario"), "unknown scenario 'no-such-scenario'"),
        (("mil", "no-such-scenario"), "unknown scenario 'no-such-scenario'"),
        (("run", "hot-lap", "--bus", "can7"), "bus can7: can7 does not exist"),
        (("run", "hot-lap", "--duration", "0"), "must be 0.01 s or more"),
        (("run", "hot-lap", "--period", "0.0001"), "must be 0.001"),
        (("run", "hot-lap", "--seed", "-1"), "must be 0 or more"),
        (("inspect", "no-such.mcap"), "no-such.mcap"),
        (("report", "no-such.mcap", "-o", "x.html"), "no-such.mcap"),
    ],
)
def test_refused_in_one_line(args, says, tmp_path):
    done = rt_runner(*args, *(("--log", tmp_path / "x.mcap") if args[0] in ("run", "mil") else ()))
    assert done.returncode == 1
    assert says in one_line(done.stderr)
    assert not list(tmp_path.iterdir()), "something was half-written"


def test_a_terminal_without_our_letters(tmp_path):
    log = tmp_path / "x.mcap"
    assert rt_runner("mil", "hot-lap", "--duration", 1, "--log", log, env={"PYTHONIOENCODING": "ascii"}).returncode == 3
    done = rt_runner("inspect", log, env={"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr


def test_a_result_that_its_frames_do_not_give(tmp_path):
    log = tmp_path / "x.mcap"
    rt_runner("mil", "hot-lap", "--duration", 12, "--log", log)
    honest = rt_runner("inspect", log)
    assert honest.returncode == 0, honest.stderr
    assert "recomputed from the frames: the same result" in honest.stdout
    raw = log.read_bytes()
    place = raw.index(b'"est_max_degc": 0.') + len(b'"est_max_degc": 0.')
    log.write_bytes(raw[:place] + (b"9" if raw[place : place + 1] != b"9" else b"8") + raw[place + 1 :])
    forged = rt_runner("inspect", log)
    assert forged.returncode == 1
    assert "accuracy.theta_w.est_max_degc" in one_line(forged.stderr)


@pytest.mark.parametrize("args", [("run", "--duration", "soon"), ("fly",), ()])
def test_usage_errors_exit_with_1(args):
    done = rt_runner(*args)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("verb", ["run", "mil"])
def test_unknown_setting_is_refused(verb, tmp_path):
    done = rt_runner(verb, "hot-lap", "--duration", 1, "--setting", "guess", "--log", tmp_path / "x.mcap")
    assert done.returncode == 1
    assert "guess" in one_line(done.stderr)
    assert not list(tmp_path.iterdir())


def test_a_core_that_is_not_ours(tmp_path):
    done = rt_runner(*RUN, "--core", 4096, "--log", tmp_path / "x.mcap")
    assert done.returncode == 1
    assert "--core 4096" in one_line(done.stderr)


@pytest.mark.skipif(os.geteuid() != 0, reason="making a device needs root")
def test_a_device_is_written_to_and_never_replaced(tmp_path):
    null = tmp_path / "null"
    os.mknod(null, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    done = rt_runner("mil", "hot-lap", "--duration", 1, "--log", tmp_path / "x.mcap", "--json", null)
    assert done.returncode == 3, done.stderr
    assert stat.S_ISCHR(null.stat().st_mode)
    done = rt_runner("mil", "hot-lap", "--duration", 1, "--log", null)
    assert done.returncode == 1
    assert "no ordinary file" in one_line(done.stderr)
    assert stat.S_ISCHR(null.stat().st_mode)


def test_a_pipe_is_no_place_for_a_log(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    done = rt_runner("mil", "hot-lap", "--duration", 1, "--log", tmp_path / "pipe", timeout_s=30)
    assert done.returncode == 1
    assert "no ordinary file" in one_line(done.stderr)


@pytest.mark.parametrize("path", ["", ".", "/", "no-such-folder/x.json", "n" * 300])
def test_json_paths_that_cannot_be(path, tmp_path):
    done = rt_runner("mil", "hot-lap", "--duration", 1, "--log", tmp_path / "x.mcap", "--json", path)
    assert done.returncode == 1
    one_line(done.stderr.splitlines()[-1])
    assert "Traceback" not in done.stderr


def test_log_and_json_must_be_two_files(tmp_path):
    done = rt_runner("mil", "--duration", 1, "--log", tmp_path / "x", "--json", tmp_path / "x")
    assert done.returncode == 1
    assert "same file" in one_line(done.stderr)


@pytest.mark.parametrize("name", ["n" * 300, "n" * 300 + ".toml"])
def test_names_nobody_can_have(name):
    done = rt_runner("mil", name)
    assert done.returncode == 1
    one_line(done.stderr)


def test_the_working_folder_cannot_stand_in_for_our_modules(tmp_path):
    (tmp_path / "plant_sim.py").write_text("raise SystemExit('not the plant')")
    done = subprocess.run(
        [Path(sys.executable).with_name("rt-runner"), "mil", "hot-lap", "--duration", "1", "--log", "x.mcap"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr  # too short to judge, but it ran


def test_a_log_path_that_is_a_folder(tmp_path):
    done = rt_runner(*RUN, "--log", tmp_path)
    assert done.returncode == 1
    assert str(tmp_path) in one_line(done.stderr.splitlines()[-1])


def test_a_log_path_whose_folder_cannot_be_made(tmp_path):
    (tmp_path / "no").write_text("a file")
    done = rt_runner(*RUN, "--log", tmp_path / "no" / "x.mcap")
    assert done.returncode == 1
    assert "x.mcap" in one_line(done.stderr.splitlines()[-1])


def test_a_busy_log_is_left_alone(tmp_path):
    log = tmp_path / "busy.mcap"
    log.write_bytes(b"somebody is writing here")
    with log.open("rb") as f:
        fcntl.flock(f, fcntl.LOCK_EX)
        done = rt_runner(*RUN, "--duration", 2, "--log", log)
    assert done.returncode == 1
    assert "busy.mcap" in done.stderr
    assert log.read_bytes() == b"somebody is writing here"


def test_an_existing_log_is_kept_under_another_name(tmp_path):
    log = tmp_path / "x.mcap"
    log.write_bytes(b"an earlier run")
    done = rt_runner("mil", "hot-lap", "--duration", 1, "--log", log)
    assert done.returncode in (0, 2, 3), done.stderr
    assert summarise(log).complete
    assert [p.read_bytes() for p in tmp_path.glob("x*.mcap") if p != log] == [b"an earlier run"]


def test_a_dbc_that_does_not_parse(tmp_path):
    bad = tmp_path / "bad.dbc"
    bad.write_text('VERSION ""\nBO_ 1 Broken: 8\n')
    done = rt_runner(*RUN, "--log", tmp_path / "x.mcap", env={"RT_DBC": str(bad)})
    assert done.returncode == 1
    assert "bad.dbc" in one_line(done.stderr.splitlines()[-1])


# ---- while it runs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("needle", "name"), [("plant_sim", "plant"), ("rt_estimator", "estimator")])
def test_a_process_killed_while_running(live, needle, name):
    run = live(60)
    run.wait_for_estimates()
    os.kill(run.pid(needle), signal.SIGKILL)
    status, text = run.end()
    assert status == 1
    assert f"the {name} was killed by SIGKILL" in text + run.process.stdout.read()
    summary = summarise(run.log)
    assert summary.complete
    assert summary.result["verdict"] == "fail"
    assert any(name == "Estimate" for _, name, _, _ in read_log(run.log))


@pytest.mark.parametrize(("needle", "name"), [("rt_runner.logger", "logger"), ("rt_hub", "hub")])
def test_losing_the_logger_or_the_hub(live, needle, name):
    run = live(60)
    run.wait_for_estimates()
    os.kill(run.pid(needle), signal.SIGKILL)
    status, text = run.end()
    assert status == 1
    assert f"the {name} was killed by SIGKILL" in text, text
    assert "Traceback" not in text
    assert sum(1 for _ in read_log(run.log)) > 10, "the log is not readable"


@pytest.mark.parametrize("sig", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_cleanly(live, sig):
    run = live(60)
    run.wait_for_estimates()
    run.process.send_signal(sig)
    status, text = run.end()
    assert status == 3, text
    assert "Traceback" not in text
    assert summarise(run.log).complete
    assert load_result(run.json)["verdict"] == "inconclusive"


@pytest.mark.parametrize("after_s", [0.6, 0.9, 1.2, 1.8, 3.0])
def test_ctrl_c_at_any_time_leaves_a_readable_log_or_nothing_started(live, after_s):
    run = live(60)
    time.sleep(after_s)
    run.process.send_signal(signal.SIGINT)
    status, text = run.end()
    assert "Traceback" not in text
    if run.log.exists():
        assert status == 3, text
        assert summarise(run.log).complete
    else:
        assert status in (3, 130), text
    assert not [p for p in Path("/proc").glob("[0-9]*/stat") if _parent(p) == run.process.pid]


def _parent(stat_file: Path) -> int:
    try:
        return int(stat_file.read_text().rsplit(")", 1)[1].split()[1])
    except OSError:
        return -1


@pytest.mark.parametrize("sig", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_lock_step_ends_cleanly_too(tmp_path, sig):
    log = tmp_path / "x.mcap"
    run = start_rt_runner("mil", "lap", "--log", log)
    deadline = time.monotonic() + 60
    while not (log.exists() and log.stat().st_size > 200_000) and time.monotonic() < deadline:
        time.sleep(0.02)
    run.send_signal(sig)
    out, err = run.communicate(timeout=60)
    assert run.returncode == 3, out + err
    assert "Traceback" not in err
    assert summarise(log).complete
    assert "stopped by hand" in out


def test_lock_step_killed_takes_its_children_along(tmp_path):
    run = start_rt_runner("mil", "lap", "--log", tmp_path / "x.mcap")
    children: list[int] = []
    deadline = time.monotonic() + 60
    while len(children) < 2 and time.monotonic() < deadline:
        children = [int(p.parent.name) for p in Path("/proc").glob("[0-9]*/stat") if _parent(p) == run.pid]
        time.sleep(0.01)
    run.kill()
    run.communicate()
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{p}").exists() for p in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(children) == 2
    assert not [p for p in children if Path(f"/proc/{p}").exists()]


def test_a_neighbouring_file_is_left_alone(tmp_path):
    mine = tmp_path / "x.config.json"
    mine.write_text("mine")
    assert rt_runner(*RUN, "--duration", 2, "--log", tmp_path / "x.mcap").returncode == 3
    assert mine.read_text() == "mine"


def test_a_killed_supervisor_takes_its_children_along_and_leaves_a_finished_log(live):
    run = live(60)
    run.wait_for_estimates()
    pids = [run.pid(n) for n in ("plant_sim", "rt_estimator", "rt_runner.logger", "rt_hub")]
    run.process.kill()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(Path(f"/proc/{p}").exists() for p in pids):
        time.sleep(0.1)
    assert not [p for p in pids if Path(f"/proc/{p}").exists()]
    summary = summarise(run.log)
    assert summary.complete
    assert summary.result is not None
    assert summary.result["verdict"] == "fail"
    assert summary.result["scenario"] == "hot-lap"


def test_a_plant_that_is_held_up_is_stale_within_a_timeout_and_recovers(live):
    """SIGSTOP, half a second, SIGCONT: judged from the log, where every job says whether its input was stale."""
    run = live(6)
    run.wait_for_estimates()
    plant = run.pid("plant_sim")
    time.sleep(0.5)
    os.kill(plant, signal.SIGSTOP)
    time.sleep(0.6)
    os.kill(plant, signal.SIGCONT)
    run.end()
    frames = [(f.t_ns, f.name, f.values) for f in LogReader(run.log).frames()]
    motor = [t for t, name, _ in frames if name == "MotorState"]
    jobs = [(t, bool(v["stale_input"])) for t, name, v in frames if name == "EstTimingA"]
    silence_ns, stopped = max((b - a, a) for a, b in itertools.pairwise(motor))
    assert silence_ns > 500e6
    timeout_ns, period_ns = DBC["MotorState"].timeout_ms * 1e6, 100e6
    first_stale = next(t for t, stale in jobs if stale and t > stopped)
    assert first_stale <= stopped + timeout_ns + period_ns + LATE_NS, "stale within one timeout, at the job after it"
    spoken = stopped + silence_ns
    assert all(stale for t, stale in jobs if stopped + timeout_ns + LATE_NS < t < spoken - LATE_NS)
    after = [stale for t, stale in jobs if t > spoken + LATE_NS][:5]
    assert after == [False] * 5, "fresh with the first job after it"
    assert load_result(run.json)["timing"]["estimator"]["stale_jobs"] >= 4


def test_frames_with_a_bad_crc_are_counted_and_not_believed(live):
    run = live(14)
    run.wait_for_estimates()
    encoder = Encoder(DBC, "PLANT")
    with HubBus(run.hub_path()) as bus:
        for _ in range(50):
            hot = encoder.encode("TempMeas", {"theta_w_meas_degc": 400.0, "theta_r_meas_degc": 400.0, "tick": 7})
            hot.data[0] ^= 0x5A
            bus.send(hot)
            time.sleep(0.02)
    status, text = run.end()
    assert status == 3, text  # damaged frames are in the log: nothing is certain
    result = load_result(run.json)
    assert result["input_faults"]["crc_errors"] == 50
    assert result["log"]["damaged"] == 50
    assert result["accuracy"]["theta_w"]["est_max_degc"] < 2.0, "a damaged temperature was believed"


def test_garbage_datagrams_harm_nobody(live):
    run = live(14)
    run.wait_for_estimates()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as s:
        s.connect(run.hub_path())
        for size in (1, 3, 15, 17, 64, 71, 73, 500):
            s.send(os.urandom(size))
    status, text = run.end()
    assert status in (0, 3), text
    result = load_result(run.json)
    assert result["log"]["dropped"] == result["log"]["damaged"] == 0
    assert result["accuracy"]["theta_w"]["est_rmse_degc"] is not None


def test_an_unknown_id_is_logged_raw_and_nothing_else_happens(live):
    run = live(13)
    run.wait_for_estimates()
    with HubBus(run.hub_path()) as bus:
        bus.send(can.Message(arbitration_id=0x7FE, data=b"stranger", is_extended_id=False))
    status, text = run.end()
    assert status in (0, 3), text
    assert sum(summarise(run.log).unknown.values()) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small tmpfs needs root")
def test_a_full_disk(live, tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(small)], check=True)
    try:
        run = live(60, log=small / "run.mcap")
        status, text = run.end(120)
        assert status == 1, text
        assert "No space left" in text or "disk full" in text, text
        assert "Traceback" not in text
        assert sum(1 for _ in read_log(small / "run.mcap")) > 10
    finally:
        subprocess.run(["umount", "-l", str(small)], check=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small tmpfs needs root")
@pytest.mark.parametrize("verb", ["run", "mil"])
def test_a_disk_that_is_full_from_the_start(tmp_path, verb):
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(small)], check=True)
    try:
        (small / "full").write_bytes(bytes(12_000))
        bus = ("--bus", "hub") if verb == "run" else ()
        done = rt_runner(verb, "hot-lap", *bus, "--duration", 3, "--log", small / "x.mcap")
        assert done.returncode == 1
        assert "No space left" in done.stderr
        assert "Traceback" not in done.stderr
    finally:
        subprocess.run(["umount", "-l", str(small)], check=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small tmpfs needs root")
def test_a_disk_that_fills_up_in_lock_step(tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(small)], check=True)
    try:
        done = rt_runner("mil", "lap", "--log", small / "x.mcap")
        assert done.returncode == 1
        assert "No space left" in one_line(done.stderr.splitlines()[-1])
        assert b"\0" * 1000 not in (small / "x.mcap").read_bytes(), "there is a hole in the log"
        assert sum(1 for _ in read_log(small / "x.mcap")) > 1000
    finally:
        subprocess.run(["umount", "-l", str(small)], check=True)


def test_json_to_standard_output_is_nothing_but_json(tmp_path):
    done = rt_runner("mil", "hot-lap", "--duration", 12, "--log", tmp_path / "x.mcap", "--json", "-")
    assert json.loads(done.stdout)["bus"] == "lockstep"
