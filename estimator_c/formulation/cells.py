"""The recurrent cells in CasADi: one step forward with its activations ("tape"), and the exact way back from the tape.

The way back is written from the recorded activations because reverse mode then needs no exp at all; a test holds it
against CasADi's own derivative. `i`, `f`, `g`, `o` are the LSTM's gates (the paper's eq. LSTMeq), `r`, `z`, `n` the
GRU's in PyTorch's definition, where the reset gate acts on W_hn h + b_hn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from .weights import Layer

Parts = Sequence[tuple[ca.DM, ca.SX]]  # the input's share of the gates: sum of matrix @ vector over the parts


class Cell(Protocol):
    """A layer of cells. H: cells, all vectors are columns; a GRU has no c, its c is a vector of no elements."""

    @property
    def tape_gates(self) -> int:
        """The tape has tape_gates * H elements."""
        ...

    def step(self, inputs: Parts, c: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(c_next, h_next, tape)."""
        ...

    def pull_back(self, tape: ca.SX, c: ca.SX, h: ca.SX, c_bar: ca.SX, h_bar: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """From the bars of (c_next, h_next) to (bar of the gates' input share, c_bar, h_bar)."""
        ...


@dataclass(frozen=True)
class LstmCell:
    """Tape: i, f, g, o, tanh(c_next)."""

    w_h: ca.DM
    b: ca.DM
    tape_gates: int = 5

    def step(self, inputs: Parts, c: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        n_h = self.w_h.columns()
        z = _share(inputs) + self.w_h @ h + self.b
        i, f = _sigmoid(z[:n_h]), _sigmoid(z[n_h : 2 * n_h])
        g, o = _tanh(z[2 * n_h : 3 * n_h]), _sigmoid(z[3 * n_h :])
        c_next = f * c + i * g
        tanh_c = _tanh(c_next)
        return c_next, o * tanh_c, ca.vertcat(i, f, g, o, tanh_c)

    def pull_back(self, tape: ca.SX, c: ca.SX, h: ca.SX, c_bar: ca.SX, h_bar: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        ti, tf, tg, to, tc = ca.vertsplit(tape, self.w_h.columns())
        c_sum = c_bar + h_bar * to * (1 - tc * tc)
        z_bar = ca.vertcat(
            c_sum * tg * ti * (1 - ti),
            c_sum * c * tf * (1 - tf),
            c_sum * ti * (1 - tg * tg),
            h_bar * tc * to * (1 - to),
        )
        return z_bar, c_sum * tf, self.w_h.T @ z_bar


@dataclass(frozen=True)
class GruCell:
    """Tape: r, z, n, W_hn h + b_hn."""

    w_h: ca.DM
    b: ca.DM
    b_h: ca.DM
    tape_gates: int = 4

    def step(self, inputs: Parts, c: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        n_h = self.w_h.columns()
        from_input = _share(inputs) + self.b
        from_h = self.w_h @ h + self.b_h
        r, z = (_sigmoid(from_input[k * n_h : (k + 1) * n_h] + from_h[k * n_h : (k + 1) * n_h]) for k in range(2))
        q = from_h[2 * n_h :]
        n = _tanh(from_input[2 * n_h :] + r * q)
        return c, n + z * (h - n), ca.vertcat(r, z, n, q)

    def pull_back(self, tape: ca.SX, c: ca.SX, h: ca.SX, c_bar: ca.SX, h_bar: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        r, z, n, q = ca.vertsplit(tape, self.w_h.columns())
        n_bar = h_bar * (1 - z) * (1 - n * n)
        r_bar = n_bar * q * r * (1 - r)
        z_bar = h_bar * (h - n) * z * (1 - z)
        return (
            ca.vertcat(r_bar, z_bar, n_bar),
            c_bar,
            h_bar * z + self.w_h.T @ ca.vertcat(r_bar, z_bar, n_bar * r),
        )


def cell_of(kind: str, layer: Layer, b: ca.DM) -> Cell:
    """The cell `kind` ("lstm" or "gru") with the weights of `layer` and the input bias b."""
    if kind == "gru":
        assert layer.b_h is not None, "a GRU layer has it, or it was not loaded"
        return GruCell(ca.DM(layer.w_h), b, ca.DM(layer.b_h))
    return LstmCell(ca.DM(layer.w_h), b)


def _share(inputs: Parts) -> ca.SX:
    share = inputs[0][0] @ inputs[0][1]
    for matrix, vector in inputs[1:]:
        share = share + matrix @ vector
    return share


def _sigmoid(z: ca.SX) -> ca.SX:
    return 1 / (1 + ca.exp(-z))


def _tanh(z: ca.SX) -> ca.SX:
    # Through exp: libm's tanh costs three times as much; the absolute error stays at one rounding.
    return 1 - 2 / (1 + ca.exp(2 * z))
