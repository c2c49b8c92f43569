"""Cycle check: how often each cyclic message really came, against what the DBC says. For any DBC, for any log.

A row is made of nothing but receive stamps. Times are integer nanoseconds inside and milliseconds in the rows. What a
message promises is its ``GenMsgCycleTime``; how long a receiver waits for it is its ``HilTimeoutMs``, and three cycles
where the DBC has no such attribute. A message that is sent once per job (``HilPerJob``) has the period of its loop.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from cantools.database.can import Database, Message

NS_PER_MS = 1_000_000
TIMEOUT_CYCLES = 3  # where the DBC does not say how long a receiver waits
END_GRACE_S = 1.0  # a run is not ended at one moment: its nodes may stop so long before its log does
TRIM_FROM = 5  # from so many periods on the typical one is their mean without the shortest and the longest


@dataclass(frozen=True)
class Expected:
    """What the DBC says about one cyclic message. ``extended`` tells 29-bit ids from 11-bit ones."""

    name: str
    frame_id: int
    sender: str
    cycle_ms: float
    timeout_ms: float
    per_job: bool = False
    extended: bool = False

    @property
    def key(self) -> tuple[int, bool]:
        """What tells its frames from others."""
        return self.frame_id, self.extended


@dataclass(frozen=True)
class CycleRow:
    """One message over one log. Times between neighbouring frames in ms, None where there are too few frames.

    ``typical_ms`` is the mean without the shortest and the longest period, of fewer than five periods the upper median:
    last words at the end of a run and one interruption do not change a rate. ``longest_ms`` counts the silences at both
    ends, too: from its node's first frame on, and up to its node's last one, or the log's end less a second.
    ``longest_from_ns`` is the stamp it began at. ``missing`` is how many cycles passed without a frame, ``timeouts``
    how often it was silent for longer than ``timeout_ms``; a message that never came although its node spoke for long
    enough timed out once.
    """

    name: str
    frame_id: int
    sender: str
    per_job: bool
    cycle_ms: float
    timeout_ms: float
    frames: int
    mean_ms: float | None
    typical_ms: float | None
    min_ms: float | None
    max_ms: float | None
    std_ms: float | None
    missing: int
    timeouts: int
    longest_ms: float | None
    longest_from_ns: int | None

    def rate_ok(self, tolerance: float) -> bool | None:
        """Whether its typical period is its cycle, within this share of it; None where no period was seen."""
        if self.typical_ms is None:
            return None
        return abs(self.typical_ms - self.cycle_ms) <= tolerance * self.cycle_ms


def expected_cycles(
    database: Database, node: str | None = None, job_period_s: float | None = None
) -> tuple[Expected, ...]:
    """Every message of a DBC that has a cycle time; those of one node, if it is named.

    Parameters
    ----------
    database : as cantools loads it; ``Dbc.database`` for ours
    node : a sender; an unknown one gives an empty tuple
    job_period_s : period of the loop, for messages that are sent once per job; None takes their cycle time
    """
    found = []
    for message in database.messages:
        cycle_ms = float(message.cycle_time or 0)
        sender = message.senders[0] if message.senders else ""
        if cycle_ms <= 0 or (node is not None and node not in message.senders):
            continue
        per_job = bool(_attribute(message, "HilPerJob"))
        timeout_ms = float(_attribute(message, "HilTimeoutMs"))
        if per_job and job_period_s:
            cycle_ms = 1e3 * job_period_s
            timeout_ms = max(timeout_ms, TIMEOUT_CYCLES * cycle_ms)
        found.append(
            Expected(
                message.name,
                message.frame_id,
                node or sender,
                cycle_ms,
                timeout_ms if timeout_ms > 0 else TIMEOUT_CYCLES * cycle_ms,
                per_job,
                bool(message.is_extended_frame),
            )
        )
    return tuple(found)


def _attribute(message: Message, name: str) -> int:
    """An integer attribute; 0 where the DBC has none of that name."""
    attributes = message.dbc.attributes if message.dbc is not None else {}
    return int(attributes[name].value) if name in attributes else 0


class CycleCheck:
    """Takes every frame of a log, one after the other, and gives the rows. Memory does not grow with the log.

    Parameters
    ----------
    expected : the messages to watch; frames of others only tell how long the log is
    """

    def __init__(self, expected: Iterable[Expected]) -> None:
        self._meters = {e.key: _Meter(e) for e in expected}
        self._first_ns: int | None = None
        self._last_ns: int | None = None

    def add(self, t_ns: int, frame_id: int, extended: bool = False) -> None:
        """One frame, received at ``t_ns``; 1 to 2 us."""
        if self._last_ns is None:
            self._first_ns = self._last_ns = t_ns
        elif t_ns > self._last_ns:
            self._last_ns = t_ns
        meter = self._meters.get((frame_id, extended))
        if meter is not None:
            meter.add(t_ns)

    @property
    def span_s(self) -> float:
        """From the first frame of the log to the last."""
        return 0.0 if self._first_ns is None or self._last_ns is None else (self._last_ns - self._first_ns) / 1e9

    def rows(self, end_grace_s: float = END_GRACE_S) -> list[CycleRow]:
        """One row per message, in DBC order; ``end_grace_s`` of silence up to the log's end are forgiven."""
        spoke: dict[str, tuple[int, int]] = {}
        for meter in self._meters.values():
            if meter.frames:
                first, last = spoke.get(meter.expected.sender, (meter.first_ns, meter.last_ns))
                spoke[meter.expected.sender] = min(first, meter.first_ns), max(last, meter.last_ns)
        end_ns = None if self._last_ns is None else self._last_ns - round(end_grace_s * 1e9)
        return [m.row(spoke.get(m.expected.sender), end_ns) for m in self._meters.values()]


