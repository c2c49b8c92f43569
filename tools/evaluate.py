"""How good is a net? Rate errors and open-loop drift of a weights file over a lap, in plain numpy.

    python -m tools.evaluate --weights estimator_c/weights/lstm8.json --lap build/data/lap.npz

Rates are compared sample by sample with the plant's temperatures as input (one step ahead). "Open loop" feeds the net its
own integrated temperatures from the lap's first sample on: what remains when no sensor corrects it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CHANNELS = ("w", "r")
LAUNCH_S = 20.0  # the launch from standstill is a third of the winding rate's range, in 3 % of the lap
COLUMNS = (
    "n_rpm",
    "torque_nm",
    "theta_w_degc",
    "theta_r_degc",
    "dtheta_w_degc_s",
    "dtheta_r_degc_s",
)


class DataError(Exception):
    """A data or weights file that cannot be used; the message says what, where and what to do."""


@dataclass(frozen=True)
class Rows:
    """Rows of a data set at the net's rate: inputs x (N, 4), rates (N, 2) in °C/s, trajectory ids (N,), hash of the rows."""

    x: np.ndarray
    rates_degc_s: np.ndarray
    trajectory: np.ndarray
    sha256: str

    def pieces(self) -> list[np.ndarray]:
        """Row numbers of each trajectory, in order of their ids."""
        return [np.flatnonzero(self.trajectory == i) for i in np.unique(self.trajectory)]


def load_rows(path: Path) -> Rows:
    """Read a data set written by `tools.dataset`.

    Raises
    ------
    DataError
        File missing or unreadable, a column missing or of another length, a value not finite.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = [np.asarray(file[name], dtype=np.float64) for name in COLUMNS]
            trajectory = np.asarray(file["trajectory"]) if "trajectory" in file else np.zeros(len(columns[0]), int)
            sha256 = str(file["sha256"])
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"data set {path}: {error}; build it with `python -m tools.dataset`") from error
    if len({len(c) for c in (*columns, trajectory)}) != 1 or not all(np.isfinite(c).all() for c in columns):
        raise DataError(f"data set {path}: columns of unequal length or values not finite; build it again")
    return Rows(np.stack(columns[:4], axis=1), np.stack(columns[4:], axis=1), trajectory, sha256)


@dataclass(frozen=True)
class NumpyNet:
    """The embedded LSTM in readable numpy, float64; one `step` is what the C code computes."""

    dt_s: float
    in_offset: np.ndarray
    in_scale: np.ndarray
    out_offset: np.ndarray
    out_scale: np.ndarray
    w_u: np.ndarray
    w_h: np.ndarray
    b: np.ndarray
    w_y: np.ndarray
    b_y: np.ndarray

    @property
    def hidden(self) -> int:
        return self.w_h.shape[1]

    def empty_memory(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(self.hidden), np.zeros(self.hidden)

    def step(
        self, x: np.ndarray, memory: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """One 0.1 s step: x = (rpm, Nm, °C, °C) -> rates (2,) in °C/s and the new memory (c, h)."""
        c, h = memory
        m = self.hidden
        z = self.w_u @ ((x - self.in_offset) / self.in_scale) + self.w_h @ h + self.b
        gate = 1.0 / (1.0 + np.exp(-z))
        c = gate[m : 2 * m] * c + gate[:m] * np.tanh(z[2 * m : 3 * m])
        h = gate[3 * m :] * np.tanh(c)
        return self.out_offset + self.out_scale * (self.w_y @ h + self.b_y), (c, h)


def net_from_document(document: dict) -> NumpyNet:
    """Numpy net of a weights document (format rt-lstm-weights/1)."""
    inputs, outputs = (
        np.array([[p["offset"], p["scale"]] for p in document[side]], dtype=np.float64).T
        for side in ("inputs", "outputs")
    )
    return NumpyNet(
        float(document["dt_s"]),
        *inputs,
        *outputs,
        *(np.array(document[key], dtype=np.float64) for key in ("W_u", "W_h", "b", "W_y", "b_y")),
    )


def read_document(path: Path) -> dict:
    """The JSON of a weights file; `estimator_c.formulation.weights` is the strict reader, this one serves the tools."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"weights {path}: {error}; train them with `python -m tools.train`") from error


