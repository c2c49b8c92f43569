"""The net in CasADi: one step, its exact adjoint from recorded activations, its direct temperature slope.

One or two layers of cells (see cells.py), a linear output layer on the new h of the last. Scaling of inputs and outputs
is folded into the weights here, once, so that all functions take rpm, Nm and degC and give degC/s. What the net
carries from step to step is one vector, the memory: c of all layers (LSTM only), then h of all layers.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from .cells import Cell, cell_of
from .weights import NetWeights


@dataclass(frozen=True)
class NetFunctions:
    """The step of the net as CasADi functions of scalars (SX); M = memory, T = tape elements.

    forward  (u[2], theta[2], memory[M]) -> (memory_next[M], rate[2], tape[T])
    adjoint  (tape[T], memory[M], rate_bar[2], memory_next_bar[M]) -> (theta_bar[2], memory_bar[M])
    slope    (tape[T], memory[M]) -> (slope[2]), slope = [drate_w/dtheta_w, drate_r/dtheta_r] at given memory
    """

    memory: int
    tape: int
    forward: ca.Function
    adjoint: ca.Function
    slope: ca.Function


def build_net(weights: NetWeights) -> NetFunctions:
    """Build the symbolic net. u = [speed rpm, torque Nm]; all temperatures degC, rates degC/s."""
    n_h, count = weights.hidden, len(weights.stack)
    w_in = weights.stack[0].w_u / weights.in_scale
    first_bias = ca.DM(weights.stack[0].b - w_in @ weights.in_offset)
    biases = [first_bias, *(ca.DM(layer.b) for layer in weights.stack[1:])]
    cells: list[Cell] = [cell_of(weights.cell, *pair) for pair in zip(weights.stack, biases, strict=True)]
    w_u, w_theta = ca.DM(w_in[:, :2]), ca.DM(w_in[:, 2:])
    w_up = [ca.DM(layer.w_u) for layer in weights.stack[1:]]  # of layer k + 1, on the h of layer k
    w_y = ca.DM(weights.out_scale[:, None] * weights.w_y)
    b_y = ca.DM(weights.out_offset + weights.out_scale * weights.b_y)

    u, theta, memory = ca.SX.sym("u", 2), ca.SX.sym("theta", 2), ca.SX.sym("memory", weights.memory)
    parts, c_new, h_new, tapes = [(w_u, u), (w_theta, theta)], [], [], []
    for k, (cell, (c, h)) in enumerate(zip(cells, _split(memory, weights), strict=True)):
        c_next, h_next, tape_k = cell.step(parts, c, h)
        c_new.append(c_next)
        h_new.append(h_next)
        tapes.append(tape_k)
        if k + 1 < count:
            parts = [(w_up[k], h_next)]
    forward = ca.Function(
        "net_forward",
        [u, theta, memory],
        [ca.vertcat(*c_new, *h_new), w_y @ h_new[-1] + b_y, ca.vertcat(*tapes)],
        ["u", "theta", "memory"],
        ["memory_next", "rate", "tape"],
    )

    tape = ca.SX.sym("tape", n_h * sum(cell.tape_gates for cell in cells))
    ends = np.cumsum([0, *(cell.tape_gates * n_h for cell in cells)])
    rate_bar, memory_next_bar = ca.SX.sym("rate_bar", 2), ca.SX.sym("memory_next_bar", weights.memory)

    def pull_back(rate_seed: ca.SX, memory_seed: ca.SX) -> tuple[ca.SX, ca.SX]:
        seeds, states = _split(memory_seed, weights), _split(memory, weights)
        c_bars, h_bars = [ca.SX()] * count, [ca.SX()] * count
        above = w_y.T @ rate_seed
        for k in reversed(range(count)):
            tape_k = tape[int(ends[k]) : int(ends[k + 1])]
            gates, c_bars[k], h_bars[k] = cells[k].pull_back(tape_k, *states[k], seeds[k][0], above + seeds[k][1])
            above = (w_up[k - 1] if k > 0 else w_theta).T @ gates
        return above, ca.vertcat(*c_bars, *h_bars)

    adjoint = ca.Function(
        "net_adjoint",
        [tape, memory, rate_bar, memory_next_bar],
        list(pull_back(rate_bar, memory_next_bar)),
        ["tape", "memory", "rate_bar", "memory_next_bar"],
        ["theta_bar", "memory_bar"],
    )
    none = ca.SX(weights.memory, 1)
    rows = [pull_back(ca.SX(ca.DM([1 - k, k])), none)[0][k] for k in range(2)]
    slope = ca.Function("net_slope", [tape, memory], [ca.vertcat(*rows)], ["tape", "memory"], ["slope"])
    return NetFunctions(weights.memory, tape.numel(), forward, adjoint, slope)


def _split(memory: ca.SX, weights: NetWeights) -> list[tuple[ca.SX, ca.SX]]:
    """(c, h) of each layer; c has no elements where the cell has none."""
    n_h, n_c = weights.hidden, weights.hidden if weights.memory_c else 0
    at_h = weights.memory_c
    return [
        (memory[k * n_c : (k + 1) * n_c], memory[at_h + k * n_h : at_h + (k + 1) * n_h])
        for k in range(len(weights.stack))
    ]
