"""``rt-runner mil``: model in the loop, the same plant and the same C estimator in lock-step, as fast as it goes."""


def add_parser(verbs) -> None:
    """Add the verb."""
    from rt_runner.commands.run import add_scenario_options

    p = verbs.add_parser(
        "mil",
        help="the same plant and estimator in lock-step, without a clock",
        description="Run plant and estimator in lock-step, as fast as they go, with the same log and result.",
    )
    add_scenario_options(p)
    p.set_defaults(run=run, scenario="lap")


def run(args) -> int:
    """Run; returns the exit status."""
    from pathlib import Path

    from rt_runner import paths
    from rt_runner.commands.run import scenario_from
    from rt_runner.lockstep import run_lockstep
    from rt_runner.mcap_log import prepare_log_path
    from rt_runner.present import Progress, deliver

    scenario = scenario_from(args)
    paths.binary("rt_estimator")
    log = prepare_log_path(Path(args.log) if args.log else None, f"{scenario.name}-mil")
    progress = Progress(scenario.duration_s)
    progress.line(f"{scenario.name}: {scenario.title}, in lock-step")
    try:
        result = run_lockstep(scenario, args.seed, log, progress.update)
    finally:
        progress.close()
    return deliver(result, log, args.json)
