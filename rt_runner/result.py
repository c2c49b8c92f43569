"""The result of a run, computed from the frames in its log and from nothing else.

``ResultAccumulator`` is fed every decoded frame in log order: by the logger while it writes, by ``inspect`` and
the report when they read. What no frame can tell (which bus, who crashed, stolen time) comes in ``RunFacts``.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, field, fields

from rt_runner.judge import Finding, overall
from rt_runner.node_account import RELEASES_LAST as RELEASES_LAST
from rt_runner.node_account import SKIPPED_LAST as SKIPPED_LAST
from rt_runner.node_account import NodeAccount, Terms
from rt_runner.sensor_account import SensorAccount
from rt_runner.timing_account import CAUSES as CAUSES
from rt_runner.timing_account import MACHINE_CAUSES as MACHINE_CAUSES
from rt_runner.timing_account import RELEASE_BITS as RELEASE_BITS
from rt_runner.timing_account import Unwrapper as Unwrapper
from rt_runner.timing_config import grace_releases

TICK_S = 0.01
TICK_BITS = 16
SETTLE_S = 10.0  # accuracy is judged from here after the first estimate: the net's memory starts empty
REPEATED, WRONG_CRC = 1, 4  # E2E states as in the log
STATUS_SHOWN = ("init", "starting", "ok", "predicting", "input_stale", "invalid", "open_loop", "fallback")
CORE_FAULTS = {
    "EstCoreFaults": ("restarts", "held_intervals", "late_measurements", "stray_ticks"),
    "EstCoreFaults2": ("off_grid", "invalid_inputs", "unconverged", "repeated_ticks"),
}
CONTROLLER_COUNTS = {
    "Fallbacks": ("mute", "shifted", "by_rule", "clamped"),
    "Solves": ("failed", "unconverged", "no_estimate", "bad_inputs"),
}


@dataclass(frozen=True)
class Limits:
    """What a run is judged against (scenario table ``[limits]``)."""

    miss_rate_max: float = 0.05
    theta_w_rmse_max_degc: float = 0.25
    theta_r_rmse_max_degc: float = 0.25


@dataclass(frozen=True)
class RunFacts:
    """What the log's frames cannot say about a run; crosses process borders as JSON."""

    bus: str = "unknown"
    scenario: str = "unknown"
    duration_s: float | None = None
    period_s: float = 0.1
    lockstep: bool = False
    stopped_by: str = "end"  # end | interrupt | misses | crash
    crash: str | None = None  # which process, its exit, its last words
    seed: int | None = None
    granted: dict = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    steal_ms: float | None = None
    log_dropped: int = 0  # frames the kernel or the hub dropped before the logger saw them
    log_cut_short: bool = False  # the logger could not take all that had arrived
    faults: tuple[str, ...] = ()  # of the sensors, as text
    mk: tuple[int, int] | None = None  # at most m misses in any K releases
    grace_releases: int | None = None  # releases of start-up grace; None: an older log does not say
    restarts: tuple[str, ...] = ()  # how processes ended that were then started again
    controller: str | None = None  # the name of the one that closes the loop

    @staticmethod
    def from_dict(values: dict) -> "RunFacts":
        """Build from parsed JSON; unknown keys are ignored so that a newer runner's log can still be read."""
        known = {f.name for f in fields(RunFacts)}
        kept = {k: v for k, v in values.items() if k in known}
        if isinstance(kept.get("limits"), dict):
            names = {f.name for f in fields(Limits)}
            kept["limits"] = Limits(**{k: v for k, v in kept["limits"].items() if k in names})
        kept["faults"] = tuple(kept.get("faults") or ())
        kept["mk"] = tuple(kept["mk"]) if kept.get("mk") else None
        kept["restarts"] = tuple(kept.get("restarts") or ())
        return RunFacts(**kept)


@dataclass
class _Trace:
    """A temperature pair over unwrapped ticks."""

    tick: list[int] = field(default_factory=list)
    theta_w_degc: list[float | None] = field(default_factory=list)
    theta_r_degc: list[float | None] = field(default_factory=list)

    def add(self, tick: int, theta_w: float | None, theta_r: float | None) -> None:
        self.tick.append(tick)
        self.theta_w_degc.append(theta_w)
        self.theta_r_degc.append(theta_r)


