"""Which frames a job had read.

Nothing on the bus says it outright, but little is left open. The frames of a bus have one order, so a job has read a
first part of the log's inputs, no less than the job before and no more than stand before its own frames: a *cut*. Where
it lies is told by the tick of the newest MotorState used (Estimate) and, in logs that have EstTimingC, by the ages of
the newest MotorState and TempMeas, which also say to 0.1 us when the job began. What these leave open is a Coolant
between two such frames (in older logs a TempMeas as well). There the stamps decide first. The other cuts are kept for
the case that the stamps were wrong: a job goes on reading what arrives while it reads, and two sockets stamp a frame at
different moments.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from rt_runner.replay.session import Input, Job, Session

MS = 1_000_000
MOTOR_TIMEOUT_SLACK_NS = 20 * MS  # how wrong an age taken from stamps may be, where the status says so
INPUT_STALE = 4
ESTIMATES = (2, 3, 6, 7)  # statuses that a stale MotorState turns into INPUT_STALE
STEP_NS = MS  # the grid moved (policy rebase) or the clock was set, if by more than this
LOCKSTEP_SLACK_NS = 100_000  # stamps of lock-step logs are exact, other formats round them


def _smoothed(offsets: Sequence[int | None], own: Sequence[int]) -> list[int]:
    """Median of the ten known offsets on either side of each place.

    Where the two sides disagree the grid moved: then that of the side which the place's own offset (``own``: known for
    every place, but late on a bus that lags) belongs to, and where it moved more often than that, its own.
    """
    places = [k for k, o in enumerate(offsets) if o is not None]
    known = [o for o in offsets if o is not None]
    out = []
    for k, mine in enumerate(own):
        at = bisect_right(places, k)
        sides = [median(side) for side in (known[max(0, at - 10) : at], known[at : at + 10]) if side]
        if max(sides) - min(sides) <= STEP_NS:
            out.append(round(median(known[max(0, at - 10) : at + 10])))
            continue
        side = min(sides, key=lambda s: abs(s - mine))
        out.append(round(side) if abs(side - mine) <= STEP_NS else mine)
    return out


@dataclass(frozen=True, slots=True)
class Cut:
    """What may be said of one job. ``options`` count the inputs read since the log's start, the likeliest first."""

    start_ns: int  # when it read them, on the log's clock
    options: tuple[int, ...]
    newest_motor: int | None = None  # position of the newest MotorState used, as far as it is known from evidence
    newest_temp: int | None = None


