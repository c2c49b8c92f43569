"""Pure arithmetic on the report's signals: tick unwrapping, gaps, errors, decimation, log bins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rt_runner.result import TICK_BITS, TICK_S
from tools.report.data import Array, Trace

TICK_MODULUS = 1 << TICK_BITS


def unwrap_ticks(ticks: Array) -> NDArray[np.int64]:
    """Continue 16-bit plant ticks, shape (n,), across their wrap.

    A step is read as the shortest way round, so an older tick after a newer one is a step back, not a wrap, and
    one wild value does not shift what follows it.
    """
    whole = np.asarray(ticks, dtype=np.int64)
    if whole.size == 0:
        return whole
    half = TICK_MODULUS // 2
    steps = (np.diff(whole) + half) % TICK_MODULUS - half
    return np.concatenate([whole[:1], whole[0] + np.cumsum(steps)])


def time_of_tick(tick: Array, seen_tick: Array, seen_t_s: Array) -> Array:
    """Log time of plant ticks from the receptions `seen_*` (m,), straight lines between, 10 ms a tick outside."""
    if seen_tick.size == 0:
        return np.full(np.shape(tick), np.nan)
    # First reception of each tick: later carriers of the same tick only show how long the estimator took.
    known, first = np.unique(seen_tick, return_index=True)
    t_known = np.maximum.accumulate(seen_t_s[first])
    t_s = np.interp(tick, known, t_known)
    t_s += TICK_S * (np.minimum(tick - known[0], 0) + np.maximum(tick - known[-1], 0))
    return t_s


def with_gaps(position: Array, trace: Trace) -> Trace:
    """Insert a NaN wherever `position` (n,), the tick or index of the samples, jumps: missing data is no line.

    A jump is more than 1.5 usual steps, and at least two ticks more than usual (estimates are not locked to ticks).
    """
    if position.size < 3:
        return trace
    steps = np.diff(position)
    usual = float(np.median(steps))
    at = np.flatnonzero(steps > max(1.5 * usual, usual + 2.0)) + 1
    middle = 0.5 * (trace.t_s[at - 1] + trace.t_s[at])
    return Trace(np.insert(trace.t_s, at, middle), np.insert(trace.value, at, np.nan))


def error_against_truth(tick: Array, value: Array, truth_tick: Array, truth: Array, reach: float = 20.0) -> Array:
    """Value minus truth at the same plant tick, NaN where truth has no samples within `reach` ticks on both sides."""
    good = np.isfinite(truth)
    truth_tick, truth = truth_tick[good], truth[good]
    if truth_tick.size == 0:
        return np.full(value.shape, np.nan)
    right = np.clip(np.searchsorted(truth_tick, tick), 0, truth_tick.size - 1)
    left = np.where(truth_tick[right] == tick, right, np.maximum(right - 1, 0))
    covered = (truth_tick[left] <= tick) & (tick <= truth_tick[right])
    covered &= truth_tick[right] - truth_tick[left] <= reach
    return np.where(covered, value - np.interp(tick, truth_tick, truth), np.nan)


def decimate(trace: Trace, max_points: int) -> Trace:
    """Keep the extremes: at most about `max_points` samples, the lowest and the highest of each time bucket, and
    one NaN for each gap. No peak is lost, and a trace that is short enough comes back untouched."""
    n = trace.t_s.size
    if n <= max_points:
        return trace
    finite = np.isfinite(trace.value)
    edge = np.diff(np.concatenate([[False], finite, [False]]).astype(np.int8))
    starts, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    t0, span = trace.t_s[0], max(trace.t_s[-1] - trace.t_s[0], 1e-9)
    n_buckets = max(max_points // 2, 1)
    keep: list[NDArray[np.int64]] = []
    last_bucket = -1
    for start, end in zip(starts, ends, strict=True):
        bucket = np.minimum(((trace.t_s[start:end] - t0) / span * n_buckets).astype(np.int64), n_buckets - 1)
        if start > 0 and keep and bucket[-1] > last_bucket:
            keep.append(np.array([start - 1]))
        last_bucket = int(bucket[-1])
        first = np.flatnonzero(np.diff(bucket, prepend=-1))
        segment = trace.value[start:end]
        # Within a bucket, sorted by value: the first is its minimum and the last its maximum.
        order = np.lexsort((segment, bucket))
        stop = np.append(first[1:], end - start) - 1
        keep.append(np.unique(np.concatenate([order[first], order[stop]])) + start)
    index = np.unique(np.concatenate(keep)) if keep else np.arange(0)
    return Trace(trace.t_s[index], trace.value[index])


@dataclass(frozen=True)
class LogHistogram:
    """Counts over bins of equal width in log10; `edges_us` has one element more than each row of `counts`."""

    edges_us: Array
    counts: tuple[NDArray[np.int64], ...]


def log_histogram(samples_us: list[Array], bins_per_decade: int = 20, floor_us: float = 0.1) -> LogHistogram:
    """Bin times in µs over common log bins; NaN is left out, values under `floor_us` fall in the first bin."""
    clean = [np.maximum(s[np.isfinite(s)], floor_us) for s in samples_us]
    filled = [s for s in clean if s.size]
    if not filled:
        return LogHistogram(EMPTY_EDGES, tuple(np.zeros(0, dtype=np.int64) for _ in clean))
    low = np.floor(np.log10(min(float(s.min()) for s in filled)) * bins_per_decade)
    high = np.floor(np.log10(max(float(s.max()) for s in filled)) * bins_per_decade) + 1
    exponents = np.arange(low, high + 1) / bins_per_decade
    counts = []
    for sample in clean:
        index = np.floor(np.log10(sample) * bins_per_decade).astype(np.int64) - int(low)
        counts.append(np.bincount(np.clip(index, 0, exponents.size - 2), minlength=exponents.size - 1))
    return LogHistogram(10.0**exponents, tuple(counts))


EMPTY_EDGES: Array = np.empty(0)
