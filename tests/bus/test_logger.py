"""The logger process on every transport: nothing is lost, and the log is readable whichever way it ends."""

import json
import os
import queue
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest

from rt_runner.codec import Encoder
from rt_runner.dbc import DEFAULT_DBC, load_dbc
from rt_runner.log_reader import LogReader
from tests.support.buses import ROOT, Buses, have_vcan, wait_until

DBC = load_dbc()


class LoggerProcess:
    """``python -m rt_runner.logger`` under test."""

    def __init__(self, bus: str, log: Path, *options: str, config: dict | None = None, limit: int = 0) -> None:
        arguments = ["--bus", bus, "--log", str(log), *options]
        if config is not None:
            path = log.with_suffix(".config.json")
            path.write_text(json.dumps(config))
            arguments += ["--config", str(path)]
        self.log = log
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rt_runner.logger", *arguments], cwd=ROOT, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            preexec_fn=(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))) if limit else None,
        )  # fmt: skip
        self.lines: queue.Queue[dict] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:  # type: ignore[union-attr]
            self.lines.put(json.loads(line))

    def wait_for(self, key: str, timeout_s: float = 60.0) -> dict:
        """The next line that has ``key``, skipping others."""
        deadline = time.monotonic() + timeout_s
        while True:
            line = self.lines.get(timeout=max(0.01, deadline - time.monotonic()))
            if key in line:
                return line

    def tell(self, text: str) -> None:
        self.process.stdin.write(text + "\n")  # type: ignore[union-attr]
        self.process.stdin.flush()  # type: ignore[union-attr]

    def finish(self, **outcome: object) -> dict:
        """Finish the run; the result."""
        self.tell(json.dumps({"finish": {"outcome": outcome, "granted": {"policy": "fifo", "core": 1, "mlock": True}}}))
        return self.wait_for("result")["result"]

    def end(self, sig: int | None = None, timeout_s: float = 60.0) -> tuple[int, list[str]]:
        """Exit status and lines of stderr."""
        if sig is not None:
            self.process.send_signal(sig)
        status = self.process.wait(timeout_s)
        return status, self.process.stderr.read().splitlines()  # type: ignore[union-attr]


@pytest.fixture
def start(tmp_path):
    """Starts loggers and takes care of their end."""
    started: list[LoggerProcess] = []

    def start_one(bus: str, *options: str, ready: bool = True, **more) -> LoggerProcess:
        logger = LoggerProcess(bus, more.pop("log", tmp_path / "run.mcap"), *options, **more)
        started.append(logger)
        if ready:
            logger.wait_for("ready")
        return logger

    yield start_one
    for logger in started:
        if logger.process.poll() is None:
            logger.process.kill()
        logger.process.wait()
        for stream in (logger.process.stdin, logger.process.stderr):
            stream.close()  # type: ignore[union-attr]


def drive(count: int) -> list[can.Message]:
    """Frames of plant and estimator, 10 ms of drive per motor frame."""
    plant, estimator = Encoder(DBC, "PLANT"), Encoder(DBC, "ESTIMATOR")
    frames = []
    for i in range(count):
        frames.append(plant.encode("MotorState", derating_active=0, torque_nm=1.0, speed_rpm=100.0, tick=i))
        if i % 10 == 0:
            for name, kind in (("TruthTemp", "true"), ("TempMeas", "meas")):
                temperatures = {f"theta_w_{kind}_degc": 80.0, f"theta_r_{kind}_degc": 70.0}
                frames.append(plant.encode(name, temperatures, tick=i))
            frames.append(estimator.encode("Estimate", status=2, theta_w_est_degc=80.5, theta_r_est_degc=69.5, tick=i))
    return frames


def send(bus: can.BusABC, frames: list[can.Message]) -> None:
    for frame in frames:
        bus.send(frame, 5.0)


def logged(path: Path) -> list[tuple[int, bytes]]:
    return [(f.can_id, f.data) for f in LogReader(path).raw()]


def as_sent(frames: list[can.Message]) -> list[tuple[int, bytes]]:
    return [(f.arbitration_id, bytes(f.data)) for f in frames]


