"""Read nets: our own weights files, and the plain format that a reference net is published in.

The plain format is one JSON object: ``Wu`` (4H, 4), ``Wh`` (4H, H), ``b`` (4H), ``Wf`` (2, H), ``bf`` (2), the gate
order and the normalisation as text: ``"x_norm": "[n/A, T/B, (Tw-C)/D, (Tr-E)/F]"`` and, one scale for both rates from
-Q to P, ``"y_denorm": "y*(P+Q)-Q [degC/s]"``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import tempfile
from pathlib import Path
from typing import Any

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import INPUTS, OUTPUTS, LstmWeights, load_weights

PLAIN_KEYS = frozenset({"Wu", "Wh", "b", "Wf", "bf"})
REMEDY = "see the formats in docs/model.md, 'Evaluate'"
_NUMBER = r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_X_NORM = re.compile(rf"\[n/{_NUMBER},T/{_NUMBER},\(Tw-{_NUMBER}\)/{_NUMBER},\(Tr-{_NUMBER}\)/{_NUMBER}\]")
_Y_DENORM = re.compile(rf"y\*\({_NUMBER}\+{_NUMBER}\)-{_NUMBER}\[degC/s\]")


def load_net(path: Path) -> LstmWeights:
    """Read a net in either format.

    Raises
    ------
    FormulationError
        One line with file, field and what to do.
    """
    try:
        raw = path.read_bytes()
        data = json.loads(raw)
    except (OSError, ValueError):
        return load_weights(path)  # which says what is wrong
    if not isinstance(data, dict) or not PLAIN_KEYS & data.keys() - {"b"} or "format" in data:
        return load_weights(path)
    document = document_from_plain(path, data)
    with tempfile.TemporaryDirectory() as folder:
        converted = Path(folder) / "net.json"
        converted.write_text(json.dumps(document), encoding="utf-8")
        try:
            net = load_weights(converted)
        except FormulationError as error:
            raise FormulationError(path, error.field, error.problem, REMEDY) from error
    return dataclasses.replace(net, sha256=hashlib.sha256(raw).hexdigest(), name=path.stem)


def document_from_plain(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """The contract's weights document (one LSTM layer) of a net in the plain format."""
    for key in sorted(PLAIN_KEYS | {"gate_order", "x_norm", "y_denorm"}):
        if key not in data:
            raise FormulationError(path, key, "is missing", REMEDY)
    if data["gate_order"] != "i,f,g,o":
        raise FormulationError(path, "gate_order", f"must be 'i,f,g,o', is {data['gate_order']!r}", REMEDY)
    x = _numbers(path, data, "x_norm", _X_NORM)
    p, q, again = _numbers(path, data, "y_denorm", _Y_DENORM)
    if q != again:
        raise FormulationError(path, "y_denorm", f"must subtract what it adds ({q:g}), subtracts {again:g}", REMEDY)
    hidden = len(data["Wh"]) // 4 if isinstance(data["Wh"], list) else 0
    scaling = ((0.0, x[0]), (0.0, x[1]), (x[2], x[3]), (x[4], x[5]))
    return {
        "format": "rt-lstm-weights/1",
        "cell": "lstm",
        "hidden": hidden,
        "layers": 1,
        "gate_order": "ifgo",
        "dt_s": 0.1,
        "inputs": [{"name": n, "offset": o, "scale": s} for n, (o, s) in zip(INPUTS, scaling, strict=True)],
        "outputs": [{"name": n, "offset": -q, "scale": p + q} for n in OUTPUTS],
        "W_u": data["Wu"],
        "W_h": data["Wh"],
        "b": data["b"],
        "W_y": data["Wf"],
        "b_y": data["bf"],
    }


def _numbers(path: Path, data: dict[str, Any], field: str, pattern: re.Pattern[str]) -> list[float]:
    found = pattern.fullmatch(re.sub(r"\s", "", str(data[field])))
    if found is None:
        raise FormulationError(path, field, f"is not understood: {data[field]!r}", REMEDY)
    return [float(text) for text in found.groups()]
