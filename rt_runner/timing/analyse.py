"""A log → everything that is said about its timing. Knows no terminal and no page."""

from array import array
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from rt_runner.dbc import parse_dbc
from rt_runner.errors import RtError
from rt_runner.judge import Finding, judge_misses, overall
from rt_runner.log_reader import LogError, LogReader
from rt_runner.result import MACHINE_CAUSES
from rt_runner.timing import age as age_of_output
from rt_runner.timing.audit import COUNTERS, Audit, Books, audit
from rt_runner.timing.columns import LogColumns, read_columns
from rt_runner.timing.cycles import CycleRow, Expected, cycle_rows, expected_cycles
from rt_runner.timing.jobs import NO_NS, TIMING_SIGNALS, Jobs, Process, collect, processes
from rt_runner.timing.lives import lives
from rt_runner.timing.metrics import derive, summaries
from rt_runner.timing.misses import MissAccount, account
from rt_runner.timing.setup import TimingSetup, final_of, setup_of
from rt_runner.timing.summary import Summary
from rt_runner.timing_config import grace_releases

STATISTICS = ("WakeStat", "ExecStat", "RespStat")
EVIDENCE = ("Machine", "Environment", "Canary", "Overload", "Outputs")


@dataclass(frozen=True)
class ProcessTiming:
    """One real-time process. ``windows`` are warmup, last_second and since_start (without warm-up): metric -> summary.

    ``published`` are the newest values of the frames it sends once a second, message -> signal -> value.
    """

    process: Process
    period_ns: int
    deadline_ns: int
    jobs: Jobs
    account: MissAccount
    windows: dict[str, dict[str, Summary]]
    ages: Mapping[str, Any]
    audit: Audit
    published: dict[str, dict[str, float | None]]
    findings: list[Finding] = field(default_factory=list)


@dataclass(frozen=True)
class TimingReport:
    """A whole log. ``cycles`` are empty where the log's DBC cannot be read."""

    path: str
    setup: TimingSetup
    complete: bool
    trouble: list[str]
    frames: int
    span_s: float
    processes: list[ProcessTiming]
    cycles: list[CycleRow]
    findings: list[Finding]

    @property
    def verdict(self) -> str:
        """pass | fail | inconclusive."""
        return overall(self.findings)


def analyse(path: str | Path) -> TimingReport:
    """Read a log, finished or not, and say all about its timing.

    Raises
    ------
    LogError : no such file, not an MCAP file, or no real-time process in it (one line)
    """
    reader = LogReader(path)
    setup = setup_of(reader)
    log = read_columns(reader, _wanted(reader))
    found = processes(log)
    if not found:
        raise LogError(f"{path}: no timing frames of a real-time process in it; give a log of rt-runner run or mil")
    timings = _timings(reader, log, found, setup)
    cycles = _cycles(reader, log, setup, timings)
    findings = [*(f for t in timings for f in t.findings), _log_finding(reader, setup)]
    if setup.facts.crash:
        findings.append(Finding("run", "fail", setup.facts.crash))
    findings += [
        Finding(
            f"{t.process.name} life", "fail", f"it ended after release {max(t.jobs.release, default=0)}, without a word"
        )
        for t in timings
        if t.process.life
    ]
    return TimingReport(
        path=str(path),
        setup=setup,
        complete=reader.complete,
        trouble=reader.trouble,
        frames=log.raw_frames,
        span_s=0.0 if log.first_ns is None or log.last_ns is None else (log.last_ns - log.first_ns) / 1e9,
        processes=timings,
        cycles=cycles,
        findings=findings,
    )


