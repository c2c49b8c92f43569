"""What the report knows about a run, free of where it came from and of how it is drawn."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rt_runner.timing.analyse import TimingReport

Array = NDArray[np.float64]
EMPTY: Array = np.empty(0)


@dataclass(frozen=True)
class Trace:
    """One signal over the time of the log.

    Parameters
    ----------
    t_s : (n,) seconds since the first frame of the log, ascending.
    value : (n,) in the unit of the signal; NaN is a gap and is drawn as one.
    """

    t_s: Array = field(default_factory=lambda: EMPTY)
    value: Array = field(default_factory=lambda: EMPTY)

    def __post_init__(self) -> None:
        if self.t_s.shape != self.value.shape or self.t_s.ndim != 1:
            raise ValueError(f"trace: time {self.t_s.shape} and value {self.value.shape} must be equal vectors")

    def __bool__(self) -> bool:
        return bool(np.isfinite(self.value).any())


@dataclass(frozen=True)
class Temperature:
    """One node's temperature as the plant, the sensor and the estimator see it, in °C and K.

    The estimate stands at the time of the plant tick it is valid for; the sensor value at the tick of its frame,
    because that is the best the bus offers without an estimator.
    """

    truth: Trace = Trace()
    sensor: Trace = Trace()
    estimate: Trace = Trace()
    sensor_error: Trace = Trace()
    estimate_error: Trace = Trace()


@dataclass(frozen=True)
class Jobs:
    """Executed jobs of the estimator, one element per job; all arrays (n,).

    `wake_us` is all NaN in lock-step, where no clock releases the job.
    """

    t_s: Array = field(default_factory=lambda: EMPTY)
    wake_us: Array = field(default_factory=lambda: EMPTY)
    exec_us: Array = field(default_factory=lambda: EMPTY)
    resp_us: Array = field(default_factory=lambda: EMPTY)
    late: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    cause: tuple[str, ...] = ()
    skipped_t_s: Array = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True)
class FrameStat:
    """One id on the bus. Gaps are times between consecutive receptions, in ms, None with fewer than two frames.

    `cycle_ms` is that of the DBC; of frames sent once per job it is the estimator's period. `jitter_ms` is the standard
    deviation of the gaps, `missing` the cycles without a frame, `timeouts` the silences longer than a receiver waits.
    """

    can_id: int
    name: str
    sender: str
    cycle_ms: float
    count: int
    rate_hz: float | None
    rate_ok: bool | None
    gap_min_ms: float | None
    gap_max_ms: float | None
    timed_out: bool
    jitter_ms: float | None
    missing: int | None
    timeouts: int | None
    counter_gaps: int
    repeats: int
    crc_errors: int


@dataclass(frozen=True)
class Span:
    """A stretch of time that is shaded in every time chart; `kind` is `unjudged` or `status`."""

    start_s: float
    end_s: float
    label: str
    kind: str


@dataclass(frozen=True)
class ReportData:
    """Everything on the page.

    `result` has the keys of the runner's result JSON. `lockstep` says that no wake latency can exist. `notices` are
    shown as banners: a log that was never finished, a result that was recomputed, what the system did not grant.
    """

    source: str
    title: str
    started: str
    lockstep: bool
    result: dict[str, Any]
    result_from_log: bool
    complete: bool
    duration_s: float
    cycle_start_s: float | None
    winding: Temperature
    rotor: Temperature
    torque: Trace
    speed: Trace
    jobs: Jobs
    period_s: float | None
    frames: tuple[FrameStat, ...] = ()
    spans: tuple[Span, ...] = ()
    identity: tuple[tuple[str, str], ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    notices: tuple[str, ...] = ()
    timing: TimingReport | None = None  # None: no real-time process in the log

    @property
    def deadline_s(self) -> float | None:
        """Of the estimator: one period, unless the scenario says less."""
        own = [p for p in self.timing.processes if p.process.sender == "ESTIMATOR"] if self.timing is not None else []
        return own[-1].deadline_ns / 1e9 if own and not self.lockstep else self.period_s
