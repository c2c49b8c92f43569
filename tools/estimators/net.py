"""The trained net as a compiled numpy loop, for estimators that evaluate it a million times; every kind and size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator_c.formulation.weights import NetWeights
from tools.estimators.jit import compiled

Array = NDArray[np.float64]


class Net(NamedTuple):
    """Weights as plain arrays; L layers of H cells with G gates, inputs padded to the widest layer.

    The matrices lie transposed: then the innermost loop runs over the gates, and the compiler uses vectors.
    """

    lstm: bool
    dt_s: float
    in_offset: Array
    in_scale: Array
    out_offset: Array
    out_scale: Array
    w_u: Array  # (L, max(4, H), G H)
    w_h: Array  # (L, H, G H)
    b: Array  # (L, G H)
    b_h: Array  # (L, G H), zeros for an LSTM
    w_y: Array  # (2, H)
    b_y: Array  # (2,)


def pack(weights: NetWeights) -> Net:
    """The compiled loop's view of a net."""
    layers, wide = len(weights.stack), max(4, weights.hidden)
    gates = weights.stack[0].w_h.shape[0]
    w_u = np.zeros((layers, wide, gates))
    for k, layer in enumerate(weights.stack):
        w_u[k, : layer.w_u.shape[1]] = layer.w_u.T
    nothing = np.zeros(gates)
    return Net(
        weights.cell == "lstm",
        weights.dt_s,
        np.array(weights.in_offset),
        np.array(weights.in_scale),
        np.array(weights.out_offset),
        np.array(weights.out_scale),
        w_u,
        np.stack([np.ascontiguousarray(layer.w_h.T) for layer in weights.stack]),
        np.stack([layer.b for layer in weights.stack]),
        np.stack([nothing if layer.b_h is None else layer.b_h for layer in weights.stack]),
        np.array(weights.w_y),
        np.array(weights.b_y),
    )


def memory_size(net: Net) -> int:
    """Numbers the net carries from step to step: c of all layers (LSTM), then h of all layers."""
    cells = net.w_h.shape[0] * net.w_h.shape[1]
    return 2 * cells if net.lstm else cells


def scratch_size(net: Net) -> int:
    """Length of the work array of `step`."""
    return net.w_u.shape[1] + 2 * net.w_h.shape[2]


@compiled
def _sigmoid(z):
    return 1.0 / (1.0 + np.exp(-z))  # half the time of a tanh, which everything here waits for; exact at both ends


@compiled
def _tanh(z):
    return 2.0 / (1.0 + np.exp(-2.0 * z)) - 1.0


@compiled
def step(net, u, state, scratch):
    """One step in place: state = [theta_w, theta_r, memory] moves by 0.1 s under u = [speed rpm, torque Nm]."""
    layers, hidden, gates = net.w_h.shape
    wide = net.w_u.shape[1]
    value, z, z_h = scratch[:wide], scratch[wide : wide + gates], scratch[wide + gates : wide + 2 * gates]
    h_at = 2 + (layers * hidden if net.lstm else 0)
    value[:] = 0.0
    for i in range(2):
        value[i] = (u[i] - net.in_offset[i]) / net.in_scale[i]
        value[2 + i] = (state[i] - net.in_offset[2 + i]) / net.in_scale[2 + i]
    width = 4
    for k in range(layers):
        h = state[h_at + k * hidden : h_at + (k + 1) * hidden]
        for row in range(gates):
            z[row], z_h[row] = net.b[k, row], net.b_h[k, row]
        for i in range(width):
            for row in range(gates):
                z[row] += net.w_u[k, i, row] * value[i]
        for i in range(hidden):
            for row in range(gates):
                z_h[row] += net.w_h[k, i, row] * h[i]
        if net.lstm:
            c = state[2 + k * hidden : 2 + (k + 1) * hidden]
            for i in range(hidden):
                gate_i = _sigmoid(z[i] + z_h[i])
                gate_f = _sigmoid(z[hidden + i] + z_h[hidden + i])
                gate_o = _sigmoid(z[3 * hidden + i] + z_h[3 * hidden + i])
                c[i] = gate_f * c[i] + gate_i * _tanh(z[2 * hidden + i] + z_h[2 * hidden + i])
                h[i] = gate_o * _tanh(c[i])
        else:
            for i in range(hidden):
                gate_r = _sigmoid(z[i] + z_h[i])
                gate_z = _sigmoid(z[hidden + i] + z_h[hidden + i])
                h[i] = (1.0 - gate_z) * _tanh(z[2 * hidden + i] + gate_r * z_h[2 * hidden + i]) + gate_z * h[i]
        width = hidden
        for i in range(hidden):
            value[i] = h[i]
    for i in range(2):
        rate = net.b_y[i]
        for j in range(hidden):
            rate += net.w_y[i, j] * value[j]
        state[i] += net.dt_s * (net.out_offset[i] + net.out_scale[i] * rate)


@compiled
def run_ahead(net, u, first, last, state, ahead, scratch):
    """`ahead` = `state` moved on by rows first .. last of u; `state` stays."""
    ahead[:] = state
    for k in range(first, last + 1):
        step(net, u[k], ahead, scratch)