class ResultAccumulator:
    """Collects what a result needs, frame by frame. Memory grows by about 100 bytes per temperature or job."""

    def __init__(self) -> None:
        self._ticks: dict[str, Unwrapper] = {}
        self._truth, self._sensor, self._estimate = _Trace(), _Trace(), _Trace()
        self._sensors = SensorAccount()
        self._first_estimate_tick: int | None = None
        self._estimator, self._controller = NodeAccount("Est", "estimator"), NodeAccount("Ctl", "controller")
        self._last: dict[str, dict[str, float | None]] = {}
        self._counter: dict[str, int] = {}
        self._frames = self._lost = self._damaged = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    def feed(self, t_ns: int, name: str, values: dict[str, float | None], e2e: int = 0) -> None:
        """Take one decoded frame.

        Parameters
        ----------
        t_ns : receive stamp
        name : message name in the DBC; unknown names only count
        values : signal -> physical value, None where not available
        e2e : 0 ok, 1 repeated, 2 lost, 3 wrong sequence, 4 wrong CRC
        """
        self._frames += 1
        self._first_ns = t_ns if self._first_ns is None else self._first_ns
        self._last_ns = max(self._last_ns, t_ns)
        if e2e == WRONG_CRC:
            self._damaged += 1
            return
        counter = values.get("counter")
        if counter is not None:
            before = self._counter.get(name)
            if before is not None and e2e != REPEATED:  # a repeat is no gap
                self._lost += (int(counter) - before - 1) % 16
            self._counter[name] = int(counter)
        self._estimator.feed(name, values)
        self._controller.feed(name, values)
        handler = getattr(self, f"_on_{name}", None)
        if handler is not None:
            handler(values)
        else:
            self._last[name] = values

    # ---- temperatures ---------------------------------------------------------------------------------
    def _tick(self, values: dict[str, float | None]) -> int | None:
        """Every temperature frame's tick on one common, unwrapped axis."""
        wrapped = values.get("tick")
        if wrapped is None:
            return None
        unwrap = self._ticks.setdefault("all", Unwrapper(TICK_BITS))
        return unwrap(wrapped)

    def _on_TruthTemp(self, v: dict) -> None:
        tick = self._tick(v)
        if tick is not None and (not self._truth.tick or tick > self._truth.tick[-1]):
            self._truth.add(tick, v.get("theta_w_true_degc"), v.get("theta_r_true_degc"))

    def _on_TempMeas(self, v: dict) -> None:
        tick = self._tick(v)
        if tick is not None:
            self._sensor.add(tick, v.get("theta_w_meas_degc"), v.get("theta_r_meas_degc"))

    def _on_Estimate(self, v: dict) -> None:
        self._last["Estimate"] = v
        tick = self._tick(v) if v.get("theta_w_est_degc") is not None else None
        if tick is None:
            return
        if self._first_estimate_tick is None:
            self._first_estimate_tick = tick
        self._estimate.add(tick, v.get("theta_w_est_degc"), v.get("theta_r_est_degc"))

    def _on_EstWinding(self, v: dict) -> None:
        self._on_channel("theta_w", v)

    def _on_EstRotor(self, v: dict) -> None:
        self._on_channel("theta_r", v)

    def _on_channel(self, channel: str, v: dict) -> None:
        if self._last.get("Estimate", {}).get("theta_w_est_degc") is None:
            return  # nothing is estimated yet, and its tick means nothing
        tick = self._tick(v)
        if tick is not None:
            self._sensors.add_job(channel, tick, v)

    def _on_TruthFault(self, v: dict) -> None:
        tick = self._tick(v)
        if tick is not None:
            self._sensors.add_truth(tick, v)

    def _on_EstCalibration(self, v: dict) -> None:
        self._sensors.add_calibration(v)

    def _true_at(self, tick: int, channel: str) -> float | None:
        """Truth between its two neighbouring samples, linear; None outside what was logged."""
        ticks, theta = self._truth.tick, getattr(self._truth, channel)
        i = bisect_right(ticks, tick)
        if i == 0 or (i == len(ticks) and ticks[-1] != tick):
            return None
        a, b = i - 1, min(i, len(ticks) - 1)
        if theta[a] is None or theta[b] is None:
            return None
        span = ticks[b] - ticks[a]
        if span > 100:  # a second without truth is a hole, not a line
            return None
        return theta[a] if span == 0 else theta[a] + (theta[b] - theta[a]) * (tick - ticks[a]) / span

    def _errors(self, trace: _Trace, channel: str) -> list[tuple[int, float]]:
        """(tick, error) of what is judged: from `SETTLE_S` after the first estimate on."""
        if self._first_estimate_tick is None:
            return []
        from_tick = self._first_estimate_tick + round(SETTLE_S / TICK_S)
        out = []
        for tick, theta in zip(trace.tick, getattr(trace, channel), strict=True):
            if theta is None or tick < from_tick:
                continue
            true = self._true_at(tick, channel)
            if true is not None:
                out.append((tick, theta - true))
        return out

    def _accuracy(self, channel: str) -> dict[str, float | int | None]:
        raw, est = ([e for _, e in self._errors(t, channel)] for t in (self._sensor, self._estimate))
        return {
            "raw_rmse_degc": _rms(raw),
            "est_rmse_degc": _rms(est),
            "est_max_degc": max(map(abs, est)) if est else None,
            "samples": len(est),
        }

    def _sensor_accounts(self) -> dict:
        out: dict = {}
        for channel in ("theta_w", "theta_r"):
            key = f"{channel}_degc"
            errors = dict(self._errors(self._estimate, key))
            out[channel] = self._sensors.channel(channel, lambda tick, key=key: self._true_at(tick, key), errors)
        return {**out, "calibration": self._sensors.calibration()}

    def _count(self, message: str, signal: str) -> int:
        value = self._last.get(message, {}).get(signal)
        return 0 if value is None else int(value)

    # ---- the result -----------------------------------------------------------------------------------
    def result(self, facts: RunFacts) -> dict:
        """Judge the run.

        Returns
        -------
        dict ready for JSON: ``verdict`` (pass | fail | inconclusive), ``findings`` with the evidence, and the figures.
        Temperatures in degC, times in us or s as named; None where a figure does not exist (n/a).
        """
        accuracy = {c: self._accuracy(f"{c}_degc") for c in ("theta_w", "theta_r")}
        span_s = (self._last_ns - self._first_ns) / 1e9 if self._first_ns is not None else 0.0
        closed = self._closed(facts)
        dropped = max(self._lost, facts.log_dropped)  # the same frames, seen by their counters and by the kernel
        findings = [
            *self._judge_run(facts),
            *self._judge_accuracy(accuracy, facts),
            *self._judge_timing(facts, dropped),
            self._judge_log(dropped, facts.log_cut_short),
        ]
        return {
            "verdict": overall(findings),
            "findings": [vars(f) for f in findings],
            "bus": facts.bus,
            "scenario": facts.scenario,
            "seed": facts.seed,
            "faults": list(facts.faults),
            "duration_s": round(facts.duration_s if facts.duration_s is not None else span_s, 3),
            "accuracy": accuracy,
            "sensors": self._sensor_accounts(),
            "timing": {
                "estimator": self._estimator.figures(facts.period_s, facts.mk, facts.grace_releases),
                **({"controller": self._controller.figures(self._controller_period_s())} if closed else {}),
            },
            "granted": {k: facts.granted.get(k) for k in ("policy", "core", "mlock")},
            "environment": {
                "steal_ms": facts.steal_ms,
                "warnings": facts.granted.get("warnings", []),
                **self._estimator.environment(),
            },
            "input_faults": self._estimator.faults("input"),
            "bus_faults": self._estimator.faults("bus"),
            "core_faults": {k: self._count(m, k) for m, ks in CORE_FAULTS.items() for k in ks},
            "plant": {
                "ticks_late": self._count("PlantStatus", "ticks_late"),
                "late_max_ms": self._last.get("PlantStatus", {}).get("late_max_ms"),
            },
            "log": {"frames": self._frames, "dropped": dropped, "damaged": self._damaged},
            **({"controller": self._controller_figures(facts)} if closed else {}),
        }

    def _closed(self, facts: RunFacts) -> bool:
        """Whether a controller was to close the loop, or did."""
        return facts.controller is not None or self._controller.heard

    def _controller_period_s(self) -> float | None:
        period_us = self._controller.value("Granted", "period_us")
        return None if period_us is None else period_us / 1e6

    def _controller_figures(self, facts: RunFacts) -> dict:
        """What became of the controller beside its loop's timing."""
        node = self._controller
        return {
            "name": facts.controller,
            **{k: node.count(m, k) for m, ks in CONTROLLER_COUNTS.items() for k in ks},
            "input_faults": node.faults("input"),
            "bus_faults": node.faults("bus"),
            "environment": {"steal_ms": node.value("Machine", "steal_ms"), **node.environment()},
        }

    def _judge_run(self, facts: RunFacts) -> list[Finding]:
        if facts.crash:
            return [Finding("run", "fail", facts.crash)]
        if facts.restarts:
            return [Finding("run", "fail", f"{words}; it was started again") for words in facts.restarts]
        if facts.stopped_by == "misses":
            says = "the estimator stopped itself: the number of misses in its policy was reached"
            return [Finding("policy", "fail", says)]
        if facts.stopped_by == "interrupt":
            return [Finding("run", "inconclusive", "stopped by hand before its end")]
        return []

    def _judge_accuracy(self, accuracy: dict, facts: RunFacts) -> list[Finding]:
        if self._first_estimate_tick is None:
            return [Finding("accuracy", "inconclusive", "no estimate with a temperature is in the log")]
        if not self._truth.tick:
            return [Finding("accuracy", "pass", "no truth on this bus: nothing to compare with, not judged")]
        limits, whole = facts.limits, facts.stopped_by == "end"
        out = []
        for channel, limit in (("theta_w", limits.theta_w_rmse_max_degc), ("theta_r", limits.theta_r_rmse_max_degc)):
            rmse, what = accuracy[channel]["est_rmse_degc"], f"{channel} accuracy"
            if rmse is None:
                says = f"nothing logged later than {SETTLE_S:g} s after the first estimate: run longer"
                out.append(Finding(what, "inconclusive", says))
                continue
            says = f"RMSE {rmse:.3f} degC, limit {limit:g} degC"
            if rmse > limit and not whole:  # the limit is one for the whole scenario
                out.append(Finding(what, "inconclusive", f"{says}, of a part of the scenario"))
            else:
                out.append(Finding(what, "pass" if rmse <= limit else "fail", says))
        return out

    def _judge_timing(self, facts: RunFacts, dropped: int) -> list[Finding]:
        limit = facts.limits.miss_rate_max
        terms = Terms(limit, facts.mk, facts.grace_releases, facts.lockstep, facts.steal_ms, dropped)
        out = self._estimator.judge(terms)
        if self._closed(facts):
            period_s = self._controller_period_s()
            grace = None if period_s is None else grace_releases(None, period_s)
            steal_ms = self._controller.value("Machine", "steal_ms")
            terms = Terms(limit, None, grace, facts.lockstep, steal_ms, dropped)
            out += self._controller.judge(terms, "controller")
        return out

    def _judge_log(self, dropped: int, cut_short: bool) -> Finding:
        trouble = [f"{dropped} frames missing"] if dropped else []
        trouble += [f"{self._damaged} damaged"] if self._damaged else []
        trouble += ["the logger could not take all that had arrived"] if cut_short else []
        if trouble:
            return Finding("log", "inconclusive", f"{', '.join(trouble)}: figures may be wrong")
        return Finding("log", "pass", f"{self._frames} frames, none missing by their counters")


def _rms(errors: list[float]) -> float | None:
    return math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else None