def _wanted(reader: LogReader) -> dict[str, tuple[str, ...]]:
    """Which signals are kept; of all other messages only the counter."""
    wanted: dict[str, tuple[str, ...]] = dict(age_of_output.WANTED)
    for name, about in reader.channels().items():
        letter, kind = name[-1:], name[:-1]
        if kind.endswith("Timing") and letter in TIMING_SIGNALS:
            ages = (u.partition("=")[0] for u in about.get("units", "").split(","))
            wanted[name] = (*TIMING_SIGNALS[letter], *(a for a in ages if a.startswith("in_age_")))
        once = (*COUNTERS.items(), *((s, ("p99_us", "max_us")) for s in STATISTICS), ("Granted", ("period_us",)))
        for message, signals in once:
            if name.endswith(message) and about.get("sender", "") not in ("", "PLANT"):
                wanted[name] = signals
    return wanted


def _timings(reader: LogReader, log: LogColumns, found: list[Process], setup: TimingSetup) -> list[ProcessTiming]:
    """One after the other: a drop that the logger counted excuses one missing frame of one of them."""
    out: list[ProcessTiming] = []
    others = frozenset(p.sender for p in found)  # the plant keeps no books: its frames are looked at with the first
    left = setup.facts.log_dropped
    for process, part in (life for p in found for life in lives(log, p)):
        out.append(_process(reader, part, process, setup.with_drops(max(left, 0)), others))
        left -= out[-1].audit.charged
        others = frozenset(c.sender for c in log.columns.values())
    return out


def _process(
    reader: LogReader, log: LogColumns, process: Process, setup: TimingSetup, keepers: frozenset[str]
) -> ProcessTiming:
    jobs = collect(log, process)
    told_us = _newest(log, f"{process.prefix}Granted").get("period_us")  # each process may have a period of its own
    if told_us is not None:
        setup = setup.with_period(round(told_us * 1e3))
    if process.sender != "ESTIMATOR":  # the scenario's [timing] is the estimator's
        setup = replace(setup, deadline_ns=setup.period_ns, policy="skip", mk=None)
    derive(jobs, setup.deadline_ns)
    final = final_of(reader, process.final)
    misses = account(jobs, _grace(process, final, setup))
    published = {m: _newest(log, process.prefix + m) for m in (*EVIDENCE, "MissRun", *STATISTICS)}
    rebased = int(published["Overload"].get("rebased") or 0)
    grid = setup.trigger == "time" and not setup.facts.lockstep
    if not grid or rebased:  # starts are no longer one grid's: their distances are something else
        for name in ("period_dev", "period_dev_abs"):
            jobs.times[name] = array("q", [NO_NS]) * len(jobs)
    ages = age_of_output.age_of(log, jobs).times()
    books = Books(
        log=log,
        jobs=jobs,
        account=misses,
        final=final,
        logged=setup.logged,
        log_dropped=setup.facts.log_dropped,
        from_start=setup.started_by_runner,
        queue=setup.queue,
        grid=grid,
        period_ns=setup.period_ns,
        deadline_ns=setup.deadline_ns,
        rebased=rebased,
        bookkeepers=keepers,
    )
    done = audit(books)
    return ProcessTiming(
        process=process,
        period_ns=setup.period_ns,
        deadline_ns=setup.deadline_ns,
        jobs=jobs,
        account=misses,
        windows=summaries(jobs, ages, setup.period_ns),
        ages=ages,
        audit=done,
        published=published,
        findings=_judge(process, misses, done, final, setup),
    )


def _grace(process: Process, final: Mapping[str, Any] | None, setup: TimingSetup) -> int:
    """Releases of warm-up: by the process's own count; without its last words by its rule."""
    with suppress(KeyError, TypeError, ValueError):
        return int((final or {})["warmup"]["releases"])
    return grace_releases(setup.grace_s if process.sender == "ESTIMATOR" else None, setup.period_ns / 1e9)


def _newest(log: LogColumns, name: str) -> dict[str, float | None]:
    """Newest values of a message; empty where it never came."""
    column = log[name]
    if not len(column):
        return {}
    return {s: None if values[-1] != values[-1] else values[-1] for s, values in column.signals.items()}


