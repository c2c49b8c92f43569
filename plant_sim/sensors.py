"""Temperature sensor with delay and biased noise: y(t) = theta(t - 1.5 s) + N(-1, var 0.1 K^2), at 10 Hz."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plant_sim.params import SensorParams


class TemperatureSensor:
    """Two channels (winding, rotor) behind one delay line, with its own random generator.

    Parameters
    ----------
    params
        Delay, noise mean and variance, period.
    theta0_degc
        Initial temperatures (2,): what the delay line holds before the start.
    rng
        The sensor's own generator; two normal numbers per sample, winding first.
    """

    def __init__(
        self, params: SensorParams, theta0_degc: NDArray[np.float64], rng: np.random.Generator
    ) -> None:
        self._mean_k, self._std_k = params.mean_k, float(np.sqrt(params.variance_k2))
        self._line = np.tile(
            np.asarray(theta0_degc, dtype=float), (round(params.delay_s / params.period_s), 1)
        )
        self._rng = rng

    def sample(self, theta_degc: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the temperatures of M consecutive periods (M, 2); return the reading at each (M, 2)."""
        joined = np.concatenate([self._line, theta_degc])
        delayed = joined[: theta_degc.shape[0]]
        self._line = joined[theta_degc.shape[0] :]
        return delayed + self._mean_k + self._std_k * self._rng.standard_normal(theta_degc.shape)
