"""What a step of the MHE costs on a Cortex-M7: instructions, flash, RAM, stack, and whether the answers are the host's.

    python -m tools.bench_ecu [--steps N] [--weights W] [--stream FILE] [--json FILE]        (make bench-ecu)

The portable float C, compiled by arm-none-eabi-gcc and run bare-metal in qemu-system-arm with -icount, on recorded steps. In:
mhe_advance, mhe_arrival, mhe_measure, mhe_forget, mhe_shift, mhe_solve, their code, tables and state, start-up code, stack. Out: reading
the record and writing the answers (memory of their own), the Kalman filter and the sensor monitors around the MHE, frames.
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
from tools.ecu_replay import PARTS, Replay, differing_steps, first_steps, fixed_sweeps, replay

SWEEPS = 2
TARGETS = {"instructions_max": 250_000, "flash_bytes": 32 * 1024, "ram_bytes": 12 * 1024}


@dataclass(frozen=True)
class EcuCost:
    """The figures of one run. Instructions are per step: all calls from one solution to the next.

    instructions_plain: largest of the steps that only advance, take the filter's arrival, measure and solve without a bound;
    the others also fill a memory (the window's first 20 s), move or clear the window, or meet a bound.
    flash_bytes: all of the image in flash; step_flash_bytes: MHE, solver and net alone. ram_bytes: data, bss and the deepest
    stack; state_bytes: sizeof(mhe_t). differing_steps: answers that are not the host's, bit for bit.
    """

    steps: int
    sweeps: int
    instructions_median: int
    instructions_max: int
    instructions_plain: int
    instructions_by_part: dict[str, int]
    flash_bytes: int
    step_flash_bytes: int
    ram_bytes: int
    state_bytes: int
    stack_bytes: int
    differing_steps: int
    counter_slope: float
    targets_met: bool


def cost_of(image: Image, ecu: Replay, host: Replay, sweeps: int) -> EcuCost:
    """Figures from both machines' answers."""
    parts = ecu.instructions()
    step = parts.sum(1)
    plain = (parts[:, PARTS.index("level")] == 0) & (ecu.answers["active"] == 0)
    arrival = parts[:, PARTS.index("arrival")]
    plain &= arrival <= 1000  # with a memory it is a pass over the window
    stack = int(ecu.answers["stack"].max())
    figures = {
        "instructions_max": int(step.max()),
        "flash_bytes": image.flash,
        "ram_bytes": image.ram_static + stack,
    }
    differing = differing_steps(ecu, host)
    met = differing == 0 and all(figures[name] <= target for name, target in TARGETS.items())
    return EcuCost(
        steps=len(step),
        sweeps=sweeps,
        instructions_median=int(np.median(step)),
        instructions_plain=int(step[plain].max()) if plain.any() else 0,
        instructions_by_part={name: int(parts[:, k].max()) for k, name in enumerate(PARTS)},
        step_flash_bytes=image.step_flash,
        state_bytes=ecu.state,
        stack_bytes=stack,
        differing_steps=differing,
        counter_slope=ecu.counter_slope,
        targets_met=met,
        **figures,
    )


def table(cost: EcuCost) -> str:
    """The figures as a table, targets beside them."""
    parts = ", ".join(f"{name} {count:,}" for name, count in cost.instructions_by_part.items())
    rows = [
        ("steps, sweeps each", f"{cost.steps:,} × {cost.sweeps}", ""),
        ("answers unlike the host's", f"{cost.differing_steps:,}", "0"),
        ("instructions, median", f"{cost.instructions_median:,}", ""),
        ("instructions, plain step, max", f"{cost.instructions_plain:,}", ""),
        ("instructions, any step, max", f"{cost.instructions_max:,}", f"{TARGETS['instructions_max']:,}"),
        ("flash, bytes", f"{cost.flash_bytes:,}", f"{TARGETS['flash_bytes']:,}"),
        ("  of it MHE, solver, net", f"{cost.step_flash_bytes:,}", ""),
        ("RAM, bytes", f"{cost.ram_bytes:,}", f"{TARGETS['ram_bytes']:,}"),
        ("  of it state (mhe_t)", f"{cost.state_bytes:,}", ""),
        ("  of it stack", f"{cost.stack_bytes:,}", ""),
    ]
    lines = [f"{'Cortex-M7, float':<32}{'measured':>14}{'target ≤':>12}"]
    lines += [f"{name:<32}{value:>14}{target:>12}" for name, value, target in rows]
    return "\n".join([*lines, f"largest by call: {parts}"])


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures."""
    parser = argparse.ArgumentParser(prog="tools.bench_ecu", description="cost of one MHE step on a Cortex-M7")
    parser.add_argument("--weights", type=Path, default=BASE / "weights" / "lstm8.json")
    parser.add_argument("--stream", type=Path, help="recorded calls (tools/solver_backends/stream.h); default: record them")
    parser.add_argument("--steps", type=int, help="steps to run, spread over the record; default: all")
    parser.add_argument("--sweeps", type=int, default=SWEEPS, help="of each solution (default %(default)s)")
    parser.add_argument("--json", type=Path, help="write all figures here")
    args = parser.parse_args(argv)
    try:
        stream = recorded_stream(args.stream)
        if args.steps is not None:
            stream = first_steps(stream, args.steps)
        with tempfile.TemporaryDirectory() as name:
            image = build_image(args.weights, Path(name))
            cost = cost_of(image, *replay(image, fixed_sweeps(stream, args.sweeps), Path(name)), args.sweeps)
    except (ToolError, FormulationError, OSError) as err:
        print(f"bench_ecu: {err}", file=sys.stderr)
        return 1
    print(table(cost))
    if args.json:
        args.json.write_text(json.dumps(asdict(cost), indent=1) + "\n", encoding="utf-8")
    return 0 if cost.targets_met else 2


if __name__ == "__main__":
    sys.exit(main())
