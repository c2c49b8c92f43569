"""Weights files for tests: a random net of plausible slopes, and the paper's net from the reference folder."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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


def random_net(folder: Path, hidden: int = 8, seed: int = 0, gain: float = 1.0) -> Path:
    """Write a net nobody trained; `gain` scales all gate weights (1: as strong as a trained net's)."""
    rng = np.random.default_rng(seed)
    path = folder / f"random-{hidden}-{seed}-{gain:g}.json"
    document = weights_document(
        gain * rng.normal(0.0, 0.8, (4 * hidden, 4)),
        gain * rng.normal(0.0, 0.4, (4 * hidden, hidden)),
        rng.normal(0.0, 0.5, 4 * hidden),
        rng.normal(0.0, 0.4, (2, hidden)),
        rng.normal(0.3, 0.1, 2),
    )
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


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
