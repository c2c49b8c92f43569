"""Temperature sensor with delay, biased noise and faults: y(t) = theta(t - 1.5 s) + N(-1, var 0.1 K^2), at 10 Hz.

    theta -> gain error -> lag (slow) -> delay line -> + mean + noise -> offset, drift -> spike -> stuck -> dropout

So a gain error or a slow element shows in the reading one delay after the window's start, the others at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import exp

import numpy as np
from numpy.typing import NDArray

from plant_sim.faults import Fault, check_faults
from plant_sim.params import SensorParams

GAIN_ABOUT_DEGC = 25.0
DRIFT_LIMIT_K = 20.0
SPIKE_K = (10.0, 40.0)


class TemperatureSensor:
    """Two channels (winding, rotor) behind one delay line, with its own random generator.

    Runs with and without faults are paired: no fault changes the sequence of the nominal noise, ``noise`` scales the
    same numbers, and spikes have a generator of their own. Any chunking of `sample` gives the same readings.

    Parameters
    ----------
    params
        Delay, noise mean and variance, period.
    theta0_degc
        Initial temperatures (2,): what the delay line holds before the start.
    rng
        The sensor's own generator; two normal numbers per sample, winding first.
    faults
        What is wrong with it, when.

    Raises
    ------
    FaultError
        If two faults of one kind overlap on one channel.
    """

    def __init__(
        self,
        params: SensorParams,
        theta0_degc: NDArray[np.float64],
        rng: np.random.Generator,
        faults: Sequence[Fault] = (),
    ) -> None:
        self._mean_k, self._std_k = params.mean_k, float(np.sqrt(params.variance_k2))
        self._period_s = params.period_s
        self._delay = round(params.delay_s / params.period_s)
        self._faults = check_faults(faults)
        more = [self._extra(f) for f in self._faults if f.kind == "delay"]
        self._line = np.tile(np.asarray(theta0_degc, dtype=float), (self._delay + max(more, default=0), 1))
        self._rng = rng
        self._spike_rng = rng.spawn(1)[0] if any(f.kind == "spike" for f in self._faults) else None
        self._next = 1  # the first sample is taken one period after the start
        self._lagged = [0.0, 0.0]
        self._last: NDArray[np.float64] | None = None  # the newest reading before dropout: what a stuck sensor holds

    def sample(self, theta_degc: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the temperatures of M consecutive periods (M, 2); return the reading at each (M, 2), NaN: no value."""
        count = theta_degc.shape[0]
        if not self._faults:
            joined = np.concatenate([self._line, theta_degc])
            self._line = joined[count:]
            self._next += count
            return joined[:count] + self._mean_k + self._std_k * self._rng.standard_normal(theta_degc.shape)

        joined = np.concatenate([self._line, self._element(theta_degc)])
        self._line = joined[count:]
        y = self._delayed(joined, count) + self._mean_k + self._noise(count)
        self._add(y)
        self._hold(y)
        for fault, rows, column in self._active("dropout", count):
            y[rows, column] = np.nan if fault.amplitude is None else fault.amplitude
        self._next += count
        return y

    def _active(self, kind: str, count: int) -> Iterator[tuple[Fault, slice, int]]:
        """Faults of one kind within the next ``count`` samples: fault, rows of the chunk, column."""
        for fault in self._faults:
            if fault.kind != kind:
                continue
            first, end = (k - self._next for k in fault.samples(self._period_s))
            if first < count and end > 0:
                for column in fault.columns:
                    yield fault, slice(max(first, 0), min(end, count)), column

    def _is_first(self, fault: Fault, rows: slice) -> bool:
        """Whether the window begins with the first of these rows, not in an earlier chunk."""
        first = max(fault.samples(self._period_s)[0], 1)
        return self._next + rows.start == first

    def _extra(self, fault: Fault) -> int:
        return round(fault.size / self._period_s)

    def _element(self, theta_degc: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the sensing element has: gain error, then its lag."""
        seen = np.array(theta_degc, dtype=float)
        for fault, rows, column in self._active("gain", len(seen)):
            seen[rows, column] += fault.size / 100.0 * (seen[rows, column] - GAIN_ABOUT_DEGC)
        for fault, rows, column in self._active("slow", len(seen)):
            values = seen[rows, column].tolist()
            lagged = values[0] if self._is_first(fault, rows) else self._lagged[column]
            share = 1.0 - exp(-self._period_s / fault.size)
            for i, value in enumerate(values):
                lagged += share * (value - lagged)
                values[i] = lagged
            seen[rows, column] = values
            self._lagged[column] = lagged
        return seen

    def _delayed(self, joined: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """Read the delay line, further back where the delay is longer."""
        start = len(joined) - count - self._delay
        out = joined[start : start + count].copy()
        for fault, rows, column in self._active("delay", count):
            back = start - self._extra(fault)
            out[rows, column] = joined[back + rows.start : back + rows.stop, column]
        return out

    def _noise(self, count: int) -> NDArray[np.float64]:
        std = np.full((count, 2), self._std_k)
        for fault, rows, column in self._active("noise", count):
            std[rows, column] = fault.size
        return std * self._rng.standard_normal((count, 2))

    def _add(self, y: NDArray[np.float64]) -> None:
        """Offset, drift and spikes on top of the readings."""
        for fault, rows, column in self._active("offset", len(y)):
            y[rows, column] += fault.size
        for fault, rows, column in self._active("drift", len(y)):
            t_s = np.arange(self._next + rows.start, self._next + rows.stop) * self._period_s - fault.start_s
            y[rows, column] += np.clip(fault.size * t_s, -DRIFT_LIMIT_K, DRIFT_LIMIT_K)
        if self._spike_rng is None:
            return
        draws = self._spike_rng.random((len(y), 2, 2))  # for every sample, so that windows do not shift the sequence
        for fault, rows, column in self._active("spike", len(y)):
            chance, size = draws[rows, column].T
            up = np.where(size < 0.5, -1.0, 1.0)
            height = up * (SPIKE_K[0] + (SPIKE_K[1] - SPIKE_K[0]) * np.abs(2.0 * size - 1.0))
            y[rows, column] += np.where(chance < fault.size / 100.0, height, 0.0)

    def _hold(self, y: NDArray[np.float64]) -> None:
        """Stuck: the last reading before the window, in it; the very first reading where there is none before."""
        for _, rows, column in self._active("stuck", len(y)):
            if rows.start > 0:
                y[rows, column] = y[rows.start - 1, column]
            else:
                y[rows, column] = y[0, column] if self._last is None else self._last[column]
        if len(y):
            self._last = y[-1].copy()
