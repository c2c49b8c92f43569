"""A process that died and was started again: its frames are cut into lives, each with books of its own."""

from array import array
from bisect import bisect_left
from dataclasses import replace

from rt_runner.e2e import E2eStatus
from rt_runner.result import RELEASE_BITS
from rt_runner.timing.columns import Column, LogColumns
from rt_runner.timing.jobs import Process

_HALF = 1 << (RELEASE_BITS - 1)
RESTART_BELOW = 1000  # a process begins with release 1; what goes back to a later one than this is no new life


def lives(log: LogColumns, process: Process) -> list[tuple[Process, LogColumns]]:
    """The log once per life of the process, with the frames of that life; the last one keeps the process's name."""
    cuts = _restarts(log, process)
    if not cuts:
        return [(process, log)]
    bounds = [0, *cuts, 1 << 33]
    out = []
    for k in range(len(bounds) - 1):
        columns = {
            name: _part(c, bounds[k], bounds[k + 1]) if c.sender == process.sender else c
            for name, c in log.columns.items()
        }
        last = k == len(cuts)
        out.append((process if last else replace(process, life=k + 1), replace(log, columns=columns)))
    return out


def _restarts(log: LogColumns, process: Process) -> list[int]:
    """Numbers of the frames with which a new life begins: the first of the job whose release went back."""
    column = log[f"{process.prefix}TimingA"]
    first = next((c for c in log.sent_by(process.sender) if c.per_job and len(c)), column)
    cuts, before = [], None
    for i, value in enumerate(column.signal("release_index")):
        if value != value:
            continue
        index = int(value)
        if before is not None and 0 < before - index < _HALF and index < RESTART_BELOW:
            at = bisect_left(first.order, column.order[i]) - 1
            inside = at >= 0 and (i == 0 or first.order[at] > column.order[i - 1])
            cuts.append(first.order[at] if inside else column.order[i])
        before = index
    return cuts


def _part(column: Column, low: int, high: int) -> Column:
    """Frames with numbers from ``low`` to before ``high``."""
    a, b = bisect_left(column.order, low), bisect_left(column.order, high)
    return Column(
        name=column.name,
        about=column.about,
        t_ns=column.t_ns[a:b],
        order=column.order[a:b],
        counter=column.counter[a:b],
        e2e=_first_is_ok(column.e2e[a:b]),
        signals={name: values[a:b] for name, values in column.signals.items()},
    )


def _first_is_ok(states: array) -> array:
    """The receiver judged a life's first frame by the life before; a sequence begins with it."""
    out = array("B", states)
    if out and out[0] != E2eStatus.WRONG_CRC:
        out[0] = 0
    return out
