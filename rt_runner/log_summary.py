"""What is in a log, in figures: counts, rates, gaps, damage. Text is made of it elsewhere."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rt_runner.e2e import COUNTER_MASK, E2eStatus
from rt_runner.log_reader import LogReader
from rt_runner.result import ResultAccumulator, RunFacts

RATE_TOLERANCE = 0.05  # a period further off its cycle than this is pointed out
MIN_PERIODS = 5  # ... once there are this many periods to judge


@dataclass
class MessageSummary:
    """One message of the DBC over a whole log. Times in ms; None where there are too few frames."""

    name: str
    can_id: str
    sender: str
    cycle_ms: float  # of the DBC; for frames sent per job the period of the loop, where the log says it
    per_job: bool
    simulation_only: bool
    timeout_ms: float = 0.0  # of the DBC, or three periods of the loop where that is longer; 0 where unknown
    frames: int = 0
    mean_ms: float | None = None
    min_ms: float | None = None
    max_ms: float | None = None
    counter_gaps: int = 0  # places where the counter jumped
    lost: int = 0  # frames missing there, modulo 16
    repeated: int = 0
    wrong_sequence: int = 0
    wrong_crc: int = 0

    @property
    def timed_out(self) -> bool:
        """Whether it was silent at least once for longer than a receiver waits."""
        return self.max_ms is not None and 0.0 < self.timeout_ms < self.max_ms

    @property
    def rate_ok(self) -> bool | None:
        """Whether the mean period is that of the DBC; None where it cannot be judged.

        The shortest and the longest period are left out: last words at the end of a run, one frame lost.
        """
        if self.mean_ms is None or self.min_ms is None or self.max_ms is None or self.frames <= MIN_PERIODS:
            return None
        periods = self.frames - 1
        mean_ms = (self.mean_ms * periods - self.min_ms - self.max_ms) / (periods - 2)
        return abs(mean_ms - self.cycle_ms) <= RATE_TOLERANCE * self.cycle_ms


@dataclass
class LogSummary:
    """A whole log."""

    path: str
    bytes: int
    complete: bool
    trouble: list[str]
    frames: int = 0
    unknown: dict[str, int] = field(default_factory=dict)  # ids that are not in the DBC, with their counts
    start_ns: int | None = None
    end_ns: int | None = None
    messages: list[MessageSummary] = field(default_factory=list)
    attachments: dict[str, int] = field(default_factory=dict)  # name -> bytes
    run: dict[str, str] = field(default_factory=dict)
    result: dict[str, Any] | None = None
    differences: list[str] | None = None  # where the result, recomputed from the frames, is another; None: no result

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return 0.0 if self.start_ns is None or self.end_ns is None else (self.end_ns - self.start_ns) / 1e9


@dataclass
class _Running:
    """Figures of one message while its frames pass by."""

    summary: MessageSummary
    first_ns: int = 0
    last_ns: int = 0
    counter: int | None = None

    def add(self, t_ns: int, counter: float | None, e2e: int) -> None:
        s = self.summary
        if s.frames:
            gap_ms = (t_ns - self.last_ns) / 1e6
            s.min_ms = gap_ms if s.min_ms is None else min(s.min_ms, gap_ms)
            s.max_ms = gap_ms if s.max_ms is None else max(s.max_ms, gap_ms)
            s.mean_ms = (t_ns - self.first_ns) / 1e6 / s.frames
        else:
            self.first_ns = t_ns
        s.frames += 1
        self.last_ns = t_ns
        s.repeated += e2e == E2eStatus.REPEATED
        s.wrong_sequence += e2e == E2eStatus.WRONG_SEQUENCE
        s.wrong_crc += e2e == E2eStatus.WRONG_CRC
        if counter is None:
            return
        if self.counter is not None and e2e != E2eStatus.REPEATED:
            missing = (int(counter) - self.counter - 1) & COUNTER_MASK
            s.lost += missing
            s.counter_gaps += missing > 0
        self.counter = int(counter)


def summarise(path: str | Path) -> LogSummary:
    """Read a log, finished or not, and say what is in it.

    Raises
    ------
    LogError : no such file, or not an MCAP file (one line)
    """
    reader = LogReader(path)
    running = {name: _Running(m) for name, m in _messages(reader).items()}
    summary = LogSummary(str(path), reader.size, reader.complete, reader.trouble)
    accumulator = ResultAccumulator()
    for frame in reader.frames():
        accumulator.feed(frame.t_ns, frame.name, frame.values, frame.e2e)
        one = running.get(frame.name)
        if one is not None:
            one.add(frame.t_ns, frame.values.get("counter"), frame.e2e)
    known = {int(r.summary.can_id, 16) for r in running.values()}
    for raw in reader.raw():
        summary.frames += 1
        summary.start_ns = raw.t_ns if summary.start_ns is None else min(summary.start_ns, raw.t_ns)
        summary.end_ns = raw.t_ns if summary.end_ns is None else max(summary.end_ns, raw.t_ns)
        if raw.can_id not in known:
            key = f"0x{raw.can_id:03X}"
            summary.unknown[key] = summary.unknown.get(key, 0) + 1
    summary.messages = [r.summary for r in running.values()]
    summary.attachments = {name: len(data) for name, data in reader.attachments.items()}
    summary.run = reader.metadata.get("run", {})
    summary.result = result_of(reader.metadata)
    facts = _facts(reader.metadata)
    if summary.result is not None and facts is not None:
        summary.differences = _differences(summary.result, json.loads(json.dumps(accumulator.result(facts))))
    return summary


def _facts(metadata: Mapping[str, Mapping[str, str]]) -> RunFacts | None:
    try:
        return RunFacts.from_dict(json.loads(metadata["facts"]["json"]))
    except (KeyError, ValueError, TypeError, AttributeError):
        return None


def _differences(stored: Any, again: Any, where: str = "") -> list[str]:
    """Names of the figures that differ, as ``a.b.c``."""
    if isinstance(stored, dict) and isinstance(again, dict):
        names = [k for k in again if k in stored]  # what another version of the runner adds is no difference
        return [d for k in names for d in _differences(stored[k], again[k], f"{where}.{k}" if where else k)]
    return [] if stored == again else [where]


def result_of(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, Any] | None:
    """The result as the run wrote it, None if it did not get that far."""
    try:
        result = json.loads(metadata["result"]["json"])
    except (KeyError, ValueError):
        return None
    return result if isinstance(result, dict) else None


def _messages(reader: LogReader) -> dict[str, MessageSummary]:
    """One entry per channel of decoded frames, as the log itself describes it; no DBC is needed."""
    period_ms = _float(reader.metadata.get("run", {}).get("period_s"))
    out = {}
    for name, about in reader.channels().items():
        per_job = about.get("per_job") == "1"
        cycle_ms = _float(about.get("cycle_ms")) or 0.0
        if per_job and period_ms:
            cycle_ms = 1e3 * period_ms
        out[name] = MessageSummary(
            name=name,
            can_id=about.get("can_id", "0x0"),
            sender=about.get("sender", ""),
            cycle_ms=cycle_ms,
            per_job=per_job,
            simulation_only=about.get("simulation_only") == "1",
            timeout_ms=max(_float(about.get("timeout_ms")) or 0.0, 3 * cycle_ms if per_job else 0.0),
        )
    return out


def _float(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
