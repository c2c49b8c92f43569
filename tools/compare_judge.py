"""How good one run was, and what several together say.

Errors are estimate minus truth at the same instant, from 10 s after the start to the lap's end; "window" is the time
of the fault. "Hot" is where the winding is truly above 140 °C, whichever channel is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.estimators.drive import Estimates

Array = NDArray[np.float64]
DT_S = 0.1
JUDGED_FROM_S = 10.0
HOT_DEGC = 140.0
RECOVERED_DEGC, RECOVERED_FOR_S = 1.0, 10.0
GRACE_S = 30.0  # after a fault: an alarm then is not a false one
SLACK_S = 1e-6


@dataclass(frozen=True)
class Figures:
    """One run, one channel. Sums of squares, so that runs can be pooled.

    Attributes
    ----------
    squares, count, most
        Over the judged time: sum of squared errors in K², rows, largest error in K.
    hot_squares, hot_count, window_squares, window_count, window_most
        The same above 140 °C and in the fault's window.
    detection_s
        First published class other than ok, after the fault's start; None: none in the window, or no class published.
    faulty, publishes
        Whether there was a fault; whether the estimator publishes a class.
    alarms, clear_h
        Rising edges of "not ok" outside window and grace, and the hours these were counted over.
    other_alarms, other_h
        The same for the other, always healthy channel, over the whole judged time.
    recovery_s
        After the fault's end until the error stays below 1 K for 10 s; None: never, or no fault.
    classes
        Rows in the window per published class, by code.
    above_upper
        Rows in which the truth was above the published upper bound; None without one.
    nees
        Mean squared error over published variance; None without one.
    """

    squares: float
    count: int
    most: float
    hot_squares: float
    hot_count: int
    window_squares: float
    window_count: int
    window_most: float
    faulty: bool
    publishes: bool
    detection_s: float | None
    alarms: int
    clear_h: float
    other_alarms: int
    other_h: float
    recovery_s: float | None
    classes: tuple[tuple[int, int], ...]
    above_upper: int | None
    nees: float | None


def judge(found: Estimates, truth_degc: Array, channel: int, window_s: tuple[float, float] | None) -> Figures:
    """Figures of one run; truth_degc (n, 2), channel 0 winding or 1 rotor.

    An estimate that is missing or not finite in the judged time counts as an infinite error: silence is no accuracy.
    """
    t_s = DT_S * np.arange(1, len(truth_degc) + 1, dtype=np.float64)
    judged = t_s >= JUDGED_FROM_S - SLACK_S
    error = np.abs(found.theta_degc[:, channel] - truth_degc[:, channel])
    error = np.where(np.isfinite(error), error, math.inf)
    start, end = (math.inf, math.inf) if window_s is None else window_s
    inside = judged & (t_s >= start - SLACK_S) & (t_s < end - SLACK_S)
    hot = judged & (truth_degc[:, 0] > HOT_DEGC)
    clear = judged & ~((t_s >= start - SLACK_S) & (t_s < end + GRACE_S - SLACK_S))

    bad, other_bad = None, None
    if found.fault is not None:
        bad, other_bad = found.fault[:, channel] != 0, found.fault[:, 1 - channel] != 0
    detected = None if bad is None else _first(bad & inside)
    edges = 0 if bad is None else int(np.sum(_rising(bad) & clear))
    nees, above = None, None
    if found.sigma_degc is not None:
        known = judged & (found.sigma_degc[:, channel] > 0.0)
        if known.any():
            nees = float(np.mean((error[known] / found.sigma_degc[known, channel]) ** 2))
    if found.upper_degc is not None and np.isfinite(found.upper_degc[judged, channel]).any():
        above = int(np.sum(judged & (truth_degc[:, channel] > found.upper_degc[:, channel])))
    classes: tuple[tuple[int, int], ...] = ()
    if found.fault is not None and inside.any():
        codes, rows = np.unique(found.fault[inside, channel], return_counts=True)
        classes = tuple((int(c), int(r)) for c, r in zip(codes, rows, strict=True))
    return Figures(
        squares=float(np.sum(error[judged] ** 2)),
        count=int(judged.sum()),
        most=float(error[judged].max()),
        hot_squares=float(np.sum(error[hot] ** 2)),
        hot_count=int(hot.sum()),
        window_squares=float(np.sum(error[inside] ** 2)),
        window_count=int(inside.sum()),
        window_most=float(error[inside].max()) if inside.any() else 0.0,
        faulty=window_s is not None,
        publishes=bad is not None,
        detection_s=None if detected is None else max(0.0, float(t_s[detected]) - start),
        alarms=edges,
        clear_h=float(clear.sum()) * DT_S / 3600.0,
        other_alarms=0 if other_bad is None else int(np.sum(_rising(other_bad) & judged)),
        other_h=float(judged.sum()) * DT_S / 3600.0,
        recovery_s=None if window_s is None else _recovery_s(error, t_s, end),
        classes=classes,
        above_upper=above,
        nees=nees,
    )


def _first(flags: NDArray[np.bool_]) -> int | None:
    return int(flags.argmax()) if flags.any() else None


def _rising(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return flags & ~np.concatenate([[False], flags[:-1]])


def _recovery_s(error: Array, t_s: Array, end_s: float) -> float | None:
    """Time from end_s to the first row from which the error stays small for 10 s."""
    good, need = error < RECOVERED_DEGC, round(RECOVERED_FOR_S / DT_S)
    run = 0
    for k in np.flatnonzero(t_s >= end_s - SLACK_S):
        run = run + 1 if good[k] else 0
        if run == need:
            return max(0.0, float(t_s[k - need + 1]) - end_s)
    return None


def pooled(runs: Sequence[Sequence[Figures]]) -> dict[str, Any]:
    """One case out of its runs [seed][variant].

    RMSE over a seed's variants together, largest error over them; then mean and standard deviation over the seeds.
    Times are means over the runs that have one; `missed` and `unrecovered` are the shares of faulty runs that have
    none. What cannot be said is None.
    """
    flat = [f for seed in runs for f in seed]
    faulty = [f for f in flat if f.faulty]
    rmse = [_rms(sum(f.squares for f in s), sum(f.count for f in s)) for s in runs]
    most = [max(f.most for f in s) for s in runs]
    hot = [_rms(sum(f.hot_squares for f in s), sum(f.hot_count for f in s)) for s in runs]
    inside = [_rms(sum(f.window_squares for f in s), sum(f.window_count for f in s)) for s in runs]
    inside_most = [max(f.window_most for f in s) if any(f.window_count for f in s) else math.nan for s in runs]
    seen = [f.detection_s for f in faulty if f.detection_s is not None]
    back = [f.recovery_s for f in faulty if f.recovery_s is not None]
    publishes = any(f.publishes for f in flat)
    nees = [f.nees for f in flat if f.nees is not None]
    above = [f.above_upper for f in flat if f.above_upper is not None]
    classes: dict[str, int] = {}
    for f in faulty:
        for code, rows in f.classes:
            classes[class_name(code)] = classes.get(class_name(code), 0) + rows
    total = sum(classes.values())
    return {
        "rmse": _mean(rmse),
        "max": _mean(most),
        "rmse_hot": _mean(hot),
        "detection_s": _mean(seen),
        "false_alarms_per_h": sum(f.alarms for f in flat) / sum(f.clear_h for f in flat) if publishes else None,
        "recovery_s": _mean(back),
        "rmse_std": _std(rmse),
        "max_std": _std(most),
        "max_worst": _finite(max(most)),
        "rmse_hot_std": _std(hot),
        "rmse_window": _mean(inside),
        "rmse_window_std": _std(inside),
        "max_window": _mean(inside_most),
        "max_window_std": _std(inside_most),
        "detection_worst_s": max(seen, default=None),
        "missed": 1.0 - len(seen) / len(faulty) if faulty and publishes else None,
        "recovery_worst_s": max(back, default=None),
        "unrecovered": 1.0 - len(back) / len(faulty) if faulty else None,
        "other_channel_alarms_per_h": sum(f.other_alarms for f in flat) / sum(f.other_h for f in flat)
        if publishes
        else None,
        "classes_in_window": {name: rows / total for name, rows in sorted(classes.items())},
        "above_upper_share": sum(above) / sum(f.count for f in flat) if above else None,
        "nees": _mean(nees),
        "runs": len(flat),
    }


CLASSES = ("ok", "offset", "noise", "stuck", "dropout", "spike", "drift", "slow")  # sensor_class_t


def class_name(code: int) -> str:
    """Name of a published sensor class."""
    return CLASSES[code] if 0 <= code < len(CLASSES) else f"class {code}"


def _rms(squares: float, count: int) -> float:
    return math.sqrt(squares / count) if count else math.nan


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(values: Sequence[float]) -> float | None:
    return _finite(float(np.mean(values))) if values else None


def _std(values: Sequence[float]) -> float | None:
    if not values or not np.isfinite(values).all():
        return None
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
