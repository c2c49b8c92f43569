"""Shows a `TimingReport`: tables on a terminal, plain lines where none is."""

import sys
from collections.abc import Iterator, Sequence
from typing import TextIO

from rt_runner.timing.analyse import ProcessTiming, TimingReport
from rt_runner.timing.cycles import CycleRow
from rt_runner.timing.figures import cycle_ok
from rt_runner.timing.metrics import WINDOWS
from rt_runner.timing.misses import MK_WINDOW, Misses
from rt_runner.timing.summary import PERCENTILES, Summary

Rows = list[tuple[str, ...]]
TITLES = {"warmup": "warm-up, not judged", "last_second": "last second", "since_start": "since start, after warm-up"}
NAMES = {
    "wake_lat": "wake latency", "exec_wall": "execution", "exec_cpu": "processor time", "preempt": "preempted",
    "publish": "publishing", "resp": "response", "slack": "slack", "period_dev": "period deviation",
    "in_age_motor": "age of MotorState", "in_age_temp": "age of TempMeas", "canary": "canary",
    "e2e": "sample to estimate",
    "e2e_send": "  plant sends", "e2e_bus": "  bus", "e2e_wait": "  waits for release", "e2e_compute": "  computes",
    "e2e_publish": "  publishes", "e2e_rest": "  rest", "sensor_to_estimate": "TempMeas to estimate",
}  # fmt: skip
ORDER = (
    "wake_lat", "exec_wall", "exec_cpu", "preempt", "publish", "resp", "slack", "period_dev", "in_age_motor",
    "in_age_temp", "canary", "e2e", "e2e_send",
    "e2e_bus", "e2e_wait", "e2e_compute", "e2e_publish", "e2e_rest", "sensor_to_estimate",
)  # fmt: skip
EVIDENCE = {  # what the process says of the machine: message, signal -> words
    ("Machine", "steal_ms"): "ms stolen from the whole machine",
    ("Machine", "run_delay_ms"): "ms ready to run but not running",
    ("Machine", "migrations"): "migrations",
    ("Environment", "minor_faults"): "minor faults",
    ("Environment", "major_faults"): "major faults",
    ("Environment", "invol_switches"): "involuntary switches",
    ("Canary", "canary_p99_us"): "us canary p99",
    ("Canary", "canary_max_us"): "us canary max",
}


def show(report: TimingReport, stream: TextIO | None = None) -> None:
    """Print it to ``stream`` (standard output)."""
    out: TextIO = sys.stdout if stream is None else stream
    if out.isatty():
        _show_tables(report, out)
        return
    for line in plain_lines(report):
        print(line, file=out)


def plain_lines(report: TimingReport) -> list[str]:
    """What is printed where there is no terminal."""
    lines = _head(report)
    for title, rows, note in _tables(report):
        lines += ["", f"{title}{f' ({note})' if note else ''}", *_aligned(rows)]
    return [*lines, "", *_tail(report)]


def _aligned(rows: Rows) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    left = rows[0][-1:] == ("",) and len(rows[0]) == 3  # the audit: its evidence is text

    def cell(i: int, text: str) -> str:
        return text.ljust(widths[i]) if i == 0 or left else text.rjust(widths[i])

    return [("  " + "  ".join(cell(i, text) for i, text in enumerate(row))).rstrip() for row in rows]


def _show_tables(report: TimingReport, stream: TextIO) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(file=stream, highlight=False)
    for line in _head(report):
        console.print(line, markup=False)
    for title, rows, note in _tables(report):
        table = Table(title=title, title_justify="left", caption=note or None, caption_justify="left")
        for i, name in enumerate(rows[0]):
            table.add_column(name, justify="left" if i == 0 or name == "evidence" else "right", no_wrap=i == 0)
        for row in rows[1:]:
            table.add_row(*row, style="yellow" if row[-1] in BAD else None)
        console.print(table)
    for line in _tail(report):
        console.print(line, markup=False)


BAD = ("silent", "wrong rate", "FAILS")


def _head(report: TimingReport) -> list[str]:
    s = report.setup
    lines = [
        f"{report.path}: {report.frames} frames in {report.span_s:.1f} s, {s.facts.scenario} on {s.facts.bus}, period "
        f"{s.period_ns / 1e6:g} ms, deadline {s.deadline_ns / 1e6:g} ms, policy {s.policy}, on a miss {s.on_miss}"
    ]
    return [*lines, *(f"trouble: {t}" for t in report.trouble)]


