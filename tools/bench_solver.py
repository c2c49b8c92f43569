"""Every solver of the MHE problem on the same recorded steps, in turns: times, instructions, errors, memory.

    rt-runner bench solver [--backend simd,hpipm_full] [--steps N] [--repeat R] [--json FILE] [--details FILE]
                           [--doc docs/solver.md] [--weights FILE]

The steps are what the estimator asked of its MHE on drives of the plant (tools/solver_backends/stream.py): the lap,
sensor faults, active bounds, other losses. A step is what happens between two estimates: advance, arrival cost,
measurements, solve, run forward through the sensor's delay. Needs gcc; valgrind for the instructions.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from plant_sim.errors import PlantError
from tools.files import write_json, write_whole
from tools.libest import WEIGHTS
from tools.solver_backends import table
from tools.solver_backends.build import BuildError
from tools.solver_backends.configs import HPIPM, REFERENCE, Config, UnknownBackend, chosen
from tools.solver_backends.figures import Figures, Measured, best_hpipm, by_name, document, figures_of, oracle_figures
from tools.solver_backends.measure import MHE_PARTS, Bench, MeasureError, counted_steps, pinned_core
from tools.solver_backends.oracle import NODES, Answers
from tools.solver_backends.stream import Segment, record_all, shortened

ASKED = 400  # windows that the oracle is asked, fewer where fewer steps are run
KERNEL_NOTE = (
    "instructions by callgrind over {steps} steps (lap, faults, bounds, quadratic); the vector kernel counted is AVX2: "
    "valgrind knows no AVX-512"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry."""
    args = _parse(argv)
    shown = sys.stderr if args.json == "-" else sys.stdout
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        configs, with_oracle = chosen(args.backend.split(",") if args.backend else None)
        if args.doc is not None:
            table.inserted(args.doc, "")
        with tempfile.TemporaryDirectory(prefix="bench-solver-") as name:
            found, notes = bench(args, configs, with_oracle, Path(name), shown)
    except (
        UnknownBackend,
        BuildError,
        MeasureError,
        FormulationError,
        PlantError,
        table.DocumentError,
        ValueError,
    ) as error:
        print(f"bench_solver: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"bench_solver: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("bench_solver: stopped, nothing is written", file=sys.stderr)
        return 128 + signal.SIGINT
    print(table.plain(found, notes), file=shown)
    write_json(args.json, document(found))
    write_json(args.details, {"best_hpipm": best_hpipm(found), "notes": notes, "backends": found})
    if args.doc is not None:
        write_whole(args.doc, table.inserted(args.doc, table.markdown(found, notes)).encode())
        print(f"table written into {args.doc}", file=shown)
    return 0


def bench(
    args: argparse.Namespace, configs: Sequence[Config], with_oracle: bool, folder: Path, shown: TextIO
) -> tuple[dict[str, Figures], list[str]]:
    """(figures by name, notes on how they were made)."""

    def say(text: str) -> None:
        print(text, file=shown, flush=True)

    weights = load_weights(args.weights)
    segments = record_all(args.weights, lambda _: None)
    if args.steps is not None:
        segments = shortened(segments, args.steps)
    steps = sum(len(segment) for segment in segments)
    say(f"{steps} recorded steps in {len(segments)} situations")
    machine = Bench(args.weights, folder, [REFERENCE, *configs])
    places = [0, *(k for k in range(1, len(machine.configs)) if machine.runs(k))]
    absent = [config.name for k, config in enumerate(machine.configs) if k not in places]
    core = pinned_core() if args.core is None else args.core
    measured = machine.time(places, segments, args.repeat, max(1, steps // ASKED), core)
    say("timed; the oracle …")
    answers, took_us = ask_oracle(measured, Answers(weights))
    kinds = kinds_of(segments)
    ran = [machine.configs[place] for place in places]
    figures = [figures_of(measured, at, answers, kinds, config.converges) for at, config in enumerate(ran)]
    if not args.no_count:
        say("instructions …")
        for at, place in enumerate(places[1:], start=1):
            figures[at]["instructions"] = machine.count(place, segments)
            if machine.configs[place].build != HPIPM:
                figures[at]["instructions_mhe"] = machine.count(place, segments, MHE_PARTS)
    found = by_name(ran[1:], figures[1:])
    if with_oracle and took_us:
        found["oracle"] = oracle_figures(took_us)
    notes = [
        f"{steps:,} recorded steps, {len(answers)} of them also solved by ipopt, which the reference "
        f"({REFERENCE.title}) meets to {figures[0]['oracle_error_degc'] or float('nan'):.0e} °C",
        f"one core, backends in turns of 64 steps, shortest of {args.repeat} passes; {_processor()}",
        f"run forward through the delay, part of every step: median {min(f['ahead_median_us'] for f in figures):.1f} "
        "µs at best",
    ]
    notes += [] if args.no_count else [KERNEL_NOTE.format(steps=counted_steps(segments))]
    notes += [f"not on this machine: {', '.join(absent)}"] if absent else []
    return found, notes


def ask_oracle(measured: Measured, answers: Answers) -> tuple[dict[int, NDArray[np.float64]], list[float]]:
    """({chosen step: the oracle's temperatures}, µs each); full windows only, one NLP serves them all."""
    thetas, took_us = {}, []
    for place in range(len(measured.windows)):
        start = measured.window(place, 0)
        if len(start) == NODES:
            answer = answers.ask(measured.problems[place, 1:], start)
            thetas[place] = answer.theta_degc
            took_us.append(answer.took_us)
    return thetas, took_us


def kinds_of(segments: Sequence[Segment]) -> NDArray[np.str_]:
    """Group of every step."""
    return np.repeat([s.situation.kind for s in segments], [len(s) for s in segments])


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "unknown processor"


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rt-runner bench solver", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--backend", help="names with commas between (default: all)")
    parser.add_argument("--steps", type=_positive, help="about so many recorded steps (default: all, more than 20 000)")
    parser.add_argument("--repeat", type=_positive, default=2, help="passes; the shortest time of a step counts")
    parser.add_argument("--core", type=int, help="where to run (default: the last one)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="the net (default: the estimator's)")
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--details", metavar="FILE", help="write everything that was measured as JSON")
    parser.add_argument("--doc", type=Path, metavar="FILE", help="rewrite the table between the file's markers")
    parser.add_argument("--no-count", action="store_true", help="do not count instructions")
    return parser.parse_args(argv)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above zero")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
