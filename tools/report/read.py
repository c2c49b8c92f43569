"""A log file → ReportData. Judges by the log's own result, or computes one where the run never wrote it."""

from __future__ import annotations

import contextlib
import json
import math
import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rt_runner.judge import Finding, overall
from rt_runner.log_summary import MessageSummary, result_of
from rt_runner.mcap_log import LogError, LogReader, LogSummary, summarise
from rt_runner.result import TICK_S, ResultAccumulator, RunFacts
from rt_runner.timing.analyse import TimingReport, analyse
from tools.report.collect import KEPT_LAST, WANTED, Collector, signals_of
from tools.report.data import FrameStat, ReportData
from tools.report.provenance import environment, identity
from tools.report.series import TICK_MODULUS

POLICIES = ("other", "fifo", "rr")


def read_report(path: Path) -> ReportData:
    """Read all that the page shows.

    Raises
    ------
    LogError : no such file, or not an MCAP file (one line)
    """
    reader = LogReader(path)
    summary = summarise(path)
    run = reader.metadata.get("run", {})
    scenario = _scenario(reader)
    collector = Collector()
    result = finite(result_of(reader.metadata))
    from_log = result is not None
    lockstep = "lockstep" in (run.get("bus"), (result or {}).get("bus"))
    if result is not None:
        for frame in reader.frames((*WANTED, *KEPT_LAST)):
            collector.feed(*frame)
    else:
        judge = ResultAccumulator()
        for frame in reader.frames():
            collector.feed(*frame)
            judge.feed(*frame)
        result = finite(_judged(judge.result(_facts(reader, run, scenario, collector.last, lockstep)))) or {}
    timing = _timing(path)
    signals = signals_of(collector.columns(), lockstep)
    return ReportData(
        source=path.name,
        title=run.get("title") or run.get("scenario") or path.stem,
        started=_started(path, summary, lockstep),
        lockstep=lockstep,
        result=result,
        result_from_log=from_log,
        complete=summary.complete,
        duration_s=summary.duration_s,
        cycle_start_s=_cycle_start_s(signals.cycle_start_s, scenario),
        winding=signals.winding,
        rotor=signals.rotor,
        torque=signals.torque,
        speed=signals.speed,
        jobs=signals.jobs,
        period_s=_period_s(run, result),
        frames=tuple(sorted((_frame_stat(m, timing) for m in summary.messages), key=lambda f: f.can_id)),
        spans=signals.spans,
        identity=identity(reader, run, collector.last),
        environment=environment(run, result, summary),
        notices=_notices(summary, from_log, result, bool(signals.winding.truth or signals.rotor.truth)),
        timing=timing,
    )


