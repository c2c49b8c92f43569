"""What a step of the MHE costs on a Cortex-M7: instructions, flash, RAM, stack, and whether the answers are the host's.

    python -m tools.bench_ecu [--steps N] [--weights W] [--optimise 2] [--doc FILE] [--json FILE]      (make bench-ecu)

The portable float C, compiled by arm-none-eabi-gcc, run bare-metal in qemu-system-arm with -icount on recorded steps.
In: the six calls that make a step (mhe_advance ... mhe_solve), their code, tables and state, start-up code, stack. Out:
reading the record and writing the answers (memory of their own), the Kalman filter and the sensor monitors around the
MHE, frames.
The emulator counts instructions; it has no pipeline, caches or wait states, so a time is not claimed.

Exit status: 0 done, targets met; 1 set-up; 2 a target is missed or an answer differs from the host's.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from estimator_c.formulation.errors import FormulationError
from tools.ecu_image import BASE, Image, ToolError, build_image
from tools.ecu_replay import PARTS, differing_steps, fixed_sweeps, replay_double, replay_ecu, replay_host
from tools.solver_backends.stream import Segment, record_all, shortened
from tools.solver_backends.table import DocumentError, inserted

SWEEPS = 2
NODES = 16
MARKERS = ("<!-- bench-ecu: begin -->", "<!-- bench-ecu: end -->")
PASS = 10_000  # instructions: an arrival that costs more has run the net over the window
TARGETS = {"instructions_max": 250_000, "flash_bytes": 32 * 1024, "ram_bytes": 12 * 1024}


@dataclass(frozen=True)
class KindCost:
    """One group of situations.

    Instructions are per step, all calls from one solution to the next; error: difference, in degC, from the
    converged solution in double on the same calls; full: of steps with a full window, so not of the first 1.5 s.
    """

    kind: str
    steps: int
    instructions_median: int
    instructions_max: int
    error_median_degc: float
    error_full_max_degc: float
    error_max_degc: float


@dataclass(frozen=True)
class EcuCost:
    """The figures of one run, over all steps.

    instructions_plain: of the steps that advance, take the filter's arrival, measure and solve without a bound, the
    largest; the others also fill the net's memory (a window's first 20 s), move or clear the window, or meet a bound.
    instructions_to_estimate: of plain steps, until mhe_feedback() has the estimate of one sweep; the rest can wait.
    flash_bytes: all of the image in flash; step_flash_bytes: MHE, solver and net alone. ram_bytes: data, bss and the
    deepest stack; state_bytes: sizeof(mhe_t). differing_steps: answers that are not the host's, bit for bit.
    counter_slope: instructions counted per round of a loop of two.
    """

    steps: int
    sweeps: int
    compiled: str
    instructions_median: int
    instructions_plain: int
    instructions_max: int
    instructions_to_estimate: int
    instructions_by_call: dict[str, int]
    flash_bytes: int
    step_flash_bytes: int
    ram_bytes: int
    state_bytes: int
    stack_bytes: int
    differing_steps: int
    counter_slope: float
    kinds: list[KindCost]

    @property
    def targets_met(self) -> bool:
        """Every target, and every answer the host's. The one for instructions is for SWEEPS sweeps."""
        judged = [name for name in TARGETS if name != "instructions_max" or self.sweeps == SWEEPS]
        within = all(getattr(self, name) <= TARGETS[name] for name in judged)
        return within and self.differing_steps == 0 and self.counter_slope == 2.0


def measure(image: Image, segments: Sequence[Segment], sweeps: int, folder: Path) -> EcuCost:
    """Run the segments on the ECU, on the host and, converged, in double.

    Raises
    ------
    ToolError
        A program ended with an error.
    """
    calls = np.concatenate([segment.data for segment in segments])
    ecu = replay_ecu(image, fixed_sweeps(calls, sweeps), folder)
    host = replay_host(image, fixed_sweeps(calls, sweeps), folder)
    error = np.abs(ecu.answers["theta"] - replay_double(image, calls, folder).answers["theta"]).max(1)
    parts = ecu.instructions()
    step = parts.sum(1)
    level, arrival = parts[:, PARTS.index("level")], parts[:, PARTS.index("arrival")]
    plain = (level == 0) & (ecu.answers["active"] == 0) & (arrival < PASS)
    of_kind = np.repeat([segment.situation.kind for segment in segments], [len(segment) for segment in segments])
    full = ecu.answers["count"] == NODES
    stack = int(ecu.answers["stack"].max())
    return EcuCost(
        steps=len(step),
        sweeps=sweeps,
        compiled=image.compiled,
        instructions_median=int(np.median(step)),
        instructions_plain=int(step[plain].max()) if plain.any() else 0,
        instructions_max=int(step.max()),
        instructions_to_estimate=int((step - parts[:, PARTS.index("finish")])[plain].max()) if plain.any() else 0,
        instructions_by_call={name: int(parts[:, k].max()) for k, name in enumerate(PARTS)},
        flash_bytes=image.flash,
        step_flash_bytes=image.step_flash,
        ram_bytes=image.ram_static + stack,
        state_bytes=ecu.state,
        stack_bytes=stack,
        differing_steps=differing_steps(ecu, host),
        counter_slope=ecu.counter_slope,
        kinds=[_kind(str(kind), step[m], error[m], full[m]) for kind in np.unique(of_kind) for m in [of_kind == kind]],
    )


