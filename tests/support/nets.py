"""Weights files for tests: a random net of plausible slopes, and the paper's net from the reference folder."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimator_c.formulation.weights import CELLS, FORMAT_STACK, NetWeights

Y_SPAN, Y_LOW = 1.07564811 + 0.63202183, -0.63202183  # output normalisation of the paper's net, degC/s


def weights_document(w_u: Any, w_h: Any, b: Any, w_y: Any, b_y: Any, **outputs: float) -> dict[str, Any]:
    """The contract's JSON object around given matrices (nested lists or arrays), with the paper's input scaling."""
    offset, scale = outputs.get("offset", Y_LOW), outputs.get("scale", Y_SPAN)
    names = ("dtheta_w_degc_s", "dtheta_r_degc_s")
    return {
        "format": "rt-lstm-weights/1",
        "cell": "lstm",
        "hidden": len(np.asarray(w_h)[0]),
        "layers": 1,
        "gate_order": "ifgo",
        "dt_s": 0.1,
        "inputs": [
            {"name": "speed_rpm", "offset": 0.0, "scale": 15000.0},
            {"name": "torque_nm", "offset": 0.0, "scale": 160.36},
            {"name": "theta_w_degc", "offset": 60.0, "scale": 100.0},
            {"name": "theta_r_degc", "offset": 60.0, "scale": 100.0},
        ],
        "outputs": [{"name": name, "offset": offset, "scale": scale} for name in names],
        "W_u": np.asarray(w_u).tolist(),
        "W_h": np.asarray(w_h).tolist(),
        "b": np.asarray(b).tolist(),
        "W_y": np.asarray(w_y).tolist(),
        "b_y": np.asarray(b_y).tolist(),
    }


def random_net(
    folder: Path, hidden: int = 8, seed: int = 0, gain: float = 1.0, cell: str = "lstm", layers: int = 1
) -> Path:
    """Write a net nobody trained; `gain` scales all gate weights (1: as strong as a trained net's).

    One layer of LSTM cells is written in format 1, everything else in format 2.
    """
    rng = np.random.default_rng(seed)
    path = folder / f"random-{cell}-{layers}x{hidden}-{seed}-{gain:g}.json"
    gates = 4 if cell == "lstm" else 3
    recurrent = min(0.4, 1.2 / np.sqrt(hidden))  # more cells do not make a net wilder
    w_u = [gain * rng.normal(0.0, 0.8, (gates * hidden, 4))]
    w_h = [gain * rng.normal(0.0, recurrent, (gates * hidden, hidden))]
    b = [rng.normal(0.0, 0.5, gates * hidden)]
    w_y, b_y = rng.normal(0.0, min(0.4, 1.2 / np.sqrt(hidden)), (2, hidden)), rng.normal(0.3, 0.1, 2)
    for _ in range(1, layers):
        w_u.append(gain * rng.normal(0.0, 0.6, (gates * hidden, hidden)))
        w_h.append(gain * rng.normal(0.0, recurrent, (gates * hidden, hidden)))
        b.append(rng.normal(0.0, 0.5, gates * hidden))
    document = weights_document(w_u[0], w_h[0], b[0], w_y, b_y)
    if (cell, layers) != ("lstm", 1):
        stacks = {"W_u": w_u, "W_h": w_h, "b": b}
        if cell == "gru":
            stacks["b_h"] = [rng.normal(0.0, 0.5, gates * hidden) for _ in range(layers)]
        document |= {key: [table.tolist() for table in tables] for key, tables in stacks.items()}
        document |= {"format": FORMAT_STACK, "cell": cell, "layers": layers, "gate_order": CELLS[cell]}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def torch_net(weights: NetWeights) -> tuple[Any, Any]:
    """(torch.nn.LSTM or GRU, torch.nn.Linear) in float64 with these weights, batch first; needs torch."""
    import torch

    kind = torch.nn.LSTM if weights.cell == "lstm" else torch.nn.GRU
    cells = kind(4, weights.hidden, num_layers=len(weights.stack), batch_first=True, dtype=torch.float64)
    output = torch.nn.Linear(weights.hidden, 2, dtype=torch.float64)
    with torch.no_grad():
        for k, layer in enumerate(weights.stack):
            values = {"weight_ih": layer.w_u, "weight_hh": layer.w_h, "bias_ih": layer.b, "bias_hh": layer.b_h}
            for name, value in values.items():
                parameter = getattr(cells, f"{name}_l{k}")
                parameter.copy_(torch.zeros_like(parameter) if value is None else torch.tensor(value))
        output.weight.copy_(torch.tensor(weights.w_y))
        output.bias.copy_(torch.tensor(weights.b_y))
    return cells, output


def reference_folder() -> Path:
    """The folder of reference data, or a loud skip (a failure where RT_REQUIRE_REFERENCE=1)."""
    folder = os.environ.get("RT_REFERENCE_DATA", "")
    if folder and Path(folder).is_dir():
        return Path(folder)
    message = "RT_REFERENCE_DATA does not name the reference data folder: the paper's figures are NOT checked"
    if os.environ.get("RT_REQUIRE_REFERENCE") == "1":
        pytest.fail(message)
    pytest.skip(message)


def paper_net(folder: Path) -> Path:
    """Write the paper's net in our format into `folder` (a test's own)."""
    source = json.loads((reference_folder() / "paper" / "lstm_8hu_paper_weights.json").read_text(encoding="utf-8"))
    document = weights_document(source["Wu"], source["Wh"], source["b"], source["Wf"], source["bf"])
    path = folder / "paper.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return path