def finite(tree: Any) -> Any:
    """The same tree with NaN and infinities as None: what JSON can carry."""
    if isinstance(tree, dict):
        return {str(key): finite(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def _scenario(reader: LogReader) -> dict[str, Any]:
    """The scenario that is attached, empty where there is none that can be read."""
    with contextlib.suppress(KeyError, ValueError):
        return tomllib.loads(reader.attachments["scenario.toml"].decode())
    return {}


def _cycle_start_s(from_ticks_s: float | None, scenario: Mapping[str, Any]) -> float | None:
    """Cycle time at the start of the log. Ticks tell it but for whole wraps, the scenario tells how many."""
    cycle = scenario.get("cycle")
    planned_s = cycle.get("start_s", 0.0) if isinstance(cycle, dict) else 0.0
    if from_ticks_s is None or not isinstance(planned_s, int | float):
        return from_ticks_s
    wrap_s = TICK_MODULUS * TICK_S
    return from_ticks_s + wrap_s * round((planned_s - from_ticks_s) / wrap_s)


def _facts(
    reader: LogReader, run: Mapping[str, str], scenario: Mapping[str, Any], last: Mapping[str, Mapping], lockstep: bool
) -> RunFacts:
    """What is known of a run that never wrote its result."""
    facts: dict[str, Any] = {
        "bus": run.get("bus", "unknown"),
        "scenario": run.get("scenario", "unknown"),
        "lockstep": lockstep,
        "period_s": _number(run.get("period_s")) or 0.1,
        "granted": _granted(reader, last),
    }
    seed = _number(run.get("seed"))
    facts["seed"] = None if seed is None else int(seed)
    facts["limits"] = scenario.get("limits", {})
    return RunFacts.from_dict(facts)


def _granted(reader: LogReader, last: Mapping[str, Mapping]) -> dict[str, Any]:
    """From the attachment that an orderly end writes, else from the estimator's own frame."""
    with contextlib.suppress(KeyError, ValueError):
        granted = json.loads(reader.attachments["granted.json"])
        if isinstance(granted, dict):
            return granted
    frame = last.get("EstGranted", {})
    policy, core, locked = frame.get("policy"), frame.get("core"), frame.get("mlock")
    return {
        "policy": POLICIES[int(policy)] if policy is not None and int(policy) < len(POLICIES) else None,
        "core": None if core is None else int(core),
        "mlock": None if locked is None else bool(locked),
    }


def _judged(result: dict[str, Any]) -> dict[str, Any]:
    """A result computed here can be no better than inconclusive: nobody wrote down how the run ended."""
    finding = Finding("run", "inconclusive", "the log holds no result of its own: the run did not end in order")
    findings = [*(Finding(**f) for f in result["findings"]), finding]
    return {**result, "verdict": overall(findings), "findings": [vars(f) for f in findings]}


def _period_s(run: Mapping[str, str], result: Mapping[str, Any]) -> float | None:
    timing = (result.get("timing") or {}).get("estimator") or {}
    return timing.get("period_s") or _number(run.get("period_s"))


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def _started(path: Path, summary: LogSummary, lockstep: bool) -> str:
    if lockstep:
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        return f"simulated time, written {written:%Y-%m-%d %H:%M:%S} UTC"
    if summary.start_ns is None:
        return "no frames"
    return f"{datetime.fromtimestamp(summary.start_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _timing(path: Path) -> TimingReport | None:
    """What is said of deadlines, None where the log has no real-time process."""
    try:
        return analyse(path)
    except LogError:
        return None


def _frame_stat(m: MessageSummary, timing: TimingReport | None) -> FrameStat:
    cycle = next((r for r in timing.cycles if r.name == m.name), None) if timing is not None else None
    return FrameStat(
        can_id=int(m.can_id, 16),
        name=m.name,
        sender=m.sender,
        cycle_ms=m.cycle_ms,
        count=m.frames,
        rate_hz=1e3 / m.mean_ms if m.mean_ms else None,
        rate_ok=m.rate_ok,
        gap_min_ms=m.min_ms,
        gap_max_ms=m.max_ms,
        timed_out=m.timed_out,
        jitter_ms=cycle.std_ms if cycle else None,
        missing=cycle.missing if cycle else None,
        timeouts=cycle.timeouts if cycle else None,
        counter_gaps=m.counter_gaps,
        repeats=m.repeated,
        crc_errors=m.wrong_crc,
    )


def _notices(summary: LogSummary, from_log: bool, result: Mapping[str, Any], has_truth: bool) -> tuple[str, ...]:
    notices = [f"{text[0].upper()}{text[1:]}." for text in summary.trouble]
    if not from_log:
        notices.append("The log has no result of its own: the figures below are computed from its frames.")
    if not summary.frames:
        notices.append("The log has no frames.")
    elif not has_truth:
        notices.append("The log has no truth (a real motor, or its frames were left out): accuracy cannot be judged.")
    if summary.unknown:
        ids = ", ".join(f"{can_id} ({count})" for can_id, count in sorted(summary.unknown.items())[:8])
        more = " …" if len(summary.unknown) > 8 else ""
        notices.append(f"{sum(summary.unknown.values())} frames with ids that the DBC does not have: {ids}{more}.")
    warnings = (result.get("environment") or {}).get("warnings") or []
    notices += [f"Warning of the run: {warning}" for warning in warnings]
    return tuple(notices)