class Evidence:
    """The inputs of a session, indexed.

    Parameters
    ----------
    session : the log
    period_ns : of the loop
    """

    def __init__(self, session: Session, period_ns: int) -> None:
        self._session, self._period_ns = session, period_ns
        self._inputs: Sequence[Input] = session.inputs
        self._motors = [k for k, f in enumerate(self._inputs) if f.name == "MotorState" and f.tick is not None]
        self._temps = [k for k, f in enumerate(self._inputs) if f.name == "TempMeas" and f.tick is not None]
        self._by_tick: dict[int, list[int]] = {}
        for k in self._motors:
            self._by_tick.setdefault(int(self._inputs[k].tick or 0), []).append(k)
        self._grid_ns = self._local_grid()
        self._clock = [f.t_ns for f in self._inputs]

    def _local_grid(self) -> list[int]:
        """Release 0 as each job's neighbourhood sees it: a grid that moved (policy rebase), a clock that was set.

        From the stamps of Estimate, late on a bus that lags; where there are ages, from the stamps of the inputs.
        """
        jobs = self._session.jobs
        own = [j.t_ns - (0 if j.wake_ns is None else j.response_ns or 0) - j.release * self._period_ns for j in jobs]
        coarse = _smoothed(own, own)
        self._grid_ns = coarse
        fine: list[int | None] = []
        for k, job in enumerate(jobs):
            motor = None
            if job.age_motor_ns is not None and job.wake_ns is not None and job.indexed:
                motor = self._motor(job, self.start_by_grid(k), max(job.inputs_before, 1))
            offset_ns = (job.age_motor_ns or 0) - (job.wake_ns or 0) - job.release * self._period_ns
            fine.append(None if motor is None else self._inputs[motor].t_ns + offset_ns)
        if all(f is None for f in fine):
            return coarse
        return _smoothed(fine, [o if f is None else f for f, o in zip(fine, own, strict=True)])

    def start_by_grid(self, k: int) -> int:
        """When job ``k`` began, from its index, its wake-up latency and the grid."""
        job = self._session.jobs[k]
        return self._grid_ns[k] + job.release * self._period_ns + (job.wake_ns or 0)

    def between(self, k: int, share: float) -> int:
        """A moment between jobs ``k - 1`` and ``k``."""
        after = self.start_by_grid(k)
        before = self.start_by_grid(k - 1) if k else after - self._period_ns
        return before + round(share * (after - before))

    def inputs_until(self, t_ns: int, first: int, last: int) -> int:
        """How many inputs had arrived by ``t_ns``, in the order of the log, between ``first`` and ``last``."""
        return min(max(bisect_right(self._clock, t_ns), first), last)

    def cut(self, k: int, first: int) -> Cut:
        """Where the inputs of job ``k`` may end, if the job before has read ``first`` of them."""
        job, start_ns = self._session.jobs[k], self.start_by_grid(k)
        if self._session.lockstep:
            count = self.inputs_until(start_ns + min(LOCKSTEP_SLACK_NS, self._period_ns // 4), first, len(self._inputs))
            return Cut(start_ns, (count,))
        last = max(first, job.inputs_before)
        motor = self._motor(job, start_ns, last)
        if motor is not None and job.age_motor_ns is not None:
            start_ns = self._inputs[motor].t_ns + job.age_motor_ns
        temp = self._temp(job, start_ns, last)
        low = max([first, *(k + 1 for k in (motor, temp) if k is not None)])
        high = max(low, min(last, self._next(self._motors, motor, last), self._next(self._temps, temp, last)))
        options = self._options(low, high, start_ns)
        return Cut(start_ns, options, motor, temp)

    def _motor(self, job: Job, start_ns: int, last: int) -> int | None:
        """Position of the newest MotorState used; None if nothing says which it was."""
        wanted: list[int] = []
        if job.tick is not None and job.output == 0:  # what was held or predicted has another's tick
            wanted = [k for k in self._by_tick.get(job.tick, ()) if k < last]
        if not wanted and job.age_motor_ns is not None:
            wanted = self._motors[: bisect_right(self._motors, last - 1)]
        if not wanted:
            return None
        if job.age_motor_ns is None:
            return wanted[-1]
        age_ns = job.age_motor_ns
        return min(wanted[-400:], key=lambda k: abs(start_ns - age_ns - self._inputs[k].t_ns))

    def _temp(self, job: Job, start_ns: int, last: int) -> int | None:
        if job.age_temp_ns is None:
            return None
        near = self._temps[: bisect_right(self._temps, last - 1)][-400:]
        age_ns = job.age_temp_ns
        return min(near, key=lambda k: abs(start_ns - age_ns - self._inputs[k].t_ns), default=None)

    @staticmethod
    def _next(positions: list[int], newest: int | None, last: int) -> int:
        """The first of ``positions`` behind ``newest``: it was not read. Without evidence none is excluded."""
        if newest is None:
            return last
        k = bisect_right(positions, newest)
        return positions[k] if k < len(positions) else last

    def _options(self, low: int, high: int, start_ns: int) -> tuple[int, ...]:
        """Cuts that differ in a frame that counts, that of the stamps first, then outwards from it."""
        cuts = [low] + [k + 1 for k in range(low, high) if self._inputs[k].tick is not None]
        arrived = sum(self._inputs[c - 1].t_ns <= start_ns for c in cuts[1:])
        return tuple(sorted(cuts, key=lambda c: abs(cuts.index(c) - arrived)))


def arrival_ns(job: Job, cut: Cut, position: int, stamp_ns: int, motor_timeout_ns: int) -> int:
    """When an input arrived at the estimator, on the log's clock.

    The newest TempMeas as EstTimingC has its age; the others as stamped, except that a status that tells whether the
    newest MotorState was stale is believed before stamps that are near the timeout.
    """
    if position == cut.newest_temp and job.age_temp_ns is not None:
        return cut.start_ns - job.age_temp_ns
    if job.age_motor_ns is not None or position != cut.newest_motor:
        return stamp_ns
    age_ns = cut.start_ns - stamp_ns
    if job.status == INPUT_STALE and motor_timeout_ns - MOTOR_TIMEOUT_SLACK_NS < age_ns <= motor_timeout_ns:
        return cut.start_ns - motor_timeout_ns - 1
    if job.status in ESTIMATES and motor_timeout_ns < age_ns < motor_timeout_ns + MOTOR_TIMEOUT_SLACK_NS:
        return cut.start_ns - motor_timeout_ns
    return stamp_ns
