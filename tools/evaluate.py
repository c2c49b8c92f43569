"""How good is a net? Rate errors and open-loop drift of a weights file over a lap, in plain numpy.

    python -m tools.evaluate --weights estimator_c/weights/lstm8.json --lap build/data/lap.npz

Rates are compared sample by sample with the plant's temperatures as input (one step ahead). "Open loop"
feeds the net its own integrated temperatures from the lap's first sample on: what remains when no sensor
corrects it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.weights import LstmWeights, load_weights

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
    """A data set that cannot be used; the message says what, where and what to do."""


@dataclass(frozen=True)
class Rows:
    """Rows of a data set at the net's rate.

    Inputs x (N, 4) in rpm, Nm, °C, °C; rates (N, 2) in °C/s; trajectory numbers (N,); SHA-256 of the rows.
    """

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
            trajectory = (
                np.asarray(file["trajectory"]) if "trajectory" in file else np.zeros(len(columns[0]), int)
            )
            sha256 = str(file["sha256"])
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"data set {path}: {error}; build it with `python -m tools.dataset`") from error
    if len({len(c) for c in (*columns, trajectory)}) != 1 or not all(np.isfinite(c).all() for c in columns):
        raise DataError(f"data set {path}: columns of unequal length or values not finite; build it again")
    return Rows(np.stack(columns[:4], axis=1), np.stack(columns[4:], axis=1), trajectory, sha256)


def one_step_rates(net: LstmWeights, x: np.ndarray) -> np.ndarray:
    """Rates (N, 2) in °C/s over the rows x (N, 4) with true temperatures, memory empty at the first row."""
    return lstm_sequence(net, x)[0]


def open_loop(net: LstmWeights, x: np.ndarray) -> np.ndarray:
    """Temperatures (N, 2) in °C when the net integrates its own rates from the first row on."""
    theta = np.empty((len(x), 2))
    theta[0] = x[0, 2:]
    c = h = np.zeros(net.hidden)
    for k in range(len(x) - 1):
        c, h, rate = lstm_step(net, np.concatenate((x[k, :2], theta[k])), c, h)
        theta[k + 1] = theta[k] + net.dt_s * rate
    return theta


def evaluate(net: LstmWeights, rows: Rows) -> dict[str, float]:
    """Metrics over rows that form one drive, per channel w (winding) and r (rotor).

    `nrmse` divides the RMSE by the range of the true rate over the whole drive, launch included;
    `nrmse_after_launch` takes RMSE and range over t > 20 s; `open_loop_*` is the drift of `open_loop`.
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
    parser = argparse.ArgumentParser(
        prog="python -m tools.evaluate", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument(
        "--lap", type=Path, required=True, help="rows of one drive, as written by tools.dataset"
    )
    parser.add_argument("--json", type=Path, help="write the figures here too")
    args = parser.parse_args(argv)
    try:
        metrics = evaluate(load_weights(args.weights), load_rows(args.lap))
    except (DataError, FormulationError) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    print(table(metrics))
    if args.json:
        args.json.write_text(json.dumps(metrics, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
