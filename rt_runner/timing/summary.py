"""Summary of a duration: exact arithmetic on integer nanoseconds, percentiles by nearest rank."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

PERCENTILES = {"p50": 5000, "p90": 9000, "p99": 9900, "p99.9": 9990, "p99.99": 9999}  # in 1/10 000, as in C


def nearest_rank(ordered: Sequence[int], per_10k: int) -> int | None:
    """Smallest value that at least so many of all do not exceed; None where fewer than one would be beyond it.

    With fewer values it would be their maximum under another name. Integers: 0.999 * 1000 is not 999 in floating point.
    """
    n = len(ordered)
    if n * (10_000 - per_10k) < 10_000:
        return None
    return ordered[(n * per_10k + 9_999) // 10_000 - 1]


@dataclass(frozen=True)
class Summary:
    """What is said of one duration over one window; None where there are too few values.

    ``min_release`` and ``max_release`` are the releases of the first smallest and the first largest value, -1 where the
    log does not tell. ``percentile_ns`` in the order of `PERCENTILES`.
    """

    count: int = 0
    min_ns: int | None = None
    min_release: int | None = None
    max_ns: int | None = None
    max_release: int | None = None
    mean_ns: float | None = None
    std_ns: float | None = None
    percentile_ns: tuple[int | None, ...] = (None,) * len(PERCENTILES)

    def as_json(self) -> dict[str, Any]:
        """In microseconds."""
        out: dict[str, Any] = {
            "count": self.count,
            "min_us": _us(self.min_ns),
            "min_release": self.min_release,
            "max_us": _us(self.max_ns),
            "max_release": self.max_release,
            "mean_us": _us(self.mean_ns),
            "std_us": _us(self.std_ns),
        }
        for name, value in zip(PERCENTILES, self.percentile_ns, strict=True):
            out[f"{name}_us"] = _us(value)
        return out


def summarise(values_ns: Sequence[int], releases: Sequence[int]) -> Summary:
    """Summary of integer values and the releases they belong to, one each."""
    n = len(values_ns)
    if n == 0:
        return Summary()
    ordered = sorted(values_ns)
    low, high = ordered[0], ordered[-1]
    total = sum(ordered)
    squares = sum(v * v for v in ordered)
    # Integers all the way: no rounding until the very end, whatever the magnitudes.
    variance = (n * squares - total * total) / (n * (n - 1)) if n > 1 else None
    return Summary(
        count=n,
        min_ns=low,
        min_release=releases[values_ns.index(low)],
        max_ns=high,
        max_release=releases[values_ns.index(high)],
        mean_ns=total / n,
        std_ns=None if variance is None else math.sqrt(variance),
        percentile_ns=tuple(nearest_rank(ordered, p) for p in PERCENTILES.values()),
    )


def _us(ns: float | None) -> float | None:
    return None if ns is None else round(ns / 1e3, 4)
