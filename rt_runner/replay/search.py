"""Replays a session: finds the reading of the log that gives every estimate again, or the first one that differs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rt_runner.dbc import Dbc
from rt_runner.errors import SetupError
from rt_runner.log_reader import RawFrame
from rt_runner.records import job as job_record
from rt_runner.records import pack
from rt_runner.replay.cuts import Evidence, arrival_ns
from rt_runner.replay.differ import Comparison, Difference, compare
from rt_runner.replay.engine import Answer, run_engine
from rt_runner.replay.session import Job, Session, missing_jobs, raw_of, read_session, signal_of

MOST_ATTEMPTS, FEW_ATTEMPTS = 64, 8
LOOK_AHEAD = 50  # jobs behind a difference that another reading must explain before the whole log is tried
JOINED_JOBS = 30  # that a guess of the first frame seen must explain
JOINED_FRAMES = 200  # motor frames before the first job among which the first one seen is looked for
QUEUE = 4096  # frames the estimator keeps between two jobs
MOST_SWEEPS = 12  # of which a cut job tried to make more
HELD = 1


@dataclass
class Reading:
    """One way to read the log: the inputs before ``begin`` were not seen; which option each open cut takes."""

    begin: int = 0
    choice: dict[int, int] = field(default_factory=dict)  # job -> option, 0 where it has none


@dataclass
class Attempt:
    """What came of a reading. ``open_jobs``: job -> number of options of its cut."""

    reading: Reading
    comparison: Comparison
    open_jobs: dict[int, int]
    replayed: Session
    ready: dict


@dataclass(frozen=True)
class Replay:
    """The outcome. ``attempt`` is the best reading's; None where the log cannot be replayed at all."""

    verdict: str  # identical, different, inconclusive
    attempt: Attempt | None
    attempts: int
    missing_jobs: int
    notes: tuple[str, ...]

    @property
    def difference(self) -> Difference | None:
        """The first frame that is not as logged."""
        return self.attempt.comparison.difference if self.attempt else None