def test_a_run_from_ready_to_result(buses, start, tmp_path):
    (tmp_path / "lap.toml").write_text("title = 'a lap'\n")
    config = {"run": {"scenario": "lap", "seed": "3"}, "files": {"scenario.toml": str(tmp_path / "lap.toml")}}
    logger = start(buses.bus, config=config)
    frames, sender = drive(1500), buses.open()
    before_ns = time.time_ns()
    send(sender, frames)
    result = logger.finish(bus="test", scenario="lap", seed=3)
    assert logger.end() == (0, [])

    reader = LogReader(logger.log)
    assert (reader.complete, reader.trouble) == (True, [])
    assert logged(logger.log) == as_sent(frames), "all of them, in order, nothing else"
    stamps = [f.t_ns for f in reader.raw()]
    assert stamps == sorted(stamps)
    assert before_ns <= stamps[0] <= stamps[-1] <= time.time_ns()
    assert all(f.e2e == 0 for f in reader.frames())
    assert reader.metadata["run"] == config["run"]
    assert json.loads(reader.metadata["result"]["json"]) == result
    assert json.loads(reader.attachments["granted.json"])["policy"] == "fifo"
    assert reader.attachments["scenario.toml"] == b"title = 'a lap'\n"
    assert reader.attachments["drive.dbc"] == DEFAULT_DBC.read_bytes()
    assert (result["bus"], result["scenario"], result["granted"]["core"]) == ("test", "lap", 1)
    assert (result["log"]["frames"], result["log"]["dropped"]) == (len(frames), 0)
    assert result["accuracy"]["theta_w"]["est_rmse_degc"] == pytest.approx(0.5, abs=0.01)


def test_progress_is_told(buses, start):
    logger, sender = start(buses.bus), buses.open()
    send(sender, drive(11))
    logger.wait_for("progress")
    progress = logger.wait_for("progress")["progress"]
    assert progress["frames"] == 17
    assert progress["theta_w_est_degc"] == 80.5
    assert progress["t_s"] >= 0


@pytest.mark.parametrize("way", ["SIGTERM", "SIGINT", "end of input"])
def test_every_way_to_end_finishes_the_log(hub, start, way):
    logger, sender = start(hub.bus), hub.open()
    frames = drive(100)
    send(sender, frames)
    if way == "end of input":
        logger.process.stdin.close()
        status, errors = logger.end()
    else:
        status, errors = logger.end(getattr(signal, way))
    assert (status, errors) == (0, [])
    reader = LogReader(logger.log)
    assert reader.complete
    assert logged(logger.log) == as_sent(frames)
    result = json.loads(reader.metadata["result"]["json"])
    assert result["verdict"] == ("inconclusive" if way.startswith("SIG") else "fail")


def test_killed_it_leaves_all_but_the_last_half_second(buses, start):
    logger, sender = start(buses.bus), buses.open()
    frames = drive(200)
    send(sender, frames)
    time.sleep(1.5)
    send(sender, drive(3))
    assert logger.end(signal.SIGKILL)[0] == -9
    reader = LogReader(logger.log)
    assert logged(logger.log)[: len(frames)] == as_sent(frames)
    assert not reader.complete


def test_a_bus_that_is_never_quiet_cannot_hold_it(buses, start):
    logger, sender, stop = start(buses.bus), buses.open(), threading.Event()

    def flood() -> None:
        plant = Encoder(DBC, "PLANT")
        while not stop.wait(0.002):
            sender.send(plant.encode("MotorState", derating_active=0, torque_nm=1, speed_rpm=1, tick=1), 1.0)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        time.sleep(0.2)
        began = time.monotonic()
        logger.finish()
        assert time.monotonic() - began < 5.0
    finally:
        stop.set()
        thread.join()
    assert logger.end() == (0, [])
    assert LogReader(logger.log).complete


def test_flood(buses, start, record_property):
    """Lossless on the hub; on SocketCAN what the kernel dropped is counted. Cost per frame by CPU time."""
    logger, sender = start(buses.bus), buses.open()
    frames = drive(15000)
    cpu_before = _cpu_s(logger.process.pid)
    send(sender, frames)
    wait_until(lambda: _newest_count(logger) >= len(frames) or buses.hub is None)
    cpu_us = (_cpu_s(logger.process.pid) - cpu_before) / len(frames) * 1e6
    result = logger.finish()
    assert logger.end() == (0, [])
    got = logged(logger.log)
    if buses.hub is not None:
        assert got == as_sent(frames)
    assert len(got) == result["log"]["frames"]
    if len(got) < len(frames):
        assert result["log"]["dropped"] >= len(frames) - len(got)
    record_property("logger_cpu_us_per_frame", cpu_us)
    print(f"logger: {cpu_us:.1f} us of CPU per frame")
    assert cpu_us < 200, "5000 frames/s would not fit"


@pytest.mark.vcan
def test_frames_the_kernel_drops_are_counted(start, request):
    """A logger that stands still loses frames on SocketCAN, at the very end as well; the result says how many."""
    have_vcan()
    buses = Buses("socketcan:vcan0", None)
    request.addfinalizer(buses.close)
    logger, sender = start(buses.bus), buses.open()
    logger.process.send_signal(signal.SIGSTOP)
    frames = drive(30000)
    send(sender, frames)
    logger.process.send_signal(signal.SIGCONT)
    result = logger.finish()
    assert logger.end() == (0, [])
    missing = len(frames) - len(logged(logger.log))
    assert missing > 0, "the socket held them all: send more"
    assert result["log"]["dropped"] >= missing
    assert result["verdict"] != "pass"


