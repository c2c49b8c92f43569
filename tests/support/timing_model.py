"""What the real-time task must count, straight from the definitions, release by release. Slow and obvious on purpose.

The model is told what the clock said during each job and says what should have come of it. It knows nothing of the C.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

CAUSES = ("none", "late_wake", "preempted", "long_compute", "stale_input", "blocked_send", "steal")
MK_WINDOW = 100
THEFT_MIN_NS = 100_000
HISTOGRAM_END_NS = 2**40


@dataclass(frozen=True)
class Policy:
    """One entry of a scenario's `policy`; `queue` is N."""

    name: str = "skip"
    queue: int = 0
    budget_ns: int = 0
    stop_total: int = 0
    stop_row: int = 0


@dataclass(frozen=True)
class Setting:
    """A task on the grid t0 + n·T."""

    period_ns: int
    deadline_ns: int
    t0_ns: int = 0
    warmup: int = 0
    policy: Policy = Policy()
    mk: tuple[int, int] | None = None
    canary: int = 0  # 0: none, 1: not conclusive, 2: conclusive


@dataclass(frozen=True)
class Trace:
    """What the clock said during one job, and what the bus did."""

    start_ns: int
    start_cpu_ns: int
    asked: int
    asked_ns: int
    stepped_ns: int
    stepped_cpu_ns: int
    published_ns: int
    done_ns: int
    sent: bool
    stale: bool


@dataclass
class Job:
    """What is expected of one job."""

    index: int
    release_ns: int
    warmup: bool
    after_skip: bool
    queued: bool
    cut: bool
    late_now: bool
    wake_lat_ns: int
    exec_wall_ns: int
    exec_cpu_ns: int
    preempt_ns: int
    resp_ns: int
    miss_late: bool
    stolen_ns: int
    canary_ns: int
    cause: str