class Replayer:
    """Tries readings of one session.

    Parameters
    ----------
    session : the log
    dbc : decodes both sides
    setting, period_ns : of the estimator
    """

    def __init__(self, session: Session, dbc: Dbc, setting: str, period_ns: int) -> None:
        self._session, self._dbc, self._setting, self._period_ns = session, dbc, setting, period_ns
        self._evidence = Evidence(session, period_ns)
        self._base_ns = session.grid_ns(period_ns)
        self._missing = missing_jobs(session)
        self._timeout_ns = dbc["MotorState"].timeout_ms * 1_000_000
        self.attempts = 0

    @property
    def missing(self) -> int:
        """Executed jobs of which the log has no frame."""
        return len(self._missing)

    def run(self) -> Replay:
        """Find the reading that explains the log, and judge."""
        if 0 in self._missing:
            return begins_late(self._session)
        best = self._attempt(Reading())
        if best.comparison.difference is not None and best.comparison.difference.job < JOINED_JOBS:
            best = self._other_begin(best)
        best = self._other_choices(best)
        return self._judged(best)

    # ---- readings ---------------------------------------------------------------------------------------------

    def _attempt(self, reading: Reading, jobs: int | None = None) -> Attempt:
        """Replay the first ``jobs`` jobs (all, if None)."""
        self.attempts += 1
        records, open_jobs = self._records(reading, jobs)
        answer: Answer = run_engine(records, self._setting, self._period_ns)
        replayed = read_session(answer.frames, self._dbc)
        part = self._session if jobs is None else Session(jobs=self._session.jobs[:jobs])
        return Attempt(reading, compare(part, replayed, self._dbc), open_jobs, replayed, answer.ready)

    def _records(self, reading: Reading, jobs: int | None) -> tuple[list[bytes], dict[int, int]]:
        session, evidence, inputs = self._session, self._evidence, self._session.inputs
        records: list[bytes] = []
        open_jobs: dict[int, int] = {}
        done, release = reading.begin, 0
        for k, job in enumerate(session.jobs[:jobs]):
            lost = self._missing.count(k) if self._missing else 0
            for n in range(lost):  # jobs that the log lost: by the grid
                t_ns = evidence.between(k, (n + 1) / (lost + 1))
                release += 1
                upto = evidence.inputs_until(t_ns, done, job.inputs_before)
                records += [pack(f.t_ns - self._base_ns, f.can_id, f.data) for f in inputs[done:upto]]
                records.append(job_record(t_ns - self._base_ns, release))
                done = upto
            cut = evidence.cut(k, done)
            options = [(upto, limit) for limit in _sweep_limits(job) for upto in cut.options]
            if len(options) > 1:
                open_jobs[k] = len(options)
            upto, limit = options[min(reading.choice.get(k, 0), len(options) - 1)]
            for position in range(max(done, upto - QUEUE), upto):
                f = inputs[position]
                at_ns = arrival_ns(job, cut, position, f.t_ns, self._timeout_ns)
                records.append(pack(at_ns - self._base_ns, f.can_id, f.data))
            records.append(job_record(cut.start_ns - self._base_ns, job.release, job.output, limit))
            done, release = upto, job.release
        return records, open_jobs

    def _other_begin(self, best: Attempt) -> Attempt:
        """The estimator may have come to a bus that was alive: find the first frame that it saw."""
        session, evidence = self._session, self._evidence
        first_cut = evidence.cut(0, 0).options[0]
        motors = [k for k in range(first_cut) if session.inputs[k].name == "MotorState"]
        for begin in reversed(motors[1:][-JOINED_FRAMES:]):
            found = self._attempt(Reading(begin), JOINED_JOBS)
            if found.comparison.difference is None:
                whole = self._attempt(found.reading)
                best = _further(best, whole)
                if whole.comparison.difference is None:
                    break
        return best

    def _other_choices(self, best: Attempt) -> Attempt:
        """Back to the newest open cut before the difference, as long as there is one."""
        difference = best.comparison.difference
        gap = difference is not None and self._gap_before(difference.job)  # no reading settles what is not there
        current, limit = best, self.attempts + (FEW_ATTEMPTS if gap else MOST_ATTEMPTS)
        while current.comparison.difference is not None and self.attempts < limit:
            reading = _next_reading(current)
            if reading is None:
                break
            ahead = current.comparison.difference.job + LOOK_AHEAD
            current = self._attempt(reading, ahead)
            if current.comparison.difference is None and ahead < len(self._session.jobs):
                current = self._attempt(reading)
            best = _further(best, current)
        return best

    # ---- verdict ----------------------------------------------------------------------------------------------

    def _judged(self, best: Attempt) -> Replay:
        session, comparison, notes = self._session, best.comparison, []
        if self.missing or comparison.missing_frames:
            notes.append(f"the log lacks {self.missing} jobs and {comparison.missing_frames} frames of other jobs")
        if session.lost_inputs:
            notes.append(f"the counters of the inputs miss {session.lost_inputs} frames")
        if session.again:
            notes.append("the estimator was started again later: only its first run is replayed")
        if best.reading.begin:
            stamp = session.inputs[best.reading.begin].t_ns / 1e9
            notes.append(
                f"the bus was alive before the estimator: the first frame it saw is that stamped {stamp:.6f} s"
            )
        if comparison.difference is None:
            complete = not (self.missing or comparison.missing_frames or self._log_lost_inputs(best))
            return Replay("identical" if complete else "inconclusive", best, self.attempts, self.missing, tuple(notes))
        gaps = self._gap_before(comparison.difference.job) or self._log_lost_inputs(best)
        return Replay("inconclusive" if gaps else "different", best, self.attempts, self.missing, tuple(notes))

    def _gap_before(self, job: int) -> bool:
        """Whether the log lacks a job up to this one, or of one of them what says which inputs it read."""
        telling = {
            n for n in ("Estimate", "EstTimingA", "EstTimingC") if any(n in j.frames for j in self._session.jobs)
        }
        lacking = any(telling - j.frames.keys() for j in self._session.jobs[: job + 1])
        return lacking or any(k <= job for k in self._missing)

    def _log_lost_inputs(self, best: Attempt) -> bool:
        """Whether the log lacks inputs that the estimator had: it counts the gaps it sees, and so does the replay."""
        if not self._session.lost_inputs:
            return False
        name = "EstInputFaults"
        signal = signal_of(self._dbc[name], "seq_errors")
        again = {j.release: j.frames[name][1] for j in best.replayed.jobs if name in j.frames}
        told = [
            (raw_of(signal, j.frames[name][1]), raw_of(signal, again[j.release]))
            for j in self._session.jobs
            if name in j.frames and j.release in again
        ]
        return not told or told[-1][0] != told[-1][1]


