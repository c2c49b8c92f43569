"""Sorts decoded frames into columns while a log is read; knows the message names of the DBC, not the file format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rt_runner.result import CAUSES, RELEASE_BITS, SETTLE_S, STATUS_SHOWN, TICK_S
from tools.report.data import Array, Jobs, Span, Temperature, Trace
from tools.report.series import error_against_truth, time_of_tick, unwrap_ticks, with_gaps

WRONG_CRC = 4
STATUS_INIT, STATUS_STARTING, STATUS_OK = 0, 1, 2
RELEASE_MODULUS = 1 << RELEASE_BITS
TRUTH_REACH_TICKS = 100.0  # as the runner's result: a second without truth is a hole

# message -> the signals that become columns
WANTED = {
    "MotorState": ("tick", "torque_nm", "speed_rpm"),
    "TempMeas": ("tick", "theta_w_meas_degc", "theta_r_meas_degc"),
    "Estimate": ("tick", "theta_w_est_degc", "theta_r_est_degc", "status"),
    "TruthTemp": ("tick", "theta_w_true_degc", "theta_r_true_degc"),
    "EstTimingA": ("release_index", "wake_lat_us", "miss_late", "warmup"),
    "EstTimingB": ("exec_wall_us", "resp_us", "miss_cause"),
}
KEPT_LAST = ("EstIdentity", "EstBuild", "EstGranted", "PlantIdentity")


class Collector:
    """Fed every decoded frame in log order; afterwards turns its columns into the report's signals."""

    def __init__(self) -> None:
        self.first_ns: int | None = None
        self.last: dict[str, dict[str, float | None]] = {}
        self._rows: dict[str, list[tuple[float | None, ...]]] = {name: [] for name in WANTED}
        self._t_ns: dict[str, list[int]] = {name: [] for name in WANTED}
        self._ticked: list[tuple[str, int]] = []
        self._ticks: list[int] = []

    def feed(self, t_ns: int, name: str, values: dict[str, float | None], e2e: int) -> None:
        """Take one frame; a damaged one says nothing."""
        self.first_ns = t_ns if self.first_ns is None else min(self.first_ns, t_ns)
        if e2e == WRONG_CRC:
            return
        if name in KEPT_LAST:
            self.last[name] = values
        wanted = WANTED.get(name)
        if wanted is None:
            return
        tick = values.get("tick") if wanted[0] == "tick" else None
        # An estimator that has heard no plant yet sends a tick that means nothing: only its status counts.
        if tick is not None and (name != "Estimate" or values.get("theta_w_est_degc") is not None):
            self._ticks.append(int(tick))
            self._ticked.append((name, len(self._rows[name])))
        self._rows[name].append(tuple(values.get(signal) for signal in wanted))
        self._t_ns[name].append(t_ns)

    # ---- columns --------------------------------------------------------------------------------------
    def _columns(self, name: str) -> dict[str, Array]:
        table = np.array(self._rows[name], dtype=float).reshape(-1, len(WANTED[name]))
        columns = dict(zip(WANTED[name], table.T, strict=True))
        columns["t_s"] = (np.array(self._t_ns[name], dtype=np.int64) - (self.first_ns or 0)) / 1e9
        return columns

    def columns(self) -> dict[str, dict[str, Array]]:
        """Per message its signals as float arrays (NaN: not available), `t_s`, and for those that carry ticks
        `at`, the unwrapped tick (NaN: none), all on one common count."""
        out = {name: self._columns(name) for name in WANTED}
        unwrapped = unwrap_ticks(np.array(self._ticks))
        for name in WANTED:
            if WANTED[name][0] == "tick":
                out[name]["at"] = np.full(len(self._rows[name]), np.nan)
        for (name, row), tick in zip(self._ticked, unwrapped, strict=True):
            out[name]["at"][row] = tick
        return out


@dataclass(frozen=True)
class Signals:
    """What the charts show, aligned to the log's time."""

    winding: Temperature
    rotor: Temperature
    torque: Trace
    speed: Trace
    jobs: Jobs
    spans: tuple[Span, ...]
    cycle_start_s: float | None


