"""The durations of the specification, per job and window, out of what the frames carry."""

from array import array
from collections.abc import Callable, Iterator, Mapping
from itertools import compress
from typing import Any

from rt_runner.timing.jobs import NO_NS, Jobs
from rt_runner.timing.summary import Summary, summarise

HALF_STEP_NS = 50  # a time on the bus is a multiple of 0.1 us, so it is at most this far from what was measured
# metric -> how many rounded times it is made of
STEPS = {
    "wake_lat": 1, "exec_wall": 1, "exec_cpu": 1, "preempt": 2, "publish": 3, "resp": 1, "slack": 1,
    "period_dev": 2, "period_dev_abs": 2, "in_age_motor": 1, "in_age_temp": 1,
}  # fmt: skip
WINDOWS = ("warmup", "last_second", "since_start")
LAST_SECOND_NS = 1_000_000_000


def derive(jobs: Jobs, deadline_ns: int) -> None:
    """Add to the jobs' times what follows from the others: preempt, publish, slack, period_dev."""
    t = jobs.times
    t["preempt"] = _from(lambda wall, cpu: max(0, wall - cpu), t["exec_wall"], t["exec_cpu"])
    if jobs.has("wake_lat"):
        t["publish"] = _from(lambda resp, wake, wall: resp - wake - wall, t["resp"], t["wake_lat"], t["exec_wall"])
        t["slack"] = _from(lambda resp: deadline_ns - resp, t["resp"])
    else:  # lock-step: the response counts from the start, and nothing can be late
        t["publish"] = _from(lambda resp, wall: resp - wall, t["resp"], t["exec_wall"])
        t["slack"] = array("q", [NO_NS]) * len(t["resp"])
    # start = release + wake, and releases lie on the grid: what is left of the starts' distance are the wake latencies.
    wake = t["wake_lat"]
    t["period_dev"] = array("q", [NO_NS]) * len(wake)
    for k in range(1, len(wake)):
        if wake[k] != NO_NS and wake[k - 1] != NO_NS and jobs.release[k] > jobs.release[k - 1] >= 0:
            t["period_dev"][k] = wake[k] - wake[k - 1]
    t["period_dev_abs"] = _from(lambda dev: abs(dev), t["period_dev"])


def _from(function: Callable[..., int], *columns: array) -> array:
    return array("q", [NO_NS if NO_NS in row else function(*row) for row in zip(*columns, strict=True)])


def values_of(jobs: Jobs, metric: str, deadline_ns: int, warmup: bool) -> tuple[list[int], list[int]]:
    """A metric's values in or after warm-up, and their releases."""
    if "slack" not in jobs.times:
        derive(jobs, deadline_ns)
    picked = [
        (v, r)
        for v, r, w in zip(jobs.times.get(metric, ()), jobs.release, jobs.flags["warmup"], strict=False)
        if v != NO_NS and bool(w) == warmup
    ]
    return [v for v, _ in picked], [r for _, r in picked]


def window_of(jobs: Jobs, name: str, period_ns: int) -> Iterator[bool]:
    """Which jobs belong to a window: warm-up; the releases of the last second; all after warm-up."""
    if name == "last_second":
        last = max(jobs.release, default=0)
        return ((last - r) * period_ns < LAST_SECOND_NS and r >= 0 for r in jobs.release)
    return (bool(w) == (name == "warmup") for w in jobs.flags["warmup"])


def summaries(jobs: Jobs, more: Mapping[str, Any], period_ns: int) -> dict[str, dict[str, Summary]]:
    """window -> metric -> summary, of the jobs' own times and of ``more`` columns (end-to-end age)."""
    columns = {**{k: v for k, v in jobs.times.items() if k != "period_dev_abs"}, **more}
    out: dict[str, dict[str, Summary]] = {}
    for window in WINDOWS:
        inside = bytearray(window_of(jobs, window, period_ns))
        at = list(compress(jobs.release, inside))
        out[window] = {name: _summary(list(compress(values, inside)), at) for name, values in columns.items()}
    return out


def _summary(values: list[int], releases: list[int]) -> Summary:
    """Of the values that are available."""
    if NO_NS not in values:
        return summarise(values, releases)
    known = [v != NO_NS for v in values]
    return summarise(list(compress(values, known)), list(compress(releases, known)))
