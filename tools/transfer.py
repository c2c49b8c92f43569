"""Does what the net learned on the plant help on a measured motor? Fine-tune on the start of a drive, predict the rest.

    RT_REFERENCE_DATA=... python -m tools.transfer --out build/transfer

The drive is a measured heat-up and cool-down of a 52 kW traction motor (Paderborn, profile 24; rows 2.5 s apart), or
any table given by --drive. It is resampled to 0.1 s: the net is a map over 0.1 s that must be stepped at the rate it
was trained at, and at 2.5 s there would be nothing left of it to transfer. For each split the net predicts what comes
after in open loop: from the split on it gets speed and torque only and integrates its own rates. Writes OUT.json and
OUT.svg and prints the table. The data stay where they are.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.weights import LstmWeights, load_weights
from tools.evaluate import DataError, Rows, load_rows
from tools.train import as_read, document_of, fit
from tools.train_configs import TUNED, Settings

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_NET = ROOT / "estimator_c" / "weights" / "lstm8.json"
REFERENCE = Path("pmsm_paderborn") / "profile24_dt2.5s.csv"
SPLITS_S = (1000.0, 2400.0, 4600.0)  # heating up; nearly steady; 200 s into the cooling down
EPOCHS = 600
TUNE_LR = 2e-3  # a tenth of the rate from scratch: what the net knows is to be bent, not erased

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Way:
    """A way to a net for the measured motor; settings None: the plant's net as it is."""

    name: str
    settings: Settings | None
    from_net: bool


@dataclass(frozen=True)
class Outcome:
    """How a net did after the split: RMSE of rates with true temperatures, errors in open loop; winding, rotor."""

    way: str
    split_s: float
    rate_rmse_degc_s: tuple[float, float]
    open_loop_rmse_degc: tuple[float, float]
    open_loop_max_degc: tuple[float, float]


def ways(epochs: int, seed: int) -> tuple[Way, ...]:
    """Untouched; output layer fine-tuned; all weights fine-tuned; from scratch. Equal epochs."""
    scratch = dataclasses.replace(TUNED, config="transfer", epochs=epochs, seed=seed, validate_every=10)
    tune = dataclasses.replace(scratch, lr=TUNE_LR)
    return (
        Way("untouched", None, True),
        Way("output layer tuned", dataclasses.replace(tune, trained="head"), True),
        Way("all weights tuned", tune, True),
        Way("from scratch", scratch, False),
    )


def first_part(rows: Rows, split: int) -> Rows:
    """The rows before the split; the rest stays unseen."""
    return dataclasses.replace(
        rows, x=rows.x[:split], rates_degc_s=rows.rates_degc_s[:split], trajectory=rows.trajectory[:split]
    )


def learn(way: Way, known: Rows, net: LstmWeights) -> LstmWeights:
    """The net that this way gives from the known part of the drive."""
    if way.settings is None:
        return net
    result = fit(known, way.settings, start=net if way.from_net else None)
    if result.ended != "complete":
        raise KeyboardInterrupt
    return as_read(document_of(result, known, None, way.settings))


def predict(net: LstmWeights, rows: Rows, split: int) -> tuple[Array, Array]:
    """After the split: rates with true temperatures (N, 2), and temperatures in open loop (N, 2).

    The memory has seen the drive up to the split with its true temperatures.
    """
    _, c, h = lstm_sequence(net, rows.x[:split])
    rates = lstm_sequence(net, rows.x[split:], c, h)[0]
    theta = np.empty((len(rows.x) - split, 2))
    theta[0] = rows.x[split, 2:]
    for k in range(len(theta) - 1):
        c, h, rate = lstm_step(net, np.concatenate((rows.x[split + k, :2], theta[k])), c, h)
        theta[k + 1] = theta[k] + net.dt_s * rate
    return rates, theta


