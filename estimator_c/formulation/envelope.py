"""The envelope of a net's training data: where its inputs lay, as the estimator can check it at every step.

Three parts, all "inside" exactly when they say so for every row of the training data (plus a margin):

ranges   lower <= x <= upper for speed, torque, winding and rotor temperature, each alone
power    lower <= P <= upper for the mechanical power in kW: speed and torque together
history  |directions @ q - centre| <= 1 for the thermal history q, after `settle_s` of it

q has what decides how the machine heats (FEATURES): both temperatures, how far each stands above its own past (a
first-order low-pass with time constant `tau_s`, a plain mean at first), and the same low-pass of speed squared, torque
squared and |speed * torque|, to which the losses are nearly proportional. Rows of `directions` are the principal axes
of q in training. The narrow ones are the machine's heat balance: a coolant that fails moves the drive out along them
while every single input still looks normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FormulationError

Array = NDArray[np.float64]
REMEDY = "make it again with 'python -m tools.envelope'"

RANGES = 4
SLOW = ("theta_w_degc", "theta_r_degc", "speed_krpm2", "torque_nm2", "power_kw")  # what is low-passed
FEATURES = (
    "theta_w_degc",
    "theta_r_degc",
    "theta_w_above_past_degc",
    "theta_r_above_past_degc",
    "past_speed_krpm2",
    "past_torque_nm2",
    "past_power_kw",
)
KW_PER_RPM_NM = math.pi / 30e3


@dataclass(frozen=True)
class Envelope:
    """Validated content of a weights file's `envelope`.

    Attributes
    ----------
    lower, upper : (4,)
        Ranges of [speed rpm, torque Nm, theta_w degC, theta_r degC].
    power_kw : (2,)
        Lowest and highest mechanical power.
    tau_s, settle_s : float
        Time constant of the low-pass, and how long the history must be before it is judged.
    directions, centre : (7, 7), (7,)
        See the module's text.
    """

    lower: Array
    upper: Array
    power_kw: Array
    tau_s: float
    settle_s: float
    directions: Array
    centre: Array


def history(x: Array, tau_s: float, dt_s: float) -> Array:
    """Thermal history q (N, 7) of rows x (N, 4) of one drive without gaps.

    The low-pass begins as the plain mean of what there is, so that a drive that begins at full torque does not look
    for minutes as if it had always been there.
    """
    speed_krpm, torque = x[:, 0] * 1e-3, x[:, 1]
    fast = np.stack(
        [x[:, 2], x[:, 3], speed_krpm**2, torque**2, np.abs(x[:, 0] * torque) * KW_PER_RPM_NM], axis=1
    )
    slow, share = np.empty_like(fast), dt_s / tau_s
    past = np.zeros(len(SLOW))
    for k, row in enumerate(fast):
        past = past + max(share, 1.0 / (k + 1)) * (row - past)
        slow[k] = past
    return np.concatenate([fast[:, :2], fast[:, :2] - slow[:, :2], slow[:, 2:]], axis=1)


def read_envelope(path: object, data: Any) -> Envelope:
    """Validate the `envelope` object of a weights file. Raises FormulationError with file, field and what to do."""
    if not isinstance(data, dict):
        raise FormulationError(path, "envelope", "must be an object", REMEDY)
    shapes = {
        "lower": (RANGES,), "upper": (RANGES,), "power_kw": (2,), "tau_s": (), "settle_s": (),
        "directions": (len(FEATURES), len(FEATURES)), "centre": (len(FEATURES),),
    }  # fmt: skip
    values = {key: _array(path, data, key, shape) for key, shape in shapes.items()}
    if np.any(values["lower"] >= values["upper"]):
        raise FormulationError(path, "envelope.lower", "must lie below upper", REMEDY)
    if values["power_kw"][0] >= values["power_kw"][1]:
        raise FormulationError(path, "envelope.power_kw", "must be [lower, upper]", REMEDY)
    if not 1.0 <= values["tau_s"] <= 3600.0:
        raise FormulationError(path, "envelope.tau_s", "must lie in 1..3600", REMEDY)
    if not 0.0 <= values["settle_s"] <= 36000.0:
        raise FormulationError(path, "envelope.settle_s", "must lie in 0..36000", REMEDY)
    return Envelope(
        lower=values["lower"],
        upper=values["upper"],
        power_kw=values["power_kw"],
        tau_s=float(values["tau_s"]),
        settle_s=float(values["settle_s"]),
        directions=values["directions"],
        centre=values["centre"],
    )


def _array(path: object, data: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    field = f"envelope.{key}"
    if key not in data:
        raise FormulationError(path, field, "is missing", REMEDY)
    try:
        found = np.array(data[key])
        if found.dtype.kind not in "if":
            raise ValueError
        array = found.astype(np.float64)
    except ValueError as err:
        raise FormulationError(path, field, "is not a regular table of numbers", REMEDY) from err
    if array.shape != shape:
        raise FormulationError(path, field, f"must have shape {list(shape)}, has {list(array.shape)}", REMEDY)
    if not np.all(np.isfinite(array)):
        raise FormulationError(path, field, "holds a value that is not finite", REMEDY)
    array.setflags(write=False)
    return array
