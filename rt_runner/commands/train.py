"""``rt-runner train``: train a net on a data set or on a table of one's own. ``tools.train`` does it, a process."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "train",
        help="train a net and write its weights as text",
        description="Train a net on a set of 'rt-runner dataset' or on any table of time, speed, torque and both "
        "temperatures (.csv, .parquet, .mcap). Ctrl-C keeps the best so far.",
        epilog="Every other option of the trainer goes behind --, such as: rt-runner train -- --hidden 16; "
        "'rt-runner train -- --help' lists them.",
    )
    p.add_argument("--data", metavar="FILE", default="build/data/R.npz", help="default: %(default)s")
    p.add_argument("--lap", metavar="FILE", help="test lap, for the figures in the weights file (default: the set's)")
    p.add_argument("--out", metavar="FILE", default="build/net.json", help="weights to write (default: %(default)s)")
    p.add_argument("more", nargs="*", metavar="-- OPTION", help="options of the trainer")
    p.set_defaults(run=run)


def run(args) -> int:
    """Train; returns the exit status."""
    from pathlib import Path

    from rt_runner.tool_process import option, run_tool

    beside = Path(args.data).with_name("lap.npz")
    lap = args.lap or (str(beside) if beside.is_file() else None)
    own = [*option("data", args.data), *option("lap", lap), *option("out", args.out)]
    return run_tool("tools.train", [*own, *args.more], args.debug)
