"""Describes each chart as plain data: which series, axes, marks and shades; the page's script only draws them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.report.data import Array, Jobs, ReportData, Temperature, Trace
from tools.report.series import decimate, log_histogram

MAX_POINTS = 8000  # per series: over three for each pixel of a wide screen, so a little zoom is still sharp
MAX_MARKS = 4000
COUNT_FLOOR = 0.6  # a log axis has no zero: it starts under one count,
ZERO_COUNT = 0.3  # and empty bins lie below it, out of sight
T_UNIT_S = 1e-4


def build_charts(data: ReportData) -> list[dict[str, Any]]:
    """All charts of the page, in reading order."""
    return [
        _temperature_chart("winding", "Winding temperature", "θw", data.winding, data),
        _temperature_chart("rotor", "Rotor temperature", "θr", data.rotor, data),
        _error_chart("winding-error", "Winding error against truth", data.winding, data),
        _error_chart("rotor-error", "Rotor error against truth", data.rotor, data),
        _drive_chart(data),
        _histogram_chart(data),
        _response_chart(data),
    ]


def time_range(data: ReportData) -> list[float]:
    """First and last second that any time chart shows."""
    traces = [*vars(data.winding).values(), *vars(data.rotor).values(), data.torque, data.speed]
    times = [t.t_s for t in traces if t.t_s.size] + ([data.jobs.t_s] if data.jobs.t_s.size else [])
    if not times:
        return [0.0, max(data.duration_s, 1.0)]
    low, high = min(float(t[0]) for t in times), max(float(t[-1]) for t in times)
    low, high = min(low, 0.0), max(high, data.duration_s)
    return [round(low, 3), round(max(high, low + 0.1), 3)]


def _time_axis(data: ReportData) -> dict[str, Any]:
    return {"label": "time since start of the log (s)", "log": False, "range": time_range(data)}


def _spans(data: ReportData, kinds: tuple[str, ...] = ("unjudged", "status")) -> list[dict[str, Any]]:
    spans = [s for s in data.spans if s.kind in kinds]
    return [{"t0": round(s.start_s, 3), "t1": round(s.end_s, 3), "label": s.label, "kind": s.kind} for s in spans]


def encode(trace: Trace, digits: int, max_points: int = MAX_POINTS) -> dict[str, Any]:
    """A trace as JSON lists: time differences in units of 0.1 ms (first from 0), values rounded, NaN as null."""
    kept = decimate(trace, max_points)
    ticks = np.round(kept.t_s / T_UNIT_S).astype(np.int64)
    # Two samples in one 0.1 ms would be one sample to the plot: keep them apart.
    order = np.arange(ticks.size)
    ticks = np.maximum.accumulate(ticks - order) + order
    values = [None if v is None or v != v else v for v in np.round(kept.value, digits).tolist()]
    return {"dt": np.diff(ticks, prepend=0).tolist(), "y": values}


def _line(
    trace: Trace, label: str, unit: str, scale: str, colour: str, digits: int, **look: Any
) -> list[dict[str, Any]]:
    """One drawn series, or none where the log has no such data."""
    if not trace:
        return []
    style = {"style": "line", "width": 1.5, "dash": None, **look}
    return [
        {
            "label": label,
            "unit": unit,
            "scale": scale,
            "colour": colour,
            "digits": digits,
            **style,
            **encode(trace, digits),
        }
    ]


def _temperature_chart(name: str, title: str, symbol: str, node: Temperature, data: ReportData) -> dict[str, Any]:
    missing = [] if node.truth else ["this log has no truth: a real motor, or truth frames left out"]
    return {
        "id": name,
        "title": title,
        "height": 250,
        "x": _time_axis(data),
        "spans": _spans(data),
        "name_spans": True,
        "note": "; ".join(["estimate drawn at the time it is valid for, sensor when it arrives", *missing]),
        "y": [{"scale": "degc", "label": f"{symbol} (°C)", "unit": "°C", "min_span": 1.0}],
        "series": [
            *_line(node.truth, "truth", "°C", "degc", "--truth", 2, width=4),
            *_line(node.sensor, "sensor", "°C", "degc", "--sensor", 2, width=1),
            *_line(node.estimate, "estimate", "°C", "degc", "--est", 3, width=1.8),
        ],
    }


def _error_chart(name: str, title: str, node: Temperature, data: ReportData) -> dict[str, Any]:
    return {
        "id": name,
        "title": title,
        "height": 180,
        "x": _time_axis(data),
        "spans": _spans(data),
        "note": "at the same plant tick, so delay counts; hide the sensor in the legend to enlarge",
        "y": [{"scale": "k", "label": "error (K)", "unit": "K", "zero": True, "min_span": 0.2}],
        "series": [
            *_line(node.sensor_error, "sensor − truth", "K", "k", "--sensor", 3, width=1),
            *_line(node.estimate_error, "estimate − truth", "K", "k", "--est", 3, width=1.8),
        ],
    }


def _drive_chart(data: ReportData) -> dict[str, Any]:
    return {
        "id": "drive",
        "title": "Torque and speed",
        "height": 210,
        "x": _time_axis(data),
        "spans": _spans(data, ("status",)),
        "note": _decimation_note(data.torque),
        "y": [
            {
                "scale": "nm",
                "label": "torque (N·m)",
                "unit": "N·m",
                "zero": True,
                "min_span": 1.0,
                "colour": "--torque",
            },
            {
                "scale": "rpm",
                "label": "speed (rpm)",
                "unit": "rpm",
                "zero": True,
                "min_span": 10.0,
                "colour": "--speed",
            },
        ],
        "series": [
            *_line(data.torque, "torque", "N·m", "nm", "--torque", 1, width=1.2),
            *_line(data.speed, "speed", "rpm", "rpm", "--speed", 0, width=1.4, dash=[7, 3]),
        ],
    }


def _decimation_note(trace: Trace) -> str:
    if trace.t_s.size <= MAX_POINTS:
        return ""
    bucket_ms = (trace.t_s[-1] - trace.t_s[0]) / (MAX_POINTS // 2) * 1e3
    count = f"{trace.t_s.size:,}".replace(",", "\u202f")
    return f"{count} samples, drawn as lowest and highest of each {bucket_ms:.0f} ms"


def _deadline(data: ReportData, scale: str) -> list[dict[str, Any]]:
    deadline_s = data.deadline_s
    if deadline_s is None:
        return []
    what = "release period" if data.lockstep else "deadline"
    return [{"scale": scale, "value": deadline_s * 1e6, "label": f"{what} {_milli(deadline_s)}"}]


def _milli(seconds: float) -> str:
    return f"{seconds * 1e3:g} ms"


def _timing_series(data: ReportData) -> list[tuple[str, Array, str, list[int] | None]]:
    """The three times of a job that this log can have; in lock-step the response is the execution itself."""
    jobs = data.jobs
    wake = ("wake latency", jobs.wake_us, "--wake", [6, 3])
    response = ("response", jobs.resp_us, "--resp", None)
    execution = ("execution", jobs.exec_us, "--exec", [2, 2])
    chosen = [execution] if data.lockstep else [wake, execution, response]
    return [entry for entry in chosen if np.isfinite(entry[1]).any()]


def _histogram_chart(data: ReportData) -> dict[str, Any]:
    chosen = _timing_series(data)
    histogram = log_histogram([entry[1] for entry in chosen])
    edges = [float(f"{e:.5g}") for e in histogram.edges_us]
    series = []
    for (label, _, colour, dash), counts in zip(chosen, histogram.counts, strict=True):
        # The last edge closes the last step; empty bins go under the axis, a log scale has no zero.
        y = [*(c if c else ZERO_COUNT for c in counts.tolist()), ZERO_COUNT]
        series.append(
            {
                "label": label,
                "unit": "jobs",
                "scale": "n",
                "colour": colour,
                "digits": 0,
                "style": "steps",
                "width": 1.8,
                "dash": dash,
                "x": edges,
                "y": y,
                "zero_below": 1,
            }
        )
    deadline = _deadline(data, "x")
    values = [*edges, *(line["value"] for line in deadline)]
    span = (
        [10.0 ** np.floor(np.log10(min(values))), 10.0 ** np.ceil(np.log10(max(values) * 1.05))] if edges else [1, 1e5]
    )
    note = "wake latency and response from the intended release; all jobs, warm-up too; 20 bins a decade"
    if data.lockstep:
        note += "; wake latency and response n/a (lock-step)"
    return {
        "id": "histogram",
        "title": "Timing histogram",
        "height": 280,
        "note": note,
        "lines": deadline,
        "x": {"label": "time (µs … s)", "log": True, "range": [float(span[0]), float(span[1])]},
        "y": [{"scale": "n", "label": "jobs per bin", "unit": "", "log": True, "floor": COUNT_FLOOR}],
        "series": series,
    }


def _response_chart(data: ReportData) -> dict[str, Any]:
    jobs, series = data.jobs, []
    for label, values, colour, _ in _timing_series(data):
        if label == "wake latency":
            continue
        series += _line(Trace(jobs.t_s, values), label, "µs", "us", colour, 1, style="dots", width=1)
    marks = [
        ("late", "--miss", False, jobs.t_s[jobs.late], jobs.resp_us[jobs.late]),
        ("skipped", "--skip", True, jobs.skipped_t_s, _at_deadline(jobs, data.deadline_s)),
    ]
    notes = []
    for label, colour, hollow, t_s, y in marks:
        if not t_s.size or data.lockstep:
            continue
        at = _thin(t_s.size)
        if at.size < t_s.size:
            notes.append(f"{at.size} of {t_s.size} {label} marks drawn")
        series.append(
            {
                "label": f"{label} ({t_s.size})",
                "unit": "µs",
                "scale": "us",
                "colour": colour,
                "digits": 1,
                "style": "marks",
                "hollow": hollow,
                "width": 2,
                **encode(Trace(t_s[at], y[at]), 1, MAX_MARKS),
            }
        )
    if data.lockstep:
        title, note = "Execution time over time", "response n/a (lock-step): no clock releases the jobs"
    else:
        title, note = "Response time over time", "skipped activations never ran: drawn on the deadline"
    return {
        "id": "response",
        "title": title,
        "height": 220,
        "x": _time_axis(data),
        "spans": _spans(data, ("status",)),
        "note": "; ".join([note, *notes]),
        "lines": _deadline(data, "us"),
        "y": [{"scale": "us", "label": "time", "unit": "µs", "log": True}],
        "series": series,
    }


def _at_deadline(jobs: Jobs, deadline_s: float | None) -> Array:
    return np.full(jobs.skipped_t_s.shape, np.nan if deadline_s is None else deadline_s * 1e6)


def _thin(count: int) -> NDArray[np.int64]:
    """Indices of at most MAX_MARKS marks, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_MARKS)).round().astype(np.int64))
