"""The figures of a `TimingReport` as plain JSON values."""

from typing import Any

from rt_runner.log_summary import RATE_TOLERANCE
from rt_runner.timing.analyse import ProcessTiming, TimingReport
from rt_runner.timing.cycles import CycleRow
from rt_runner.timing.misses import MK_WINDOW


def cycle_ok(row: CycleRow) -> bool | None:
    """Whether a message kept its cycle and was never silent beyond its timeout; None where no frame was expected."""
    if not row.frames and not row.timeouts:
        return None
    return row.timeouts == 0 and row.rate_ok(RATE_TOLERANCE) is not False


def as_json(report: TimingReport) -> dict[str, Any]:
    """The figures, ready for JSON; times in us or ms as named."""
    setup = report.setup
    out: dict[str, Any] = {
        "log": report.path,
        "verdict": report.verdict,
        "findings": [vars(f) for f in report.findings],
        "bus": setup.facts.bus,
        "scenario": setup.facts.scenario,
        "lockstep": setup.facts.lockstep,
        "period_us": setup.period_ns / 1e3,
        "deadline_us": setup.deadline_ns / 1e3,
        "policy": setup.policy,
        "on_miss": setup.on_miss,
        "trigger": setup.trigger,
        "frames": report.frames,
        "span_s": round(report.span_s, 6),
        "complete": report.complete,
        "trouble": report.trouble,
        "cycles": [{**vars(r), "frame_id": f"0x{r.frame_id:03X}", "ok": cycle_ok(r)} for r in report.cycles],
        "steal_ms": setup.facts.steal_ms,
    }
    for p in report.processes:
        out[p.process.name] = {
            "period_us": p.period_ns / 1e3,
            "deadline_us": p.deadline_ns / 1e3,
            "windows": {w: {m: s.as_json() for m, s in rows.items()} for w, rows in p.windows.items()},
            "misses": {
                "since_start": p.account.judged.as_json(),
                "warmup": p.account.warmup.as_json(),
                "consec_miss_max": p.account.consecutive,
                "mk_worst": p.account.worst(MK_WINDOW),
                "mk": _mk(p, setup.mk),
                "unseen_releases": p.account.unseen,
            },
            "published": p.published,
            "audit": p.audit.as_json(),
        }
    audits = [p.audit for p in report.processes]
    out["audit"] = {
        "ok": all(a.ok for a in audits),
        "checks": [{"process": p.process.name, **vars(c)} for p in report.processes for c in p.audit.checks],
        "missing": [m.as_json() for a in audits for m in a.missing],
        "drops": {**{k: v for a in audits for k, v in a.drops.items()}, "logger": setup.facts.log_dropped},
    }
    return out


def _mk(timing: ProcessTiming, mk: tuple[int, int] | None) -> dict[str, int] | None:
    if mk is None:
        return None
    m, k = mk
    return {"m": m, "k": k, "worst": timing.account.worst(k, timing.account.judged_from)}
