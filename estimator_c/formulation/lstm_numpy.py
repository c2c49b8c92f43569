"""The net in numpy: the readable twin of the symbolic and of the generated one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .weights import Layer, NetWeights

Array = NDArray[np.float64]


def lstm_step(weights: NetWeights, x: Array, c: Array, h: Array) -> tuple[Array, Array, Array]:
    """One step of the net: its layers of cells in turn, the output layer on the new hidden state of the last.

    Parameters
    ----------
    x : (..., 4)
        [speed rpm, torque Nm, theta_w degC, theta_r degC] of the interval.
    c, h : (..., L H)
        Cell and hidden state before the interval, layer after layer (`weights.empty_memory()` to begin with). A GRU
        has no c: whatever is given comes back.

    Returns
    -------
    c_next, h_next : (..., L H)
        The memory after the interval.
    rate : (..., 2)
        [dtheta_w, dtheta_r] in degC/s over the interval.
    """
    value = (x - weights.in_offset) / weights.in_scale
    c_next, h_next, n_h = [], [], weights.hidden
    for k, layer in enumerate(weights.stack):
        own = slice(k * n_h, (k + 1) * n_h)
        if weights.cell == "gru":
            value = _gru(layer, value, h[..., own])
        else:
            new_c, value = _lstm(layer, value, c[..., own], h[..., own])
            c_next.append(new_c)
        h_next.append(value)
    rate = weights.out_offset + weights.out_scale * (value @ weights.w_y.T + weights.b_y)
    return np.concatenate(c_next, axis=-1) if c_next else c, np.concatenate(h_next, axis=-1), rate


def lstm_sequence(
    weights: NetWeights, x: Array, c: Array | None = None, h: Array | None = None
) -> tuple[Array, Array, Array]:
    """The net over a sequence x (n, 4) from memory c, h, empty by default: rates (n, 2), last c, h."""
    empty_c, empty_h = weights.empty_memory()
    c, h = empty_c if c is None else c, empty_h if h is None else h
    rates = np.empty((len(x), 2))
    for k, row in enumerate(x):
        c, h, rates[k] = lstm_step(weights, row, c, h)
    return rates, c, h


def _lstm(layer: Layer, u: Array, c: Array, h: Array) -> tuple[Array, Array]:
    """LSTM equations of the paper: (c_next, h_next)."""
    i, f, g, o = np.split(u @ layer.w_u.T + h @ layer.w_h.T + layer.b, 4, axis=-1)
    c_next = _sigmoid(f) * c + _sigmoid(i) * np.tanh(g)
    return c_next, _sigmoid(o) * np.tanh(c_next)


def _gru(layer: Layer, u: Array, h: Array) -> Array:
    """GRU in PyTorch's definition, the reset gate on W_hn h + b_hn: h_next."""
    assert layer.b_h is not None, "the loader gives every GRU its second bias"
    r_u, z_u, n_u = np.split(u @ layer.w_u.T + layer.b, 3, axis=-1)
    r_h, z_h, n_h = np.split(h @ layer.w_h.T + layer.b_h, 3, axis=-1)
    z = _sigmoid(z_u + z_h)
    return (1.0 - z) * np.tanh(n_u + _sigmoid(r_u + r_h) * n_h) + z * h


def _sigmoid(z: Array) -> Array:
    return 0.5 * (1.0 + np.tanh(0.5 * z))
