"""Our own MCAP logs as drives: true temperatures against the mean speed and torque of each 0.1 s.

Interval k is what happened in ticks 10k+1 .. 10k+10; its temperatures are those of tick 10k.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rt_runner.errors import RtError
from rt_runner.mcap_log import LogReader
from tools.resample import Drive
from tools.rows import DT_S, DataError

TICK_S = 0.01
PER_ROW = 10
LEAST_FRAMES = 8  # of the ten of an interval: the mean of so many still stands for all
TICK_MODULUS = 1 << 16
RESTART_TICKS = 100  # ticks and receive times drift apart by this much only when the plant was started anew


@dataclass
class _Part:
    """Frames between two starts of the plant, by unwrapped tick."""

    motor: dict[int, tuple[float, float]] = field(default_factory=dict)
    truth: dict[int, tuple[float, float]] = field(default_factory=dict)


def read_log_drives(path: Path) -> list[Drive]:
    """Drives of a log, finished or not; frames lost or damaged leave their interval out.

    Raises
    ------
    DataError
        No log, or it holds no true temperatures.
    """
    try:
        parts = _parts(LogReader(path))
    except RtError as error:
        raise DataError(str(error)) from error
    if not any(part.truth for part in parts):
        raise DataError(f"{path}: holds no frame TruthTemp, so no true temperatures; log a run of the simulated plant")
    drives = [drive for part in parts if (drive := _drive(part)) is not None]
    if not drives:
        raise DataError(f"{path}: no interval with both MotorState and TruthTemp frames; log both")
    return drives


def _parts(log: LogReader) -> list[_Part]:
    parts: list[_Part] = []
    last_tick = last_ns = 0
    for frame in log.frames(("MotorState", "TruthTemp")):
        tick = frame.values.get("tick")
        names = (
            ("speed_rpm", "torque_nm") if frame.name == "MotorState" else ("theta_w_true_degc", "theta_r_true_degc")
        )
        pair = tuple(frame.values.get(name) for name in names)
        if tick is None or pair[0] is None or pair[1] is None:
            continue
        expected = last_tick + round((frame.t_ns - last_ns) * 1e-9 / TICK_S)
        now = expected + (int(tick) - expected + TICK_MODULUS // 2) % TICK_MODULUS - TICK_MODULUS // 2
        if not parts or abs(now - expected) > RESTART_TICKS:
            parts.append(_Part())
            now = int(tick)
        last_tick, last_ns = now, frame.t_ns
        target = parts[-1].motor if frame.name == "MotorState" else parts[-1].truth
        target[now] = (pair[0], pair[1])
    return parts


def _drive(part: _Part) -> Drive | None:
    rows = []
    for tick, theta in sorted(part.truth.items()):
        inputs = [part.motor[i] for i in range(tick + 1, tick + PER_ROW + 1) if i in part.motor]
        if tick % PER_ROW == 0 and len(inputs) >= LEAST_FRAMES:
            rows.append((tick // PER_ROW * DT_S, *np.mean(inputs, axis=0), *theta))
    if not rows:
        return None
    table = np.array(rows)
    return Drive(table[:, 0] - table[0, 0], table[:, 1:])
