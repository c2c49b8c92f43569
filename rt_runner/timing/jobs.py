"""The jobs of one real-time process, put together from the frames it sent about each of them.

A process sends its frames of a job one after the other in the order of their ids, each once, so within a job all of
them carry the same E2E counter. That is how they find together again although frames may be missing.
"""

import heapq
import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from rt_runner.e2e import E2eStatus
from rt_runner.result import CAUSES, RELEASE_BITS, Unwrapper
from rt_runner.timing.columns import NO_COUNTER, Column, LogColumns

NO_NS = -(1 << 63)  # in integer columns: not available
OUTPUTS = ("computed", "held", "predicted", "invalid")
TIMING_SIGNALS = {
    "A": ("release_index", "wake_lat_us", "miss_late", "warmup", "stale_input", "after_skip"),
    "B": ("miss_cause", "exec_wall_us", "resp_us"),
    "C": ("output", "cut", "queued"),
    "D": ("exec_cpu_us", "canary_us"),
}
CEILING_NS = 1_677_721_400  # largest time a frame can carry; what is longer is sent as this


@dataclass(frozen=True)
class Process:
    """Which frames tell of a process: ``prefix`` + TimingA to D per job, ``prefix`` + Releases … once a second.

    ``life`` counts from 1 the lives of a process that was started again; the last one, or the only one, has 0.
    """

    prefix: str
    sender: str
    life: int = 0

    @property
    def name(self) -> str:
        """In results: ``controller``; of an earlier life ``controller_1``."""
        return self.sender.lower() + (f"_{self.life}" if self.life else "")

    @property
    def final(self) -> str | None:
        """Attachment with its last words; who was killed has none."""
        return None if self.life else f"{self.sender.lower()}_final.json"


@dataclass
class Jobs:
    """One element per job in every column, in the order they ran; times in integer ns, `NO_NS` where not available.

    ``position[message][k]`` is where job k's frame stands in the message's column, -1 where it is missing. ``release``
    is the unwrapped release index, -1 where the frame that says so is missing.
    """

    process: Process
    messages: list[str]
    position: dict[str, array]
    release: array
    flags: dict[str, bytearray] = field(default_factory=dict)  # late, warmup, stale, after_skip, cut, queued: 0 or 1
    cause: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)
    times: dict[str, array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.release)

    def has(self, name: str) -> bool:
        """Whether any job has this time."""
        return any(v != NO_NS for v in self.times[name]) if name in self.times else False


def processes(log: LogColumns) -> list[Process]:
    """The real-time processes of a log, known by their timing frames; those that sent none are left out."""
    found = []
    for name, column in log.columns.items():
        if name.endswith("TimingA") and len(column):
            found.append(Process(name.removesuffix("TimingA"), column.sender))
    return found


def wanted_signals(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Signals that `collect` needs, of the messages named."""
    return {n: TIMING_SIGNALS[n[-1]] for n in names if n[:-1].endswith("Timing") and n[-1] in TIMING_SIGNALS}


def collect(log: LogColumns, process: Process) -> Jobs:
    """Put the jobs of a process together."""
    columns = [c for c in log.sent_by(process.sender) if c.per_job]
    position = _in_step(columns) or _by_order(columns)
    jobs = Jobs(process, [c.name for c in columns], position, array("q"))
    count = len(next(iter(position.values()))) if position else 0
    a, b, c, d = (_picker(log, position, f"{process.prefix}Timing{x}", count) for x in "ABCD")
    unwrap = Unwrapper(RELEASE_BITS)
    jobs.release = array("q", [-1 if r != r else unwrap(r) for r in a("release_index")])
    jobs.flags = {
        name: _flag(pick(signal))
        for name, pick, signal in (
            ("late", a, "miss_late"), ("warmup", a, "warmup"), ("stale", a, "stale_input"),
            ("after_skip", a, "after_skip"), ("cut", c, "cut"), ("queued", c, "queued"),
        )
    }  # fmt: skip
    jobs.cause = bytearray(int(v) if v == v and v < len(CAUSES) else 0 for v in b("miss_cause"))
    jobs.output = bytearray(int(v) if v == v else 0 for v in c("output"))
    jobs.times = {
        "wake_lat": _ns(a("wake_lat_us")),
        "exec_wall": _ns(b("exec_wall_us")),
        "exec_cpu": _ns(d("exec_cpu_us")),
        "resp": _ns(b("resp_us")),
        "canary": _ns(d("canary_us")),
    }
    for signal in log[f"{process.prefix}TimingC"].signals:
        if signal.startswith("in_age_"):
            jobs.times[signal.removesuffix("_us")] = _ns(c(signal))
    return jobs


def _in_step(columns: list[Column]) -> dict[str, array] | None:
    """The usual case: every message has a frame of every job. None where it is not so."""
    if not columns:
        return {}
    first = columns[0]
    for c in columns:
        if c.counter != first.counter or any(c.e2e):
            return None
    if any((now - before) % 16 != 1 for before, now in zip(first.counter, first.counter[1:], strict=False)):
        return None
    return {c.name: array("q", range(len(c))) for c in columns}


def _by_order(columns: list[Column]) -> dict[str, array]:
    """Frame by frame: a job's frames have one counter and come in the order of their ids, each once."""
    position = {c.name: array("q") for c in columns}
    lists = list(position.values())
    rank_before, counter_before = len(columns), NO_COUNTER
    for _, rank, i in heapq.merge(*(_frames(rank, c) for rank, c in enumerate(columns))):
        column = columns[rank]
        state, counter = column.e2e[i], column.counter[i]
        if state == E2eStatus.REPEATED:
            continue  # the same frame once more
        if state == E2eStatus.WRONG_CRC:
            counter = counter_before  # says nothing: taken to be where it stands
        if rank <= rank_before or counter != counter_before:
            for places in lists:
                places.append(-1)
            counter_before = column.counter[i]
        rank_before = rank
        if state != E2eStatus.WRONG_CRC:
            lists[rank][-1] = i
            counter_before = counter
    return position


def _frames(rank: int, column: Column) -> Iterator[tuple[int, int, int]]:
    return ((order, rank, i) for i, order in enumerate(column.order))


def _picker(log: LogColumns, position: dict[str, array], name: str, count: int):
    """Values of a message's signals, one per job; NaN where the frame is missing."""
    column, places = log[name], position.get(name)

    def pick(signal: str) -> Sequence[float]:
        values = column.signals.get(signal)
        if values is None or places is None:
            return array("d", [math.nan]) * count
        if len(places) == len(values) and -1 not in places:
            return values  # nothing missing
        return array("d", [math.nan if p < 0 else values[p] for p in places])

    return pick


def _flag(values: Sequence[float]) -> bytearray:
    return bytearray(v == 1 for v in values)


def _ns(values_us: Sequence[float]) -> array:
    """Microseconds of a frame, a multiple of 0.1, as the integer nanoseconds they were made of."""
    return array("q", [NO_NS if v != v else round(v * 10) * 100 for v in values_us])