def cycle_rows(
    stamps_ns: Mapping[int, Sequence[int]], expected: Iterable[Expected], end_grace_s: float = END_GRACE_S
) -> list[CycleRow]:
    """Rows from the receive stamps of each 11-bit id, ascending: `CycleCheck` for who has them all at hand."""
    check = CycleCheck(expected)
    for frame_id, stamps in stamps_ns.items():
        for t_ns in stamps:
            check.add(t_ns, frame_id)
    return check.rows(end_grace_s)


class _Meter:
    """Running figures of one message."""

    __slots__ = (
        "_cycle_ns", "_early", "_m2", "_mean", "_timeout_ns", "expected", "first_ns", "frames", "last_ns",
        "longest_from_ns", "longest_ns", "max_ns", "min_ns", "missing", "timeouts",
    )  # fmt: skip

    def __init__(self, expected: Expected) -> None:
        self.expected = expected
        self._cycle_ns = round(expected.cycle_ms * NS_PER_MS)
        self._timeout_ns = round(expected.timeout_ms * NS_PER_MS)
        self.frames = self.missing = self.timeouts = 0
        self.first_ns = self.last_ns = self.min_ns = self.max_ns = 0
        self.longest_ns, self.longest_from_ns = -1, 0
        self._mean = self._m2 = 0.0
        self._early: list[int] = []  # the first periods, until there are enough for a mean

    def add(self, t_ns: int) -> None:
        n = self.frames
        self.frames = n + 1
        if n == 0:
            self.first_ns = self.last_ns = t_ns
            return
        before, period = self.last_ns, t_ns - self.last_ns
        self.last_ns = t_ns
        if n == 1 or period < self.min_ns:
            self.min_ns = period
        if n == 1 or period > self.max_ns:
            self.max_ns = period
        if n < TRIM_FROM:
            self._early.append(period)
        delta = period - self._mean
        self._mean += delta / n
        self._m2 += delta * (period - self._mean)
        self._silent(before, period)

    def _silent(self, from_ns: int, for_ns: int) -> None:
        if for_ns > self.longest_ns:
            self.longest_ns, self.longest_from_ns = for_ns, from_ns
        if 2 * for_ns > 3 * self._cycle_ns:
            self.missing += (2 * for_ns + self._cycle_ns) // (2 * self._cycle_ns) - 1
            self.timeouts += for_ns > self._timeout_ns

    def row(self, node_spoke: tuple[int, int] | None, end_ns: int | None) -> CycleRow:
        """The row; ``node_spoke`` the first and last stamp of its node, ``end_ns`` the log's end less the grace."""
        missing, timeouts, longest_ns, from_ns = self.missing, self.timeouts, self.longest_ns, self.longest_from_ns
        for start_ns, until_ns in self._ends(node_spoke, end_ns):
            silent_ns = until_ns - start_ns
            if silent_ns > self._timeout_ns:  # shorter ones are how nodes start and stop
                timeouts += 1
                missing += silent_ns // self._cycle_ns
                if silent_ns > longest_ns:
                    longest_ns, from_ns = silent_ns, start_ns
        e, periods = self.expected, self.frames - 1
        mean_ns = (self.last_ns - self.first_ns) / periods if periods > 0 else None
        typical_ns = sorted(self._early)[len(self._early) // 2] if periods > 0 else None
        if periods >= TRIM_FROM:
            typical_ns = (self.last_ns - self.first_ns - self.min_ns - self.max_ns) / (periods - 2)
        return CycleRow(
            name=e.name,
            frame_id=e.frame_id,
            sender=e.sender,
            per_job=e.per_job,
            cycle_ms=e.cycle_ms,
            timeout_ms=e.timeout_ms,
            frames=self.frames,
            mean_ms=_ms(mean_ns),
            typical_ms=_ms(typical_ns),
            min_ms=_ms(self.min_ns) if periods > 0 else None,
            max_ms=_ms(self.max_ns) if periods > 0 else None,
            std_ms=_ms(math.sqrt(self._m2 / (periods - 1))) if periods > 1 else None,
            missing=missing,
            timeouts=timeouts,
            longest_ms=_ms(longest_ns) if longest_ns >= 0 else None,
            longest_from_ns=from_ns if longest_ns >= 0 else None,
        )

    def _ends(self, node_spoke: tuple[int, int] | None, end_ns: int | None) -> list[tuple[int, int]]:
        """The silences that no pair of frames bounds."""
        if node_spoke is None:
            return []  # nothing of this node: it did not take part, or all of its messages say so by their 0 frames
        until_ns = max(node_spoke[1], node_spoke[1] if end_ns is None else end_ns)
        if not self.frames:
            return [(node_spoke[0], until_ns)]
        return [(node_spoke[0], self.first_ns), (self.last_ns, until_ns)]


def _ms(ns: float | None) -> float | None:
    return None if ns is None else ns / NS_PER_MS
