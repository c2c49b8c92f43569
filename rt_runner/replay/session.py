"""A log as the estimator's inputs and jobs: what it was sent, what it said, and what is missing of either."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median

from rt_runner.dbc import Dbc, MessageInfo, SignalInfo
from rt_runner.e2e import E2eCheck, E2eStatus
from rt_runner.log_reader import RawFrame

INPUTS = ("MotorState", "TempMeas", "Coolant")
COMPARED = ("Estimate", "EstimateInnov", "EstValidity", "EstWinding", "EstRotor")  # of every job
CALIBRATION = "EstCalibration"  # once a second, behind a job
OTHERS = ("EstInputFaults", "EstGranted", "EstIdentity", "EstBuild")  # kept with the job they follow, too
FIRST_COUNTER = 1  # profile 2 counts up before it sends
INDEX_MODULUS = 1 << 24
_USABLE = (E2eStatus.OK, E2eStatus.LOST, E2eStatus.REPEATED, E2eStatus.WRONG_SEQUENCE)


@dataclass(frozen=True, slots=True)
class Input:
    """A frame that the estimator listens to. ``tick`` is None where the frame is damaged: nobody uses it."""

    t_ns: int
    can_id: int
    data: bytes
    name: str
    tick: int | None


@dataclass(slots=True)
class Job:
    """One executed job. Times in ns, None where the log does not say. ``release`` counts beyond the bus's 24 bits."""

    frames: dict[str, tuple[int, bytes]] = field(default_factory=dict)  # name -> stamp, payload
    inputs_before: int = 0  # inputs in the log before its first frame
    release: int = 0
    wake_ns: int | None = None
    response_ns: int | None = None
    age_motor_ns: int | None = None
    age_temp_ns: int | None = None
    after_skip: bool = False
    output: int = 0  # 0 computed, 1 held, 2 predicted, 3 invalid
    cut: bool = False
    status: int | None = None
    tick: int | None = None
    sweeps: int = 0
    counter: int | None = None  # of its frames, all the same
    indexed: bool = False  # its release was read, not counted

    @property
    def t_ns(self) -> int:
        """Stamp of its first frame."""
        return next(iter(self.frames.values()))[0]


@dataclass
class Session:
    """One life of the estimator, as logged.

    Attributes
    ----------
    inputs, jobs : in the order of the log
    lost_inputs : frames that the counters of the inputs miss
    period_ns : from EstGranted; None if the log has none
    again : the estimator was started a second time; what comes from there on is left out
    """

    inputs: list[Input] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    lost_inputs: int = 0
    period_ns: int | None = None
    identity: dict[str, int] = field(default_factory=dict)
    again: bool = False

    @property
    def lockstep(self) -> bool:
        """Whether nothing slept: the wake-up latency is then not available."""
        return all(job.wake_ns is None for job in self.jobs)

    def grid_ns(self, period_ns: int) -> int:
        """Where release 0 lies on the log's clock: publishing ended a response time after the release."""
        return round(
            median(j.t_ns - (j.response_ns or 0) * (not self.lockstep) - j.release * period_ns for j in self.jobs)
        )


def signal_of(message: MessageInfo, name: str) -> SignalInfo:
    """A signal by its name."""
    return next(s for s in message.signals if s.name == name)


def raw_of(signal: SignalInfo, data: bytes) -> int:
    """The code of a signal in a payload."""
    raw = int.from_bytes(data, "little") >> signal.start & ((1 << signal.length) - 1)
    return raw - (1 << signal.length) if signal.is_signed and raw >> (signal.length - 1) else raw


