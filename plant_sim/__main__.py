"""``python -m plant_sim``: the plant process. Started by ``rt-runner run`` and ``rt-runner mil``."""

import argparse
import os
import signal
import sys

from plant_sim.errors import PlantError
from plant_sim.process import run_lockstep, run_realtime
from rt_runner.errors import RtError


def main() -> int:
    parser = argparse.ArgumentParser(prog="plant_sim", description=__doc__)
    parser.add_argument("--scenario", required=True, help="name or TOML file")
    parser.add_argument("--bus", help="socketcan:vcan0 or rt_hub:PATH")
    parser.add_argument("--lockstep", action="store_true", help="records on stdin and stdout, no clock, no bus")
    parser.add_argument("--duration", type=float, help="seconds; default: the scenario's")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fault", action="append", metavar="SPEC", help="a sensor fault beside the scenario's")
    parser.add_argument("--obey", action="store_true", help="take torque commands from the bus; without them, the rule")
    args = parser.parse_args()
    if not args.lockstep and not args.bus:
        parser.error("--bus is needed (or --lockstep)")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        if args.lockstep:
            return run_lockstep(args, sys.stdin.buffer, sys.stdout.buffer)
        return run_realtime(args)
    except (RtError, PlantError) as e:
        print(f"plant_sim: {e}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


if __name__ == "__main__":
    sys.exit(main())
