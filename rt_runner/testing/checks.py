"""Assertions about a log: every cyclic message of a node at its cycle time, none silent for too long.

They take any log and any DBC with cycle times, say everything that is wrong in one `AssertionError`, and give the rows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from rt_runner.errors import UsageError
from rt_runner.timing.cycles import CycleCheck, CycleRow, expected_cycles

if TYPE_CHECKING:
    import can
    from cantools.database.can import Database

    from rt_runner.dbc import Dbc
    from rt_runner.log_reader import RawFrame

    Log = str | PathLike[str] | Iterable[can.Message]
    AnyDbc = str | PathLike[str] | Dbc | Database

ENOUGH_CYCLES = 3  # a log this many cycles long has at least two frames of a message
_A_DATE_NS = 10**17  # lock-step logs start at 0, not on a date


def assert_cycle_times(
    log: Log,
    dbc: AnyDbc,
    node: str | None = None,
    tolerance: float = 0.05,
    max_gap: float | None = None,
    job_period_s: float | None = None,
    ignore: Collection[str] = (),
) -> list[CycleRow]:
    """Every cyclic message came as often as its DBC says.

    Parameters
    ----------
    log : a log file (.mcap, candump .log, .asc, .blf, …), or ``can.Message`` objects
    dbc : the DBC: a file, a cantools database, or ``run.dbc``
    node : all messages of this sender, which must have spoken; None: those of every node that did
    tolerance : how far the typical period may be off its cycle, as a share of it
    max_gap : the longest period allowed, in cycles; None: only the rate is judged
    job_period_s : period of the loop whose messages are sent per job; None: what the log says, else their cycle time
    ignore : names of messages that are not judged

    Returns
    -------
    list of CycleRow
        One per message that was judged.

    Raises
    ------
    AssertionError
        Names each message, what was expected, what was measured, and its longest gap with its stamp.
    """
    __tracebackhide__ = True
    found = _Found(log, dbc, node, job_period_s, ignore)
    wrong = []
    for row in found.rows:
        too_few = row.frames < 2 and found.span_s * 1e3 >= ENOUGH_CYCLES * row.cycle_ms
        too_long = max_gap is not None and row.max_ms is not None and row.max_ms > max_gap * row.cycle_ms
        if too_few or too_long or row.rate_ok(tolerance) is False:
            wrong.append(f"  {_name(row)}: every {row.cycle_ms:g} ms expected, {found.measured(row)}")
    if wrong:
        limits = f"tolerance {tolerance:.3g}" + ("" if max_gap is None else f", longest gap {max_gap:g} cycles")
        head = f"{len(wrong)} of {len(found.rows)} cyclic messages{found.of_node} are off their cycle time ({limits})"
        raise AssertionError("\n".join([f"{head} in {found.name}:", *wrong]))
    return found.rows


def assert_no_timeouts(
    log: Log,
    dbc: AnyDbc,
    node: str | None = None,
    job_period_s: float | None = None,
    ignore: Collection[str] = (),
) -> list[CycleRow]:
    """No cyclic message was silent for longer than its receivers wait, from its node's first frame to the log's end.

    How long they wait is ``HilTimeoutMs``, three cycles where the DBC has no such attribute. One second of silence at
    the log's end is forgiven: the nodes of a run do not end at one moment. Parameters as in `assert_cycle_times`.

    Raises
    ------
    AssertionError
        Names each message, how often it timed out, and its longest silence with its stamp.
    """
    __tracebackhide__ = True
    found = _Found(log, dbc, node, job_period_s, ignore)
    wrong = [
        f"  {_name(row)}: {row.timeouts} time{'s' * (row.timeouts > 1)} silent for longer than {row.timeout_ms:g} ms, "
        f"{found.longest('longest', row)}"
        for row in found.rows
        if row.timeouts
    ]
    if wrong:
        head = f"{len(wrong)} of {len(found.rows)} cyclic messages{found.of_node} timed out"
        raise AssertionError("\n".join([f"{head} in {found.name}:", *wrong]))
    return found.rows


class _Found:
    """The rows of one log, and how to speak of them."""

    def __init__(
        self, log: Log, dbc: AnyDbc, node: str | None, job_period_s: float | None, ignore: Collection[str]
    ) -> None:
        __tracebackhide__ = True
        self.name, frames, logged_period_s = _open(log)
        database = _database(dbc)
        _refuse_unknown(database, node, ignore)
        expected = expected_cycles(database, node, job_period_s or logged_period_s)
        check = CycleCheck(e for e in expected if e.name not in ignore)
        self._first_ns: int | None = None
        for frame in frames:
            if self._first_ns is None:
                self._first_ns = frame.t_ns
            check.add(frame.t_ns, frame.can_id, bool(frame.flags & 1))
        rows = check.rows()
        self.span_s = check.span_s
        self.of_node = f" of {node}" if node else ""
        spoke = {row.sender for row in rows if row.frames}
        if not spoke:
            who = f"node {node}" if node else "any node of the DBC"
            raise AssertionError(f"no cyclic message of {who} is in {self.name} ({self.span_s:.1f} s)")
        self.rows = [row for row in rows if row.sender in spoke]

    def measured(self, row: CycleRow) -> str:
        """What was seen of a message."""
        if row.frames < 2 or row.typical_ms is None:
            return f"{'came once' if row.frames else 'never came'} in {self.span_s:.1f} s"
        off = row.typical_ms / row.cycle_ms - 1
        return f"{row.typical_ms:.4g} ms measured ({off:+.1%}), {row.frames} frames; {self.longest('longest gap', row)}"

    def longest(self, what: str, row: CycleRow) -> str:
        """Its longest silence and where it began."""
        if row.longest_ms is None or row.longest_from_ns is None or self._first_ns is None:
            return f"{what} n/a"
        after_s = (row.longest_from_ns - self._first_ns) / 1e9
        text = f"{what} {row.longest_ms:.4g} ms from {after_s:.3f} s of the log on"
        if row.longest_from_ns > _A_DATE_NS:
            text += f" ({datetime.fromtimestamp(row.longest_from_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC)"
        return text


def _open(log: Log) -> tuple[str, Iterator[RawFrame], float | None]:
    """(what to call it, its frames, the period of the loop if the log says it)."""
    from rt_runner.any_log import MCAP_SUFFIX, raw_frame, raw_frames
    from rt_runner.log_reader import LogReader

    if not isinstance(log, str | PathLike):
        return "the messages given", map(raw_frame, log), None
    path = Path(log)
    if path.suffix.lower() != MCAP_SUFFIX:
        return path.name, raw_frames(path), None
    reader = LogReader(path)
    try:
        period_s = float(reader.metadata["run"]["period_s"])
    except (KeyError, ValueError):
        period_s = None
    return path.name, reader.raw(), period_s


def _database(dbc: AnyDbc) -> Database:
    import cantools
    from cantools.database.can import Database

    if not isinstance(dbc, str | PathLike):
        return getattr(dbc, "database", dbc)  # type: ignore[return-value]
    try:
        database = cantools.database.load_file(dbc)
    except Exception as e:  # cantools lets errors of many types through
        raise UsageError(f"{dbc}: not a usable DBC ({' '.join(str(e).split())})") from None
    if not isinstance(database, Database):
        raise UsageError(f"{dbc}: describes no CAN messages; give a DBC")
    return database


def _refuse_unknown(database: Database, node: str | None, ignore: Collection[str]) -> None:
    """A name that is spelled wrong must not judge nothing."""
    senders = sorted({s for m in database.messages for s in m.senders})
    if node is not None and node not in senders:
        raise UsageError(f"no node {node!r} sends anything in the DBC; its senders are {', '.join(senders)}")
    names = {m.name for m in database.messages}
    if unknown := [name for name in ignore if name not in names]:
        raise UsageError(f"ignore: the DBC has no message {', '.join(unknown)}")


def _name(row: CycleRow) -> str:
    return f"{row.name} 0x{row.frame_id:03X}"
