"""The page's section on deadlines: histograms, misses by cause, audit. What it says comes from `rt_runner.timing`."""

from __future__ import annotations

import numpy as np

from rt_runner.timing.analyse import ProcessTiming, TimingReport
from rt_runner.timing.jobs import NO_NS
from rt_runner.timing.misses import MK_WINDOW
from rt_runner.timing.show import EVIDENCE, NAMES, ORDER
from tools.report.osadl import Duration, panel
from tools.report.tables import esc, number

PANELS = (  # metric, title, colour, whether the deadline is one for it
    ("wake_lat", "Wake latency", "--wake", False),
    ("resp", "Response", "--resp", True),
    ("e2e", "Age of the estimate", "--exec", False),
)
MARKS = {True: ("pass", "✓"), False: ("fail", "✕"), None: ("inconclusive", "–")}


def section(report: TimingReport | None) -> str:
    """HTML of the whole section; empty where the log has no real-time process."""
    if report is None:
        return ""
    return "\n".join(_process(p, report) for p in report.processes)


def _process(p: ProcessTiming, report: TimingReport) -> str:
    name = esc(p.process.name)
    grid = f'<div class="grid hists">{"".join(panels(p, report))}</div>'
    note = (
        "Bars count jobs after warm-up, outlines jobs in warm-up; the last column counts what lies beyond the axis. "
        "Wake latency and response count from the intended release; the age of the estimate from the plant's sample to "
        "its stamp on the bus."
    )
    if report.setup.facts.lockstep:
        note += " Lock-step: no clock releases the jobs, so there are no latencies."
    return (
        f'<section class="panel deadline"><h2>Deadlines of the {name}</h2>{grid}<p class="note">{note}</p></section>'
        f'<div class="grid cols2"><div class="stack">{_misses(p, report)}{_summaries(p)}</div>{_audit(p)}</div>'
    )


def panels(p: ProcessTiming, report: TimingReport) -> list[str]:
    """One figure per duration."""
    warm = np.frombuffer(p.jobs.flags["warmup"], dtype=np.uint8).astype(bool)
    releases = np.frombuffer(p.jobs.release, dtype=np.int64)
    out = []
    for metric, title, colour, has_deadline in PANELS:
        column = p.jobs.times.get(metric) or p.ages.get(metric)
        values = np.frombuffer(column, dtype=np.int64) if column is not None else np.empty(0, dtype=np.int64)
        known = values != NO_NS if values.size else np.zeros(0, dtype=bool)
        if metric == "e2e" and not known.any() and p.process.sender != "ESTIMATOR":
            continue
        judged, before = (known & ~warm, known & warm) if values.size else (known, known)
        deadline = p.deadline_ns if has_deadline and not report.setup.facts.lockstep else None
        at = releases[judged] if values.size else values
        out.append(panel(Duration(title, colour, values[judged], at, values[before], deadline)))
    return out


def _misses(p: ProcessTiming, report: TimingReport) -> str:
    judged, warm, a = p.account.judged, p.account.warmup, p.account
    rows = []
    for cause in dict.fromkeys((*judged.late, *judged.skipped, *judged.other, *warm.late, *warm.skipped)):
        in_warmup = warm.late[cause] + warm.skipped[cause]
        counts = (judged.late[cause], judged.skipped[cause], judged.other[cause], in_warmup)
        if any(counts):
            hot = (" hot" if n and i < 2 else "" for i, n in enumerate(counts))
            cells = "".join(f'<td class="n{h}">{number(n)}</td>' for h, n in zip(hot, counts, strict=True))
            rows.append(f'<tr><th scope="row">{esc(cause.replace("_", " "))}</th>{cells}</tr>')
    totals = (judged.late.total(), judged.skipped.total(), judged.other.total(), warm.misses)
    cells = "".join(f'<td class="n big">{number(n)}</td>' for n in totals)
    rows.append(f'<tr><th scope="row">all</th>{cells}</tr>')
    notes = [
        f"{number(judged.misses)} of {number(judged.releases)} releases missed",
        f"longest run {number(a.consecutive)}, at most {number(a.worst(MK_WINDOW))} in {MK_WINDOW}",
    ]
    if report.setup.mk is not None:
        m, k = report.setup.mk
        notes.append(f"(m,K) = ({m},{k}): at most {number(a.worst(k, a.judged_from))}")
    notes += _machine(p, report)
    return f"""<section class="panel"><h2>Misses of the {esc(p.process.name)} by cause</h2><div class="scroll"><table>
<thead><tr><th>cause</th><th class="n">late</th><th class="n">skipped</th>
<th class="n">in time<small>named by the job</small></th><th class="n">warm-up<small>not judged</small></th></tr>
</thead><tbody>{"".join(rows)}</tbody></table></div><p class="note">{" · ".join(notes)}</p></section>"""


def _summaries(p: ProcessTiming) -> str:
    """All durations since the start, after warm-up."""
    rows = []
    for metric in ORDER:
        s = p.windows["since_start"].get(metric)
        if s is None or not s.count or metric == "slack":  # deadline less response: nothing new
            continue
        values = (s.percentile_ns[0], *s.percentile_ns[2:], s.max_ns)
        cells = "".join(f'<td class="n">{number(None if v is None else v / 1e3, 1)}</td>' for v in values)
        at = number(s.max_release) if s.max_release is not None and s.max_release >= 0 else ""
        name, part = NAMES.get(metric, metric), metric.startswith("e2e_")
        head = f'<th scope="row"{" class=part" if part else ""}>{esc(name.strip())}</th>'
        rows.append(f'<tr>{head}{cells}<td class="n soft">{at}</td></tr>')
    percentiles = "".join(f'<th class="n">{q}<small>µs</small></th>' for q in ("p50", "p99", "p99.9", "p99.99"))
    return f"""<section class="panel sums"><h2>Durations</h2><div class="scroll"><table><thead><tr><th></th>
{percentiles}<th class="n">max<small>µs</small></th><th class="n">max at<small>release</small></th></tr></thead>
<tbody>{"".join(rows)}</tbody></table></div><p class="note">since the start, without warm-up; other windows, minimum,
mean and deviation: rt-runner timing</p></section>"""


def _machine(p: ProcessTiming, report: TimingReport) -> list[str]:
    """What the machine did meanwhile."""
    said = [
        f"{p.published[message][signal]:g} {words}"
        for (message, signal), words in EVIDENCE.items()
        if p.published.get(message, {}).get(signal) is not None
    ]
    steal_ms = report.setup.facts.steal_ms
    if steal_ms is not None:
        said.append(f"{number(steal_ms)} ms stolen from the core during the run")
    return said


def _audit(p: ProcessTiming) -> str:
    rows = "".join(
        f'<li><span class="dot {MARKS[c.ok][0]}">{MARKS[c.ok][1]}</span>'
        f"<span><b>{esc(c.name)}</b> · {esc(c.evidence)}</span></li>"
        for c in sorted(p.audit.checks, key=lambda c: (c.ok is not False, c.ok is None))
    )
    says = "the books balance" if p.audit.ok else "THE BOOKS DO NOT BALANCE"
    kind = "pass" if p.audit.ok else "fail"
    return (
        f'<section class="panel audit"><h2>Audit of the {esc(p.process.name)} · '
        f'<span class="dot {kind}">{says}</span></h2><ul class="findings">{rows}</ul></section>'
    )
