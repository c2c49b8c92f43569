"""Slices of seconds of one kind each: our loop on its grid, cyclictest, our loop woken by a frame, the bare echo."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import IO

import numpy as np
from numpy.typing import NDArray

from plant_sim.cycles import CycleSpec
from plant_sim.params import load_params
from plant_sim.plant import Plant
from plant_sim.sensors import TemperatureSensor
from plant_sim.state import ROW_SPEED, ROW_THETA_R, ROW_THETA_W, ROW_TORQUE
from rt_runner import machine, paths
from rt_runner.codec import Decoder, Encoder
from rt_runner.dbc import load_dbc
from rt_runner.records import pack

PRIORITY = 80  # the estimator's
PROBE_PRIORITY = 50
INTERVAL_MS = 100.0  # of the plant, between two temperature frames
TICKS = 10  # in an interval
WARMUP_S, MIN_WARMUP = 1.0, 5  # the estimator's own rule; what others measure then is left out, too
LAP_TICKS = 72_000
END_S = 20.0
DBC = load_dbc()
ASK, ANSWER = DBC["TempMeas"].frame_id, DBC["Estimate"].frame_id
TIMING = (DBC["EstTimingA"].frame_id, DBC["EstTimingB"].frame_id)
Floats = NDArray[np.float64]
NONE: Floats = np.empty(0)


class SliceError(Exception):
    """A slice cannot be measured; the message says what, where and what to do."""


class Kind(Enum):
    """What a slice measures."""

    GRID = "our loop on its time grid"
    CYCLICTEST = "cyclictest"
    FRAME = "our loop woken by the frame"
    ECHO = "bare C echo"


@dataclass(frozen=True, eq=False)
class Slice:
    """One slice, warm-up left out; empty where its kind does not measure it. ``steal_ms`` on the core meanwhile."""

    wake_us: Floats = field(default_factory=lambda: NONE)
    exec_us: Floats = field(default_factory=lambda: NONE)
    resp_us: Floats = field(default_factory=lambda: NONE)
    rtt_us: Floats = field(default_factory=lambda: NONE)
    asked: int = 0
    unanswered: int = 0
    lost: int = 0  # frames the probe could not send, or the kernel lost
    steal_ms: float = 0.0


def records(intervals: int) -> bytes:
    """The lap's first intervals as the plant sends them: ten motor frames, then the temperatures."""
    ticks = min(intervals * TICKS, LAP_TICKS)
    params = load_params()
    rows = Plant(params, CycleSpec("lap", theta0_degc=60.0)).record(ticks, stop=False)
    sensor = TemperatureSensor(params.sensor, np.array([60.0, 60.0]), np.random.default_rng(1))
    readings = sensor.sample(rows[TICKS - 1 :: TICKS, ROW_THETA_W : ROW_THETA_R + 1])
    encoder, out = Encoder(DBC, "PLANT"), []

    def add(t_ns: int, name: str, **values: float) -> None:
        frame = encoder.encode(name, values)
        out.append(pack(t_ns, frame.arbitration_id, bytes(frame.data)))

    for tick, row in enumerate(rows, start=1):
        t_ns = tick * 10_000_000
        motor = {"torque_nm": row[ROW_TORQUE], "speed_rpm": row[ROW_SPEED], "derating_active": 0}
        add(t_ns, "MotorState", tick=tick % 65536, **motor)
        if tick % (10 * TICKS) == 0:
            add(t_ns, "Coolant", tick=tick % 65536, soaked=0, coolant_degc=65.0, ambient_degc=25.0)
        if tick % TICKS == 0:
            theta_w, theta_r = readings[tick // TICKS - 1]
            add(t_ns, "TempMeas", tick=tick % 65536, theta_w_meas_degc=theta_w, theta_r_meas_degc=theta_r)
    return b"".join(out)


class Bench:
    """Measures slices on one bus and one core.

    Parameters
    ----------
    bus : bus string
    core : of what is measured; ``others`` are for the sender and for cyclictest's own main thread
    slice_s : length of a slice

    Raises
    ------
    SliceError
        cyclictest or a binary is missing.
    """

    def __init__(self, bus: str, core: int, others: set[int], slice_s: float) -> None:
        self._bus, self._core, self._others, self._slice_s = bus, core, others, slice_s
        self._cyclictest = _cyclictest()
        self.granted: dict = {}
        self._estimator = str(paths.binary("rt_estimator"))
        self._probe, self._echo = (str(paths.binary(f"bench/bench_loop_{name}")) for name in ("probe", "echo"))
        words = subprocess.run([self._estimator, "--help"], capture_output=True, text=True, check=False).stdout
        self.kinds = [k for k in Kind if k is not Kind.FRAME or "--trigger" in words]
        self._lap = records(self._intervals(1.0))

    def _intervals(self, period_ms: float) -> int:
        return round(1e3 * self._slice_s / period_ms)

    def run(self, kind: Kind, period_ms: float) -> Slice:
        """One slice."""
        before = machine.steal_ms(self._core) or 0.0
        measured = self._run(kind, period_ms)
        stolen = (machine.steal_ms(self._core) or 0.0) - before
        return Slice(**{**vars(measured), "steal_ms": stolen})

    def _run(self, kind: Kind, period_ms: float) -> Slice:
        if kind is Kind.CYCLICTEST:
            probe = self._start_probe(period_ms)
            wake_us = self._run_cyclictest(period_ms)
            self._finish(probe, "probe")
            return Slice(wake_us=wake_us)
        subject, ready = self._start_subject(kind, period_ms)
        self.granted = {**self.granted, **{k: ready[k] for k in ("policy", "core", "mlock") if k in ready}}
        try:
            figures = json.loads(self._finish(self._start_probe(period_ms), "probe"))
        finally:
            subject.terminate()
            self._finish(subject, kind.value)
        return _slice(kind, figures, _warmup(period_ms))

    def _start(self, command: Sequence[str], stdin: int | IO[bytes] = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
        def place() -> None:
            os.sched_setaffinity(0, self._others)  # who has a core of its own takes it itself

        return subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0, preexec_fn=place
        )

    def _start_subject(self, kind: Kind, period_ms: float) -> tuple[subprocess.Popen[bytes], dict]:
        if kind is Kind.ECHO:
            command = [self._echo, self._bus, f"{ASK:x}", f"{ANSWER:x}", str(self._core), str(PRIORITY)]
        else:
            command = [self._estimator, "--bus", self._bus, "--core", str(self._core), "--priority", str(PRIORITY)]
            command += ["--period-us", str(round(1e3 * period_ms))]
            command += ["--trigger", "frame"] if kind is Kind.FRAME else []
        process = self._start(command)
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            self._finish(process, kind.value)
            raise SliceError(f"{command[0]} said nothing")
        return process, json.loads(line)

    def _start_probe(self, period_ms: float) -> subprocess.Popen[bytes]:
        speed = INTERVAL_MS / period_ms
        core = str(min(self._others))
        ids = [f"{i:x}" for i in (ASK, ANSWER)]
        command = [self._probe, self._bus, repr(speed), *ids, core, str(PROBE_PRIORITY), *(f"{i:x}" for i in TIMING)]
        frames = self._intervals(period_ms) * (TICKS + 1) + self._intervals(period_ms) // TICKS
        process = self._start(command, subprocess.PIPE)
        assert process.stdin is not None
        with process.stdin as stdin:
            view = memoryview(self._lap)[: frames * 24]
            while view:  # unbuffered: a pipe takes what it has room for
                view = view[stdin.write(view) or 0 :]
        process.stdin = None
        return process

    def _run_cyclictest(self, period_ms: float) -> Floats:
        loops = self._intervals(period_ms)
        command = [self._cyclictest, "-v", "-N", "-m", "-t1", "-a", str(self._core), "-l", str(loops)]
        command += ["-i", str(round(1e3 * period_ms))]
        command += [f"--mainaffinity={','.join(map(str, sorted(self._others)))}"]
        fifo = self.granted.get("policy") != "other"
        command += ["-p", str(PRIORITY)] if fifo else ["--policy=other"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=END_S + 2 * self._slice_s)
        wake_ns = []
        for line in done.stdout.splitlines():
            fields = line.split(":")
            if len(fields) == 3 and all(f.strip().isdigit() for f in fields):
                wake_ns.append(int(fields[2]))
        if done.returncode != 0 or len(wake_ns) < loops // 2:
            words = (done.stderr.strip() or done.stdout.strip()).splitlines()
            raise SliceError(f"cyclictest ended with status {done.returncode}: {words[-1] if words else 'no word'}")
        return np.array(wake_ns[_warmup(period_ms) :], dtype=np.float64) / 1e3

    def _finish(self, process: subprocess.Popen[bytes], name: str) -> bytes:
        """Its standard output; an error where it failed."""
        try:
            out, err = process.communicate(timeout=END_S + 2 * self._slice_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise SliceError(f"{name} did not end") from None
        if process.returncode != 0:
            words = err.decode(errors="replace").strip().splitlines()
            raise SliceError(f"{name} ended with status {process.returncode}: {words[-1] if words else 'no word'}")
        return out


def _warmup(period_ms: float) -> int:
    return max(MIN_WARMUP, round(1e3 * WARMUP_S / period_ms))


def _slice(kind: Kind, figures: dict, warmup: int) -> Slice:
    """The figures of a slice out of what the probe kept."""
    decoder, columns = Decoder(DBC), {"wake_lat_us": [], "exec_wall_us": [], "resp_us": []}
    judged: list[bool] = []
    for frame_id in TIMING:
        for k, text in enumerate(figures["frames"][f"{frame_id:X}"]):
            decoded = decoder.decode(frame_id, bytes.fromhex(text))
            assert decoded is not None
            if "warmup" in decoded.values:
                judged.append(not decoded.values["warmup"])
            for name in columns.keys() & decoded.values.keys():
                value = decoded.values[name]
                if value is not None and k < len(judged) and judged[k]:
                    columns[name].append(value)
    wake, wall, resp = (np.array(columns[n]) for n in ("wake_lat_us", "exec_wall_us", "resp_us"))
    return Slice(
        wake_us=wake,
        exec_us=wall,
        resp_us=resp,
        rtt_us=NONE if kind is Kind.GRID else np.array(figures["rtt_ns"][warmup:], dtype=np.float64) / 1e3,
        asked=figures["asked"],
        unanswered=0 if kind is Kind.GRID else figures["unanswered"],
        lost=figures["tx_drops"] + figures["rx_drops"],
    )


def _cyclictest() -> str:
    """Where cyclictest is; installed if this machine lets us."""
    if shutil.which("cyclictest") is None:
        done = subprocess.run([paths.ROOT / "tools" / "apt-install", "rt-tests"], check=False, capture_output=True)
        if done.returncode != 0 or shutil.which("cyclictest") is None:
            raise SliceError("cyclictest is missing: install the Debian package rt-tests")
    return str(shutil.which("cyclictest"))