class _Reader:
    """Fills a session frame by frame."""

    def __init__(self, dbc: Dbc) -> None:
        self.session = Session()
        own = [m for m in dbc if m.sender == "ESTIMATOR"]
        self._rank = {m.name: k for k, m in enumerate(sorted((m for m in own if m.per_job), key=lambda m: m.frame_id))}
        wanted = {m.name: m for m in own if m.per_job or m.name in (CALIBRATION, *OTHERS)}
        wanted |= {name: dbc[name] for name in INPUTS}
        self._messages = {m.frame_id: m for m in wanted.values()}
        self._checks = {m.name: E2eCheck(m.data_id_list, m.max_delta, m.length) for m in wanted.values()}
        self._signals = {(m.name, s.name): s for m in wanted.values() for s in m.signals}
        self._last_rank = len(self._rank)
        self._wraps = 0

    def take(self, frame: RawFrame) -> bool:
        """Take one frame; False once the estimator was started again."""
        message = self._messages.get(frame.can_id)
        if message is None or frame.flags or self.session.again:
            return not self.session.again
        status = self._checks[message.name].check(frame.data)
        if message.name in INPUTS:
            tick = self._raw(message.name, "tick", frame.data) if status in _USABLE else None
            self.session.inputs.append(Input(frame.t_ns, frame.can_id, frame.data, message.name, tick))
            return True
        if message.name in self._rank:
            self._per_job(message.name, frame, frame.data[1] & 0x0F if status in _USABLE else None)
        elif self.session.jobs:
            self.session.jobs[-1].frames[message.name] = (frame.t_ns, frame.data)
        if status in _USABLE:
            self._note(message.name, frame.data)
        return not self.session.again

    def _raw(self, message: str, signal: str, data: bytes) -> int:
        return raw_of(self._signals[message, signal], data)

    def _ns(self, message: str, signal: str, data: bytes) -> int | None:
        s = self._signals.get((message, signal))
        raw = None if s is None else raw_of(s, data)
        return None if s is None or raw is None or raw == s.raw_na else round(raw * s.factor * 1000)

    def _per_job(self, name: str, frame: RawFrame, counter: int | None) -> None:
        """Into the newest job, or a new one: where the order of frames starts again, or the counter moves on."""
        jobs, rank = self.session.jobs, self._rank[name]
        moved = bool(jobs) and None not in (counter, jobs[-1].counter) and counter != jobs[-1].counter
        if rank <= self._last_rank or moved or not jobs:
            jobs.append(Job(inputs_before=len(self.session.inputs)))
        self._last_rank, job = rank, jobs[-1]
        if job.counter is None and counter is not None:
            job.counter = counter
            if len(jobs) > 1:  # until its own index is read: a job without EstTimingA keeps this one
                before = jobs[-2]
                passed = 1 if before.counter is None else (counter - before.counter) & 0x0F or 1
                job.release = before.release + passed
        job.frames[name] = (frame.t_ns, frame.data)

    def _note(self, name: str, data: bytes) -> None:
        session = self.session
        if name == "EstGranted":
            session.period_ns = session.period_ns or (self._ns(name, "period_us", data))
        elif name in ("EstIdentity", "EstBuild"):
            wanted = ("dbc_hash", "weights_hash") if name == "EstIdentity" else ("build_hash", "setting_id")
            session.identity |= {s: self._raw(name, s, data) for s in wanted}
        if not session.jobs or name not in self._rank:
            return
        job = session.jobs[-1]
        if name == "Estimate":
            job.status, job.tick = self._raw(name, "status", data), self._raw(name, "tick", data)
        elif name == "EstimateInnov":
            job.sweeps = self._raw(name, "sweeps", data)
        elif name == "EstTimingA":
            job.wake_ns, job.after_skip = self._ns(name, "wake_lat_us", data), bool(self._raw(name, "after_skip", data))
            self._index(job, self._raw(name, "release_index", data))
        elif name == "EstTimingB":
            job.response_ns = self._ns(name, "resp_us", data)
        elif name == "EstTimingC":
            job.age_motor_ns, job.age_temp_ns = (self._ns(name, f"in_age_{n}_us", data) for n in ("motor", "temp"))
            job.output, job.cut = self._raw(name, "output", data), bool(self._raw(name, "cut", data))

    def _index(self, job: Job, code: int) -> None:
        jobs = self.session.jobs
        job.release, job.indexed = code + self._wraps * INDEX_MODULUS, True
        if len(jobs) > 1 and job.release <= jobs[-2].release:
            if jobs[-2].release % INDEX_MODULUS > INDEX_MODULUS // 2 > code:
                self._wraps += 1
                job.release += INDEX_MODULUS
            else:
                jobs.pop()
                self.session.again = True


def read_session(frames: Iterable[RawFrame], dbc: Dbc) -> Session:
    """Sort a log's frames into the inputs and jobs of the (first) estimator in it."""
    reader = _Reader(dbc)
    for frame in frames:
        if not reader.take(frame):
            break
    session = reader.session
    for name in INPUTS:
        check = reader._checks[name]
        session.lost_inputs += check.frames_lost + check.counts[E2eStatus.WRONG_SEQUENCE]
    return session


def missing_jobs(session: Session) -> list[int]:
    """Position (in ``session.jobs``) of each job before which executed jobs are missing, as often as they are.

    The counter of the jobs' frames counts executed jobs; fifteen in a row is the most it can tell.
    """
    missing, last = [], FIRST_COUNTER - 1
    for k, job in enumerate(session.jobs):
        if job.counter is None:  # all of its frames are damaged
            last += 1
            continue
        passed = (job.counter - last) & 0x0F
        room = job.release - (session.jobs[k - 1].release if k else 0)
        missing += [k] * (passed - 1 if 1 < passed <= room else 0)
        last = job.counter
    return missing
