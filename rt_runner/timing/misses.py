"""Misses of a process over its releases: late and skipped ones, by cause, and how they cluster."""

from collections import Counter
from dataclasses import dataclass, field

from rt_runner.result import CAUSES
from rt_runner.timing.jobs import Jobs

MK_WINDOW = 100  # `mk_worst`: most misses in so many consecutive releases


@dataclass
class Misses:
    """Counts of one window. ``late`` and ``skipped`` by cause; ``other`` are jobs in time that name a cause."""

    jobs: int = 0
    late: Counter = field(default_factory=Counter)
    skipped: Counter = field(default_factory=Counter)
    other: Counter = field(default_factory=Counter)

    @property
    def releases(self) -> int:
        return self.jobs + self.skipped.total()

    @property
    def misses(self) -> int:
        return self.late.total() + self.skipped.total()

    def by(self, causes: tuple[str, ...]) -> int:
        """Misses with one of these causes."""
        return sum(self.late[c] + self.skipped[c] for c in causes)

    def as_json(self) -> dict:
        table = {
            c: {"late": self.late[c], "skipped": self.skipped[c], "in_time": self.other[c]}
            for c in CAUSES
            if self.late[c] or self.skipped[c] or self.other[c]
        }
        return {
            "releases": self.releases,
            "jobs": self.jobs,
            "late": self.late.total(),
            "skipped": self.skipped.total(),
            "misses": self.misses,
            "by_cause": table,
        }


@dataclass
class MissAccount:
    """What `account` finds. ``runs`` are the misses as (first release, how many in a row), ascending, since the start.

    ``unseen`` are releases between two jobs that nobody called skipped: their frames are missing from the log.
    """

    warmup: Misses
    judged: Misses
    runs: list[tuple[int, int]]
    unseen: int

    @property
    def judged_from(self) -> int:
        """First release after warm-up."""
        return self.warmup.releases + 1

    @property
    def consecutive(self) -> int:
        """Longest run of misses, since the start."""
        return max((n for _, n in self.runs), default=0)

    def worst(self, window: int, judged_from: int = 0) -> int:
        """Most misses among any ``window`` consecutive releases from ``judged_from`` on."""
        runs = [(max(first, judged_from), first + n) for first, n in self.runs if first + n > judged_from]
        most = 0
        # A window with the most misses can be moved until it ends with a run's last release or begins with its first.
        for start in {s for s, _ in runs} | {max(e - window, judged_from) for _, e in runs}:
            inside = sum(max(0, min(e, start + window) - max(s, start)) for s, e in _near(runs, start, window))
            most = max(most, inside)
        return most


def _near(runs: list[tuple[int, int]], start: int, window: int) -> list[tuple[int, int]]:
    return [r for r in runs if r[1] > start and r[0] < start + window]


def account(jobs: Jobs, grace: int = 0) -> MissAccount:
    """Go through the jobs once. A skipped release has the cause of the job that ran over it.

    ``grace``: releases of warm-up, as far as no job tells: those skipped between its last job and the first one after.
    """
    warmup, judged = Misses(), Misses()
    runs: list[tuple[int, int]] = []
    before, warm_before, unseen, cause_before = None, True, 0, CAUSES[0]
    late, warm, after_skip = jobs.flags["late"], jobs.flags["warmup"], jobs.flags["after_skip"]

    def miss(first: int, count: int) -> None:
        if runs and sum(runs[-1]) == first:
            runs[-1] = runs[-1][0], runs[-1][1] + count
        else:
            runs.append((first, count))

    for k, release in enumerate(jobs.release):
        if release < 0:
            continue
        window = warmup if warm[k] else judged
        gap = 0 if before is None else release - before - 1
        if gap > 0 and after_skip[k]:
            early = gap if warm[k] else min(max(grace - before, 0), gap) if warm_before else 0  # type: ignore[operator]
            warmup.skipped[cause_before] += early
            judged.skipped[cause_before] += gap - early
            miss(before + 1, gap)  # type: ignore[operator]
        elif gap > 0:
            unseen += gap
        window.jobs += 1
        cause_before = CAUSES[jobs.cause[k]]
        if late[k]:
            window.late[cause_before] += 1
            miss(release, 1)
        elif cause_before != CAUSES[0]:
            window.other[cause_before] += 1
        before, warm_before = release, bool(warm[k])
    return MissAccount(warmup, judged, runs, unseen)
