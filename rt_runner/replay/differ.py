"""Two tellings of the same jobs: the first frame, and in it the first signal, that is not the same."""

from dataclasses import asdict, dataclass

from rt_runner.dbc import Dbc
from rt_runner.replay.session import CALIBRATION, COMPARED, Session, raw_of


@dataclass(frozen=True)
class Difference:
    """The first frame that is not as logged. ``job`` counts from 0; values are physical, None where not available."""

    frame: str
    can_id: int
    t_ns: int
    job: int
    release: int
    signal: str
    logged: float | None
    replayed: float | None
    logged_data: str
    replayed_data: str

    def as_json(self) -> dict:
        """For the result file."""
        return asdict(self)

    def __str__(self) -> str:
        def shown(value: float | None) -> str:
            return "n/a" if value is None else format(value, ".10g")

        return (
            f"{self.frame}.{self.signal} of release {self.release}, stamped {self.t_ns / 1e9:.6f} s: "
            f"logged {shown(self.logged)}, replayed {shown(self.replayed)}"
        )


@dataclass(frozen=True)
class Comparison:
    """How far two sessions agree."""

    jobs: int  # compared, up to the first difference
    frames: int
    missing_frames: int  # of the log's jobs, in the whole log
    difference: Difference | None


def compare(logged: Session, replayed: Session, dbc: Dbc) -> Comparison:
    """Compare job by job (by release), every payload byte; frames that the log lacks are counted, not compared."""
    again = {job.release: job for job in replayed.jobs}
    jobs = frames = missing = 0
    difference: Difference | None = None
    for k, job in enumerate(logged.jobs):
        last = job is logged.jobs[-1]  # a log may end inside a job; and the counters after the last job come once more
        present = [n for n, name in enumerate(COMPARED) if name in job.frames]
        missing += (max(present, default=-1) + 1 if last else len(COMPARED)) - len(present)
        if difference is not None:
            continue
        twin = again[job.release]
        for name in (*COMPARED, CALIBRATION):
            if name not in job.frames or (name == CALIBRATION and (last or name not in twin.frames)):
                continue
            (t_ns, mine), (_, other) = job.frames[name], twin.frames[name]
            if mine != other:
                difference = _difference(name, k, job.release, t_ns, mine, other, dbc)
                break
            frames += 1
        else:
            jobs += 1
    return Comparison(jobs, frames, missing, difference)


def _difference(name: str, job: int, release: int, t_ns: int, mine: bytes, other: bytes, dbc: Dbc) -> Difference:
    """What is said first is what a reader looks for: content before counter before checksum."""
    message = dbc[name]
    order = [*message.payload, *(s for s in message.signals if s.name == message.counter_signal), *message.signals]
    signal = next((s for s in order if raw_of(s, mine) != raw_of(s, other)), None)
    where = "unused bits" if signal is None else signal.name  # or another length
    logged, replayed = (None if signal is None else signal.to_physical(raw_of(signal, d)) for d in (mine, other))
    return Difference(name, message.frame_id, t_ns, job, release, where, logged, replayed, mine.hex(), other.hex())