def _newest_count(logger: LoggerProcess) -> int:
    try:
        return logger.wait_for("progress", 5.0)["progress"]["frames"]
    except queue.Empty:
        return 0


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_unknown_and_damaged_frames_and_nonsense_lines_are_taken_calmly(hub, start):
    logger, sender = start(hub.bus), hub.open()
    for line in ("", "hello", "[1, 2]", '{"what": 1}', "{"):
        logger.tell(line)
    damaged = drive(1)[0]
    damaged.data[3] ^= 0x20
    strange = [
        damaged,
        can.Message(arbitration_id=0x55, data=b"\x01", is_extended_id=False),
        can.Message(arbitration_id=0x0A0, data=b"\x01\x02", is_extended_id=False),
        can.Message(arbitration_id=0x0A0, is_remote_frame=True, dlc=8, is_extended_id=False),
        can.Message(arbitration_id=0x1ABCDEF0, data=bytes(8)),
        can.Message(arbitration_id=0x0A0, data=bytes(64), is_fd=True, is_extended_id=False),
    ]
    send(sender, strange)
    result = logger.finish()
    assert logger.end() == (0, [])
    assert result["log"]["damaged"] == 3
    assert [(f.can_id, f.data) for f in LogReader(logger.log).raw()] == [
        (m.arbitration_id, b"" if m.is_remote_frame else bytes(m.data)) for m in strange
    ]


def test_bus_lost(hub, start):
    logger, sender = start(hub.bus), hub.open()
    frames = drive(50)
    send(sender, frames)
    time.sleep(0.5)
    hub.hub.process.kill()
    assert "bus lost" in logger.wait_for("error")["error"]
    result = logger.finish(crash="the hub was killed")
    assert logger.end() == (0, [])
    assert result["verdict"] == "fail"
    assert LogReader(logger.log).complete
    assert logged(logger.log) == as_sent(frames)


def test_disk_full(hub, start):
    logger, sender = start(hub.bus, limit=150_000), hub.open()  # the contract, attached first, takes most of it
    plant = Encoder(DBC, "PLANT")
    error = None
    for i in range(200_000):
        values = {"derating_active": i % 2, "torque_nm": (i * 7919) % 300, "speed_rpm": (i * 104729) % 15000}
        try:
            sender.send(plant.encode("MotorState", values, tick=i % 65536), 5.0)
        except can.CanError as e:  # nobody reads any more
            error = e
            break
        if logger.process.poll() is not None:
            break
    status, errors = logger.end()
    assert status == 1, error
    assert len(errors) == 1
    assert "make room on the disk" in errors[0]
    assert str(logger.log) in errors[0]
    assert logger.wait_for("error")["error"] in errors[0]
    reader = LogReader(logger.log)
    assert len(list(reader.frames())) > 500
    assert not reader.complete


@pytest.mark.parametrize("trouble", ["exists", "directory", "no folder", "no bus", "no config", "bad config", "busy"])
def test_bad_set_up_is_one_line(hub, start, tmp_path, trouble):
    log, bus, options, says = tmp_path / "x.mcap", hub.bus, [], "x.mcap"
    if trouble == "exists":
        log.write_text("precious")
        says = "exists already"
    elif trouble == "directory":
        log.mkdir()
        says = "is a directory"
    elif trouble == "no folder":
        log = tmp_path / "none" / "x.mcap"
    elif trouble == "no bus":
        bus, says = f"rt_hub:{tmp_path / 'nobody'}", "nobody"
    elif trouble == "no config":
        options, says = ["--config", str(tmp_path / "none.json")], "none.json"
    elif trouble == "bad config":
        (tmp_path / "bad.json").write_text("[1]")
        options, says = ["--config", str(tmp_path / "bad.json")], "must be JSON"
    else:
        start(hub.bus, log=log)
        says = "another logger writes it"
    logger = start(bus, *options, log=log, ready=False)
    status, errors = logger.end()
    assert status == 1
    assert len(errors) == 1, errors
    assert errors[0].startswith("logger: ")
    assert says in errors[0]
    if trouble == "exists":
        assert log.read_text() == "precious"


def test_force_overwrites(hub, start, tmp_path):
    (tmp_path / "run.mcap").write_text("old")
    logger = start(hub.bus, "--force")
    logger.finish()
    assert logger.end() == (0, [])
    assert LogReader(logger.log).complete
