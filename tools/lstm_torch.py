"""The learned thermal model in torch, and its export to the weights text that the C generator reads.

The net is one or two layers of LSTM or GRU cells and a linear output layer: x = (speed, torque, winding and rotor
temperature) at 10 Hz in, the rates of the two temperatures out. torch is imported only by this module and the
`tools.train*` beside it.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from estimator_c.formulation.weights import INPUTS, OUTPUTS, LstmWeights
from tools.train_gru import FastGru

FORMATS = ("rt-lstm-weights/1", "rt-net-weights/2")  # one layer of LSTM cells; any other net, tables per layer
GATES = {"lstm": "ifgo", "gru": "rzn"}  # in torch's order


@dataclass(frozen=True)
class Scaling:
    """Affine scaling of the net's ports: u = (x − in_offset)/in_scale, y = out_offset + out_scale·y_norm.

    Arrays of shape (4,) and (2,), in the units that the names in `INPUTS` and `OUTPUTS` carry.
    """

    in_offset: np.ndarray
    in_scale: np.ndarray
    out_offset: np.ndarray
    out_scale: np.ndarray

    @classmethod
    def from_rates(cls, rates_degc_s: np.ndarray) -> Scaling:
        """Inputs near the paper's ranges; outputs by mean and standard deviation of the rates, shape (N, 2).

        One scale per channel: with a common one the rotor, ten times slower, would hardly count in the loss.
        """
        return cls(
            in_offset=np.array([0.0, 0.0, 60.0, 60.0]),
            in_scale=np.array([15000.0, 160.0, 100.0, 100.0]),
            out_offset=np.round(rates_degc_s.mean(axis=0), 6),
            out_scale=np.round(rates_degc_s.std(axis=0), 6),
        )


class LstmRates(nn.Module):
    """Cells + linear layer on scaled ports: (steps, batch, 4) -> (steps, batch, 2), from an empty memory."""

    def __init__(self, hidden: int, cell: str = "lstm", layers: int = 1) -> None:
        super().__init__()
        self.hidden, self.cell = hidden, cell
        kind = FastGru if cell == "gru" else nn.LSTM
        self.lstm = kind(len(INPUTS), hidden)
        self.upper = nn.ModuleList(kind(hidden, hidden) for _ in range(layers - 1))
        self.head = nn.Linear(hidden, len(OUTPUTS))

    @property
    def stack(self) -> list[nn.Module]:
        """The layers of cells, from the inputs on."""
        return [self.lstm, *self.upper]

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        for layer in self.stack:
            u = layer(u)[0]
        return self.head(u)


def spread_time_constants(net: LstmRates, dt_s: float, shortest_s: float, longest_s: float) -> None:
    """Start the cells with memory times spread logarithmically from `shortest_s` to `longest_s`, in place.

    A cell forgets with f = σ(b_f); b_f = ln(τ/dt − 1) gives it the time constant τ at rest, and b_i = −b_f
    keeps its content near one. The plant's hidden lags (about 8 s and 120 s) are then in reach from the first
    epoch; from torch's default (τ ≈ 0.2 s) the gradient has to find them through hundreds of steps. A GRU's gate z
    does the work of both.
    """
    n_h = net.hidden
    tau_s = torch.logspace(math.log10(shortest_s), math.log10(longest_s), n_h)
    keep = torch.log(tau_s / dt_s - 1.0)
    with torch.no_grad():
        for layer in net.stack:
            parameters = dict(layer.named_parameters())
            parameters["bias_hh_l0"].zero_()
            if net.cell == "lstm":
                parameters["bias_ih_l0"][:n_h] = -keep
            parameters["bias_ih_l0"][n_h : 2 * n_h] = keep  # f of an LSTM, z of a GRU


def start_as_matlab(net: LstmRates) -> None:
    """MATLAB's initial weights, in place: Glorot at the inputs, orthogonal in the recurrence, forget gates at one."""
    with torch.no_grad():
        for layer in net.stack:
            parameters = dict(layer.named_parameters())
            nn.init.xavier_uniform_(parameters["weight_ih_l0"])
            nn.init.orthogonal_(parameters["weight_hh_l0"])
            parameters["bias_ih_l0"].zero_()
            parameters["bias_hh_l0"].zero_()
            if net.cell == "lstm":
                parameters["bias_ih_l0"][net.hidden : 2 * net.hidden] = 1.0
        nn.init.xavier_uniform_(net.head.weight)
        net.head.bias.zero_()


