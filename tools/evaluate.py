"""How good is a net? Rate errors and open-loop drift of a net over a lap, in plain numpy.

    rt-runner evaluate [--net FILE] [--lap FILE]        (or python -m tools.evaluate)

Without options the default net on the synthetic Nordschleife-like lap. Rates are compared sample by sample with
the true temperatures as input (one step ahead). "Open loop" feeds the net its own integrated temperatures from a
drive's first row on: what remains when no sensor corrects it. Two ranges normalise the RMSE: that of the true rate
over the whole lap, launch included, as the paper does, and that over t > 20 s.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.weights import LstmWeights
from tools.files import write_json
from tools.plain_net import load_net
from tools.rows import COLUMNS, DataError, Rows
from tools.tables_io import load_rows

__all__ = ["COLUMNS", "DataError", "Rows", "evaluate", "load_rows", "one_step_rates", "open_loop", "table"]

CHANNELS = ("w", "r")
LAUNCH_S = 20.0  # the launch from standstill is a third of the winding rate's range, in 3 % of the lap
WARM_S = 60.0  # from here on the memory has seen what it needs
DEFAULT_NET = Path(__file__).resolve().parent.parent / "estimator_c" / "weights" / "lstm8.json"
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a net makes of rows: rates one step ahead (N, 2) in °C/s, open-loop temperatures (N, 2) in °C."""

    rates_degc_s: Array
    theta_degc: Array


def one_step_rates(net: LstmWeights, x: Array) -> Array:
    """Rates (N, 2) in °C/s over the rows x (N, 4) with true temperatures, memory empty at the first row."""
    return lstm_sequence(net, x)[0]


def open_loop(net: LstmWeights, x: Array) -> Array:
    """Temperatures (N, 2) in °C when the net integrates its own rates from the first row on."""
    theta = np.empty((len(x), 2))
    theta[0] = x[0, 2:]
    _, c, h = lstm_sequence(net, x[:0])  # empty memory
    for k in range(len(x) - 1):
        c, h, rate = lstm_step(net, np.concatenate((x[k, :2], theta[k])), c, h)
        theta[k + 1] = theta[k] + net.dt_s * rate
    return theta


def predict(net: LstmWeights, rows: Rows) -> Prediction:
    """Run a net over rows, each drive from an empty memory and, in open loop, from its first temperatures."""
    rates, theta = np.empty_like(rows.rates_degc_s), np.empty_like(rows.rates_degc_s)
    for piece in rows.pieces():
        rates[piece], theta[piece] = one_step_rates(net, rows.x[piece]), open_loop(net, rows.x[piece])
    return Prediction(rates, theta)


def time_in_drive(rows: Rows, dt_s: float) -> Array:
    """Time in s since the first row of each row's own drive, shape (N,)."""
    t_s = np.empty(len(rows.x))
    for piece in rows.pieces():
        t_s[piece] = np.arange(len(piece)) * dt_s
    return t_s


def evaluate(net: LstmWeights, rows: Rows, found: Prediction | None = None) -> dict[str, float]:
    """Metrics over rows of one or more drives, per channel w (winding) and r (rotor).

    `nrmse` divides the RMSE by the range of the true rate over all rows, launch included;
    `nrmse_after_launch` takes RMSE and range over t > 20 s; `mean_error_after_60s` the mean over t > 60 s;
    `open_loop_*` is the drift of `open_loop`. Where no row is that late, the figure is left out; where a rate never
    changes, it is NaN or infinite.
    """
    found = predict(net, rows) if found is None else found
    error = found.rates_degc_s - rows.rates_degc_s
    drift = found.theta_degc - rows.x[:, 2:]
    t_s = time_in_drive(rows, net.dt_s)
    late, warm = t_s >= LAUNCH_S, t_s >= WARM_S

    def rms(e: Array) -> Array:
        return np.sqrt(np.mean(e**2, axis=0))

    with np.errstate(divide="ignore", invalid="ignore"):
        figures = {
            "mae_degc_s": np.abs(error).mean(axis=0),
            "rmse_degc_s": rms(error),
            "mean_error_degc_s": error.mean(axis=0),
            "nrmse": rms(error) / np.ptp(rows.rates_degc_s, axis=0),
            "open_loop_max_degc": np.abs(drift).max(axis=0),
            "open_loop_rmse_degc": rms(drift),
        }
        if late.any():
            figures["nrmse_after_launch"] = rms(error[late]) / np.ptp(rows.rates_degc_s[late], axis=0)
        if warm.any():
            figures["mean_error_after_60s_degc_s"] = error[warm].mean(axis=0)
    return {f"{name}_{c}": float(value[i]) for name, value in figures.items() for i, c in enumerate(CHANNELS)}