def _tables(report: TimingReport) -> Iterator[tuple[str, Rows, str]]:
    for p in report.processes:
        for window in WINDOWS:
            rows = _summary_rows(p.windows[window])
            if len(rows) > 1:
                note = "times in us, n/a where too few; @ is the release"
                yield f"{p.process.name}, {TITLES[window]}", rows, note
        yield f"{p.process.name}, misses by cause", _miss_rows(p), _cluster_note(p, report)
    if report.cycles:
        yield "cycles against the DBC", _cycle_rows(report.cycles), "times in ms between receptions by the logger"
    for p in report.processes:
        yield f"{p.process.name}, audit", _audit_rows(p), ""


def _summary_rows(summaries: dict[str, Summary]) -> Rows:
    rows: Rows = [("", "count", "min", "mean", "std", *PERCENTILES, "max", "@")]
    known = [m for m in ORDER if m in summaries] + sorted(m for m in summaries if m not in ORDER)
    for metric in known:
        s = summaries[metric]
        if not s.count:
            continue
        values = (s.min_ns, s.mean_ns, s.std_ns, *s.percentile_ns, s.max_ns)
        at = "" if s.max_release is None or s.max_release < 0 else str(s.max_release)
        rows.append((NAMES.get(metric, metric), str(s.count), *(us(v) for v in values), at))
    return rows


def us(ns: float | None) -> str:
    """Microseconds for a table."""
    return "n/a" if ns is None else f"{ns / 1e3:.1f}"


def _miss_rows(p: ProcessTiming) -> Rows:
    rows: Rows = [("cause", "late", "skipped", "in time", "warm-up")]
    judged, warm = p.account.judged, p.account.warmup
    for cause in dict.fromkeys((*judged.late, *judged.skipped, *judged.other, *warm.late, *warm.skipped)):
        in_warmup = warm.late[cause] + warm.skipped[cause]
        counts = (judged.late[cause], judged.skipped[cause], judged.other[cause], in_warmup)
        if any(counts):
            rows.append((cause.replace("_", " "), *(str(n or "·") for n in counts)))
    rows.append(("all", *_totals(judged), str(warm.misses)))
    return rows


def _totals(misses: Misses) -> tuple[str, str, str]:
    return str(misses.late.total()), str(misses.skipped.total()), str(misses.other.total())


def _cluster_note(p: ProcessTiming, report: TimingReport) -> str:
    a = p.account
    note = f"{a.judged.misses} of {a.judged.releases} releases; "
    note += f"longest run {a.consecutive}, at most {a.worst(MK_WINDOW)} in {MK_WINDOW}"
    if report.setup.mk is not None:
        m, k = report.setup.mk
        note += f"; (m,K) = ({m},{k}): at most {a.worst(k, a.judged_from)}"
    return note


def _cycle_rows(cycles: Sequence[CycleRow]) -> Rows:
    rows: Rows = [("message", "id", "frames", "cycle", "mean", "min", "max", "jitter", "missing", "timeouts", "")]
    for r in cycles:
        if not r.frames and not r.timeouts:
            continue
        times = (ms(v) for v in (r.mean_ms, r.min_ms, r.max_ms, r.std_ms))
        says = "silent" if r.timeouts else "wrong rate" if cycle_ok(r) is False else "ok"
        says = says if r.frames else "never came"
        counts = (str(n or "·") for n in (r.missing, r.timeouts))
        rows.append((r.name, f"{r.frame_id:03X}", str(r.frames), f"{r.cycle_ms:g}", *times, *counts, says))
    return rows


def ms(value: float | None) -> str:
    """Milliseconds for a table."""
    return "n/a" if value is None else f"{value:.3f}"


def _audit_rows(p: ProcessTiming) -> Rows:
    words = {True: "holds", False: "FAILS", None: "not checked"}
    return [("check", "evidence", ""), *((c.name, c.evidence, words[c.ok]) for c in p.audit.checks)]


def _tail(report: TimingReport) -> list[str]:
    lines = []
    for p in report.processes:
        said = [
            f"{value:g} {words}"
            for (message, signal), words in EVIDENCE.items()
            if (value := p.published.get(message, {}).get(signal)) is not None
        ]
        if said:
            lines.append(f"machine, as {p.process.name} saw it after warm-up: {', '.join(said)}")
    if report.setup.facts.steal_ms is not None:
        lines.append(f"stolen from the core during the run: {report.setup.facts.steal_ms:.0f} ms")
    lines += [f"{f.verdict:<12} {f.what}: {f.evidence}" for f in report.findings]
    return [*lines, f"verdict: {report.verdict}"]
