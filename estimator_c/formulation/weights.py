"""The trained net as a file: load, validate, identify."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .envelope import Envelope, read_envelope
from .errors import FormulationError

FORMAT = "rt-lstm-weights/1"  # one layer of LSTM cells
FORMAT_STACK = "rt-net-weights/2"  # LSTM or GRU, one or two layers: W_u, W_h, b (and b_h) are lists, one per layer
CELLS = {"lstm": "ifgo", "gru": "rzn"}  # cell -> order of its gates, as in PyTorch
MAX_LAYERS = 2
INPUTS = ("speed_rpm", "torque_nm", "theta_w_degc", "theta_r_degc")
OUTPUTS = ("dtheta_w_degc_s", "dtheta_r_degc_s")
REMEDY = "restore the file or train it again with 'make train'"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Layer:
    """One layer of H cells with G gates (LSTM 4, GRU 3) on n inputs; the rows follow the order of the gates.

    Attributes
    ----------
    w_u, w_h, b : (G H, n), (G H, H), (G H,)
        Input weights, recurrent weights, bias. LSTM: b = b_ih + b_hh of PyTorch; GRU: b = b_ih.
    b_h : (G H,) or None
        GRU: b_hh, which the reset gate acts on too. LSTM: None.
    """

    w_u: Array
    w_h: Array
    b: Array
    b_h: Array | None = None


@dataclass(frozen=True)
class NetWeights:
    """One or two layers of LSTM or GRU cells and the output layer, in PyTorch's gate order (i, f, g, o or r, z, n).

    Normalised input u = (x - in_offset)/in_scale with x = [speed rpm, torque Nm, theta_w degC, theta_r degC];
    rates in degC/s = out_offset + out_scale*(w_y h + b_y).

    Attributes
    ----------
    cell, hidden : str, int
        "lstm" or "gru"; cells per layer, H.
    stack : tuple of Layer
        The layers, from the inputs on.
    w_y, b_y : (2, H), (2,)
        Output layer, on the *new* hidden state of the last layer.
    dt_s : float
        The step the net was trained at.
    envelope : Envelope or None
        Where the training data lay; None where the file does not say.
    sha256 : str
        SHA-256 of the file's bytes, 64 hex digits.
    """

    cell: str
    hidden: int
    dt_s: float
    in_offset: Array
    in_scale: Array
    out_offset: Array
    out_scale: Array
    stack: tuple[Layer, ...]
    w_y: Array
    b_y: Array
    envelope: Envelope | None
    sha256: str
    name: str

    @property
    def hash24(self) -> int:
        """First 24 bits of the SHA-256: what identifies the net on the bus."""
        return int(self.sha256[:6], 16)

    @property
    def memory_c(self) -> int:
        """Elements of c over all layers; a GRU has none."""
        return len(self.stack) * self.hidden if self.cell == "lstm" else 0

    @property
    def memory(self) -> int:
        """Elements of c and h over all layers: what the net carries from step to step."""
        return self.memory_c + len(self.stack) * self.hidden

    def empty_memory(self) -> tuple[Array, Array]:
        """(c, h) of a net that has seen nothing: zeros."""
        return np.zeros(self.memory_c), np.zeros(self.memory - self.memory_c)

    @property
    def parameters(self) -> int:
        """Trained numbers, counted as they act (LSTM: one bias per gate)."""
        arrays = [a for layer in self.stack for a in (layer.w_u, layer.w_h, layer.b, layer.b_h) if a is not None]
        return sum(array.size for array in (*arrays, self.w_y, self.b_y))

    @property
    def w_u(self) -> Array:
        """W_u of a net of one layer."""
        return self._only.w_u

    @property
    def w_h(self) -> Array:
        """W_h of a net of one layer."""
        return self._only.w_h

    @property
    def b(self) -> Array:
        """b of a net of one layer."""
        return self._only.b

    @property
    def _only(self) -> Layer:
        if len(self.stack) != 1:
            raise ValueError(f"{self.name} has {len(self.stack)} layers: take them from `stack`")
        return self.stack[0]


LstmWeights = NetWeights  # the name from when a net was one layer of LSTM cells


def load_weights(path: str | Path) -> NetWeights:
    """Read and validate a weights file (docs/model.md, "Nets the generator takes").

    Raises
    ------
    FormulationError
        One line with file, field and what to do: unreadable, not JSON, wrong format, shape, name or value.
    """
    path = Path(path)
    try:
        raw = path.read_bytes()
    except OSError as err:
        raise FormulationError(path, "file", f"cannot be read ({err.strerror})", REMEDY) from err
    try:
        data = json.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as err:
        raise FormulationError(path, "file", f"is not valid JSON ({err})", REMEDY) from err
    if not isinstance(data, dict):
        raise FormulationError(path, "file", "must hold one JSON object", REMEDY)
    reader = _Reader(path, data)

    version = reader.choice("format", (FORMAT, FORMAT_STACK))
    cell = reader.choice("cell", ("lstm",) if version == FORMAT else tuple(CELLS))
    reader.choice("gate_order", (CELLS[cell],))
    layers = reader.count("layers", 1 if version == FORMAT else MAX_LAYERS)
    hidden = reader.count("hidden", 64)
    dt_s = float(reader.array("dt_s", ()))
    if dt_s != 0.1:
        raise FormulationError(path, "dt_s", f"must be 0.1 (the estimator's interval), is {dt_s!r}", REMEDY)
    in_offset, in_scale = reader.scaling("inputs", INPUTS)
    out_offset, out_scale = reader.scaling("outputs", OUTPUTS)
    return NetWeights(
        cell=cell,
        hidden=hidden,
        dt_s=dt_s,
        in_offset=in_offset,
        in_scale=in_scale,
        out_offset=out_offset,
        out_scale=out_scale,
        stack=reader.stack(version, cell, hidden, layers),
        w_y=reader.array("W_y", (len(OUTPUTS), hidden)),
        b_y=reader.array("b_y", (len(OUTPUTS),)),
        envelope=read_envelope(path, data["envelope"]) if data.get("envelope") is not None else None,
        sha256=hashlib.sha256(raw).hexdigest(),
        name=path.stem,
    )


class _Reader:
    """Typed access to the JSON object; every failure names the field."""

    def __init__(self, path: Path, data: dict[str, Any]) -> None:
        self.path, self.data = path, data

    def fail(self, field: str, problem: str) -> FormulationError:
        return FormulationError(self.path, field, problem, REMEDY)

    def get(self, field: str) -> Any:
        if field not in self.data:
            raise self.fail(field, "is missing")
        return self.data[field]

    def choice(self, field: str, allowed: tuple[str, ...]) -> str:
        found = self.get(field)
        if not isinstance(found, str) or found not in allowed:
            raise self.fail(field, f"must be {' or '.join(map(repr, allowed))}, is {found!r}")
        return found

    def count(self, field: str, most: int) -> int:
        found = self.get(field)
        if type(found) is not int or not 1 <= found <= most:
            allowed = "1" if most == 1 else f"a whole number 1..{most}"
            raise self.fail(field, f"must be {allowed}, is {found!r}")
        return found

    def stack(self, version: str, cell: str, hidden: int, layers: int) -> tuple[Layer, ...]:
        rows = len(CELLS[cell]) * hidden
        keys = ("W_u", "W_h", "b") if cell == "lstm" else ("W_u", "W_h", "b", "b_h")
        values = {key: [self.get(key)] if version == FORMAT else self.get(key) for key in keys}
        for key, found in values.items():
            if not isinstance(found, list) or len(found) != layers:
                raise self.fail(key, f"must be a list with one table per layer ({layers})")
        stack = []
        for k in range(layers):
            shapes = {"W_u": (rows, hidden if k else len(INPUTS)), "W_h": (rows, hidden), "b": (rows,), "b_h": (rows,)}
            name = "{}" if version == FORMAT else f"{{}}[{k}]"
            stack.append(Layer(*(self.array(name.format(key), shapes[key], values[key][k]) for key in keys)))
        return tuple(stack)

    def array(self, field: str, shape: tuple[int, ...], value: Any = None) -> Array:
        found = self.get(field) if value is None else value
        if _has_non_number(found):
            raise self.fail(field, "holds something that is not a number")
        try:
            array = np.array(found, dtype=np.float64)
        except (TypeError, ValueError) as err:
            raise self.fail(field, "is not a regular table of numbers") from err
        if array.shape != shape:
            raise self.fail(field, f"must have shape {list(shape)}, has {list(array.shape)}")
        if not np.all(np.isfinite(array)):
            raise self.fail(field, "holds a value that is not finite")
        array.setflags(write=False)
        return array

    def scaling(self, field: str, names: tuple[str, ...]) -> tuple[Array, Array]:
        rows = self.get(field)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise self.fail(field, "must be a list of objects with name, offset and scale")
        found = tuple(row.get("name") for row in rows)
        if found != names:
            raise self.fail(field, f"must name {', '.join(names)} in this order, names {found}")
        for name, row in zip(names, rows, strict=True):
            for key in ("offset", "scale"):
                if key not in row:
                    raise self.fail(f"{field}.{name}.{key}", "is missing")
        offset = self.array(f"{field}.offset", (len(names),), [row["offset"] for row in rows])
        scale = self.array(f"{field}.scale", (len(names),), [row["scale"] for row in rows])
        if np.any(scale == 0.0):
            raise self.fail(f"{field}.scale", "must not be zero")
        return offset, scale


def _has_non_number(value: Any) -> bool:
    """True where a nested list holds a string, null or boolean (numpy would convert some of them)."""
    if isinstance(value, list):
        return any(_has_non_number(item) for item in value)
    return isinstance(value, bool) or not isinstance(value, (int, float))
