"""Drives at any sample time -> uniform rows at the net's rate, with the rates of temperature it learns.

Samples 0.1 s apart are taken as they are. Finer ones: speed and torque are averaged over each interval, temperatures
read at its start. Coarser ones (up to 5 s): speed and torque hold between samples' straight connections, temperatures
follow a monotone cubic through the samples, since a staircase of rates would be learned as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant_sim.interpolation import pchip
from tools.rows import DT_S, DataError, Rows, rows_from

Array = NDArray[np.float64]
COARSEST_S = 5.0
SHORTEST_S = 10.0  # of a drive; shorter ones teach nothing and are left out
SAME_TIME_S = 1e-3  # jitter within which samples count as 0.1 s apart
# What a sensor's resolution may add to a rate, taken as white noise; the net's own error is ten times that. It is not
# white where a temperature takes longer than the window from one step to the next: ten times as much is then left.
RATE_NOISE_DEGC_S = 0.002
LONGEST_SMOOTHING_S = 10.0
CHANNELS = ("winding", "rotor")


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive as found.

    Attributes
    ----------
    t_s : (N,)
        Rising times.
    x : (N, 4)
        Speed in rpm and torque in Nm (means from a sample's time to the next), winding and rotor in °C at its time.
    rates_degc_s : (N, 2) or None
        Rates in °C/s if the source gives them.
    """

    t_s: Array
    x: Array
    rates_degc_s: Array | None = None


def to_rows(drives: Sequence[Drive], source: str, smooth_s: float | None = None) -> Rows:
    """Uniform 10-Hz rows of all drives; long gaps begin a new drive.

    Parameters
    ----------
    source : names the data in errors
    smooth_s : smoothing window of the temperatures; None: as the sensors' resolution needs, 0: never

    Raises
    ------
    DataError
        Too coarse, or nothing long enough.
    """
    if smooth_s is not None and not 0.0 <= smooth_s <= 600.0:
        raise DataError(f"smoothing over {smooth_s} s is not offered: give 0 to 600 s")
    notes: list[str] = []
    pieces = [piece for drive in drives for piece in _without_gaps(drive, source, notes)]
    long_enough = [p for p in pieces if p.t_s[-1] - p.t_s[0] >= SHORTEST_S - DT_S]
    if len(long_enough) < len(pieces):
        notes.append(f"{len(pieces) - len(long_enough)} drives shorter than {SHORTEST_S:g} s are left out")
    if not long_enough:
        raise DataError(f"{source}: no drive of {SHORTEST_S:g} s or more without a gap; record a longer one")
    windows_s = _windows(long_enough, smooth_s)
    blocks = [_uniform(piece, windows_s, notes) for piece in long_enough]
    for i in range(2):
        if windows_s[i] > 0.0 and not _given(long_enough):
            notes.append(f"{CHANNELS[i]} temperature smoothed over {windows_s[i]:.1f} s before its rate is formed")
    trajectory = np.repeat(np.arange(len(blocks), dtype=np.int32), [len(b) for b in blocks])
    return rows_from(np.concatenate(blocks), trajectory, tuple(dict.fromkeys(notes)))


def _without_gaps(drive: Drive, source: str, notes: list[str]) -> list[Drive]:
    """Pieces of a drive between gaps."""
    if len(drive.t_s) < 3:
        return [drive] if len(drive.t_s) else []
    step_s = float(np.median(np.diff(drive.t_s)))
    if step_s > COARSEST_S:
        raise DataError(
            f"{source}: samples are {step_s:g} s apart, the net steps by {DT_S:g} s; record at least every "
            f"{COARSEST_S:g} s"
        )
    gap_s = max(3.0 * step_s, 0.5)
    cuts = np.flatnonzero(np.diff(drive.t_s) > gap_s) + 1
    if cuts.size:
        notes.append(f"gaps of more than {gap_s:.2g} s begin a new drive")
    parts = [slice(a, b) for a, b in zip([0, *cuts], [*cuts, len(drive.t_s)], strict=True)]
    rates = drive.rates_degc_s
    return [Drive(drive.t_s[p], drive.x[p], None if rates is None else rates[p]) for p in parts]


def _is_uniform(drive: Drive) -> bool:
    t = drive.t_s - drive.t_s[0]
    return bool(np.abs(t - DT_S * np.arange(len(t))).max() <= SAME_TIME_S)


def _given(drives: Sequence[Drive]) -> bool:
    """Whether all rates can be taken from the source."""
    return all(d.rates_degc_s is not None and _is_uniform(d) for d in drives)


