"""Recorded steps on the emulated ECU and on the host: the stream given to both, their answers compared bit for bit."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.ecu_image import Image, ToolError

# Records and places in them: tools/solver_backends/stream.h
INIT, SOLVE = 1, 8
SETTING_MAX_SWEEPS, SETTING_TOLERANCE = 14, 15

# -icount shift=10: an instruction is 1024 ns of virtual time, and the board's timer ticks every 40 ns of it: 25.6 ticks each, so a
# difference of two readings is a whole number of instructions after rounding.
QEMU = (
    "qemu-system-arm", "-M", "mps2-an500", "-icount", "shift=10", "-display", "none", "-serial", "none", "-monitor", "none",
    "-nodefaults", "-semihosting-config", "enable=on,target=native", "-kernel",
)  # fmt: skip
INSTRUCTIONS_PER_TICK = 40 / 1024
EXIT = {3: "the stream is not one this build knows", 4: "a file could not be read or written", 5: "fault (HardFault or worse)"}

PARTS = ("advance", "arrival", "measure", "level", "solve")
MAGIC = 0x31554345
FIRST = np.dtype(
    [(name, "<u4") for name in ("magic", "real_bytes", "memory", "state", "reading", "loop_1k", "loop_3k", "reserved")]
)
ANSWER = np.dtype([
    ("status", "<i4"), ("sweeps", "<i4"), ("active", "<i4"), ("count", "<i4"), ("ticks", "<u4", len(PARTS)), ("stack", "<u4"),
    ("window_hash", "<u4"), ("reserved", "<u4"), ("theta", "<f4", 2), ("kkt_degc", "<f4"), ("innovation", "<f4", 2),
    ("padding", "<f4"),
])  # fmt: skip
COUNTED = ("ticks", "stack")  # fields that only the ECU has


@dataclass(frozen=True)
class Replay:
    """One machine's answers, one row (ANSWER) per solved step.

    state: sizeof(mhe_t) in bytes. counter_slope: instructions that the counter saw per round of a loop of two; 0 on the host.
    """

    answers: np.ndarray
    state: int
    counter_slope: float

    def instructions(self) -> np.ndarray:
        """(steps, len(PARTS)): instructions of each step, by kind of call."""
        return np.rint(self.answers["ticks"] * INSTRUCTIONS_PER_TICK).astype(np.int64)


def records(stream: np.ndarray) -> list[tuple[int, int, int]]:
    """(op, start of the payload, its length) of each record of a stream of float64."""
    found, at = [], 0
    while at < len(stream):
        op, length = int(stream[at]), int(stream[at + 1])
        found.append((op, at + 2, length))
        at += 2 + length
    if at != len(stream):
        raise ToolError("the stream ends within a record: record it again")
    return found


def fixed_sweeps(stream: np.ndarray, sweeps: int) -> np.ndarray:
    """The same calls, each solution with exactly that many sweeps."""
    out = stream.copy()
    for op, at, _ in records(stream):
        if op == INIT:
            out[at + SETTING_MAX_SWEEPS] = sweeps
            out[at + SETTING_TOLERANCE] = -1.0  # below any residual
    return out


def first_steps(stream: np.ndarray, steps: int) -> np.ndarray:
    """The stream, each segment cut after an even share of `steps` solutions in all."""
    found = records(stream)
    share = -(-steps // max(1, sum(op == INIT for op, _, _ in found)))
    keep, solved = [], 0
    for op, at, length in found:
        solved = 0 if op == INIT else solved
        if solved < share:
            keep.append(stream[at - 2 : at + length])
        solved += op == SOLVE
    return np.concatenate(keep)


def replay(image: Image, stream: np.ndarray, folder: Path, limit_s: float = 900.0) -> tuple[Replay, Replay]:
    """The stream through the ECU and through the host: (ecu, host).

    Raises
    ------
    ToolError
        A program ended with an error, or took longer than limit_s.
    """
    return (
        _replay([*QEMU, str(image.elf)], stream, folder / "on_ecu", limit_s),
        _replay([str(image.host)], stream, folder / "on_host", limit_s),
    )


def _replay(command: list[str], stream: np.ndarray, folder: Path, limit_s: float) -> Replay:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stream.bin").write_bytes(stream.astype("<f4").tobytes())
    result = folder / "result.bin"
    result.unlink(missing_ok=True)
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired as err:
        raise ToolError(f"{command[0]}: not finished after {limit_s:.0f} s: fewer steps, or a machine less busy") from err
    if done.returncode != 0:
        why = EXIT.get(done.returncode, f"exit status {done.returncode}")
        raise ToolError(f"{Path(command[0]).name}: {why}\n{(done.stdout + done.stderr).strip()}")
    data = result.read_bytes()
    first = np.frombuffer(data, FIRST, 1)[0]
    if first["magic"] != MAGIC or first["real_bytes"] != 4 or (len(data) - FIRST.itemsize) % ANSWER.itemsize:
        raise ToolError(f"{result}: not an answer of this bench's float build")
    answers = np.frombuffer(data, ANSWER, offset=FIRST.itemsize)
    loops = [round(int(first[name]) * INSTRUCTIONS_PER_TICK) for name in ("loop_1k", "loop_3k")]
    return Replay(answers, int(first["state"]), (loops[1] - loops[0]) / 2000)


def differing_steps(ecu: Replay, host: Replay) -> int:
    """Steps whose answers differ in any bit (counters aside); all of them where the numbers of steps differ."""
    if len(ecu.answers) != len(host.answers):
        return max(len(ecu.answers), len(host.answers))
    same = [name for name in ANSWER.names or () if name not in COUNTED]
    equal = np.ones(len(ecu.answers), dtype=bool)
    for name in same:
        a, b = (np.ascontiguousarray(run.answers[name]).view("<u4").reshape(len(equal), -1) for run in (ecu, host))
        equal &= (a == b).all(axis=1)
    return int((~equal).sum())
