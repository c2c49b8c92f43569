"""HTML fragments: header, key figures, frames, identity. Every text from the log passes through `esc`."""

from __future__ import annotations

from html import escape
from typing import Any

from tools.report.data import FrameStat, ReportData

MARK = {"pass": "✓", "fail": "✕", "inconclusive": "?"}
NONE = "n/a"
LOCKSTEP = "n/a (lock-step)"
THIN = "\u202f"


def esc(value: Any) -> str:
    """Text for HTML, quotes included; None reads n/a."""
    return NONE if value is None else escape(str(value), quote=True)


def number(value: float | int | None, digits: int = 0) -> str:
    """Grouped with thin spaces; None and NaN read n/a."""
    if value is None or value != value:
        return NONE
    return f"{value:,.{digits}f}".replace(",", THIN).replace("-", "−")


def look_up(tree: dict[str, Any], *path: str) -> Any:
    """Value under nested keys, None where any of them is missing."""
    at: Any = tree
    for key in path:
        at = at.get(key) if isinstance(at, dict) else None
    return at


def header(data: ReportData) -> str:
    """Title, verdict with its findings, and the run in one strip."""
    result = data.result
    verdict = str(result.get("verdict", "inconclusive"))
    kind = verdict if verdict in MARK else "inconclusive"
    mode = "model in the loop, lock-step" if data.lockstep else "real-time run"
    facts = [
        ("scenario", result.get("scenario")),
        ("bus", result.get("bus")),
        ("duration", _seconds(result.get("duration_s"))),
        ("period", _milliseconds(data.period_s)),
        *_granted(data),
        ("frames logged", number(look_up(result, "log", "frames"))),
        ("frames lost", number(look_up(result, "log", "dropped"))),
        ("seed", result.get("seed")),
    ]
    strip = "".join(f"<div><dt>{esc(k)}</dt><dd>{esc(v)}</dd></div>" for k, v in facts)
    notices = "".join(f'<p class="notice" role="status">{esc(n)}</p>' for n in data.notices)
    return f"""<header class="top">
<div><div class="over">rt-runner report · {mode}</div><h1>{esc(data.title)}</h1>
<div class="soft">{esc(data.started)} · <span class="mono">{esc(data.source)}</span></div></div>
<div class="verdict"><div class="badge {kind}"><span aria-hidden="true">{MARK[kind]}</span>{esc(verdict.upper())}</div>
<div class="themebar"><button type="button" id="theme">theme: auto</button></div></div>
</header>
{notices}<dl class="panel facts">{strip}</dl>"""


def _seconds(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f} s"


def _milliseconds(value_s: float | None) -> str:
    return NONE if value_s is None else f"{value_s * 1e3:g} ms"


def _granted(data: ReportData) -> list[tuple[str, Any]]:
    if data.lockstep:
        return [("scheduling, core, mlock", LOCKSTEP)]
    granted = data.result.get("granted") or {}
    policy, locked = granted.get("policy"), granted.get("mlock")
    policy = {"fifo": "SCHED_FIFO", "rr": "SCHED_RR", "other": "SCHED_OTHER (not real-time)"}.get(str(policy), policy)
    return [
        ("scheduling granted", policy),
        ("core", granted.get("core")),
        ("memory locked", None if locked is None else "yes" if locked else "no"),
    ]


def key_figures(data: ReportData) -> str:
    """Accuracy, timing and findings side by side."""
    return f'<div class="grid keyfigs">{_accuracy(data.result)}{_timing(data)}{_findings(data)}</div>'


def _findings(data: ReportData) -> str:
    findings = [f for f in data.result.get("findings") or [] if isinstance(f, dict)]
    findings.sort(key=lambda f: ("fail", "inconclusive", "pass").index(_kind(f)))
    rows = (
        "".join(
            f'<li><span class="dot {_kind(f)}" title="{_kind(f)}">{MARK[_kind(f)]}</span>'
            f"<span><b>{esc(f.get('what'))}</b> · {esc(f.get('evidence'))}</span></li>"
            for f in findings
        )
        or '<li class="soft">the log gives no reasons for its verdict</li>'
    )
    return f'<section class="panel"><h2>Why this verdict</h2><ul class="findings">{rows}</ul></section>'


def _kind(finding: dict[str, Any]) -> str:
    verdict = str(finding.get("verdict"))
    return verdict if verdict in MARK else "inconclusive"


def _accuracy(result: dict[str, Any]) -> str:
    rows = []
    for key, name in (("theta_w", "winding θw"), ("theta_r", "rotor θr")):
        figures = look_up(result, "accuracy", key) or {}
        raw, est = figures.get("raw_rmse_degc"), figures.get("est_rmse_degc")
        ratio = f"{raw / est:.1f}×" if raw and est else NONE
        rows.append(
            f'<tr><th scope="row">{name}</th><td class="n">{number(raw, 3)}</td><td class="n big">{number(est, 3)}</td>'
            f'<td class="n">{number(figures.get("est_max_degc"), 3)}</td><td class="n">{ratio}</td></tr>'
        )
    samples = look_up(result, "accuracy", "theta_w", "samples")
    judged = f"; {number(samples)} estimates judged" if samples is not None else ""
    return f"""<section class="panel"><h2>Accuracy against truth</h2><div class="scroll"><table>
<thead><tr><th></th><th class="n">sensor<small>RMSE, K</small></th><th class="n">estimate<small>RMSE, K</small></th>
<th class="n">estimate<small>max |error|, K</small></th><th class="n">gain<small>sensor/est.</small></th></tr></thead>
<tbody>{"".join(rows)}</tbody></table></div><p class="note">from 10 s after the first estimate{judged}</p></section>"""


