"""``rt-runner timing``: what a log says about deadlines, and whether its books balance."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "timing",
        help="summaries, misses by cause, cycle times, end-to-end age, conservation audit of a log",
        description="Everything a log says about timing: summaries per window, misses by cause, every cyclic message "
        "against the DBC, the age of the estimates, and the audit of the books. docs/timing.md explains each number.",
        epilog="exit status: 0 the deadline holds and the books balance, 1 usage or no such log, 2 it does not hold or "
        "they do not balance, 3 cannot be decided",
    )
    p.add_argument("log", metavar="LOG", help="an .mcap file of rt-runner run or mil, finished or not")
    p.add_argument("--json", metavar="FILE", help="write all figures as JSON (- for standard output)")
    p.add_argument("--csv", metavar="FILE", help="write one line per job of the estimator")
    p.set_defaults(run=run)


def run(args) -> int:
    """Print it; returns the exit status of the verdict."""
    from pathlib import Path

    from rt_runner.present import EXIT, check_json_path, write_json
    from rt_runner.timing.analyse import analyse
    from rt_runner.timing.figures import as_json
    from rt_runner.timing.show import show
    from rt_runner.timing.table import write_table

    check_json_path(args.json, args.log)
    report = analyse(args.log)
    if args.csv is not None:
        write_table(report.processes[0], Path(args.csv))
    write_json(as_json(report), args.json)
    if args.json != "-":
        show(report)
    return EXIT[report.verdict]
