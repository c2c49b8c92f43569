"""Logs of a loop that never ran, with every figure known: frames through the codec, numbers from the script.

A script is a list of `Job`; release n is due at ``T0_NS + n * PERIOD_NS``. What the process would have counted is made
here in the plainest way, so that the reader under test has something to be compared with.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from rt_runner.codec import Encoder
from rt_runner.dbc import Dbc, load_dbc
from rt_runner.mcap_log import LogReader, LogWriter
from rt_runner.result import CAUSES

T0_NS = 1_790_000_000_000_000_000
PERIOD_NS = 10_000_000
PER_JOB = (
    "Estimate", "EstimateInnov", "EstValidity", "EstWinding", "EstRotor",
    "EstTimingA", "EstTimingB", "EstTimingC", "EstTimingD",
)  # fmt: skip
ONCE_A_SECOND = (
    "EstReleases", "EstMisses", "EstInputFaults", "EstBusFaults", "EstOverload", "EstMissRun", "EstOutputs",
)  # fmt: skip
Frame = tuple[int, str, dict]
Lost = Callable[[str, int], bool]  # message, how many of it came before -> whether the log does not get it


@dataclass(frozen=True)
class Job:
    """One executed job. Times in ns, multiples of 100 (what a frame can say)."""

    release: int
    wake_ns: int = 20_000
    wall_ns: int = 100_000
    cpu_ns: int = 90_000
    publish_ns: int = 10_000
    warmup: bool = False
    stale: bool = False
    cause: str = "none"
    output: int = 0
    canary_ns: int | None = None

    @property
    def resp_ns(self) -> int:
        return self.wake_ns + self.wall_ns + self.publish_ns

    @property
    def late(self) -> bool:
        return self.resp_ns > PERIOD_NS


@cache
def dbc() -> Dbc:
    """The project's DBC, read once."""
    return load_dbc()


def filler(name: str, **values: float | None) -> dict[str, float | None]:
    """Values for every signal of a message: the given ones, else not available or zero."""
    signals = dbc()[name].payload
    return {s.name: values.get(s.name, None if s.raw_na is not None else 0.0) for s in signals}


