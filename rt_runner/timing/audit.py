"""Conservation audit: do the books of the process and of the log balance, frame by frame?

    releases = executed + skipped + waiting          executed = sent + refused by the bus
    sent     = in the log + counted as dropped       histograms of the process = values in the log

A frame that is missing and that nobody counted as dropped breaks the books: the audit fails, whatever else is fine.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from rt_runner.result import CAUSES, RELEASES_LAST, SKIPPED_LAST
from rt_runner.timing.audit_histograms import histogram_checks
from rt_runner.timing.check import Check
from rt_runner.timing.columns import Column, LogColumns, damaged
from rt_runner.timing.jobs import OUTPUTS, Jobs
from rt_runner.timing.misses import MK_WINDOW, MissAccount
from rt_runner.timing.missing import Missing, missing_frames

NAMED = 5  # so many missing frames are named in the text; all are in the JSON
COUNTERS = {  # once a second, all but what can go down again
    "Releases": ("releases", "jobs"),
    "Misses": ("miss_late", "miss_skipped", "overrun"),
    "InputFaults": ("crc_errors", "seq_errors", "stale_inputs"),
    "BusFaults": ("rx_drops", "tx_drops", "rejected"),
    "Overload": ("queued", "cut", "rebased"),
    "MissRun": ("consec_miss_max", "mk_worst", "phase_us"),
    "Outputs": ("held", "predicted", "invalidated"),
    "Environment": ("minor_faults", "major_faults", "invol_switches"),
    "Machine": ("run_delay_ms", "steal_ms", "migrations"),
    "Canary": ("canary_p99_us", "canary_max_us"),
}
FALLING = ("canary_p99_us",)  # a percentile is no counter


@dataclass(frozen=True)
class Books:
    """What is compared: the log, what was made of it, and what others say."""

    log: LogColumns
    jobs: Jobs
    account: MissAccount
    final: Mapping[str, Any] | None = None  # last words of the process; None: an older log, or it never got to them
    logged: int | None = None  # frames in the log by the count of who wrote it
    log_dropped: int = 0  # frames that kernel or hub dropped before the logger saw them, by their own count
    from_start: bool = True  # whether the log was there before the senders
    queue: int = 0  # releases that may wait (policy queue:N)
    grid: bool = True  # releases on a time grid, so that every one has an index
    period_ns: int = 0
    deadline_ns: int = 0
    rebased: int = 0
    bookkeepers: frozenset[str] = frozenset()  # senders that have an audit of their own

    def own(self, message: str, signal: str) -> int | None:
        """Newest value of a counter that the process sends once a second."""
        for value in reversed(self.log[self.jobs.process.prefix + message].signal(signal)):
            if value == value:
                return int(value)
        return None

    def said(self, key: str, message: str, signal: str) -> int | None:
        """The last words' figure, else the newest counter frame's."""
        return int(self.final[key]) if self.final is not None and key in self.final else self.own(message, signal)

    @property
    def columns(self) -> list[Column]:
        """Messages of this process, and of who keeps no books of his own (the plant)."""
        own = self.jobs.process.sender
        return [c for c in self.log.columns.values() if c.sender == own or c.sender not in self.bookkeepers]

    @property
    def whole(self) -> bool:
        """Whether every job in the log has all its frames."""
        return all(-1 not in places for places in self.jobs.position.values())


@dataclass(frozen=True)
class Audit:
    """What came out. ``ok`` is False as soon as one check failed; a check that could not be made fails nothing."""

    checks: list[Check] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    drops: dict[str, int] = field(default_factory=dict)
    charged: int = 0  # missing frames that only the logger's drops can excuse

    @property
    def ok(self) -> bool:
        return all(c.ok is not False for c in self.checks)

    @property
    def failed(self) -> list[Check]:
        return [c for c in self.checks if c.ok is False]

    def as_json(self) -> dict[str, Any]:
        return {
            "ok": self.ok,
            "checks": [vars(c) for c in self.checks],
            "missing": [m.as_json() for m in self.missing],
            "drops": self.drops,
        }


def audit(books: Books) -> Audit:
    """Make all checks."""
    found = missing_frames(books.columns, books.from_start)
    missing = [replace(m, release=_release(books.jobs, m)) for m in found]
    drops = _drops(books)
    checks = [
        _file(books),
        _counters(books, missing, drops),
        *_conservation(books),
        *_executed(books),
        *_skips(books),
        *_counts(books),
        *_clusters(books),
        *histogram_checks(books.final, books.jobs, books.account, books.deadline_ns, books.rebased),
        _monotonic(books),
    ]
    return Audit(checks, missing, drops, _charged(books, missing, drops))


def _release(jobs: Jobs, missing: Missing) -> int | None:
    """Release of the job that the frame before belongs to."""
    places = jobs.position.get(missing.message)
    if places is None or missing.place not in places:
        return None
    release = jobs.release[places.index(missing.place)]
    return release if release >= 0 else None


def _drops(books: Books) -> dict[str, int]:
    process = books.jobs.process
    return {
        f"{process.name}_tx": books.said("tx_drops", "BusFaults", "tx_drops") or 0,
        "logger": books.log_dropped,
    }


def _file(books: Books) -> Check:
    """The numbers that the logger gave to the frames, and how many it counted."""
    log, gaps = books.log, books.log.raw_order_gaps
    if gaps:
        before, count = gaps[0]
        total = sum(abs(n) for _, n in gaps)
        says = f"{total} frames are not in the file, the first after frame number {before} ({count})"
        return Check("file", False, says)
    if books.logged is not None and log.decoded != books.logged:
        says = f"the logger counted {books.logged} frames of the DBC, {log.decoded} are in the file"
        return Check("file", False, says)
    return Check("file", True, f"{log.raw_frames} frames, numbered without a gap")


def _counters(books: Books, missing: list[Missing], drops: Mapping[str, int]) -> Check:
    """Frames missing by their E2E counters against frames counted as dropped."""
    bad = sum(1 for c in books.columns for _ in damaged(c))
    tail = f"; {bad} damaged" if bad else ""
    counted = ", ".join(f"{n} {who}" for who, n in drops.items() if n)
    if not missing:
        says = "no frame missing by its counter" + (f"; counted as dropped: {counted}" if counted else "") + tail
        return Check("frames", True, says)
    named = "; ".join(m.text() for m in missing[:NAMED]) + ("; …" if len(missing) > NAMED else "")
    left = _charged(books, missing, drops)
    total = sum(m.count for m in missing)
    if left <= drops["logger"]:
        return Check("frames", True, f"{total} frames missing, all counted as dropped ({counted}): {named}{tail}")
    says = f"{total} frames missing, {left - drops['logger']} of them counted by nobody"
    return Check("frames", False, f"{says} ({counted or 'no drops counted'}): {named}{tail}")


def _charged(books: Books, missing: list[Missing], drops: Mapping[str, int]) -> int:
    """Missing frames that the bus did not refuse to their sender."""
    own = sum(m.count for m in missing if m.sender == books.jobs.process.sender)
    refused = min(own, drops[f"{books.jobs.process.name}_tx"])
    return sum(m.count for m in missing) - refused


def _conservation(books: Books) -> Iterator[Check]:
    """releases = executed + skipped + waiting, in every round of counters and at the end."""
    prefix, rounds = books.jobs.process.prefix, 0
    for releases, jobs, skipped in _rounds(books.log[f"{prefix}Releases"], books.log[f"{prefix}Misses"]):
        rounds += 1
        wait = releases - jobs - skipped
        if not 0 <= wait <= books.queue:
            says = f"round {rounds}: {releases} releases, but {jobs} executed + {skipped} skipped"
            yield Check("releases", False, says + (f" (at most {books.queue} may wait)" if books.queue else ""))
            return
    final = books.final
    if final is not None and {"releases", "jobs", "miss_skipped"} <= final.keys():
        total, jobs, skipped = (int(final[k]) for k in ("releases", "jobs", "miss_skipped"))
        wait = total - jobs - skipped
        says = f"{total} releases = {jobs} executed + {skipped} skipped + {wait} waiting"
        yield Check("releases", 0 <= wait <= books.queue, f"{says}, and in each round of counters ({rounds})")
    elif rounds:
        yield Check("releases", True, f"releases = executed + skipped in each round of counters ({rounds})")
    else:
        yield Check("releases", None, "no counters of the process in the log")


def _rounds(releases: Column, misses: Column) -> Iterator[tuple[int, int, int]]:
    """Counters of one round carry one E2E counter; saturated ones tell nothing."""
    at, n = 0, len(misses)
    total, jobs, skipped = releases.signal("releases"), releases.signal("jobs"), misses.signal("miss_skipped")
    for i, order in enumerate(releases.order):
        while at < n and misses.order[at] < order:
            at += 1
        if at == n or misses.counter[at] != releases.counter[i]:
            continue
        if total[i] != total[i] or skipped[at] != skipped[at]:
            continue
        if total[i] < RELEASES_LAST and skipped[at] < SKIPPED_LAST:
            yield int(total[i]), int(jobs[i]), int(skipped[at])


def _executed(books: Books) -> Iterator[Check]:
    """executed = sent + refused; sent = in the log + counted drops."""
    final, jobs = books.final, books.jobs
    logged, name = len(jobs), jobs.messages[0] if jobs.messages else ""
    if final is None:
        own = books.own("Releases", "jobs")
        if own is None or own >= RELEASES_LAST:
            yield Check("executed", None, "the process does not say how many jobs it executed")
            return
        last_words = _stands_last(books)
        says = f"{own} jobs counted by the process{' at its end' if last_words else ''}, {logged} in the log"
        short = own - logged if last_words else max(0, own - logged)
        yield Check("executed", short == 0 or 0 < short <= books.log_dropped, says)
        return
    executed = int(final.get("jobs", 0))
    sent, lost = (next((int(final[k]) for k in keys if k in final), None)
                  for keys in (("estimates_sent", "outputs_sent"), ("estimates_lost", "outputs_lost")))  # fmt: skip
    if sent is None or lost is None:
        yield Check("executed", None, "the process does not say how many outputs it sent")
        return
    yield Check("executed", executed == sent + lost, f"{executed} executed = {sent} sent + {lost} refused by the bus")
    in_log = len(books.log[name])
    counted = f"({books.log_dropped} counted as dropped)"
    says = f"{sent} {name} sent = {in_log} in the log + {sent - in_log} missing {counted}"
    yield Check("sent", 0 <= sent - in_log <= books.log_dropped, says)
    if "frames_sent" in final:
        frames = sum(len(c) for c in books.log.sent_by(jobs.process.sender))
        short = int(final["frames_sent"]) - frames
        says = f"{final['frames_sent']} frames sent = {frames} in the log + {short} missing"
        yield Check("frames sent", 0 <= short <= books.log_dropped, f"{says} {counted}")


def _stands_last(books: Books) -> bool:
    """Whether the last counters were sent after the last job: the process ended in order."""
    releases = books.log[f"{books.jobs.process.prefix}Releases"]
    newest = [c.order[-1] for c in (books.log[name] for name in books.jobs.messages) if len(c)]
    return bool(len(releases) and newest and releases.order[-1] > max(newest))


def _skips(books: Books) -> Iterator[Check]:
    """Gaps of the release index are the skipped releases; what was skipped after the last job nobody else tells."""
    own = books.said("miss_skipped", "Misses", "miss_skipped")
    total = books.said("releases", "Releases", "releases")
    seen = books.account.warmup.skipped.total() + books.account.judged.skipped.total()
    if own is None or total is None or own >= SKIPPED_LAST or (books.final is None and not _stands_last(books)):
        return
    if not books.whole or books.account.unseen:
        yield Check("skipped", None, f"{books.account.unseen} releases cannot be judged: frames are missing")
        return
    last = next((r for r in reversed(books.jobs.release) if r >= 0), 0)
    first = next((r for r in books.jobs.release if r >= 0), 1)
    waiting = max(0, total - own - (books.said("jobs", "Releases", "jobs") or 0))
    tail = max(0, total - waiting - last) if books.grid else 0
    before = first - 1 if books.from_start else 0
    says = f"{own} skipped = {seen} gaps of the release index + {tail + before} outside the first and last job"
    yield Check("skipped", own == seen + tail + before, says)


def _counts(books: Books) -> Iterator[Check]:
    """Flags in the log against the counters of the process."""
    jobs, final = books.jobs, books.final
    if not books.whole or (final is None and not _stands_last(books)):
        yield Check("counts", None, "not to be compared with the counters: frames are missing, or no last counters")
        return
    pairs: list[tuple[str, int, int | None]] = [
        ("late", sum(jobs.flags["late"]), books.said("miss_late", "Misses", "miss_late")),
        ("stale", sum(jobs.flags["stale"]), books.own("InputFaults", "stale_inputs")),
        ("queued", sum(jobs.flags["queued"]), books.own("Overload", "queued")),
        ("cut", sum(jobs.flags["cut"]), books.own("Overload", "cut")),
        *(
            (OUTPUTS[i], jobs.output.count(i), books.own("Outputs", signal))
            for i, signal in ((1, "held"), (2, "predicted"), (3, "invalidated"))
        ),
    ]
    causes = (final or {}).get("causes") or {}
    pairs += [(f"cause {c}", jobs.cause.count(i), int(causes[c])) for i, c in enumerate(CAUSES) if c in causes]
    compared = [(name, raw, own) for name, raw, own in pairs if own is not None]
    wrong = [f"{raw} {name} in the log, {own} counted" for name, raw, own in compared
             if raw != own and min(raw, own) < SKIPPED_LAST]  # fmt: skip
    if wrong:
        yield Check("counts", False, "; ".join(wrong))
    else:
        yield Check("counts", True, f"{len(compared)} counters agree with the flags of {len(jobs)} jobs")


def _clusters(books: Books) -> Iterator[Check]:
    """Longest run of misses and most misses in 100 releases, recomputed."""
    pairs = [
        (name, mine, books.own("MissRun", name))
        for name, mine in (
            ("consec_miss_max", books.account.consecutive), ("mk_worst", books.account.worst(MK_WINDOW)),
        )
    ]  # fmt: skip
    if not books.whole or any(own is None for *_, own in pairs) or not _stands_last(books):
        return
    total, last = books.own("Releases", "releases") or 0, max(books.jobs.release, default=0)
    tail = max(0, total - last) if books.grid else 0  # skipped after the last job: may lengthen a run, nobody saw it
    wrong = [f"{name} {own} published, {mine} in the log" for name, mine, own in pairs
             if not mine <= (own or 0) <= mine + tail]  # fmt: skip
    says = "; ".join(wrong) or ", ".join(f"{name} {mine}" for name, mine, _ in pairs) + ": as published"
    yield Check("clusters", not wrong, says)


def _monotonic(books: Books) -> Check:
    """Counters never fall, the release index always grows."""
    prefix, falls = books.jobs.process.prefix, []
    for message, signals in COUNTERS.items():
        for signal in signals:
            values = [v for v in books.log[prefix + message].signal(signal) if v == v]
            if signal not in FALLING and any(b < a for a, b in pairwise(values)):
                falls.append(f"{prefix}{message}.{signal}")
    known = [r for r in books.jobs.release if r >= 0]
    if any(b <= a for a, b in pairwise(known)):
        falls.append("release_index")
    if falls:
        return Check("monotonic", False, f"went back: {', '.join(falls)}")
    return Check("monotonic", True, "no counter went back, every release is later than the one before")
