"""``rt-runner mil``: model in the loop, the same plant and the same C estimator in lock-step, as fast as it goes."""


def add_parser(verbs) -> None:
    """Add the verb."""
    from rt_runner.commands.run import add_scenario_options

    p = verbs.add_parser(
        "mil",
        help="the same plant and estimator in lock-step, without a clock",
        description="Run plant and estimator in lock-step, as fast as they go, with the same log and result.",
    )
    add_scenario_options(p, "lap")
    p.set_defaults(run=run)


def run(args) -> int:
    """Run; returns the exit status."""
    import signal
    from pathlib import Path

    from rt_runner import provenance
    from rt_runner.commands.run import scenario_from
    from rt_runner.dbc import load_dbc
    from rt_runner.lockstep import run_lockstep
    from rt_runner.mcap_log import prepare_log_path
    from rt_runner.present import Progress, check_json_path, deliver
    from rt_runner.timing_config import timing_options

    scenario, dbc = scenario_from(args), load_dbc()
    timing_options(scenario.timing, scenario.estimator.period_s, scenario.estimator.trigger, lockstep=True)
    check_json_path(args.json, args.log)
    identity = provenance.preflight(scenario, dbc)
    log = prepare_log_path(Path(args.log) if args.log else None, f"{scenario.name}-mil")
    about = provenance.gather(scenario, "lockstep", args.seed, identity)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # ends it as Ctrl-C does, with a finished log
    progress = Progress(scenario.duration_s)
    progress.line(f"{scenario.name}: {scenario.title}, in lock-step")
    try:
        result = run_lockstep(scenario, args.seed, log, dbc, about, progress.update)
    finally:
        progress.close()
    return deliver(result, log, args.json)