def weights_document(net: LstmRates, scaling: Scaling, dt_s: float) -> dict[str, Any]:
    """The net as a weights document, numbers in float64, gates in torch's order.

    Format rt-lstm-weights/1 for one layer of LSTM cells; rt-net-weights/2, with lists of tables from the first layer
    on and a GRU's second bias as b_h, for any other.
    """
    ports = {
        "inputs": zip(INPUTS, scaling.in_offset, scaling.in_scale, strict=True),
        "outputs": zip(OUTPUTS, scaling.out_offset, scaling.out_scale, strict=True),
    }
    tables: dict[str, list[Any]] = {"W_u": [], "W_h": [], "b": []} | ({"b_h": []} if net.cell == "gru" else {})
    for layer in net.stack:
        p = {name: value.detach().to(torch.float64).numpy() for name, value in layer.named_parameters()}
        tables["W_u"].append(p["weight_ih_l0"].tolist())
        tables["W_h"].append(p["weight_hh_l0"].tolist())
        if net.cell == "gru":
            tables["b"].append(p["bias_ih_l0"].tolist())
            tables["b_h"].append(p["bias_hh_l0"].tolist())
        else:
            tables["b"].append((p["bias_ih_l0"] + p["bias_hh_l0"]).tolist())
    plain = net.cell == "lstm" and len(net.stack) == 1
    return {
        "format": FORMATS[0] if plain else FORMATS[1],
        "cell": net.cell,
        "hidden": net.hidden,
        "layers": len(net.stack),
        "gate_order": GATES[net.cell],
        "dt_s": dt_s,
        **{
            side: [{"name": name, "offset": float(offset), "scale": float(scale)} for name, offset, scale in rows]
            for side, rows in ports.items()
        },
        **({name: table[0] for name, table in tables.items()} if plain else tables),
        "W_y": net.head.weight.detach().to(torch.float64).tolist(),
        "b_y": net.head.bias.detach().to(torch.float64).tolist(),
    }


def net_from_weights(weights: LstmWeights) -> tuple[LstmRates, Scaling]:
    """The torch twin of a weights file, in float64 (tests compare it with numpy, CasADi and C)."""
    stack = getattr(weights, "stack", (weights,))
    net = LstmRates(weights.hidden, getattr(weights, "cell", "lstm"), len(stack)).double()
    for layer, values in zip(net.stack, stack, strict=True):
        b_h = getattr(values, "b_h", None)
        tables = {
            "weight_ih_l0": values.w_u,
            "weight_hh_l0": values.w_h,
            "bias_ih_l0": values.b,
            "bias_hh_l0": np.zeros_like(values.b) if b_h is None else b_h,
        }
        layer.load_state_dict({name: torch.tensor(value) for name, value in tables.items()})
    net.head.load_state_dict({"weight": torch.tensor(weights.w_y), "bias": torch.tensor(weights.b_y)})
    return net, Scaling(weights.in_offset, weights.in_scale, weights.out_offset, weights.out_scale)


def format_document(document: dict) -> str:
    """Text of a weights document that diffs well: one port, matrix row, vector entry or figure per line.

    Keys of the document keep their order, those of the tables in it are sorted. Floats are written by repr,
    the shortest text that reads back to the same double, so writing twice gives the same bytes.
    """
    items = []
    for key, value in document.items():
        if isinstance(value, list):
            text = "[\n" + ",\n".join("  " + _rows(entry) for entry in value) + "\n ]"
        elif isinstance(value, dict):
            text = json.dumps(value, indent=1, sort_keys=True, allow_nan=False).replace("\n", "\n ")
        else:
            text = json.dumps(value, allow_nan=False)
        items.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(items) + "\n}\n"


def _rows(entry: Any) -> str:
    """One entry of a list: a layer's table with a row per line, anything else on one line."""
    if isinstance(entry, list) and entry and isinstance(entry[0], list):
        return "[\n" + ",\n".join("   " + json.dumps(row, allow_nan=False) for row in entry) + "\n  ]"
    return json.dumps(entry, allow_nan=False)


def write_document(path: Path, document: dict) -> None:
    """Write a weights document whole or not at all (a generator may be reading the old one)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(format_document(document), encoding="utf-8")
    os.replace(part, path)
