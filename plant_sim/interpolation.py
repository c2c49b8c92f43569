"""Shape-preserving cubic interpolation and Gaussian smoothing on plain arrays."""

import numpy as np
from numpy.typing import NDArray


def pchip(x: NDArray[np.float64], y: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Monotone piecewise cubic Hermite interpolation (Fritsch and Carlson 1980; harmonic-mean slopes).

    Parameters
    ----------
    x, y
        Knots (N,), x strictly rising, N >= 3.
    at
        Where to evaluate (M,); points outside are extrapolated with the end cubic.
    """
    if x.size < 3 or np.any(np.diff(x) <= 0.0):
        raise ValueError("pchip needs at least 3 knots with strictly rising x")
    h = np.diff(x)
    delta = np.diff(y) / h
    slope = np.zeros_like(y, dtype=float)
    inner = delta[:-1] * delta[1:] > 0.0
    w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (w1 + w2) / (w1 / delta[:-1] + w2 / delta[1:])
    slope[1:-1] = np.where(inner, mean, 0.0)
    slope[0], slope[-1] = (
        _end_slope(h[0], h[1], delta[0], delta[1]),
        _end_slope(h[-1], h[-2], delta[-1], delta[-2]),
    )
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, x.size - 2)
    t = (at - x[i]) / h[i]
    return (
        y[i] * (1.0 + 2.0 * t) * (1.0 - t) ** 2
        + h[i] * slope[i] * t * (1.0 - t) ** 2
        + y[i + 1] * t**2 * (3.0 - 2.0 * t)
        + h[i] * slope[i + 1] * t**2 * (t - 1.0)
    )


def _end_slope(h0: float, h1: float, d0: float, d1: float) -> float:
    """Three-point end slope, limited so that the end interval stays monotone."""
    slope = ((2.0 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    if slope * d0 <= 0.0:
        return 0.0
    if d0 * d1 <= 0.0 and abs(slope) > 3.0 * abs(d0):
        return 3.0 * d0
    return slope


def gaussian_smooth(values: NDArray[np.float64], sigma_samples: float) -> NDArray[np.float64]:
    """Convolve with a Gaussian of the given standard deviation (cut at 4 sigma; end values held)."""
    half = int(np.ceil(4.0 * sigma_samples))
    if half == 0:
        return values.astype(float)
    k = np.arange(-half, half + 1)
    kernel = np.exp(-0.5 * (k / sigma_samples) ** 2)
    padded = np.pad(values.astype(float), half, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
