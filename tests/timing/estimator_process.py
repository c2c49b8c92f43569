"""Drives the estimator binary: frames of a simulated lap in, records or bus frames out, statistics as JSON."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest

from plant_sim.cycles import CycleSpec
from plant_sim.params import load_params
from plant_sim.plant import Plant as SimulatedPlant
from plant_sim.sensors import TemperatureSensor
from plant_sim.state import ROW_SPEED, ROW_THETA_R, ROW_THETA_W, ROW_TORQUE
from rt_runner import paths
from rt_runner.bus import open_bus
from rt_runner.codec import Decoder, Encoder
from rt_runner.dbc import DEFAULT_DBC, load_dbc
from rt_runner.e2e import E2eStatus
from rt_runner.records import CONTROL_ID, END, RECORD, TICK, Record, control, pack

DBC = load_dbc()
DBC_SHA256 = hashlib.sha256(DEFAULT_DBC.read_bytes()).hexdigest()
MS = 1_000_000
TICK_NS = 10 * MS
LAP_TICKS = 72_000
CONTENT = ("Estimate", "EstimateInnov", "EstValidity", "EstWinding", "EstRotor")  # what carries no timing
PER_JOB = (*CONTENT, "EstTimingA", "EstTimingB", "EstTimingC", "EstTimingD")
COUNTERS = ("EstReleases", "EstMisses", "EstInputFaults", "EstBusFaults", "EstCoreFaults", "EstCoreFaults2",
            "EstCalibration", "EstOverload", "EstMissRun", "EstOutputs", "EstEnvironment", "EstMachine", "EstCanary",
            "EstWakeStat", "EstExecStat", "EstRespStat")  # fmt: skip
IDENTITY = ("EstIdentity", "EstBuild", "EstGranted")


def binary(kind: str) -> Path:
    """The estimator as built normally (``release``) or with sanitizers (``asan``); skips where it is not built."""
    path = paths.build_dir() / ("asan/bin" if kind == "asan" else "bin") / "rt_estimator"
    if not os.access(path, os.X_OK):
        target = "build-asan" if kind == "asan" else "build"
        if os.environ.get("CI") == "true":
            pytest.fail(f"{path} is missing; run 'make {target}'")
        pytest.skip(f"{path} is missing; run 'make {target}'")
    return path


@cache
def lap() -> tuple[np.ndarray, np.ndarray]:
    """The lap from 60 degC on: one row per tick (from 1 on), and the sensors' readings at every tenth.

    The sensor monitor tells real temperatures from made-up ones, so the temperatures follow from torque and speed.
    """
    params = load_params()
    rows = SimulatedPlant(params, CycleSpec("lap", theta0_degc=60.0)).record(LAP_TICKS, stop=False)
    sensor = TemperatureSensor(params.sensor, np.array([60.0, 60.0]), np.random.default_rng(1))
    return rows, sensor.sample(rows[9::10, ROW_THETA_W : ROW_THETA_R + 1])


class Plant:
    """MotorState, TempMeas and Coolant frames of the lap, tick after tick; beyond its end its last ones."""

    def __init__(self) -> None:
        self._encoder = Encoder(DBC, "PLANT")
        self._rows, self._readings = lap()

    def truth(self, tick: int) -> tuple[float, float]:
        """True winding and rotor temperature, degC."""
        theta_w, theta_r = self._row(tick)[ROW_THETA_W : ROW_THETA_R + 1]
        return float(theta_w), float(theta_r)

    def _row(self, tick: int) -> np.ndarray:
        return self._rows[min(max(tick - 1, 0), len(self._rows) - 1)]

    def motor(self, tick: int, **override) -> bytes:
        values = {
            "derating_active": 0,
            "torque_nm": self._row(tick)[ROW_TORQUE],
            "speed_rpm": self._row(tick)[ROW_SPEED],
            "tick": tick % 65536,
        }
        return bytes(self._encoder.encode("MotorState", values | override).data)

    def temp(self, tick: int, **override) -> bytes:
        theta_w, theta_r = self._readings[min(max(tick // 10 - 1, 0), len(self._readings) - 1)]
        values = {"theta_w_meas_degc": theta_w, "theta_r_meas_degc": theta_r, "tick": tick % 65536}
        return bytes(self._encoder.encode("TempMeas", values | override).data)

    def coolant(self, tick: int, **override) -> bytes:
        values = {"soaked": 0, "coolant_degc": 65.0, "ambient_degc": 25.0, "tick": tick % 65536}
        return bytes(self._encoder.encode("Coolant", values | override).data)

    def frames(self, tick: int) -> list[tuple[int, bytes]]:
        """What the plant sends at `tick`."""
        out = [(0x0A0, self.motor(tick))]
        if tick % 10 == 0:
            out.append((0x1A0, self.temp(tick)))
        if tick % 100 == 0:
            out.append((0x1C0, self.coolant(tick)))
        return out


def drive(ticks: Iterable[int]) -> list[Record]:
    """Records of an undisturbed drive: frames at tick x 10 ms, each tick followed by its TICK record."""
    plant = Plant()
    out = []
    for tick in ticks:
        out += [Record(tick * TICK_NS, can_id, data) for can_id, data in plant.frames(tick)]
        out.append(tick_record(tick * TICK_NS))
    return out


def tick_record(t_ns: int, code: int = TICK) -> Record:
    return Record(t_ns, CONTROL_ID, bytes([code]))


def to_bytes(records: Iterable[Record]) -> bytes:
    return b"".join(control(r.t_ns, r.data[0]) if r.can_id == CONTROL_ID else pack(*r) for r in records)


@dataclass(frozen=True)
class Frame:
    """A decoded frame of the estimator; `t_ns` is record time, or the receive stamp."""

    t_ns: int
    name: str
    values: dict
    e2e: E2eStatus
    data: bytes


@dataclass(frozen=True)
class Run:
    """What came out of a run."""

    status: int
    frames: list[Frame]
    controls: list[tuple[int, int]]
    ready: dict | None
    final: dict | None
    errors: list[str]
    lost_here: int = 0  # frames our own witness was too slow for
    life_s: float = 0.0  # from ready to the end

    def named(self, name: str) -> list[Frame]:
        return [f for f in self.frames if f.name == name]

    def payload(self) -> list[tuple]:
        """Everything the estimator concluded: record time and content of the frames that carry no timing."""
        return [(f.t_ns, f.name, f.data) for f in self.frames if f.name in CONTENT]


def _sort_lines(text: str) -> tuple[dict | None, dict | None, list[str]]:
    ready = final = None
    errors = []
    for line in text.splitlines():
        if line.startswith('{"ready"'):
            ready = json.loads(line)
        elif line.startswith('{"final"'):
            final = json.loads(line)
        else:
            errors.append(line)
    return ready, final, errors


def lockstep(program: Path, raw: bytes, *args: str, env: dict | None = None) -> Run:
    """Feed raw records to a lock-step estimator and read it to its end."""
    done = subprocess.run([program, "--lockstep", *args], input=raw, capture_output=True, timeout=120, check=False,
                          env={**os.environ, **(env or {})})  # fmt: skip
    ready, final, errors = _sort_lines(done.stderr.decode(errors="replace"))
    decoder, frames, controls = Decoder(DBC), [], []
    assert len(done.stdout) % RECORD.size == 0
    if ready is not None:
        assert ready["dbc_hash"] == DBC_SHA256, f"{program} was built from another DBC: run 'make build build-asan'"
    for t_ns, can_id, length, data in RECORD.iter_unpack(done.stdout):
        if can_id == CONTROL_ID:
            controls.append((t_ns, data[0]))
            continue
        decoded = decoder.decode(can_id, data[:length])
        assert decoded is not None
        frames.append(Frame(t_ns, decoded.name, decoded.values, decoded.e2e, data[:length]))
    return Run(done.returncode, frames, controls, ready, final, errors)


def run_drive(program: Path, records: Iterable[Record], *args: str) -> Run:
    """A lock-step run over `records`, ended in good order."""
    records = list(records)
    end = tick_record(records[-1].t_ns, END)
    return lockstep(program, to_bytes([*records, end]), *args)


class OnBus:
    """The estimator on a real bus, with a plant beside it that sends in real time and a witness that reads."""

    def __init__(self, bus: str, program: Path, *args: str, **popen) -> None:
        lap()  # computed before the clock runs
        self._witness = open_bus(bus)
        self._talker = open_bus(bus, receive=False)
        self.process = subprocess.Popen([program, "--bus", bus, *args], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                        text=True, **popen)  # fmt: skip
        line = self.process.stdout.readline() if self.process.stdout else ""
        if not line:
            raise AssertionError(self.process.communicate()[1])
        self._born = time.monotonic()
        self.ready = json.loads(line)
        assert self.ready["dbc_hash"] == DBC_SHA256, (
            f"{program} was built from another DBC: run 'make build build-asan'"
        )
        self._messages: list = []
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._read), threading.Thread(target=self._send)]
        self.sent_ticks = 0
        for thread in self._threads:
            thread.start()

    def _read(self) -> None:
        message = None
        while message is not None or not self._stop.is_set():  # to the end, and then until the bus is quiet
            try:
                message = self._witness.recv(0.3 if self._stop.is_set() else 0.05)
            except Exception:  # the bus ended: the test that ends it looks at the estimator, not at us
                return
            if message is not None:
                self._messages.append(message)

    def _send(self) -> None:
        plant, start, tick = Plant(), time.monotonic(), 0
        try:
            while not self._stop.wait(max(0.0, start + tick * 0.01 - time.monotonic())):
                for can_id, data in plant.frames(tick):
                    self.send(can_id, data)
                tick += 1
                self.sent_ticks = tick
        except Exception:  # as above
            return

    def send(self, can_id: int, data: bytes) -> None:
        """Put one frame on the bus."""
        self._talker.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=can_id > 0x7FF))

    def wait(self, seconds: float) -> OnBus:
        time.sleep(seconds)
        return self

    def finish(self, signal_number: int | None = signal.SIGTERM) -> Run:
        """End the estimator (by a signal, or None: it ends by itself), then read what is left."""
        if signal_number is not None:
            self.process.send_signal(signal_number)
        out, err = self.process.communicate(timeout=20)
        life_s = time.monotonic() - self._born
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._witness.shutdown()
        self._talker.shutdown()
        _, final, noise = _sort_lines(out)
        decoder, frames = Decoder(DBC), []
        for m in self._messages:
            decoded = decoder.decode(m.arbitration_id, bytes(m.data)) if not m.is_extended_id else None
            if decoded is not None and decoded.name.startswith("Est"):
                frames.append(Frame(round(m.timestamp * 1e9), decoded.name, decoded.values, decoded.e2e, bytes(m.data)))
        lost = getattr(self._witness, "rx_drops", 0)
        return Run(self.process.returncode, frames, [], self.ready, final, noise + err.splitlines(), lost, life_s)


def per_job(run: Run) -> Iterator[tuple[Frame, ...]]:
    """The frames of each job, in the order they must come."""
    frames = [f for f in run.frames if f.name in PER_JOB]
    assert [f.name for f in frames] == list(PER_JOB) * (len(frames) // len(PER_JOB))
    for i in range(0, len(frames), len(PER_JOB)):
        yield tuple(frames[i : i + len(PER_JOB)])