@dataclass
class Model:
    """The task so far: the fate of every release."""

    setting: Setting
    fate: dict[int, str] = field(default_factory=dict)  # "waiting", "ran", "late", "skipped"; in order of release
    jobs: list[Job] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    overruns: list[int] = field(default_factory=list)  # the job that was running, once per activation hit
    skip_cause: dict[int, str] = field(default_factory=dict)
    heard: list[tuple[int, int]] = field(default_factory=list)
    samples: dict[tuple[str, bool], list[tuple[int, int]]] = field(default_factory=dict)
    queued: set[int] = field(default_factory=set)
    phase_ns: int = 0
    rebased: int = 0
    delay_cause: str = "none"

    def release(self, n: int) -> int:
        """r_n."""
        return self.setting.t0_ns + self.phase_ns + n * self.setting.period_ns

    def next_index(self) -> int:
        """The release the next job is for."""
        waiting = [n for n, fate in self.fate.items() if fate == "waiting"]
        return waiting[0] if waiting else max(self.fate, default=0) + 1

    def stopped(self) -> bool:
        """Whether the policy ends the task before the next job."""
        policy, judged = self.setting.policy, self._window("judged")
        misses = sum(self.fate[n] in ("late", "skipped") for n in judged)
        total = policy.stop_total > 0 and misses >= policy.stop_total
        return total or (policy.stop_row > 0 and longest_run(self._misses(judged)) >= policy.stop_row)

    def run(self, trace: Trace, heard: list[tuple[int, int]], due_ns: int | None = None) -> Job:
        """One job.

        `heard`: the canary's wake-ups (due, woke) between the last job's publication and this one's; `due_ns`: what it
        sleeps for then.
        """
        s, n = self.setting, self.next_index()
        r, before = self.release(n), self.jobs[-1] if self.jobs else None
        self.heard += heard
        wall, cpu = trace.stepped_ns - trace.start_ns, trace.stepped_cpu_ns - trace.start_cpu_ns
        resp = trace.published_ns - r
        late = resp > s.deadline_ns
        job = Job(
            index=n,
            release_ns=r,
            warmup=n <= s.warmup,
            after_skip=n != (before.index if before else 0) + 1,
            queued=self.fate.get(n) == "waiting",
            cut=s.policy.budget_ns > 0 and trace.asked > 0 and trace.asked_ns - r >= s.policy.budget_ns,
            late_now=trace.stepped_ns - r > s.deadline_ns,
            wake_lat_ns=trace.start_ns - r,
            exec_wall_ns=wall,
            exec_cpu_ns=cpu,
            preempt_ns=max(0, wall - cpu),
            resp_ns=resp,
            miss_late=late,
            stolen_ns=self._stolen(r, trace, due_ns) if late and s.canary == 2 else 0,
            canary_ns=self.heard[-1][1] - self.heard[-1][0] if self.heard else -1,
            cause="none",
        )
        job.cause = self._cause(job, trace)
        self.fate[n] = "late" if late else "ran"
        if job.queued:
            self.queued.add(n)
        self._sample(job, trace, heard)
        self.delay_cause = job.cause if late else self._largest_part(job, trace, trace.done_ns)
        self._end(n, trace)
        self.jobs.append(job)
        self.traces.append(trace)
        return job

    def _end(self, n: int, trace: Trace) -> None:
        """Activations before the end of the job: which were hit, which wait, which are skipped."""
        policy = self.setting.policy
        m = n + 1
        while self.release(m) < trace.done_ns:
            if self.release(m) >= trace.start_ns:
                self.overruns.append(n)
            m += 1
        passed = [p for p in range(n + 1, m) if p not in self.fate]
        if policy.name == "rebase":
            if passed:
                self.rebased += 1
                self.phase_ns += trace.done_ns - self.release(passed[0])
            return
        for p in passed:
            room = policy.queue - sum(fate == "waiting" for fate in self.fate.values())
            self.fate[p] = "waiting" if room > 0 else "skipped"
            if room <= 0:
                self.skip_cause[p] = self.delay_cause

    def _cause(self, job: Job, trace: Trace) -> str:
        if not job.miss_late:
            return "blocked_send" if not trace.sent else "stale_input" if trace.stale else "none"
        if job.stolen_ns > 0 and job.resp_ns - job.stolen_ns <= self.setting.deadline_ns:
            return "steal"
        return self._largest_part(job, trace, trace.published_ns)

    def _largest_part(self, job: Job, trace: Trace, end_ns: int) -> str:
        """Parts in order of time; the first of the largest ones. `end_ns`: where sending ended."""
        backlog = max(0, self.traces[-1].done_ns - job.release_ns) if self.traces else 0
        parts = [
            ("late_wake", job.wake_lat_ns - backlog),
            ("preempted", job.preempt_ns),
            ("long_compute", job.exec_wall_ns - job.preempt_ns),
            ("blocked_send", end_ns - trace.stepped_ns),
        ]
        if backlog:
            parts.insert(0, (self.delay_cause, backlog))
        return max(parts, key=lambda part: part[1])[0]

    def _stolen(self, release_ns: int, trace: Trace, due_ns: int | None) -> int:
        """Time in which a due canary did not run; its ordinary latency does not count.

        One that is overdue even now did not run until the job began, at least.
        """
        overdue = [] if due_ns is None else [(due_ns, trace.start_ns)]
        late = [(due, woke) for due, woke in self.heard + overdue if woke - due > THEFT_MIN_NS]
        return sum(max(0, min(woke, trace.published_ns) - max(due, release_ns)) for due, woke in late)

    def _sample(self, job: Job, trace: Trace, heard: list[tuple[int, int]]) -> None:
        values = [
            ("wake_lat_us", job.wake_lat_ns),
            ("exec_wall_us", job.exec_wall_ns),
            ("exec_cpu_us", job.exec_cpu_ns),
            ("preempt_us", job.preempt_ns),
            ("publish_us", trace.published_ns - trace.stepped_ns),
            ("resp_us", job.resp_ns),
            ("slack_us", self.setting.deadline_ns - job.resp_ns),
            *(("canary_us", woke - due) for due, woke in heard),
        ]
        if self.jobs:
            dev = trace.start_ns - self.traces[-1].start_ns
            dev -= (job.index - self.jobs[-1].index) * self.setting.period_ns
            values += [("period_dev_us", dev), ("period_dev_abs_us", abs(dev))]
        for name, value in values:
            self.samples.setdefault((name, job.warmup), []).append((value, job.index))

    def _window(self, name: str) -> list[int]:
        warmup = self.setting.warmup
        return [n for n in self.fate if name == "total" or (n <= warmup) == (name == "warmup")]

    def _misses(self, window: list[int]) -> list[bool]:
        """In order of release, up to the first whose fate is open."""
        waiting = [n for n, fate in self.fate.items() if fate == "waiting"]
        settled = [n for n in sorted(window) if not waiting or n < waiting[0]]
        return [self.fate[n] in ("late", "skipped") for n in settled]

    def counters(self, name: str) -> dict[str, int]:
        """All counters of a window: "total", "warmup" or "judged"."""
        window = self._window(name)
        fates = Counter(self.fate[n] for n in window)
        misses = self._misses(window)
        m, k = self.setting.mk if self.setting.mk and name == "judged" else (0, 0)
        in_k = [sum(misses[max(0, i - k + 1) : i + 1]) for i in range(len(misses))] if k else []
        return {
            "releases": len(window),
            "jobs": fates["ran"] + fates["late"],
            "miss_late": fates["late"],
            "miss_skipped": fates["skipped"],
            "overrun": sum(n in window for n in self.overruns),
            "consec_miss_max": longest_run(misses),
            "mk_worst": max((sum(misses[max(0, i - MK_WINDOW + 1) : i + 1]) for i in range(len(misses))), default=0),
            "queued": sum(n in window for n in self.queued),
            "queued_now": fates["waiting"],
            "mk_misses_max": max(in_k, default=0),
            "mk_violations": sum(count > m for count in in_k),
        }

    def causes(self) -> tuple[Counter[str], Counter[str], Counter[str]]:
        """Of jobs, of skipped releases, of judged misses of both kinds."""
        skipped, warmup = self.skip_cause, self.setting.warmup
        judged = Counter(job.cause for job in self.jobs if job.miss_late and not job.warmup)
        judged += Counter(cause for n, cause in skipped.items() if n > warmup)
        return Counter(job.cause for job in self.jobs), Counter(skipped.values()), judged


def longest_run(misses: list[bool]) -> int:
    """The longest run of misses."""
    best = run = 0
    for miss in misses:
        run = run + 1 if miss else 0
        best = max(best, run)
    return best


def bucket(value_ns: int) -> tuple[int, int]:
    """[low, high) of the log-linear histogram: 64 buckets an octave, one each below 64."""
    width = 1 if value_ns < 64 else 2 ** (value_ns.bit_length() - 7)
    low = value_ns // width * width
    return low, low + width


def histogram(values: list[int]) -> tuple[int, int, dict[tuple[int, int], int]]:
    """Underflow, overflow and the buckets that are not empty."""
    inside = [v for v in values if 0 <= v < HISTOGRAM_END_NS]
    return sum(v < 0 for v in values), sum(v >= HISTOGRAM_END_NS for v in values), dict(Counter(map(bucket, inside)))