def _judge(
    process: Process, misses: MissAccount, done: Audit, final: Mapping[str, Any] | None, setup: TimingSetup
) -> list[Finding]:
    findings = []
    if not setup.facts.lockstep:
        count, releases, by_machine = misses.judged.misses, misses.judged.releases, misses.judged.by(MACHINE_CAUSES)
        judged = (final or {}).get("judged") or {}
        if {"releases", "miss_late", "miss_skipped"} <= judged.keys() and int(judged["releases"]) >= releases:
            # The process's own account knows the jobs whose frames were dropped, too.
            releases, count = int(judged["releases"]), int(judged["miss_late"]) + int(judged["miss_skipped"])
        finding = judge_misses(min(count, releases), min(by_machine, count), releases, setup.facts.limits.miss_rate_max)
        findings.append(_named(process, finding))
        if setup.mk is not None:
            findings.append(_mk_finding(process, misses, setup.mk))
    what = f"{process.name} audit"
    if done.failed:
        says = "; ".join(f"{c.name}: {c.evidence}" for c in done.failed)
        findings.append(Finding(what, "fail", f"the books do not balance: {says}"))
    else:
        made = [c for c in done.checks if c.ok]
        dropped = ", ".join(f"{n} {who}" for who, n in done.drops.items() if n)
        says = f"{len(made)} checks hold" + (f", counted as dropped: {dropped}" if dropped else "")
        open_ = ", ".join(c.name for c in done.checks if c.ok is None)
        findings.append(Finding(what, "pass", says + (f"; not checked: {open_}" if open_ else "")))
    return findings


def _named(process: Process, finding: Finding) -> Finding:
    return Finding(f"{process.name} {finding.what}", finding.verdict, finding.evidence)


def _mk_finding(process: Process, misses: MissAccount, mk: tuple[int, int]) -> Finding:
    m, k = mk
    worst = misses.worst(k, misses.judged_from)
    says = f"at most {worst} misses in any {k} releases, allowed {m}"
    if worst <= m and misses.judged.releases < k:
        return Finding(f"{process.name} (m,K)", "inconclusive", f"{says}; only {misses.judged.releases}: run longer")
    return Finding(f"{process.name} (m,K)", "pass" if worst <= m else "fail", says)


def _log_finding(reader: LogReader, setup: TimingSetup) -> Finding:
    if reader.trouble:
        return Finding("log", "inconclusive", "; ".join(reader.trouble))
    if not setup.sealed:
        return Finding(
            "log", "inconclusive", "the run did not end in order: nobody says what came after the last frame"
        )
    if setup.facts.log_cut_short:
        return Finding("log", "inconclusive", "the logger could not take all that had arrived")
    if setup.facts.stopped_by == "interrupt":
        return Finding("log", "inconclusive", "stopped by hand before its end")
    return Finding("log", "pass", "finished in order")


def _cycles(reader: LogReader, log: LogColumns, setup: TimingSetup, timings: list[ProcessTiming]) -> list[CycleRow]:
    """Cyclic messages against the DBC that the log carries."""
    text = reader.attachments.get("drive.dbc")
    if text is None:
        return []
    try:
        periods = {t.process.sender: t.period_ns for t in timings}
        senders = dict.fromkeys(c.sender for c in log.columns.values())
        expected = [e for s in senders for e in _expected(text, periods.get(s, setup.period_ns) / 1e9) if e.sender == s]
    except RtError as e:
        reader.trouble.append(f"its attachment drive.dbc: {e}")
        return []
    return cycle_rows({c.frame_id: c.t_ns for c in log.columns.values() if len(c)}, expected)


@lru_cache(maxsize=4)
def _expected(dbc: bytes, period_s: float) -> tuple[Expected, ...]:
    """Parsing a DBC takes longer than reading a short log, and most logs carry the same one."""
    return expected_cycles(parse_dbc(dbc).database, job_period_s=period_s)
