"""The trained net as a file: load, validate, identify."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FormulationError

FORMAT = "rt-lstm-weights/1"
INPUTS = ("speed_rpm", "torque_nm", "theta_w_degc", "theta_r_degc")
OUTPUTS = ("dtheta_w_degc_s", "dtheta_r_degc_s")
REMEDY = "restore the file or train it again with 'make train'"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LstmWeights:
    """One LSTM layer and its output layer, in PyTorch's gate order i, f, g, o.

    Normalised input u = (x - in_offset)/in_scale with x = [speed rpm, torque Nm, theta_w degC, theta_r degC];
    rates in degC/s = out_offset + out_scale*(w_y h + b_y).

    Attributes
    ----------
    w_u, w_h, b : (4H, 4), (4H, H), (4H,)
        Gate weights and bias (b = b_ih + b_hh of PyTorch).
    w_y, b_y : (2, H), (2,)
        Output layer, on the *new* hidden state.
    dt_s : float
        The step the net was trained at.
    sha256 : str
        SHA-256 of the file's bytes, 64 hex digits.
    """

    hidden: int
    dt_s: float
    in_offset: Array
    in_scale: Array
    out_offset: Array
    out_scale: Array
    w_u: Array
    w_h: Array
    b: Array
    w_y: Array
    b_y: Array
    sha256: str
    name: str

    @property
    def hash24(self) -> int:
        """First 24 bits of the SHA-256: what identifies the net on the bus."""
        return int(self.sha256[:6], 16)


def load_weights(path: str | Path) -> LstmWeights:
    """Read and validate a weights file.

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

    reader.expect("format", FORMAT)
    reader.expect("cell", "lstm")
    reader.expect("layers", 1)
    reader.expect("gate_order", "ifgo")
    hidden = reader.get("hidden")
    if type(hidden) is not int or not 1 <= hidden <= 64:
        raise FormulationError(path, "hidden", f"must be a whole number 1..64, is {hidden!r}", REMEDY)
    dt_s = float(reader.array("dt_s", ()))
    if dt_s != 0.1:
        raise FormulationError(path, "dt_s", f"must be 0.1 (the estimator's interval), is {dt_s!r}", REMEDY)
    in_offset, in_scale = reader.scaling("inputs", INPUTS)
    out_offset, out_scale = reader.scaling("outputs", OUTPUTS)
    return LstmWeights(
        hidden=hidden,
        dt_s=dt_s,
        in_offset=in_offset,
        in_scale=in_scale,
        out_offset=out_offset,
        out_scale=out_scale,
        w_u=reader.array("W_u", (4 * hidden, len(INPUTS))),
        w_h=reader.array("W_h", (4 * hidden, hidden)),
        b=reader.array("b", (4 * hidden,)),
        w_y=reader.array("W_y", (len(OUTPUTS), hidden)),
        b_y=reader.array("b_y", (len(OUTPUTS),)),
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

    def expect(self, field: str, value: object) -> None:
        found = self.get(field)
        if found != value or type(found) is not type(value):
            raise self.fail(field, f"must be {value!r}, is {found!r}")

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
