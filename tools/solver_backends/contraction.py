"""How fast the θ-space iteration contracts, measured on nets of every size.

    python -m tools.solver_backends.contraction [--doc docs/solver.md] WEIGHTS.json ...

Each net drives its own recorded drive (with process and sensor noise, driven hard), and the C's MHE follows it. In each
step the solver is asked for one sweep at a time; the change in °C that a sweep asks for, over the one before, is the
contraction. Changes below 1e-9 °C are rounding and left out.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.generate import describe
from estimator_c.formulation.weights import load_weights
from tools.files import write_whole
from tools.libest import WEIGHTS, Lib, Mhe, compile_library
from tools.mhe_recorder import Recorder, record
from tools.solver_backends import table

BEGIN, END = "<!-- contraction: begin -->", "<!-- contraction: end -->"
STEPS, SWEEPS = 120, 12
ROUNDING_DEGC = 1e-9


@dataclass(frozen=True)
class Contraction:
    """Of one net, over a drive: ratio of successive changes (median, largest); sweeps to 1e-6 °C (mean, largest)."""

    net: str
    name: str
    median: float
    largest: float
    sweeps_mean: float
    sweeps_max: int


def contraction_of(path: Path, loss: int = 0, steps: int = STEPS) -> Contraction:
    """Measure one net.

    Raises
    ------
    FormulationError
        The weights file cannot be used.
    """
    weights = load_weights(path)
    lib = Lib(compile_library(path))
    setting = lib.setting("default", loss=loss, max_sweeps=1, tolerance_degc=0.0)
    run = Recorder(lib, weights, setting, record(weights, steps=steps))
    ratios, sweeps = [], []
    for step in range(steps - 1):
        run.advance()
        changes = _changes(run.mhe)
        if step < 16:
            continue  # the growing window
        counted = [c for c in changes if c > ROUNDING_DEGC]
        ratios += [b / a for a, b in itertools.pairwise(counted)]
        sweeps.append(next((k + 1 for k, c in enumerate(changes) if c <= 1e-6), SWEEPS))
    return Contraction(
        describe(weights), path.stem, float(np.median(ratios)), float(max(ratios)), float(np.mean(sweeps)), max(sweeps)
    )


def _changes(mhe: Mhe) -> list[float]:
    """°C that each of SWEEPS sweeps asks for, one solve() each."""
    return [mhe.solve()[1].kkt_degc for _ in range(SWEEPS)]


def markdown(found: Sequence[Contraction]) -> str:
    """A table."""
    lines = [
        "| net | file | contraction, median | largest | sweeps to 1e-6 °C, mean | most |",
        "|---|---|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {c.net} | `{c.name}` | {c.median:.1e} | {c.largest:.1e} | {c.sweeps_mean:.1f} | {c.sweeps_max} |"
        for c in found
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "weights", type=Path, nargs="*", default=[WEIGHTS], help="weights files (default: the estimator's)"
    )
    parser.add_argument("--doc", type=Path, help="rewrite the table between this document's markers")
    args = parser.parse_args(argv)
    try:
        found = [contraction_of(path) for path in args.weights]
        text = markdown(found)
        print(text)
        if args.doc is not None:
            write_whole(args.doc, table.inserted(args.doc, text, BEGIN, END).encode())
    except (FormulationError, table.DocumentError) as error:
        print(f"contraction: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
