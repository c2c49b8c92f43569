"""Where did the training data lie? Makes the `envelope` that travels in a weights file.

    python -m tools.envelope --data build/data/R.npz --weights net.json     (adds it to net.json, in place)

The trainer calls `envelope_of` itself; this command is for nets that have none yet. What the envelope is:
estimator_c/formulation/envelope.py. How well it watches: `python -m tools.check_validity`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimator_c.formulation.envelope import FEATURES, KW_PER_RPM_NM, Envelope, history, read_envelope
from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from tools.rows import DT_S, DataError, Rows
from tools.tables_io import load_rows

TAU_S = 60.0
SETTLE_S = 120.0  # two time constants: 14 % of whatever the start got wrong is left
LEAST_ROWS = 600  # of settled history, over all drives: a minute
MARGIN = 0.01  # of each range; bus quantisation and rounding must not leave a range that ends where the plant does
MARGIN_HISTORY = 0.1  # of each half-width; drives of one kind, held out one by one, exceed the others by about this

# What counts as the same: the error of the estimate, of the codec; widths are never below these.
SAME_X = np.array([1.0, 0.1, 0.5, 0.5])  # rpm, Nm, degC, degC
SAME_KW = 0.1
SAME_Q = np.array([0.5, 0.5, 0.25, 0.25, 0.01, 1.0, 0.1])


def envelope_of(rows: Rows) -> dict[str, Any] | None:
    """The envelope of training rows at 10 Hz, as it goes into the weights file.

    Returns
    -------
    dict or None
        JSON object accepted by `read_envelope`; None if no drive in the rows is long enough to show a thermal history
        (the weights file then has no envelope and the monitor says "not available").
    """
    drives = [rows.x[piece] for piece in rows.pieces()]
    settled = [history(x, TAU_S, DT_S)[round(SETTLE_S / DT_S) :] for x in drives if len(x) > round(SETTLE_S / DT_S)]
    q = np.concatenate([*settled, np.empty((0, len(FEATURES)))])
    if len(q) < LEAST_ROWS:
        return None
    lower, upper = _widened(rows.x, SAME_X)
    power_kw = np.concatenate(_widened(rows.x[:, :1] * rows.x[:, 1:2] * KW_PER_RPM_NM, np.array([SAME_KW])))
    directions, centre = _polytope(q)
    return {
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "power_kw": power_kw.tolist(),
        "tau_s": TAU_S,
        "settle_s": SETTLE_S,
        "directions": directions.tolist(),
        "centre": centre.tolist(),
    }


def _widened(values: np.ndarray, least: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = values.min(axis=0), values.max(axis=0)
    extra = np.maximum(MARGIN * (high - low), least)
    return _short(low - extra), _short(high + extra)


def _polytope(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box along the principal axes of q (standardised first: units must not choose the axes)."""
    spread = np.maximum(q.std(axis=0), SAME_Q)
    _, axes = np.linalg.eigh(np.cov(((q - q.mean(axis=0)) / spread).T))
    axes = axes.T / spread  # rows; act on q itself
    axes *= np.sign(axes[np.arange(len(axes)), np.argmax(np.abs(axes * spread), axis=1)])[:, None]
    along = q @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    half = np.maximum(0.5 * (1 + MARGIN_HISTORY) * (high - low), np.linalg.norm(axes * SAME_Q, axis=1))
    return _short(axes / half[:, None]), _short(0.5 * (low + high) / half)


def _short(values: np.ndarray) -> np.ndarray:
    """Ten significant digits: the last bits of a LAPACK are not the same everywhere."""
    return np.array([float(f"{value:.9e}") for value in np.ravel(values)]).reshape(np.shape(values))


def novelty_of(envelope: Envelope, x: np.ndarray) -> np.ndarray:
    """For tests and plots: novelty (N,) of rows x (N, 4) of one drive, as the C computes it."""
    middle, half = 0.5 * (envelope.lower + envelope.upper), 0.5 * (envelope.upper - envelope.lower)
    novelty = np.max(np.abs(x - middle) / half, axis=1)
    power = x[:, 0] * x[:, 1] * KW_PER_RPM_NM
    novelty = np.maximum(novelty, np.abs(power - envelope.power_kw.mean()) / (0.5 * np.ptp(envelope.power_kw)))
    past = np.abs(history(x, envelope.tau_s, DT_S) @ envelope.directions.T - envelope.centre).max(axis=1)
    past[: round(envelope.settle_s / DT_S)] = 0.0
    return np.maximum(novelty, past)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; errors are one line on stderr and exit code 1."""
    parser = argparse.ArgumentParser(prog="python -m tools.envelope", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="the data set the net was trained on")
    parser.add_argument("--weights", type=Path, required=True, help="weights file that gets the envelope")
    parser.add_argument("--force", action="store_true", help="even if the net was trained on other data")
    args = parser.parse_args(argv)
    try:
        load_weights(args.weights)
        rows = load_rows(args.data)
        document = json.loads(args.weights.read_text(encoding="utf-8"))
        if document.get("data_sha256") != rows.sha256 and not args.force:
            raise DataError(f"{args.data} is not what {args.weights} was trained on; give that data set, or --force")
        envelope = envelope_of(rows)
        if envelope is None:
            raise DataError(f"{args.data} has no drive longer than {SETTLE_S:g} s; give longer ones")
        read_envelope(args.weights, envelope)
        document["envelope"] = envelope
        from tools.lstm_torch import write_document

        write_document(args.weights, document)
    except (DataError, FormulationError) as error:
        print(f"envelope: {error}", file=sys.stderr)
        return 1
    print(f"{args.weights}: envelope of {len(rows.x)} rows in {len(rows.pieces())} drives")
    return 0


if __name__ == "__main__":
    sys.exit(main())
