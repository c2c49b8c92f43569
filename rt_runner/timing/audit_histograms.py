"""The histograms that a process kept against the values it sent, job by job.

Values are sent in steps of 0.1 us, buckets have borders in ns. So a value lies within half a step of what was counted,
and at every border b the count below it must be at least the values below b - tolerance and at most those below
b + tolerance.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from typing import Any

from rt_runner.timing.check import Check
from rt_runner.timing.jobs import CEILING_NS, NO_NS, Jobs
from rt_runner.timing.metrics import HALF_STEP_NS, STEPS, values_of
from rt_runner.timing.misses import MissAccount

WINDOWS = ("warmup", "judged")
PERIODS = ("period_dev", "period_dev_abs")


def histogram_checks(
    final: Mapping[str, Any] | None, jobs: Jobs, account: MissAccount, deadline_ns: int, rebased: int
) -> Iterator[Check]:
    """One check for the totals and borders of all metrics, one for their extremes; none without histograms."""
    histograms = (final or {}).get("histograms")
    if not histograms:
        yield Check("histograms", None, "the log holds no histograms of the process")
        return
    compared, wrong, extremes = 0, [], []
    lost = _holes(jobs) + max(0, int((final or {}).get("jobs", 0)) - len(jobs))
    for window in WINDOWS:
        for key, histogram in (histograms.get(window) or {}).items():
            metric = key.removesuffix("_us")
            if metric not in STEPS or (metric in PERIODS and (rebased or account.unseen)):
                continue  # the canary wakes more often than jobs run; a moved grid has other periods
            values, releases = values_of(jobs, metric, deadline_ns, window == "warmup")
            compared += 1
            where = f"{metric} ({window})"
            tolerance_ns = STEPS[metric] * HALF_STEP_NS
            wrong += [f"{where}: {w}" for w in _compare(histogram, values, tolerance_ns, lost)]
            if not lost:
                extremes += [f"{where}: {w}" for w in _extremes(histogram, values, releases, tolerance_ns)]
    yield Check("histograms", not wrong, "; ".join(wrong) or f"{compared} histograms hold the values of the log")
    yield Check("extremes", not extremes, "; ".join(extremes) or "smallest and largest values and their releases agree")


def _holes(jobs: Jobs) -> int:
    """Jobs in the log that lack a frame."""
    if all(-1 not in places for places in jobs.position.values()):
        return 0
    return sum(1 for row in zip(*jobs.position.values(), strict=True) if -1 in row)


def _compare(histogram: Mapping[str, Any], values: list[int], tolerance_ns: int, lost: int) -> Iterator[str]:
    """What does not fit: the total, or the count below a border."""
    count, known = int(histogram["count"]), len(values)
    if not known <= count <= known + lost:
        yield f"{count} counted by the process, {known} in the log" + (f" and {lost} incomplete" if lost else "")
        return
    ordered = sorted(values)
    below = int(histogram.get("underflow", 0))
    borders = [(0, below)]
    for low, high, n in histogram.get("buckets", ()):
        borders.append((low, below))
        below += n
        borders.append((high, below))
    if below + int(histogram.get("overflow", 0)) != count:
        yield f"its buckets hold {below}, its count is {count}"
        return
    for border, counted in borders:
        if border + tolerance_ns >= CEILING_NS:
            break  # longer times are all sent as the longest one
        least, most = bisect_left(ordered, border - tolerance_ns), bisect_right(ordered, border + tolerance_ns)
        if not least <= counted <= most + lost:
            yield f"{counted} counted below {border} ns, {least} to {most} in the log"
            return


def _extremes(histogram: Mapping[str, Any], values: list[int], releases: list[int], tolerance_ns: int) -> Iterator[str]:
    if not values or histogram.get("min_ns") is None:
        return
    at = dict(zip(releases, values, strict=True))
    for name, mine in (("min", min(values)), ("max", max(values))):
        theirs, index = int(histogram[f"{name}_ns"]), int(histogram[f"{name}_index"])
        if abs(min(theirs, CEILING_NS) - mine) > tolerance_ns:
            yield f"{name} is {theirs} ns, in the log {mine} ns"
        elif abs(at.get(index, NO_NS) - min(theirs, CEILING_NS)) > tolerance_ns:
            yield f"{name} is release {index}, which has {at.get(index)} ns in the log"
