"""``rt-runner run``: plant and estimator over CAN in real time, logged and judged."""

import argparse


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "run",
        help="plant and estimator over CAN, in real time",
        description="Run plant, estimator and logger on a CAN bus in real time, then judge the log.",
    )
    add_scenario_options(p, "hot-lap")
    p.add_argument(
        "--bus",
        default="auto",
        metavar="auto|vcan0|can0|hub",
        help="default: vcan0 if it exists, else the hub; rt_hub:PATH is a hub that runs already",
    )
    p.add_argument("--core", type=int, help="core of the estimator (default: the last one)")
    p.add_argument("--no-rt", action="store_true", help="do not ask for SCHED_FIFO and locked memory")
    p.set_defaults(run=run)


def add_scenario_options(p: argparse.ArgumentParser, default: str) -> None:
    """Options that ``run`` and ``mil`` share."""
    from rt_runner.paths import setting_names

    p.add_argument(
        "scenario", nargs="?", default=default, metavar="SCENARIO", help=f"name or .toml file (default: {default})"
    )
    p.add_argument("--duration", type=float, metavar="S", help="seconds, instead of the scenario's")
    p.add_argument("--setting", metavar="NAME", help=f"estimator setting: {', '.join(setting_names())}")
    p.add_argument("--period", type=float, metavar="S", help="period of the estimator's loop, 0.001 … 1")
    p.add_argument(
        "--controller",
        metavar="NAME",
        help="who commands the torque: none, rule-150-155, rule-145-160, mpc-S, mpc-M, paper; off: the plant's driver",
    )
    p.add_argument(
        "--fault",
        action="append",
        metavar="SPEC",
        help="a sensor fault beside the scenario's, KIND[:AMPLITUDE]@START-END[/CHANNEL] in seconds of the plant, "
        "e.g. offset:-20@430-550 or stuck@430-490/r; may be given again",
    )
    p.add_argument(
        "--log", metavar="FILE.mcap", help="default: logs/SCENARIO-TIME.mcap; an existing file is kept, renamed"
    )
    p.add_argument("--json", metavar="FILE", help="write the result as JSON (- for standard output)")
    p.add_argument("--seed", type=int, default=1, help="of sensor noise and generated cycles (default: 1)")


def scenario_from(args):
    """The scenario that the options describe, checked."""
    from dataclasses import replace

    from rt_runner.config import check_controller, check_faults, check_period, load_scenario, with_duration, with_faults
    from rt_runner.errors import UsageError
    from rt_runner.timing_config import check_timing

    s = with_faults(with_duration(load_scenario(args.scenario), args.duration), args.fault)
    check_faults(s)
    if args.seed < 0:
        raise UsageError(f"--seed {args.seed}: must be 0 or more")
    if args.period is not None:
        check_period(args.period, "--period")
        s = replace(s, estimator=replace(s.estimator, period_s=args.period))
        check_timing(s.timing, args.period, s.estimator.trigger, "--period: [timing]")
    if args.controller is not None:
        s = replace(s, controller=replace(s.controller, name=args.controller))
        check_controller(s, "--controller")
    if args.setting is not None:
        s = replace(s, estimator=replace(s.estimator, setting=args.setting))
    return s


def run(args) -> int:
    """Run; returns the exit status."""
    import signal
    from pathlib import Path

    from rt_runner import provenance
    from rt_runner.bus import choose_bus
    from rt_runner.dbc import load_dbc
    from rt_runner.machine import check_core
    from rt_runner.mcap_log import prepare_log_path
    from rt_runner.present import Progress, check_json_path, deliver
    from rt_runner.supervisor import Plan, Supervisor

    scenario = scenario_from(args)
    check_core(args.core)
    check_json_path(args.json, args.log)
    identity = provenance.preflight(scenario, load_dbc())
    bus = choose_bus(args.bus)
    log = prepare_log_path(Path(args.log) if args.log else None, scenario.name)
    progress = Progress(scenario.duration_s)
    progress.line(f"{scenario.name}: {scenario.title}")
    progress.line(f"bus: {bus.name}, {bus.reason}")
    plan = Plan(
        scenario=scenario,
        bus=bus,
        log=log,
        provenance=provenance.gather(scenario, bus.name, args.seed, identity),
        seed=args.seed,
        core=args.core,
        realtime=not args.no_rt,
    )
    supervisor = Supervisor(plan, progress.line, progress.update)
    before = {s: signal.signal(s, lambda *_: supervisor.stop()) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        result = supervisor.run()
    finally:
        progress.close()
        for s, handler in before.items():
            signal.signal(s, handler)
    return deliver(result, log, args.json)