def job_frames(script: Sequence[Job], plant: bool = True) -> list[Frame]:
    """Everything on the bus, in the order of the stamps; the estimate is stamped when its job has published."""
    out = list(_plant_frames(script)) if plant else []
    before, skipped, late, stale, causes = 0, 0, 0, 0, Counter()
    for job in script:
        gap = job.release - before - 1
        before, skipped, late, stale = job.release, skipped + gap, late + job.late, stale + job.stale
        causes[job.cause] += 1
        start = T0_NS + job.release * PERIOD_NS + job.wake_ns
        t = start + job.wall_ns + job.publish_ns
        tick = heard_tick(start)
        told = {
            "Estimate": {"status": 2 if tick is not None else 0, "tick": (tick or 0) % 65536, "theta_w_est_degc": 80.0},
            "EstTimingA": {"miss_late": job.late, "warmup": job.warmup, "stale_input": job.stale, "after_skip": gap > 0,
                           "release_index": job.release % (1 << 24), "wake_lat_us": job.wake_ns / 1e3},
            "EstTimingB": {"miss_cause": CAUSES.index(job.cause), "exec_wall_us": job.wall_ns / 1e3,
                           "resp_us": job.resp_ns / 1e3},
            "EstTimingC": {"output": job.output, "cut": 0, "queued": 0,
                           "in_age_motor_us": None if tick is None else (start - motor_ns(tick)) / 1e3,
                           "in_age_temp_us": None if tick is None else (start - motor_ns(tick // 10 * 10)) / 1e3},
            "EstTimingD": {"exec_cpu_us": job.cpu_ns / 1e3,
                           "canary_us": None if job.canary_ns is None else job.canary_ns / 1e3},
        }  # fmt: skip
        out += [(t, name, filler(name, **told.get(name, {}))) for name in PER_JOB]
    out.sort(key=lambda f: f[0])
    end = max(f[0] for f in out) + 1000
    outputs = Counter(job.output for job in script)
    runs = miss_runs(script)
    last = {
        "EstReleases": {"releases": before, "jobs": len(script)},
        "EstMisses": {"miss_late": late, "miss_skipped": skipped, "overrun": skipped},
        "EstInputFaults": {"crc_errors": 0, "seq_errors": 0, "stale_inputs": stale},
        "EstOutputs": {"held": outputs[1], "predicted": outputs[2], "invalidated": outputs[3]},
        "EstMissRun": {"consec_miss_max": max(runs, default=0), "mk_worst": worst_window(script, 100), "phase_us": 0},
    }
    return out + [(end, name, filler(name, **last.get(name, {}))) for name in ONCE_A_SECOND]


def missed(script: Sequence[Job]) -> list[bool]:
    """For every release from 1 on whether it was a miss; from the first job on in a log that was begun later."""
    done = {job.release: job.late for job in script}
    first = 1 if script[0].release < 100 else script[0].release
    return [done.get(n, True) for n in range(first, script[-1].release + 1)]


def miss_runs(script: Sequence[Job]) -> list[int]:
    """Lengths of the runs of misses."""
    text = "".join("x" if m else " " for m in missed(script))
    return [len(run) for run in text.split()]


def worst_window(script: Sequence[Job], size: int) -> int:
    """Most misses in any ``size`` consecutive releases, by counting in each of them."""
    misses = missed(script)
    return max(sum(misses[i : i + size]) for i in range(len(misses)))


# ---- the plant: MotorState 0.3 ms after its sample, every 10 ms -----------------------------------------------
FIRST_TICK, SEND_NS, BUS_NS = 65_500, 120_000, 180_000  # ticks wrap on the way


def sample_ns(tick: int) -> int:
    """When the plant sampled; whole microseconds."""
    return T0_NS + (tick - FIRST_TICK) * 10_000_000 + 3_000_000


def motor_ns(tick: int) -> int:
    """Stamp of MotorState (and of TempMeas) of a tick."""
    return sample_ns(tick) + SEND_NS + BUS_NS


def heard_tick(start_ns: int) -> int | None:
    """Newest tick a job that starts then has heard of."""
    tick = FIRST_TICK + (start_ns - motor_ns(FIRST_TICK)) // 10_000_000
    return tick if tick >= FIRST_TICK else None


def _plant_frames(script: Sequence[Job]) -> Iterator[Frame]:
    last = T0_NS + (script[-1].release + 1) * PERIOD_NS
    for tick in range(FIRST_TICK // 10 * 10, FIRST_TICK + (last - T0_NS) // 10_000_000):
        t, tick16 = motor_ns(tick), tick % 65536
        if tick >= FIRST_TICK:
            yield t, "MotorState", filler("MotorState", tick=tick16)
        if tick % 10 == 0:
            yield t, "TempMeas", filler("TempMeas", tick=tick16)
        if tick >= FIRST_TICK:
            told = {"tick": tick16, "sample_us": sample_ns(tick) // 1000 % (1 << 24), "send_us": SEND_NS / 1e3}
            yield t + 5_000, "PlantSample", filler("PlantSample", **told)


# ---- the last words of the process ----------------------------------------------------------------------------
def buckets(values: Sequence[int]) -> list[list[int]]:
    """Log-linear histogram: 64 buckets of their own, then 64 per octave; only those that are not empty."""
    found: Counter = Counter()
    for v in values:
        octave = max(0, v.bit_length() - 7)
        low = v >> octave << octave
        found[low, low + (1 << octave)] += 1
    return [[low, high, n] for (low, high), n in sorted(found.items())]


def histogram(values: Sequence[int], releases: Sequence[int]) -> dict:
    """As the process prints it; what is negative is underflow."""
    inside = [v for v in values if v >= 0]
    return {
        "count": len(values), "underflow": len(values) - len(inside), "overflow": 0, "buckets": buckets(inside),
        "min_ns": min(values, default=None), "max_ns": max(values, default=None),
        "min_index": releases[values.index(min(values))] if values else None,
        "max_index": releases[values.index(max(values))] if values else None,
    }  # fmt: skip


def final_words(script: Sequence[Job], frames: Sequence[Frame], jitter: Callable[[], int] = lambda: 0) -> dict:
    """What the process says at its end. ``jitter`` (-49 … 49 ns) is what the frames' steps of 0.1 us hide."""
    histograms: dict[str, dict] = {}
    for window, warmup in (("warmup", True), ("judged", False)):
        part = [j for j in script if j.warmup == warmup]
        at = [j.release for j in part]
        histograms[window] = {
            name: histogram([value(j) + jitter() for j in part], at)
            for name, value in (
                ("wake_lat_us", lambda j: j.wake_ns), ("exec_wall_us", lambda j: j.wall_ns),
                ("exec_cpu_us", lambda j: j.cpu_ns), ("resp_us", lambda j: j.resp_ns),
                ("preempt_us", lambda j: max(0, j.wall_ns - j.cpu_ns)),
                ("slack_us", lambda j: PERIOD_NS - j.resp_ns),
            )
        }  # fmt: skip
    own = sum(1 for _, name, _ in frames if dbc()[name].sender == "ESTIMATOR")
    skipped = script[-1].release - len(script)
    return {
        "final": True, "releases": script[-1].release, "jobs": len(script), "miss_skipped": skipped,
        "miss_late": sum(j.late for j in script), "estimates_sent": len(script), "estimates_lost": 0,
        "frames_sent": own, "tx_drops": 0, "causes": dict(Counter(j.cause for j in script)), "histograms": histograms,
    }  # fmt: skip


def write(
    path: Path, frames: Sequence[Frame], final: dict | None = None, lost: Lost = lambda name, n: False,
    facts: dict | None = None, files: dict[str, bytes] | None = None,
) -> Path:  # fmt: skip
    """Write a log; ``lost`` frames were sent (their senders count them) but never reach it."""
    encoders = {s: Encoder(dbc(), s) for s in ("PLANT", "ESTIMATOR")}
    seen: Counter = Counter()
    run = {"scenario": "made-up", "period_s": PERIOD_NS / 1e9}
    with LogWriter(path, dbc(), run, files or {}, force=True) as writer:
        for t_ns, name, values in frames:
            message = encoders[dbc()[name].sender].encode(name, values)
            seen[name] += 1
            if not lost(name, seen[name] - 1):
                writer.write(t_ns, message.arbitration_id, bytes(message.data))
        if final is not None:
            writer.attach("estimator_final.json", json.dumps(final).encode())
        if facts is not None:
            told = {"bus": "hub", "scenario": "made-up", "period_s": PERIOD_NS / 1e9, "stopped_by": "end", **facts}
            writer.seal(told, {"log": {"frames": writer.frames}})
    return path


def copy_without(source: Path, target: Path, drop: Callable[[int, str], bool]) -> Path:
    """The same log, rewritten, without the frames (their number, their message) that ``drop`` names."""
    reader = LogReader(source)
    names = {m.frame_id: m.name for m in dbc()}
    files = {n: d for n, d in reader.attachments.items() if n not in ("drive.dbc", "granted.json")}
    with LogWriter(target, dbc(), reader.metadata["run"], files, force=True) as writer:
        for number, f in enumerate(reader.raw()):
            if not drop(number, names[f.can_id]):
                writer.write(f.t_ns, f.can_id, f.data, f.flags, f.dlc)
        for name in ("facts", "result"):
            writer.metadata(name, reader.metadata[name])
    return target


def regular(count: int, **changes) -> list[Job]:
    """Jobs of the releases 1 … count, the first five in warm-up, each a little different."""
    return [
        replace(Job(n, wake_ns=20_000 + 100 * (n * 7919 % 97), warmup=n <= 5), **changes) for n in range(1, count + 1)
    ]
