"""Frames that are not in the log although their neighbours say they were sent: found by the E2E counters."""

from collections.abc import Iterable
from dataclasses import dataclass

from rt_runner.e2e import COUNTER_MASK, E2eStatus
from rt_runner.timing.columns import NO_COUNTER, Column

FIRST_COUNTER = 1  # a sender counts up before it sends


@dataclass(frozen=True)
class Missing:
    """``count`` frames (modulo 16) of a message between two of its frames; ``after_counter`` None: before its first.

    ``t_ns`` is the stamp of the frame before (of the first one, where none is before), ``release`` the job it is of.
    """

    message: str
    sender: str
    after_counter: int | None
    count: int
    t_ns: int
    release: int | None = None
    place: int = 0  # of the frame before, in its column

    def text(self) -> str:
        """One line for people."""
        frames = "1 frame" if self.count == 1 else f"{self.count} frames"
        where = "before its first frame" if self.after_counter is None else f"after counter {self.after_counter}"
        job = "" if self.release is None else f", release {self.release}"
        return f"{self.message}: {frames} missing {where}{job}, stamp {self.t_ns} ns"

    def as_json(self) -> dict:
        return {
            "message": self.message,
            "sender": self.sender,
            "after_counter": self.after_counter,
            "count": self.count,
            "t_ns": self.t_ns,
            "release": self.release,
        }


def missing_frames(columns: Iterable[Column], from_start: bool) -> list[Missing]:
    """Gaps of all messages, in the order of their stamps.

    A damaged frame fills a place, as it was on the bus; a repeat does not move the sequence. ``from_start`` says that
    the log was there before the senders, so that every sequence must begin with counter 1.
    """
    found = []
    for column in columns:
        found += _gaps(column, from_start)
    return sorted(found, key=lambda m: m.t_ns)


def _gaps(column: Column, from_start: bool) -> list[Missing]:
    found: list[Missing] = []
    last = FIRST_COUNTER - 1 if from_start else None
    last_i, damaged = -1, 0
    for i, counter in enumerate(column.counter):
        if column.e2e[i] == E2eStatus.WRONG_CRC or counter == NO_COUNTER:
            damaged += 1
            continue
        if last is not None and column.e2e[i] != E2eStatus.REPEATED:
            count = (counter - last - 1) & COUNTER_MASK
            if damaged <= count:  # a damaged frame more than are missing is no frame of this sequence
                count -= damaged
            if count:
                after = None if last_i < 0 else last
                found.append(
                    Missing(column.name, column.sender, after, count, column.t_ns[max(last_i, 0)], None, max(last_i, 0))
                )
        if column.e2e[i] != E2eStatus.REPEATED:
            damaged = 0
        last, last_i = counter, i
    return found