def _sweep_limits(job: Job) -> list[int]:
    """After how many sweeps the solver's time may have been up: as published; more where it solved several windows.

    A held output repeats an older job's sweeps and tells nothing.
    """
    if not job.cut:
        return [0]
    first = job.sweeps if job.output != HELD and job.sweeps > 0 else 1
    return [first, *(n for n in range(1, MOST_SWEEPS + 1) if n != first)]


def _further(one: Attempt, other: Attempt) -> Attempt:
    """The one that explains more."""
    if one.comparison.difference is None or other.comparison.difference is None:
        return one if one.comparison.difference is None else other
    return other if other.comparison.difference.job > one.comparison.difference.job else one


def _next_reading(current: Attempt) -> Reading | None:
    """The reading that takes the next option of the newest open cut up to the difference; None: all were tried."""
    difference = current.comparison.difference
    assert difference is not None
    choice = current.reading.choice
    for k in sorted((k for k in current.open_jobs if k <= difference.job), reverse=True):
        taken = choice.get(k, 0)
        if taken + 1 < current.open_jobs[k]:
            kept = {j: n for j, n in choice.items() if j < k}
            return Reading(current.reading.begin, {**kept, k: taken + 1})
    return None


def begins_late(session: Session) -> Replay:
    """The outcome for a log that lacks the estimator's first jobs, and with them what it had learnt by then."""
    note = (
        f"the log begins with release {session.jobs[0].release}, when the estimator had run before: "
        "what it knew then is not in the log"
    )
    return Replay("inconclusive", None, 0, len(missing_jobs(session)), (note,))


def replay_frames(
    frames: Sequence[RawFrame], dbc: Dbc, setting: str | None, period_s: float | None
) -> tuple[Session, Replay, str, int]:
    """Replay a log's frames; returns what was read, the outcome, and the setting and period (ns) used.

    Raises
    ------
    SetupError
        Nothing to replay, or setting or period are neither in the log nor given.
    """
    from rt_runner.replay.identity import setting_name

    session = read_session(frames, dbc)
    if not any("EstTimingA" in job.frames for job in session.jobs):
        raise SetupError("no job of an estimator in the log (no EstTimingA frame); give the log of a run")
    if not session.inputs:
        raise SetupError("no MotorState, TempMeas or Coolant in the log: there is nothing to feed the estimator")
    period_ns = session.period_ns if period_s is None else round(period_s * 1e9)
    if period_ns is None and 0 in missing_jobs(session):
        return session, begins_late(session), setting or "unknown", 0
    if period_ns is None:
        raise SetupError("no EstGranted frame in the log, which tells the period: give --period")
    chosen = setting or setting_name(session.identity)
    return session, Replayer(session, dbc, chosen, period_ns).run(), chosen, period_ns


def as_json(log: str, session: Session, replay: Replay, setting: str, period_ns: int) -> dict[str, Any]:
    """The outcome for the result file."""
    from rt_runner.replay.identity import compare_identity

    attempt = replay.attempt
    return {
        "log": log,
        "identical": replay.verdict == "identical",
        "verdict": replay.verdict,
        "estimates": attempt.comparison.jobs if attempt else 0,
        "frames": attempt.comparison.frames if attempt else 0,
        "first_difference": replay.difference.as_json() if replay.difference else None,
        "jobs": len(session.jobs),
        "inputs": len(session.inputs),
        "missing": {
            "jobs": replay.missing_jobs,
            "frames": attempt.comparison.missing_frames if attempt else 0,
            "inputs": session.lost_inputs,
        },
        "ambiguous": len(attempt.open_jobs) if attempt else 0,
        "attempts": replay.attempts,
        "setting": setting,
        "period_s": period_ns / 1e9,
        "lockstep": session.lockstep,
        "identity": compare_identity(session.identity, attempt.ready if attempt else {}),
        "notes": list(replay.notes),
    }