def one_step_rates(net: NumpyNet, x: np.ndarray) -> np.ndarray:
    """Rates (N, 2) in °C/s over the rows x (N, 4), memory empty at the first row, true temperatures as input."""
    rates, memory = np.empty((len(x), 2)), net.empty_memory()
    for k, row in enumerate(x):
        rates[k], memory = net.step(row, memory)
    return rates


def open_loop(net: NumpyNet, x: np.ndarray) -> np.ndarray:
    """Temperatures (N, 2) in °C when the net integrates its own rates from the first row's temperatures on."""
    theta, memory = np.empty((len(x), 2)), net.empty_memory()
    theta[0] = x[0, 2:]
    for k in range(len(x) - 1):
        rate, memory = net.step(np.concatenate((x[k, :2], theta[k])), memory)
        theta[k + 1] = theta[k] + net.dt_s * rate
    return theta


def evaluate(net: NumpyNet, rows: Rows) -> dict[str, float]:
    """Metrics over rows that form one drive, per channel w (winding) and r (rotor).

    Keys `mae`, `rmse`, `mean_error` are in °C/s; `nrmse` divides the RMSE by the range of the true rate over the whole
    drive, launch included; `nrmse_after_launch` divides the same kind of RMSE by the range, both over t > 20 s;
    `open_loop_max_degc` and `open_loop_rmse_degc` are the drift of `open_loop`.
    """
    error = one_step_rates(net, rows.x) - rows.rates_degc_s
    drift = open_loop(net, rows.x) - rows.x[:, 2:]
    later = slice(round(LAUNCH_S / net.dt_s), None)

    def rms(e: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(e**2, axis=0))

    figures = {
        "mae_degc_s": np.abs(error).mean(axis=0),
        "rmse_degc_s": rms(error),
        "mean_error_degc_s": error.mean(axis=0),
        "nrmse": rms(error) / np.ptp(rows.rates_degc_s, axis=0),
        "nrmse_after_launch": rms(error[later]) / np.ptp(rows.rates_degc_s[later], axis=0),
        "open_loop_max_degc": np.abs(drift).max(axis=0),
        "open_loop_rmse_degc": rms(drift),
    }
    return {f"{name}_{c}": float(value[i]) for name, value in figures.items() for i, c in enumerate(CHANNELS)}


def table(metrics: dict[str, float]) -> str:
    """The metrics as lines for a terminal."""
    lines = [f"{'':42s}{'winding':>10s}{'rotor':>10s}"]
    for label, name, factor in (
        ("mean absolute error, °C/s", "mae_degc_s", 1),
        ("root mean square error, °C/s", "rmse_degc_s", 1),
        ("mean error, °C/s", "mean_error_degc_s", 1),
        ("NRMSE by the range of the whole lap, %", "nrmse", 100),
        ("NRMSE by the range for t > 20 s, %", "nrmse_after_launch", 100),
        ("open loop, largest error, °C", "open_loop_max_degc", 1),
        ("open loop, RMS error, °C", "open_loop_rmse_degc", 1),
    ):
        lines.append(f"{label:42s}" + "".join(f"{factor * metrics[f'{name}_{c}']:10.4f}" for c in CHANNELS))
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.evaluate", description=__doc__.splitlines()[0])
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--lap", type=Path, required=True, help="rows of one drive, as written by tools.dataset")
    parser.add_argument("--json", type=Path, help="write the figures here too")
    args = parser.parse_args(argv)
    try:
        metrics = evaluate(net_from_document(read_document(args.weights)), load_rows(args.lap))
    except DataError as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    print(table(metrics))
    if args.json:
        args.json.write_text(json.dumps(metrics, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
