"""Does the monitor cry wolf, and does it bark? Drives the plant, healthy and faulty, past the C estimator.

    python -m tools.check_validity [--weights estimator_c/weights/lstm8.json] [--seeds 3] [--json FILE]

The whole core with the sensor's noise and delay, as on the bus: what is judged is what the estimator believes. For each
case: the share of 0.1 s steps flagged, per flag, and when the first flag came. Healthy cases give the false-alarm rate;
a fault that no input shows alone is found by `joint` (power, thermal history).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from plant_sim.cycles import CycleSpec
from plant_sim.params import load_params
from plant_sim.plant import Plant
from tools.files import write_json
from tools.libest import WEIGHTS, Estimator, Lib, Validity, compile_library


@dataclass(frozen=True)
class Case:
    """One drive. From `fault_s` on: another coolant temperature, or speed and torque frames scaled."""

    name: str
    cycle: str = "lap"
    theta0_degc: float = 60.0
    params: dict[str, float] = field(default_factory=dict)  # for PlantParams.varied
    fault_s: float = 0.0
    coolant_degc: float | None = None
    speed_times: float = 1.0
    torque_times: float = 1.0
    healthy: bool = False


CASES = (
    Case("lap", healthy=True),
    Case("class 3", cycle="class3", healthy=True),
    Case("coolant 65 -> 95 degC", fault_s=200.0, coolant_degc=95.0),
    Case("coolant 65 -> 85 degC", fault_s=200.0, coolant_degc=85.0),
    Case("coolant flow 6 -> 0.1 L/min", params={"coolant__flow_lpm": 0.1}),
    Case("over-speed x1.3", speed_times=1.3),
    Case("over-torque x1.3", torque_times=1.3),
    Case("cold soak -20 degC", theta0_degc=-20.0, params={"boundary__coolant_degc": -20.0}),
)


@dataclass(frozen=True)
class Watch:
    """What the monitor said of one drive; shares of the steps after the fault, in percent."""

    case: str
    healthy: bool
    seed: int
    steps: int
    flagged_percent: float
    percent: dict[str, float]  # per flag
    first_s: float | None  # after the fault
    novelty_max: float


def watch(lib: Lib, case: Case, seed: int, duration_s: float | None = None) -> Watch:
    """Run one case for duration_s (None: to the cycle's end) and collect the flags."""
    params = load_params()
    params = params.varied(**case.params) if case.params else params
    plant = Plant(params, CycleSpec(case.cycle), theta0_degc=case.theta0_degc, seed=seed)
    core, said = Estimator(lib, lib.setting("default")), []
    last_tick = None if duration_s is None else round(duration_s * 100)
    fault_tick = round(case.fault_s * 100)
    b = params.boundary
    while not plant.done and (last_tick is None or plant.tick < last_tick):
        if plant.tick == fault_tick and case.coolant_degc is not None:
            plant.set_boundary(case.coolant_degc, b.ambient_degc, b.gearbox_degc)
        s = plant.step()
        faulty = s.tick > fault_tick
        core.feed_motor(
            s.tick,
            s.torque_nm * (case.torque_times if faulty else 1.0),
            s.speed_rpm * (case.speed_times if faulty else 1.0),
        )
        if s.theta_w_meas_degc is None or s.theta_r_meas_degc is None:
            continue
        core.feed_temp(s.tick, s.theta_w_meas_degc, s.theta_r_meas_degc)
        validity = core.step().validity
        if validity.scope > 0 and s.tick > fault_tick:
            said.append(((s.tick - fault_tick) / 100, *validity.flags, validity.novelty))
    data = np.array(said)
    flags = data[:, 1:-1] > 0
    flagged = flags.any(axis=1)
    return Watch(
        case=case.name,
        healthy=case.healthy,
        seed=seed,
        steps=len(data),
        flagged_percent=100 * float(flagged.mean()),
        percent={kind: 100 * float(share) for kind, share in zip(Validity.KINDS, flags.mean(axis=0), strict=True)},
        first_s=float(data[np.argmax(flagged), 0]) if flagged.any() else None,
        novelty_max=float(data[:, -1].max()),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: a table, and --json with all figures; errors are one line on stderr and exit code 1."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.check_validity", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--seeds", type=int, default=1, help="noise seeds per healthy case")
    parser.add_argument("--json", metavar="FILE", help="write all figures here; - is standard output")
    args = parser.parse_args(argv)
    try:
        if load_weights(args.weights).envelope is None:
            raise FormulationError(args.weights, "envelope", "is missing", "add it with 'python -m tools.envelope'")
    except FormulationError as err:
        print(f"check_validity: {err}", file=sys.stderr)
        return 1
    lib, figures = Lib(compile_library(args.weights)), []
    quiet = args.json == "-"
    if not quiet:
        kinds = "".join(f"{kind:>9}" for kind in Validity.KINDS)
        print(f"{'case':<30}{'seed':>5}{'flagged %':>11}{kinds}{'first s':>9}{'novelty':>9}")
    for case in CASES:
        for seed in range(args.seeds if case.healthy else 1):
            found = watch(lib, case, seed)
            figures.append(found)
            if not quiet:
                first = "-" if found.first_s is None else f"{found.first_s:.1f}"
                shares = "".join(f"{share:>9.2f}" for share in found.percent.values())
                print(
                    f"{found.case:<30}{seed:>5}{found.flagged_percent:>11.2f}{shares}{first:>9}{found.novelty_max:>9.2f}"
                )
    document: dict[str, Any] = {"weights": str(args.weights), "cases": [asdict(found) for found in figures]}
    write_json(args.json, document)
    return 0


if __name__ == "__main__":
    sys.exit(main())