# Label, name in `evaluate`, key in the JSON document, factor and digits in the table.
FIGURES = (
    ("mean absolute error, °C/s", "mae_degc_s", "mae", 1, 5),
    ("root mean square error, °C/s", "rmse_degc_s", "rmse", 1, 5),
    ("NRMSE by the range of the whole lap, %", "nrmse", "nrmse_full", 100, 2),
    ("NRMSE by the range for t > 20 s, %", "nrmse_after_launch", "nrmse_t20", 100, 2),
    ("mean error, °C/s", "mean_error_degc_s", "mean_error", 1, 5),
    ("mean error for t > 60 s, °C/s", "mean_error_after_60s_degc_s", "mean_error_t60", 1, 5),
    ("open loop, largest error, °C", "open_loop_max_degc", "open_loop_max_degc", 1, 3),
    ("open loop, RMS error, °C", "open_loop_rmse_degc", "open_loop_rmse_degc", 1, 3),
)


def table(metrics: dict[str, float]) -> str:
    """The metrics as lines for a terminal."""
    lines = [f"{'':42s}{'winding':>10s}{'rotor':>10s}"]
    for label, name, _, factor, digits in FIGURES:
        values = [metrics.get(f"{name}_{c}", math.nan) for c in CHANNELS]
        if not all(map(math.isnan, values)):
            lines.append(f"{label:42s}" + "".join(f"{factor * value:10.{digits}f}" for value in values))
    return "\n".join(lines)


def document(net: LstmWeights, rows: Rows, metrics: dict[str, float], lap: str) -> dict[str, Any]:
    """The figures as a JSON document; rates in °C/s, NRMSE as a fraction, what could not be formed is None."""

    def value(name: str, channel: str) -> float | None:
        figure = metrics.get(f"{name}_{channel}")
        return figure if figure is not None and math.isfinite(figure) else None

    return {
        "net": {"name": net.name, "sha256": net.sha256, "hidden": net.hidden},
        "lap": {"name": lap, "sha256": rows.sha256, "rows": len(rows.x), "drives": len(rows.pieces())},
        "notes": list(rows.notes),
        **{f"theta_{c}": {key: value(name, c) for _, name, key, _, _ in FIGURES} for c in CHANNELS},
        "nrmse_normaliser": {
            "nrmse_full": "range of the true rate over the whole lap, launch included",
            "nrmse_t20": "range of the true rate for t >= 20 s, RMSE over the same rows",
        },
    }


def synthetic_lap() -> Rows:
    """The default lap: the plant once around the Nordschleife-like track, from 60 °C, no derating."""
    from plant_sim.params import load_params
    from tools.dataset import build_lap

    return build_lap(load_params()).rows


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="rt-runner evaluate", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--net", "--weights", dest="net", type=Path, default=DEFAULT_NET,
        help="weights file, ours or in the plain format (default: the net that is embedded)",
    )  # fmt: skip
    parser.add_argument(
        "--lap", type=Path, help="drives as .npz, .csv, .parquet or .mcap (default: drive the synthetic lap now)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="predicted against actual, and over time: .svg, .png")
    args = parser.parse_args(argv)
    try:
        report(args)
    except (DataError, FormulationError) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"evaluate: {error.filename}: {error.strerror}; choose another file", file=sys.stderr)
        return 1
    return 0


def report(args: argparse.Namespace) -> None:
    """Evaluate, print, and write what was asked for."""
    from tools.plots import check_plot, plot_evaluation

    if args.plot is not None:
        check_plot(args.plot)
    net = load_net(args.net)
    rows = load_rows(args.lap) if args.lap is not None else synthetic_lap()
    lap = str(args.lap) if args.lap is not None else "synthetic Nordschleife-like lap"
    found = predict(net, rows)
    metrics = evaluate(net, rows, found)
    if args.plot is not None:
        t_s = np.arange(len(rows.x), dtype=np.float64) * net.dt_s
        plot_evaluation(args.plot, t_s, rows, found.rates_degc_s, found.theta_degc, f"{net.name} on {Path(lap).name}")
    write_json(args.json, document(net, rows, metrics, lap))
    shown = sys.stderr if args.json == "-" else sys.stdout
    print(f"net {args.net}, lap {lap} ({len(rows.x)} rows)", file=shown)
    for note in rows.notes:
        print(f"note: {note}", file=shown)
    print(table(metrics), file=shown)


if __name__ == "__main__":
    sys.exit(main())