def _timing(data: ReportData) -> str:
    timing = look_up(data.result, "timing", "estimator") or {}
    rows = []
    for key, name in (("wake_lat_us", "wake latency"), ("exec_wall_us", "execution"), ("resp_us", "response")):
        if data.lockstep and key != "exec_wall_us":
            rows.append(f'<tr><th scope="row">{name}</th><td class="n soft" colspan="3">{LOCKSTEP}</td></tr>')
            continue
        figures = timing.get(key) or {}
        cells = "".join(f'<td class="n">{number(figures.get(q), 1)}</td>' for q in ("p50", "p99", "max"))
        rows.append(f'<tr><th scope="row">{name}</th>{cells}</tr>')
    late, skipped, jobs = timing.get("miss_late"), timing.get("miss_skipped"), timing.get("jobs")
    misses = LOCKSTEP if data.lockstep else f"{number(late)} late, {number(skipped)} skipped"
    causes = timing.get("causes") or {}
    named = ", ".join(f"{number(n)} {esc(str(c).replace('_', ' '))}" for c, n in causes.items())
    blamed = f" · causes named by the jobs: {named}" if named and not data.lockstep else ""
    return f"""<section class="panel"><h2>Timing of the estimator</h2><div class="scroll"><table>
<thead><tr><th></th><th class="n">p50<small>µs</small></th><th class="n">p99<small>µs</small></th>
<th class="n">max<small>µs</small></th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>
<p class="note">{number(jobs)} jobs · misses: <b>{misses}</b>{blamed}
· warm-up {number(timing.get("warmup_jobs"))} jobs, not in the figures</p></section>"""


def frames_table(frames: tuple[FrameStat, ...]) -> str:
    """One row per id; what departs from the DBC is marked in red."""
    rows = []
    for f in frames:
        rows.append(
            f'<tr><td class="mono id">0x{f.can_id:03X}</td><td>{esc(f.name)}</td><td>{esc(f.sender)}</td>'
            f'<td class="n">{number(f.cycle_ms)}</td><td class="n">{number(f.count)}</td>'
            f'<td class="n{" hot" if f.rate_ok is False else ""}">{number(f.rate_hz, 2)}</td>'
            f'<td class="n">{number(f.gap_min_ms, 2)}</td>'
            f'<td class="n{" hot" if f.timed_out else ""}">{number(f.gap_max_ms, 2)}</td>'
            f'<td class="n">{number(f.jitter_ms, 3)}</td>'
            f"{_count(f.missing, hot=False)}{_count(f.timeouts)}"
            f"{_count(f.counter_gaps)}{_count(f.repeats)}{_count(f.crc_errors)}</tr>"
        )
    return f"""<section class="panel frames"><h2>Frames on the bus, against the DBC</h2><div class="scroll"><table>
<thead><tr><th>id</th><th>message</th><th>sender</th>
<th class="n">cycle<small>DBC, ms</small></th><th class="n">frames</th>
<th class="n">rate<small>Hz</small></th><th class="n">min gap<small>ms</small></th>
<th class="n">max gap<small>ms</small></th><th class="n">jitter<small>std, ms</small></th>
<th class="n">missing<small>cycles</small></th><th class="n">timeouts</th>
<th class="n">counter gaps</th><th class="n">E2E repeats</th><th class="n">E2E CRC</th></tr></thead>
<tbody>{"".join(rows)}</tbody></table></div>
<p class="note">gaps between receptions by the logger, jitter their standard deviation; the cycle of frames sent once
per job is the loop's period, where skipped releases are missing cycles; red: rate more than 5 % off the cycle,
silence beyond the DBC timeout, or an end-to-end (E2E) fault</p></section>"""


def _count(value: int | None, hot: bool = True) -> str:
    return f'<td class="n{" hot" if value and hot else ""}">{number(value)}</td>'


def identity(data: ReportData) -> str:
    """What ran and where: two lists."""

    def listing(title: str, pairs: tuple[tuple[str, str], ...]) -> str:
        rows = "".join(f'<dt>{esc(k)}</dt><dd class="mono">{esc(v)}</dd>' for k, v in pairs)
        rows = rows or "<dt>nothing recorded</dt><dd></dd>"
        return f'<section class="panel"><h2>{title}</h2><dl class="kv">{rows}</dl></section>'

    return (
        f'<div class="grid cols2">{listing("Identity", data.identity)}{listing("Environment", data.environment)}</div>'
    )