def _uniform(drive: Drive, windows_s: Sequence[float], notes: list[str]) -> Array:
    """Rows (n, 6) of one piece."""
    if _is_uniform(drive):
        x = drive.x
        if drive.rates_degc_s is not None:
            return np.concatenate([x, drive.rates_degc_s], axis=1)
    else:
        step_s = float(np.median(np.diff(drive.t_s)))
        notes.append(f"resampled from {step_s:.4g} s to {DT_S:g} s")
        x = _resampled(drive, step_s)
    theta = np.stack([_smoothed(x[:, 2 + i], windows_s[i]) for i in range(2)], axis=1)
    rates = np.diff(theta, axis=0) / DT_S
    return np.concatenate([x[:-1, :2], theta[:-1], rates], axis=1)


def _resampled(drive: Drive, step_s: float) -> Array:
    """Inputs (n, 4) on the grid of 0.1 s; the last row's speed and torque hold."""
    t = drive.t_s - drive.t_s[0]
    grid = DT_S * np.arange(math.floor((t[-1] + SAME_TIME_S) / DT_S) + 1)
    out = np.empty((len(grid), 4))
    edges = np.append(grid, grid[-1] + DT_S)
    for i in range(2):
        v = drive.x[:, i]
        if step_s < DT_S:  # a sample holds up to the next, the mean over an interval is then exact
            area = np.concatenate([[0.0], np.cumsum(v[:-1] * np.diff(t))])
        else:
            area = np.concatenate([[0.0], np.cumsum(0.5 * (v[:-1] + v[1:]) * np.diff(t))])
        out[:, i] = np.diff(_integral_at(edges, t, area, v, step_s < DT_S)) / DT_S
        theta = drive.x[:, 2 + i]
        out[:, 2 + i] = np.interp(grid, t, theta) if step_s <= DT_S else pchip(t, theta, np.minimum(grid, t[-1]))
    return out


def _integral_at(at: Array, t: Array, area: Array, v: Array, steps: bool) -> Array:
    """Integral of the held (`steps`) or straightly connected samples from t[0] to the times `at`."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    into = at - t[k]
    following = np.minimum(k + 1, len(t) - 1)
    width = np.where(following > k, t[following] - t[k], 1.0)
    slope = np.zeros_like(at) if steps else np.where(following > k, (v[following] - v[k]) / width, 0.0)
    return area[k] + v[k] * into + 0.5 * slope * into**2


# ---- resolution -------------------------------------------------------------------------------------------


def resolution(theta: Array) -> float:
    """Step in °C that all values of a temperature are a multiple of; 0 if there is none worth naming."""
    steps = np.abs(np.diff(theta))
    steps = steps[steps > 1e-6]
    if steps.size == 0:
        return 0.0
    quantum = float(steps.min())
    position = (theta - theta[0]) / quantum
    return quantum if bool((np.abs(position - np.round(position)) < 0.02).all()) else 0.0


def _windows(drives: Sequence[Drive], smooth_s: float | None) -> tuple[float, float]:
    """Smoothing window of winding and rotor in s."""
    if smooth_s is not None:
        return smooth_s, smooth_s
    found = []
    for i in range(2):
        window_s = 0.0
        for drive in drives:
            step_s = max(float(np.median(np.diff(drive.t_s))), DT_S)
            # The slope of a straight line through N samples of resolution q scatters by q/(N^1.5 step).
            samples = (resolution(drive.x[:, 2 + i]) / (step_s * RATE_NOISE_DEGC_S)) ** (2.0 / 3.0)
            if samples > 2.0:
                window_s = max(window_s, math.ceil(samples) * step_s)
        found.append(min(window_s, LONGEST_SMOOTHING_S))
    return found[0], found[1]


def _smoothed(theta: Array, window_s: float) -> Array:
    """Local parabolas over a centred window (Savitzky and Golay 1964); the first and last one serve the ends."""
    half = round(0.5 * window_s / DT_S)
    half = min(half, (len(theta) - 1) // 2)
    if half < 1:
        return theta
    k = np.arange(-half, half + 1) / half
    fit = np.linalg.pinv(np.stack([np.ones_like(k), k, k**2], axis=1)) if half > 1 else np.full((3, 3), 1.0 / 3.0)
    out = theta.copy()
    out[half:-half] = np.convolve(theta, fit[0][::-1], mode="valid")
    if half > 1:
        side = k[: half + 1]
        powers = np.stack([np.ones_like(side), side, side**2], axis=1)
        out[: half + 1] = powers @ (fit @ theta[: 2 * half + 1])
        out[-half - 1 :] = (powers * [1.0, -1.0, 1.0])[::-1] @ (fit @ theta[-2 * half - 1 :])
    return out