def _kind(kind: str, step: np.ndarray, error: np.ndarray, full: np.ndarray) -> KindCost:
    worst = float(error[full].max()) if full.any() else 0.0
    return KindCost(
        kind, len(step), int(np.median(step)), int(step.max()), float(np.median(error)), worst, float(error.max())
    )


def table(cost: EcuCost) -> str:
    """The figures as tables, targets beside them."""
    rows = [
        ("steps, sweeps each", f"{cost.steps:,} × {cost.sweeps or '≤ 20'}", ""),
        ("answers unlike the host's", f"{cost.differing_steps:,}", "0"),
        ("instructions, median", f"{cost.instructions_median:,}", ""),
        ("  max of plain steps", f"{cost.instructions_plain:,}", ""),
        ("  max of all steps", f"{cost.instructions_max:,}", f"{TARGETS['instructions_max']:,}"),
        ("  until feedback, plain", f"{cost.instructions_to_estimate:,}", ""),
        ("flash, bytes", f"{cost.flash_bytes:,}", f"{TARGETS['flash_bytes']:,}"),
        ("  MHE, solver and net", f"{cost.step_flash_bytes:,}", ""),
        ("RAM, bytes", f"{cost.ram_bytes:,}", f"{TARGETS['ram_bytes']:,}"),
        ("  state (mhe_t)", f"{cost.state_bytes:,}", ""),
        ("  stack", f"{cost.stack_bytes:,}", ""),
    ]
    lines = [f"{f'Cortex-M7, float, {cost.compiled}':<28}{'measured':>14}{'target ≤':>12}"]
    lines += [f"{name:<28}{value:>14}{target:>12}" for name, value, target in rows]
    lines += [
        "",
        f"{'situations':<12}{'steps':>8}{'median':>10}{'max':>10}{'error °C, median':>18}{'full':>10}{'max':>10}",
    ]
    lines += [
        f"{k.kind:<12}{k.steps:>8,}{k.instructions_median:>10,}{k.instructions_max:>10,}"
        f"{k.error_median_degc:>18.1e}{k.error_full_max_degc:>10.1e}{k.error_max_degc:>10.1e}"
        for k in cost.kinds
    ]
    calls = ", ".join(f"{name} {count:,}" for name, count in cost.instructions_by_call.items())
    lines.append("full: largest error once the window is full; max: in the first 1.5 s, too")
    return "\n".join(line.rstrip() for line in [*lines, f"largest within a step: {calls}"])


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures."""
    parser = argparse.ArgumentParser(prog="tools.bench_ecu", description="cost of one MHE step on a Cortex-M7")
    parser.add_argument("--weights", type=Path, default=BASE / "weights" / "lstm8.json")
    parser.add_argument("--steps", type=int, help="steps to run, spread over all situations; default: all")
    parser.add_argument(
        "--sweeps", type=int, default=SWEEPS, help="of each solution (default %(default)s); 0: until converged"
    )
    parser.add_argument(
        "--optimise", choices=("s", "2", "3"), default="s", help="the compiler's -O (default %(default)s)"
    )
    parser.add_argument("--doc", type=Path, help="document to write the tables into, between its two markers")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args(argv)
    try:
        with tempfile.TemporaryDirectory() as name:
            image = build_image(args.weights, Path(name), (f"-O{args.optimise}",))
            segments = record_all(args.weights)
            segments = segments if args.steps is None else shortened(segments, args.steps)
            cost = measure(image, segments, args.sweeps, Path(name))
        print(table(cost))
        if args.doc:
            args.doc.write_text(inserted(args.doc, f"```\n{table(cost)}\n```", *MARKERS), encoding="utf-8")
    except (ToolError, FormulationError, DocumentError, OSError) as err:
        print(f"bench_ecu: {err}", file=sys.stderr)
        return 1
    if args.json:
        figures = {**asdict(cost), "targets": TARGETS, "targets_met": cost.targets_met}
        args.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0 if cost.targets_met else 2


if __name__ == "__main__":
    sys.exit(main())
