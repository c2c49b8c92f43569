"""The road ahead as a file: reference speed and slope over distance, for a controller that looks ahead.

    python -m plant_sim.preview --scenario lap --out lap.preview

What a car has as map and plan, not the truth of a run: it says nothing of where the car is. The file is text: a line
``rt-preview 1``, a line with step in m, number of points and the driver's look-ahead in m, then speed (m/s) and slope
(rad) of each point, one a line.
"""

import argparse
import sys
from pathlib import Path

from plant_sim.cycles import Cycle, CycleSpec, build_cycle
from plant_sim.errors import CycleError, PlantError
from plant_sim.params import PlantParams, load_params

FORMAT = "rt-preview 1"
POINTS_MAX = 65536  # rt_controller's table


def preview_text(cycle: Cycle, params: PlantParams) -> str:
    """The file's content for a cycle over distance.

    Raises
    ------
    CycleError
        The cycle runs over time, its slope is made as it goes, or it has too many points.
    """
    if not cycle.by_distance or cycle.servo is not None:
        raise CycleError(f"cycle '{cycle.name}' runs over time: a controller looks ahead by distance; drive a lap")
    if cycle.v_ref_mps.size > POINTS_MAX:
        raise CycleError(f"cycle '{cycle.name}' has {cycle.v_ref_mps.size} points; a preview holds {POINTS_MAX}")
    lines = [FORMAT, f"{cycle.step!r} {cycle.v_ref_mps.size} {params.driver.lookahead_m!r}"]
    lines += [f"{v!r} {s!r}" for v, s in zip(cycle.v_ref_mps.tolist(), cycle.slope_rad.tolist(), strict=True)]
    return "\n".join(lines) + "\n"


def fingerprint24(content: bytes) -> int:
    """FNV-1a of 32 bits, folded to 24: what the controller publishes of the file that it loaded."""
    value = 0x811C9DC5
    for byte in content:
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return (value >> 24) ^ (value & 0xFFFFFF)


def main() -> int:
    """Command line entry; returns the exit status."""
    from rt_runner.config import load_scenario
    from rt_runner.errors import RtError

    parser = argparse.ArgumentParser(prog="python -m plant_sim.preview", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", required=True, help="name or TOML file")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="what to write")
    args = parser.parse_args()
    try:
        scenario, params = load_scenario(args.scenario), load_params()
        spec = scenario.cycle
        path = str(scenario.path.parent / spec.path) if spec.path else None
        args.out.write_text(preview_text(build_cycle(CycleSpec(kind=spec.kind, path=path), params), params))
    except (RtError, PlantError) as error:
        print(f"plant_sim.preview: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"plant_sim.preview: cannot write {args.out}: {error.strerror}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