def signals_of(columns: dict[str, dict[str, Array]], lockstep: bool) -> Signals:
    """Turn columns into signals: temperatures on plant ticks, drive and jobs on reception."""
    carriers = [columns[n] for n in ("MotorState", "TempMeas", "TruthTemp")]
    seen_at = np.concatenate([c["at"] for c in carriers])
    seen_t = np.concatenate([c["t_s"] for c in carriers])[np.isfinite(seen_at)]
    seen_at = seen_at[np.isfinite(seen_at)]
    order = np.argsort(seen_t, kind="stable")
    seen_at, seen_t = seen_at[order], seen_t[order]

    def node(letter: str) -> Temperature:
        traces, errors = {}, {}
        truth_at, _, truth = _once(columns["TruthTemp"], f"theta_{letter}_true_degc")
        for message, kind in (("TruthTemp", "true"), ("TempMeas", "meas"), ("Estimate", "est")):
            at, received, value = _once(columns[message], f"theta_{letter}_{kind}_degc")
            t_s = time_of_tick(at, seen_at, seen_t) if seen_at.size else received
            traces[kind] = with_gaps(at, Trace(t_s, value))
            error = error_against_truth(at, value, truth_at, truth, TRUTH_REACH_TICKS)
            errors[kind] = with_gaps(at, Trace(t_s, error))
        return Temperature(traces["true"], traces["meas"], traces["est"], errors["meas"], errors["est"])

    motor = columns["MotorState"]
    drive = [with_gaps(motor["at"], Trace(motor["t_s"], motor[signal])) for signal in ("torque_nm", "speed_rpm")]
    cycle = float(np.median(TICK_S * seen_at - seen_t)) if seen_at.size else None
    return Signals(
        node("w"), node("r"), drive[0], drive[1], _jobs(columns, lockstep), _spans(columns["Estimate"]), cycle
    )


def _once(column: dict[str, Array], signal: str) -> tuple[Array, Array, Array]:
    """Tick, reception and value with one sample per tick, the last: a loop faster than the ticks repeats them."""
    placed = np.isfinite(column["at"])
    at, t_s, value = column["at"][placed], column["t_s"][placed], column[signal][placed]
    _, from_end = np.unique(at[::-1], return_index=True)
    keep = at.size - 1 - from_end
    return at[keep], t_s[keep], value[keep]


def _jobs(columns: dict[str, dict[str, Array]], lockstep: bool) -> Jobs:
    """Pair the two timing frames of each job: the B that follows an A before the next A does."""
    a, b = columns["EstTimingA"], columns["EstTimingB"]
    n = a["t_s"].size
    if n == 0:
        return Jobs()
    exec_us, resp_us, cause = (np.full(n, np.nan) for _ in range(3))
    owner = np.searchsorted(a["t_s"], b["t_s"], side="right") - 1
    good = owner >= 0
    # Backwards, so that the first B after an A stays where the next A was lost.
    for into, signal in ((exec_us, "exec_wall_us"), (resp_us, "resp_us"), (cause, "miss_cause")):
        into[owner[good][::-1]] = b[signal][good][::-1]
    index = np.nan_to_num(a["release_index"]).astype(np.int64)
    skipped = []
    if not lockstep:
        steps = np.diff(index) % RELEASE_MODULUS
        for i in np.flatnonzero((steps > 1) & (steps < RELEASE_MODULUS // 2)):
            part = np.arange(1, steps[i]) / steps[i]
            skipped.append(a["t_s"][i] + part * (a["t_s"][i + 1] - a["t_s"][i]))
    return Jobs(
        t_s=a["t_s"],
        wake_us=a["wake_lat_us"],
        exec_us=exec_us,
        resp_us=resp_us,
        late=a["miss_late"] == 1,
        cause=tuple(CAUSES[int(c)] if np.isfinite(c) and int(c) < len(CAUSES) else CAUSES[0] for c in cause),
        skipped_t_s=np.concatenate(skipped) if skipped else np.empty(0),
    )


def _spans(estimate: dict[str, Array]) -> tuple[Span, ...]:
    """Stretches to shade: before accuracy is judged, and wherever the estimator says it is not well."""
    t_s, status = estimate["t_s"], np.nan_to_num(estimate["status"], nan=STATUS_OK).astype(int)
    valid = np.flatnonzero(np.isfinite(estimate["theta_w_est_degc"]))
    spans = []
    judged_from_s = np.inf
    if valid.size:
        judged_from_s = float(t_s[valid[0]]) + SETTLE_S
        spans.append(Span(0.0, judged_from_s, "settling, not judged", "unjudged"))
    edges = np.flatnonzero(np.diff(status)) + 1
    for run in np.split(np.arange(status.size), edges):
        if not run.size or status[run[0]] == STATUS_OK:
            continue
        end = t_s[min(run[-1] + 1, t_s.size - 1)]
        code = int(status[run[0]])
        label = STATUS_SHOWN[code].replace("_", " ") if code < len(STATUS_SHOWN) else f"status {code}"
        # What is normal while the net fills its memory is not worth a second shade there.
        if code in (STATUS_INIT, STATUS_STARTING) and end <= judged_from_s:
            continue
        spans.append(Span(float(t_s[run[0]]), float(end), label, "status"))
    return tuple(spans)
