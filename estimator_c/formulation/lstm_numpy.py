"""The net in numpy: the readable twin of the symbolic and of the generated one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .weights import LstmWeights

Array = NDArray[np.float64]


def lstm_step(weights: LstmWeights, x: Array, c: Array, h: Array) -> tuple[Array, Array, Array]:
    """One step of the net (LSTM equations of the paper, output layer on the new hidden state).

    Parameters
    ----------
    x : (..., 4)
        [speed rpm, torque Nm, theta_w degC, theta_r degC] of the interval.
    c, h : (..., H)
        Cell and hidden state before the interval.

    Returns
    -------
    c_next, h_next : (..., H)
        The memory after the interval.
    rate : (..., 2)
        [dtheta_w, dtheta_r] in degC/s over the interval.
    """
    u = (x - weights.in_offset) / weights.in_scale
    z = u @ weights.w_u.T + h @ weights.w_h.T + weights.b
    i, f, g, o = np.split(z, 4, axis=-1)
    c_next = _sigmoid(f) * c + _sigmoid(i) * np.tanh(g)
    h_next = _sigmoid(o) * np.tanh(c_next)
    rate = weights.out_offset + weights.out_scale * (h_next @ weights.w_y.T + weights.b_y)
    return c_next, h_next, rate


def lstm_sequence(
    weights: LstmWeights, x: Array, c: Array | None = None, h: Array | None = None
) -> tuple[Array, Array, Array]:
    """The net over a sequence x (n, 4) from memory c, h (H,), empty by default: rates (n, 2), last c, h."""
    c = np.zeros(weights.hidden) if c is None else c
    h = np.zeros(weights.hidden) if h is None else h
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rates[k] = lstm_step(weights, row, c, h)
    return rates, c, h


def _sigmoid(z: Array) -> Array:
    return 0.5 * (1.0 + np.tanh(0.5 * z))
