"""What a net costs in the estimator: instructions per step, counted by callgrind, so that noise cannot touch them.

    python -m tools.bench_net [--weights estimator_c/weights/lstm8.json] [--json FILE]

Counts are those of x86-64 code by gcc -O2 with libm's exp, over 300 steps of the plant's lap from second 400.
`forward`, `adjoint`: one step of the net; `mhe step`: append a node, measure, solve at the default setting; `core
step`: ten motor frames, a temperature frame, estimator_step() with its 15-step prediction; `validity`: the monitor of
the training envelope (part of the core step; next to nothing where the weights carry no envelope). Needs gcc and
valgrind.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.generate import describe
from estimator_c.formulation.weights import NetWeights, load_weights
from tools.bench_mhe import build, measure, recorded_rows
from tools.files import write_json
from tools.libest import WEIGHTS

STEPS = 300


@dataclass(frozen=True)
class NetCost:
    """Instructions are means per step, bytes are sizes of the C objects."""

    weights: str
    sha256: str
    net: str
    cell: str
    hidden: int
    layers: int
    parameters: int
    forward_instructions: int
    adjoint_instructions: int
    validity_instructions: int
    mhe_step_instructions: int
    core_step_instructions: int
    mhe_sweeps_mean: float
    net_memory_bytes: int
    mhe_bytes: int
    estimator_bytes: int


def cost_of(path: Path, rows: np.ndarray) -> NetCost:
    """Compile the net of a weights file and count over rows (n, 4) as of `recorded_rows`.

    Raises
    ------
    FormulationError
        The weights file cannot be used.
    RuntimeError
        valgrind is not installed, or gcc or valgrind failed.
    """
    if shutil.which("valgrind") is None:
        raise RuntimeError("valgrind is not installed; run 'tools/apt-install valgrind'")
    weights: NetWeights = load_weights(path)
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            net = build(path, folder, "bench_net.c")
            counts, sizes = {}, ""
            for function in ("forward", "adjoint", "validity"):
                counts[function], sizes = _count(net, f"counted_{function}", rows, folder)
            estimator = build(path, folder)
            mhe, core = (measure(estimator, rows, mode, 0, folder) for mode in ("mhe", "core"))
    except subprocess.CalledProcessError as err:
        raise RuntimeError(f"{err.cmd[0]} failed with status {err.returncode} on the net of {path}") from err
    _, memory_bytes, mhe_bytes, estimator_bytes = (int(word) for word in sizes.split())
    assert mhe.instructions is not None
    assert core.instructions is not None
    return NetCost(
        weights=str(path),
        sha256=weights.sha256,
        net=describe(weights),
        cell=weights.cell,
        hidden=weights.hidden,
        layers=len(weights.stack),
        parameters=weights.parameters,
        forward_instructions=counts["forward"],
        adjoint_instructions=counts["adjoint"],
        validity_instructions=counts["validity"],
        mhe_step_instructions=mhe.instructions,
        core_step_instructions=core.instructions,
        mhe_sweeps_mean=mhe.sweeps_mean,
        net_memory_bytes=memory_bytes,
        mhe_bytes=mhe_bytes,
        estimator_bytes=estimator_bytes,
    )


def _count(program: Path, function: str, rows: np.ndarray, folder: Path) -> tuple[int, str]:
    grind = ["valgrind", "--tool=callgrind", f"--toggle-collect={function}"]
    grind += [f"--callgrind-out-file={folder / 'callgrind.out'}", str(program)]
    done = subprocess.run(grind, input=rows.tobytes(), capture_output=True, check=True)
    found = re.search(rb"Collected : (\d+)", done.stderr)
    if found is None:
        raise RuntimeError(f"valgrind counted nothing in {function}; is its callgrind tool installed?")
    return round(int(found.group(1)) / len(rows)), done.stdout.decode()


def table(cost: NetCost) -> str:
    """The figures as lines for a terminal."""
    lines = [f"{cost.weights}: {cost.net}, {cost.parameters} parameters; instructions per step"]
    for label, count in (
        ("net forward", cost.forward_instructions), ("net adjoint", cost.adjoint_instructions),
        ("validity", cost.validity_instructions),
        (f"MHE step ({cost.mhe_sweeps_mean:.2f} sweeps)", cost.mhe_step_instructions),
        ("core step", cost.core_step_instructions),
    ):  # fmt: skip
        lines.append(f"{label:<26}{count:>12,}")
    lines.append(f"{'mhe_t, estimator_t':<26}{cost.mhe_bytes:>12,} and {cost.estimator_bytes:,} bytes")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table (not with --json -), and --json with all figures; errors are one line, exit code 1."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench_net", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--json", metavar="FILE", help="write all figures here; - is standard output")
    args = parser.parse_args(argv)
    try:
        load_weights(args.weights)  # before the plant is simulated
        cost = cost_of(args.weights, recorded_rows(STEPS + 1))
    except (FormulationError, RuntimeError) as err:
        print(f"bench_net: {err}", file=sys.stderr)
        return 1
    if args.json != "-":
        print(table(cost))
    write_json(args.json, asdict(cost))
    return 0


if __name__ == "__main__":
    sys.exit(main())