def judge(way: Way, split_s: float, rates: Array, theta: Array, rows: Rows, split: int) -> Outcome:
    """Errors of a prediction after the split."""
    wrong_rate, wrong = rates - rows.rates_degc_s[split:], theta - rows.x[split:, 2:]

    def pair(values: Array) -> tuple[float, float]:
        return float(values[0]), float(values[1])

    return Outcome(
        way.name,
        split_s,
        pair(np.sqrt(np.mean(wrong_rate**2, axis=0))),
        pair(np.sqrt(np.mean(wrong**2, axis=0))),
        pair(np.abs(wrong).max(axis=0)),
    )


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as a Markdown table, winding / rotor."""
    lines = [
        "| known, s | net | rate RMSE, °C/s | open loop RMSE, °C | open loop, largest, °C |",
        "|---|---|---|---|---|",
    ]
    for o in outcomes:
        cells = ["{:.4f} / {:.4f}".format(*o.rate_rmse_degc_s)]
        cells += ["{:.1f} / {:.1f}".format(*v) for v in (o.open_loop_rmse_degc, o.open_loop_max_degc)]
        lines.append(f"| {o.split_s:g} | {o.way} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(path: Path, rows: Rows, predicted: dict[float, dict[str, Array]]) -> None:
    """Measured and predicted temperatures, a row of panels per split."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "rt"}):
        figure = Figure(figsize=(9.0, 2.6 * len(predicted)), layout="constrained")
        panels = figure.subplots(len(predicted), 2, sharex=True, squeeze=False)
        t_s = 0.1 * np.arange(len(rows.x))
        thin = slice(None, None, 50)
        for line, (split_s, ways_) in zip(panels, predicted.items(), strict=True):
            for i, (axes, channel) in enumerate(zip(line, ("winding", "rotor"), strict=True)):
                axes.plot(t_s[thin], rows.x[thin, 2 + i], "k", lw=2.2, alpha=0.35, label="measured")
                after = t_s[-len(next(iter(ways_.values()))) :]
                for name, theta in ways_.items():
                    axes.plot(after[thin], theta[thin, i], lw=1.0, label=name)
                axes.axvline(split_s, color="0.5", ls=":", lw=1.0)
                axes.set_ylim(0.0, 1.35 * rows.x[:, 2 + i].max())
                axes.set_title(f"{channel}, known up to {split_s:g} s", fontsize="medium")
                axes.grid(True, alpha=0.25)
            line[0].set_ylabel("°C")
        panels[0, 0].legend(fontsize="x-small")
        for axes in panels[-1]:
            axes.set_xlabel("s")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def measured(given: Path | None) -> Path:
    """The drive's file: as given, or from the folder of reference data."""
    if given is not None:
        return given
    folder = os.environ.get("RT_REFERENCE_DATA")
    if not folder:
        raise DataError("no drive: set RT_REFERENCE_DATA to the folder of reference data, or give --drive FILE")
    return Path(folder) / REFERENCE


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; errors are one line on stderr and exit code 1."""
    parser = argparse.ArgumentParser(prog="python -m tools.transfer", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drive", type=Path, help=f"a table of one drive; default RT_REFERENCE_DATA/{REFERENCE}")
    parser.add_argument(
        "--net", type=Path, default=DEFAULT_NET, help="the net to begin with; default the committed one"
    )
    parser.add_argument("--out", type=Path, default=Path("build/transfer"), help="default %(default)s")
    parser.add_argument("--split-s", type=float, action="append", help=f"may be repeated; default {SPLITS_S}")
    parser.add_argument("--epochs", type=int, default=EPOCHS, help="default %(default)s")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    outcomes, predicted = [], {}
    try:
        rows, net = load_rows(measured(args.drive)), load_weights(args.net)
        for split_s in args.split_s or SPLITS_S:
            split = round(split_s / net.dt_s)
            if not 600 <= split <= len(rows.x) - 600:
                raise DataError(
                    f"--split-s {split_s:g}: a minute must be left on either side of it; the drive has "
                    f"{len(rows.x) * net.dt_s:g} s"
                )
            predicted[split_s] = {}
            for way in ways(args.epochs, args.seed):
                rates, theta = predict(learn(way, first_part(rows, split), net), rows, split)
                outcomes.append(judge(way, split_s, rates, theta, rows, split))
                predicted[split_s][way.name] = theta
                print(f"known {split_s:g} s, {way.name}: done", file=sys.stderr, flush=True)
        draw(args.out.with_suffix(".svg"), rows, predicted)
        text = {"epochs": args.epochs, "seed": args.seed, "drive_sha256": rows.sha256, "net_sha256": net.sha256}
        text["outcomes"] = [dataclasses.asdict(o) for o in outcomes]
        args.out.with_suffix(".json").write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
    except (DataError, FormulationError) as error:
        print(f"transfer: {error}", file=sys.stderr)
        return 1
    except ImportError as error:
        print(f"transfer: {error}; pip install -e '.[train]'", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("transfer: stopped, nothing written", file=sys.stderr)
        return 130
    print(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
