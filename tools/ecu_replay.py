"""Recorded steps on the emulated ECU and on the host: the stream given to both, their answers compared bit for bit."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.ecu_image import Image, ToolError
from tools.solver_backends.stream import INIT, records

# Places in the payload of INIT: tools/solver_backends/stream.h
SETTING_MAX_SWEEPS, SETTING_TOLERANCE = 14, 15

# -icount shift=10: an instruction is 1024 ns of virtual time, and the board's timer ticks every 40 ns of it: 25.6 ticks
# each, so the difference of two readings, rounded, is the number of instructions.
QEMU = (
    "qemu-system-arm", "-M", "mps2-an500", "-icount", "shift=10", "-nodefaults",
    "-display", "none", "-serial", "none", "-monitor", "none",
    "-semihosting-config", "enable=on,target=native", "-kernel",
)  # fmt: skip
INSTRUCTIONS_PER_TICK = 40 / 1024
EXIT = {
    3: "a record of the stream is not one this build knows",
    4: "a file could not be read or written",
    5: "a fault exception: the image is broken",
}  # port.h

PARTS = ("advance", "arrival", "measure", "level", "feedback", "finish")
MAGIC = 0x31554345
FIRST = np.dtype(
    [(name, "<u4") for name in ("magic", "real_bytes", "memory", "state", "reading", "loop_1k", "loop_3k", "reserved")]
)


def answer_type(real: str) -> np.dtype:
    """answer_t of replay.c; real: "<f4" or "<f8"."""
    return np.dtype([
        ("status", "<i4"), ("sweeps", "<i4"), ("active", "<i4"), ("count", "<i4"), ("ticks", "<u4", len(PARTS)),
        ("stack", "<u4"), ("window_hash", "<u4"), ("theta", real, 2), ("kkt_degc", real),
        ("innovation", real, 2), ("padding", real),
    ])  # fmt: skip


COUNTED = ("ticks", "stack")  # fields that only the ECU has


@dataclass(frozen=True)
class Replay:
    """One machine's answers, one row (answer_type) per solved step.

    state: sizeof(mhe_t) in bytes. counter_slope: instructions that the counter saw per round of a loop of two; host: 0.
    """

    answers: np.ndarray
    state: int
    counter_slope: float

    def instructions(self) -> np.ndarray:
        """(steps, len(PARTS)): instructions of each step, by kind of call."""
        return np.rint(self.answers["ticks"] * INSTRUCTIONS_PER_TICK).astype(np.int64)


def fixed_sweeps(data: np.ndarray, sweeps: int) -> np.ndarray:
    """The same calls, each solution with exactly that many sweeps; 0: until it has converged, as recorded."""
    if sweeps == 0:
        return data
    out = data.copy()
    for place, op, _ in records(data):
        if op == INIT:
            out[place + 2 + SETTING_MAX_SWEEPS] = sweeps
            out[place + 2 + SETTING_TOLERANCE] = -1.0  # below any residual
    return out


def replay_ecu(image: Image, data: np.ndarray, folder: Path, limit_s: float = 1200.0) -> Replay:
    """The calls on the emulated ECU. data: records as in stream.h.

    Raises
    ------
    ToolError
        The program ended with an error, or took longer than limit_s. replay_host() and replay_double() alike.
    """
    return _replay([*QEMU, str(image.elf)], data, "<f4", folder / "on_ecu", limit_s)


def replay_host(image: Image, data: np.ndarray, folder: Path) -> Replay:
    """The same source and number type on this machine."""
    return _replay([str(image.host)], data, "<f4", folder / "on_host", 600.0)


def replay_double(image: Image, data: np.ndarray, folder: Path) -> Replay:
    """The same source in double on this machine."""
    return _replay([str(image.double)], data, "<f8", folder / "in_double", 600.0)


def _replay(command: list[str], data: np.ndarray, real: str, folder: Path, limit_s: float) -> Replay:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stream.bin").write_bytes(data.astype(real).tobytes())
    result = folder / "result.bin"
    result.unlink(missing_ok=True)
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired as err:
        raise ToolError(f"{command[0]}: not finished after {limit_s:.0f} s: take fewer steps") from err
    if done.returncode != 0:
        why = EXIT.get(done.returncode, f"exit status {done.returncode}")
        raise ToolError(f"{Path(command[0]).name}: {why}\n{(done.stdout + done.stderr).strip()}")
    written = result.read_bytes()
    first, kind = np.frombuffer(written, FIRST, 1)[0], answer_type(real)
    if (
        first["magic"] != MAGIC
        or first["real_bytes"] != kind["kkt_degc"].itemsize
        or (len(written) - FIRST.itemsize) % kind.itemsize
    ):
        raise ToolError(f"{result}: not an answer of this build of the bench")
    loops = [round(int(first[name]) * INSTRUCTIONS_PER_TICK) for name in ("loop_1k", "loop_3k")]
    answers = np.frombuffer(written, kind, offset=FIRST.itemsize)
    return Replay(answers, int(first["state"]), (loops[1] - loops[0]) / 2000)


def differing_steps(ecu: Replay, host: Replay) -> int:
    """Steps whose answers differ in any bit (counters aside); all of them where the numbers of steps differ."""
    if len(ecu.answers) != len(host.answers):
        return max(len(ecu.answers), len(host.answers))
    equal = np.ones(len(ecu.answers), dtype=bool)
    for name in set(ecu.answers.dtype.names or ()) - set(COUNTED):
        a, b = (np.ascontiguousarray(run.answers[name]).view("<u4").reshape(len(equal), -1) for run in (ecu, host))
        equal &= (a == b).all(axis=1)
    return int((~equal).sum())
