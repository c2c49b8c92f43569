"""``rt-runner inspect``: what is in a log."""


def add_parser(subparsers) -> None:
    """Add the verb."""
    p = subparsers.add_parser(
        "inspect",
        help="what is in a log: frames, rates, gaps, verdict",
        description="Show what is in a log, finished or not: frames, rates against the DBC, gaps, damage, verdict.",
    )
    p.add_argument("log", metavar="LOG", help="an .mcap file")
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON (- for standard output)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Print it; returns 0 whatever the log's verdict is.

    1 if the log is unfinished, damaged, no log, or carries a result that its own frames do not give.
    """
    import sys

    from rt_runner.inspect import as_json, show
    from rt_runner.log_summary import summarise
    from rt_runner.present import write_json

    summary = summarise(args.log)
    write_json(as_json(summary), args.json)
    if args.json != "-":
        show(summary)
    trouble = list(summary.trouble)
    if summary.differences:
        trouble.append(f"its result is not what its frames give ({', '.join(summary.differences)}): do not trust it")
    if not trouble:
        return 0
    print(f"rt-runner: {args.log}: {'; '.join(trouble)}", file=sys.stderr)
    return 1
