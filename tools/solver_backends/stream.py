"""Recorded drives as a stream of MHE calls (stream.h): what the estimator asked, for any solver to answer again."""

from __future__ import annotations

import ctypes as ct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant_sim.faults import load_catalogue, parse_fault
from tools.compare_drives import Lap, drive_lap, sense
from tools.libest import Estimator, Lib, compile_library

Array = NDArray[np.float64]
INIT, START, ADVANCE, ARRIVAL, MEASURE, FORGET, SHIFT, WEIGH, SOLVE = range(1, 10)  # stream.h
WRAPPED = ("init", "start", "advance", "arrival", "measure", "forget", "shift", "weigh", "solve")
ROWS_PER_S = 10
HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Situation:
    """A stretch of the lap under one setting of the estimator.

    Attributes
    ----------
    name : str
        Of the segment, unique.
    kind : str
        Group in the table: nominal, faults, bounds, quadratic.
    begin_s, end_s : float
        Stretch of the lap; end_s may lie behind its end. The estimator starts afresh at begin_s.
    faults : tuple of str
        Of the winding's sensor, as in `plant_sim.faults`.
    setting, changes
        Compiled-in setting and the fields replaced in it.
    """

    name: str
    kind: str
    begin_s: float
    end_s: float
    seed: int = 0
    faults: tuple[str, ...] = ()
    setting: str = "default"
    changes: dict[str, Any] = field(default_factory=dict)


def situations() -> tuple[Situation, ...]:
    """All of them, more than 20 000 steps. Faults begin 10 s after their segment, where the lap is hottest."""

    def fault(name: str, *texts: str) -> Situation:
        return Situation(f"fault {name}", "faults", 420.0, 520.0, 0, texts)

    both = tuple(str(f) for f in load_catalogue()["F10"]["paper"])
    return (
        Situation("lap, seed 0", "nominal", 0.0, 3600.0, 0),
        Situation("lap, seed 1", "nominal", 0.0, 3600.0, 1),
        fault("offset", "offset:-20@430-490"),
        fault("noise", "noise:5@430-520"),
        fault("stuck", "stuck@430-490"),
        fault("dropout", "dropout:nan@430-460"),
        fault("spike", "spike:2%@430-520"),
        fault("drift", "drift:-0.05@430-520"),
        fault("slow", "slow:15@430-520"),
        fault("combined", *both),
        fault("rotor noise", "noise:5@430-520/r"),
        Situation("paper, hard box", "bounds", 380.0, 530.0, 0, setting="paper"),
        Situation("hard box met", "bounds", 420.0, 520.0, 0, changes={"hard_bounds": True, "upper_degc": 150.0}),
        Situation("soft bound met", "bounds", 420.0, 520.0, 0, changes={"upper_degc": 145.0, "bound_weight": 300.0}),
        Situation("quadratic loss", "quadratic", 380.0, 530.0, 0, changes={"loss": 0}),
        Situation("Huber loss", "nominal", 480.0, 530.0, 0, ("spike:2%@490-530",), changes={"loss": 1}),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Segment:
    """One situation's calls: records as in stream.h, and where each step begins; steps end with SOLVE."""

    situation: Situation
    data: Array
    begins: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.begins)

    def head(self, steps: int) -> Segment:
        """Its first steps."""
        if steps >= len(self):
            return self
        return Segment(self.situation, self.data[: self.begins[steps]], self.begins[:steps])


class Recorder:
    """The estimator's library with its calls to the MHE tapped."""

    def __init__(self, weights: Path) -> None:
        wraps = ",".join(f"--wrap=mhe_{name}" for name in WRAPPED)
        self._lib = Lib(compile_library(weights, ("-O2", f"-Wl,{wraps}", str(HERE / "recorder.c"))))
        self._lib.c.net_select.restype = ct.c_char_p
        if self._lib.c.net_select(b"portable") is None:  # the same bytes on every machine
            raise ValueError(f"{weights}: the generated net has no portable kernel")
        self._lib.c.recorder_take.restype = ct.c_size_t

    def record(self, situation: Situation, lap: Lap) -> Segment:
        """Drive the stretch; the same bytes every time."""
        drive = sense(lap, situation.seed, [parse_fault(text) for text in situation.faults])
        first, last = round(situation.begin_s * ROWS_PER_S), round(situation.end_s * ROWS_PER_S)
        part = drive.cut(first, min(last, len(drive)))
        estimator = Estimator(self._lib, self._lib.setting(situation.setting, **situation.changes))
        if estimator.error != 0:
            raise ValueError(f"{situation.name}: the estimator refuses the setting (error {estimator.error})")
        estimator.run(part.torque_nm, part.speed_rpm, part.y, part.first_tick, part.coolant_degc, part.soaked)
        at = ct.POINTER(ct.c_double)()
        length = self._lib.c.recorder_take(ct.byref(at))
        data = np.ctypeslib.as_array(at, (length,)).copy()
        begins, begin, end = [], 0, 0
        for place, op, size in records(data):
            if op == SOLVE:
                begins.append(begin)
                begin = end = place + 2 + size
        return Segment(situation, data[:end], np.array(begins, dtype=np.int64))


def records(data: Array) -> Iterator[tuple[int, int, int]]:
    """(place, op, payload length) of each record."""
    place = 0
    while place < len(data):
        yield place, int(data[place]), int(data[place + 1])
        place += 2 + int(data[place + 1])


def record_all(
    weights: Path, say: Callable[[str], None] = lambda _: None, chosen: Sequence[Situation] | None = None
) -> list[Segment]:
    """Every situation recorded, in order."""
    recorder, lap = Recorder(weights), drive_lap()
    segments = []
    for situation in situations() if chosen is None else chosen:
        segments.append(recorder.record(situation, lap))
        say(f"{situation.name}: {len(segments[-1])} steps")
    return segments


def shortened(segments: Sequence[Segment], steps: int) -> list[Segment]:
    """About `steps` steps in all: every segment cut to the same length, shorter ones whole."""
    length = steps // len(segments)
    while sum(min(length, len(s)) for s in segments) < min(steps, sum(len(s) for s in segments)):
        length += 1
    return [segment.head(length) for segment in segments]
