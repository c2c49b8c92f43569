"""The net in CasADi: one step, its exact adjoint from recorded activations, its direct temperature slope.

The LSTM is the paper's eq. (LSTMeq); scaling of inputs and outputs is folded into the weights here, once, so
that all functions take rpm, Nm and degC and give degC/s. The adjoint is written from the recorded activations
("tape") because reverse mode then needs no exp at all; a test holds it against CasADi's own derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from .weights import LstmWeights

TAPE_GATES = 5  # i, f, g, o, tanh(c_next)


@dataclass(frozen=True)
class LstmFunctions:
    """The step of the net as CasADi functions of scalars (SX).

    forward  (u[2], theta[2], c[H], h[H]) -> (c_next[H], h_next[H], rate[2], tape[5H])
    adjoint  (tape[5H], c[H], rate_bar[2], c_next_bar[H], h_next_bar[H]) -> (theta_bar[2], c_bar[H], h_bar[H])
    slope    (tape[5H], c[H]) -> (slope[2]) with slope = [drate_w/dtheta_w, drate_r/dtheta_r] at given c, h
    """

    hidden: int
    forward: ca.Function
    adjoint: ca.Function
    slope: ca.Function


def build_lstm(weights: LstmWeights) -> LstmFunctions:
    """Build the symbolic net. u = [speed rpm, torque Nm]; all temperatures degC, rates degC/s."""
    n_h = weights.hidden
    w_in = weights.w_u / weights.in_scale
    bias = ca.DM(weights.b - w_in @ weights.in_offset)
    w_u, w_theta, w_h = ca.DM(w_in[:, :2]), ca.DM(w_in[:, 2:]), ca.DM(weights.w_h)
    w_y = ca.DM(weights.out_scale[:, None] * weights.w_y)
    b_y = ca.DM(weights.out_offset + weights.out_scale * weights.b_y)

    u, theta = ca.SX.sym("u", 2), ca.SX.sym("theta", 2)
    c, h = ca.SX.sym("c", n_h), ca.SX.sym("h", n_h)
    z = w_u @ u + w_theta @ theta + w_h @ h + bias
    i, f = _sigmoid(z[:n_h]), _sigmoid(z[n_h : 2 * n_h])
    g, o = _tanh(z[2 * n_h : 3 * n_h]), _sigmoid(z[3 * n_h :])
    c_next = f * c + i * g
    tanh_c = _tanh(c_next)
    h_next = o * tanh_c
    rate = w_y @ h_next + b_y
    tape_out = ca.vertcat(i, f, g, o, tanh_c)
    forward = ca.Function(
        "lstm_forward",
        [u, theta, c, h],
        [c_next, h_next, rate, tape_out],
        ["u", "theta", "c", "h"],
        ["c_next", "h_next", "rate", "tape"],
    )

    tape = ca.SX.sym("tape", TAPE_GATES * n_h)
    rate_bar = ca.SX.sym("rate_bar", 2)
    c_next_bar, h_next_bar = ca.SX.sym("c_next_bar", n_h), ca.SX.sym("h_next_bar", n_h)

    def pull_back(rate_seed: ca.SX, c_seed: ca.SX, h_seed: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        ti, tf, tg, to, tc = ca.vertsplit(tape, n_h)
        h_sum = w_y.T @ rate_seed + h_seed
        c_sum = c_seed + h_sum * to * (1 - tc * tc)
        z_bar = ca.vertcat(
            c_sum * tg * ti * (1 - ti),
            c_sum * c * tf * (1 - tf),
            c_sum * ti * (1 - tg * tg),
            h_sum * tc * to * (1 - to),
        )
        return w_theta.T @ z_bar, c_sum * tf, w_h.T @ z_bar

    adjoint = ca.Function(
        "lstm_adjoint",
        [tape, c, rate_bar, c_next_bar, h_next_bar],
        list(pull_back(rate_bar, c_next_bar, h_next_bar)),
        ["tape", "c", "rate_bar", "c_next_bar", "h_next_bar"],
        ["theta_bar", "c_bar", "h_bar"],
    )
    none = ca.SX(n_h, 1)
    rows = [pull_back(ca.SX(ca.DM([1 - k, k])), none, none)[0][k] for k in range(2)]
    slope = ca.Function("lstm_slope", [tape, c], [ca.vertcat(*rows)], ["tape", "c"], ["slope"])
    return LstmFunctions(n_h, forward, adjoint, slope)


def _sigmoid(z: ca.SX) -> ca.SX:
    return 1 / (1 + ca.exp(-z))


def _tanh(z: ca.SX) -> ca.SX:
    # Through exp: libm's tanh costs three times as much; the absolute error stays at one rounding.
    return 1 - 2 / (1 + ca.exp(2 * z))
