"""The learned thermal model in torch, and its export to the weights text that the C generator reads.

The net is one LSTM layer and a linear output layer: x = (speed, torque, winding and rotor temperature) at
10 Hz in, the rates of the two temperatures out. Only this module, `tools.train` and `tools.train_windows`
import torch.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from estimator_c.formulation.weights import FORMAT, INPUTS, OUTPUTS, LstmWeights


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
    """LSTM + linear layer on scaled ports: (steps, batch, 4) -> (steps, batch, 2), from an empty memory."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(len(INPUTS), hidden)
        self.head = nn.Linear(hidden, len(OUTPUTS))

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(u)[0])


def spread_time_constants(net: LstmRates, dt_s: float, shortest_s: float, longest_s: float) -> None:
    """Start the cells with memory times spread logarithmically from `shortest_s` to `longest_s`, in place.

    A cell forgets with f = σ(b_f); b_f = ln(τ/dt − 1) gives it the time constant τ at rest, and b_i = −b_f
    keeps its content near one. The plant's hidden lags (about 8 s and 120 s) are then in reach from the first
    epoch; from torch's default (τ ≈ 0.2 s) the gradient has to find them through hundreds of steps.
    """
    hidden = net.lstm.hidden_size
    tau_s = torch.logspace(math.log10(shortest_s), math.log10(longest_s), hidden)
    forget = torch.log(tau_s / dt_s - 1.0)
    parameters = dict(net.lstm.named_parameters())
    with torch.no_grad():
        parameters["bias_hh_l0"].zero_()
        parameters["bias_ih_l0"][:hidden] = -forget
        parameters["bias_ih_l0"][hidden : 2 * hidden] = forget


def weights_document(net: LstmRates, scaling: Scaling, dt_s: float) -> dict:
    """The net as a weights document (format rt-lstm-weights/1), numbers in float64, gate order i, f, g, o."""
    values = {name: p.detach().to(torch.float64).numpy() for name, p in net.named_parameters()}
    ports = {
        "inputs": zip(INPUTS, scaling.in_offset, scaling.in_scale, strict=True),
        "outputs": zip(OUTPUTS, scaling.out_offset, scaling.out_scale, strict=True),
    }
    return {
        "format": FORMAT,
        "cell": "lstm",
        "hidden": net.lstm.hidden_size,
        "layers": 1,
        "gate_order": "ifgo",
        "dt_s": dt_s,
        **{
            side: [
                {"name": name, "offset": float(offset), "scale": float(scale)} for name, offset, scale in rows
            ]
            for side, rows in ports.items()
        },
        "W_u": values["lstm.weight_ih_l0"].tolist(),
        "W_h": values["lstm.weight_hh_l0"].tolist(),
        "b": (values["lstm.bias_ih_l0"] + values["lstm.bias_hh_l0"]).tolist(),
        "W_y": values["head.weight"].tolist(),
        "b_y": values["head.bias"].tolist(),
    }


def net_from_weights(weights: LstmWeights) -> tuple[LstmRates, Scaling]:
    """The torch twin of a weights file, in float64 (tests compare it with numpy, CasADi and C)."""
    net = LstmRates(weights.hidden).double()
    values = {
        "lstm.weight_ih_l0": weights.w_u,
        "lstm.weight_hh_l0": weights.w_h,
        "lstm.bias_ih_l0": weights.b,
        "lstm.bias_hh_l0": np.zeros(4 * weights.hidden),
        "head.weight": weights.w_y,
        "head.bias": weights.b_y,
    }
    net.load_state_dict({name: torch.tensor(value) for name, value in values.items()})
    return net, Scaling(weights.in_offset, weights.in_scale, weights.out_offset, weights.out_scale)


def format_document(document: dict) -> str:
    """Text of a weights document that diffs well: one port, matrix row, vector entry or figure per line.

    Keys of the document keep their order, those of the tables in it are sorted. Floats are written by repr,
    the shortest text that reads back to the same double, so writing twice gives the same bytes.
    """
    items = []
    for key, value in document.items():
        if isinstance(value, list):
            text = "[\n" + ",\n".join("  " + json.dumps(row, allow_nan=False) for row in value) + "\n ]"
        elif isinstance(value, dict):
            text = json.dumps(value, indent=1, sort_keys=True, allow_nan=False).replace("\n", "\n ")
        else:
            text = json.dumps(value, allow_nan=False)
        items.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(items) + "\n}\n"


def write_document(path: Path, document: dict) -> None:
    """Write a weights document whole or not at all (a generator may be reading the old one)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(format_document(document), encoding="utf-8")
    os.replace(part, path)
