"""What the timing frames of a log say of the estimator's loop: misses in order of release, their causes, durations."""

from collections import deque
from dataclasses import dataclass

from rt_runner.judge import Finding, percentile

CAUSES = ("none", "late_wake", "preempted", "long_compute", "stale_input", "blocked_send", "steal")
MACHINE_CAUSES = ("late_wake", "preempted", "steal")
OUTPUTS = ("computed", "held", "predicted", "invalid")
RELEASE_BITS = 24
DURATIONS = ("wake_lat_us", "exec_wall_us", "exec_cpu_us", "resp_us", "canary_us", "in_age_motor_us", "in_age_temp_us")


class Unwrapper:
    """Turns a counter that wraps at ``2**bits`` back into one that grows (or steps back a little)."""

    def __init__(self, bits: int) -> None:
        self._modulus = 1 << bits
        self._last: int | None = None

    def __call__(self, wrapped: float) -> int:
        value = int(wrapped)
        if self._last is not None:
            half = self._modulus // 2
            value = self._last + (value - self._last + half) % self._modulus - half
        self._last = value
        return value


@dataclass(frozen=True)
class Misses:
    """Of the judged releases: all, those missed, and how many of these the machine is to blame for."""

    releases: int
    misses: int
    by_machine: int


class TimingAccount:
    """Collects the jobs' timing frames in log order. Memory grows by about 60 bytes per job."""

    def __init__(self) -> None:
        self._release = Unwrapper(RELEASE_BITS)
        self._last_release: int | None = None
        self.jobs = self.late = self.skipped = self.stale_jobs = self.warmup_jobs = 0
        self._warmup_misses = self._warmup_skipped = 0
        self._causes: dict[str, int] = dict.fromkeys(CAUSES, 0)
        self._judged_causes: dict[str, int] = dict.fromkeys(CAUSES, 0)
        self._outputs: dict[str, int] = dict.fromkeys(OUTPUTS, 0)
        self._flags = {"cut": 0, "queued": 0}
        self._missed: list[int] = []  # judged releases, ascending
        self._in_warmup = self._was_late = False
        self._crossing = (0, 0, CAUSES[0])  # skips between warm-up and the first judged job: first, count, cause
        self._last_cause = "none"
        self._samples: dict[str, list[float]] = {name: [] for name in DURATIONS}

    def job_a(self, v: dict) -> None:
        """Take an EstTimingA."""
        if v.get("release_index") is None:
            return
        release = self._release(v["release_index"])
        warmup, late = bool(v.get("warmup")), bool(v.get("miss_late"))
        skipped = 0
        if v.get("after_skip") and self._last_release is not None:
            # Without the flag a gap is a frame lost on the way to the log.
            skipped = max(0, release - self._last_release - 1)
            self.skipped += skipped
            self._causes[self._last_cause] += skipped
            if not warmup and self._in_warmup:
                self._crossing = release - skipped, skipped, self._last_cause
            if not warmup:
                self._judged_causes[self._last_cause] += skipped
                self._missed += range(release - skipped, release)
        self._last_release = release
        self.jobs += 1
        self.late += late
        self._was_late, self._in_warmup = late, warmup
        self.stale_jobs += bool(v.get("stale_input"))
        self.warmup_jobs += warmup
        self._warmup_misses += (late + skipped) if warmup else 0
        self._warmup_skipped += skipped if warmup else 0
        if late and not warmup:
            self._missed.append(release)
        self._take(v)

    def job_b(self, v: dict) -> None:
        """Take an EstTimingB."""
        cause = v.get("miss_cause")
        self._last_cause = CAUSES[int(cause)] if cause is not None and int(cause) < len(CAUSES) else "none"
        self._causes[self._last_cause] += self._was_late  # a job in time may name a cause (stale input), too
        if not self._in_warmup:
            self._judged_causes[self._last_cause] += self._was_late
        self._take(v)

    def job_c(self, v: dict) -> None:
        """Take an EstTimingC."""
        output = v.get("output")
        if output is not None and int(output) < len(OUTPUTS):
            self._outputs[OUTPUTS[int(output)]] += 1
        for flag in self._flags:
            self._flags[flag] += bool(v.get(flag))
        self._take(v)

    def job_d(self, v: dict) -> None:
        """Take an EstTimingD."""
        self._take(v)

    def _take(self, v: dict) -> None:
        if self._in_warmup:
            return
        for name, into in self._samples.items():
            if v.get(name) is not None:
                into.append(v[name])

    def judged(self, grace: int | None = None) -> Misses:
        """What a miss rate is judged by: the releases after warm-up.

        ``grace``: so many are warm-up, also of those that a job of warm-up ran over. None: unknown, these are judged.
        """
        first, count, cause = self._crossing
        early = 0 if grace is None else min(max(grace + 1 - first, 0), count)
        releases = self.jobs - self.warmup_jobs + self.skipped - self._warmup_skipped - early
        misses = self.late + self.skipped - self._warmup_misses - early
        by_machine = sum(self._judged_causes[c] for c in MACHINE_CAUSES) - (early if cause in MACHINE_CAUSES else 0)
        return Misses(releases, misses, min(misses, by_machine))

    def worst_of(self, k: int, grace: int | None = None) -> int:
        """Most misses among any ``k`` consecutive judged releases."""
        worst, window = 0, deque()
        for release in self._missed:
            if grace is not None and release <= grace:
                continue
            window.append(release)
            while release - window[0] >= k:
                window.popleft()
            worst = max(worst, len(window))
        return worst

    def judge_mk(self, mk: tuple[int, int], dropped: int, grace: int | None = None) -> Finding:
        """At most m misses in any K consecutive releases, as far as the log has them."""
        m, k = mk
        worst, releases = self.worst_of(k, grace), self.judged(grace).releases
        says = f"at most {worst} misses in any {k} consecutive releases, {m} allowed"
        if worst > m:
            if dropped:
                return Finding("(m, K)", "inconclusive", f"{says}; but the log has gaps")
            return Finding("(m, K)", "fail", says)
        if releases < k:
            return Finding("(m, K)", "inconclusive", f"{says}; only {releases} releases: run longer")
        return Finding("(m, K)", "pass", says)

    def figures(self) -> dict:
        """Everything for the result, ready for JSON."""
        return {
            "jobs": self.jobs,
            "releases": self.jobs + self.skipped,
            "warmup_jobs": self.warmup_jobs,
            "miss_late": self.late,
            "miss_skipped": self.skipped,
            "stale_jobs": self.stale_jobs,
            "causes": {k: n for k, n in self._causes.items() if n},
            "outputs": {k: n for k, n in self._outputs.items() if n},
            "cut_jobs": self._flags["cut"],
            "queued_jobs": self._flags["queued"],
            **{name: _quantiles(samples) for name, samples in self._samples.items()},
        }


def _quantiles(samples: list[float]) -> dict[str, float | None]:
    ordered = sorted(round(x, 1) for x in samples)  # the bus's resolution: 0.1 us
    return {"p50": percentile(ordered, 50), "p99": percentile(ordered, 99), "max": ordered[-1] if ordered else None}
