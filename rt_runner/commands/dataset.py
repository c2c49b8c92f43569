"""``rt-runner dataset``: training data and the test lap from the plant. ``tools.dataset`` builds it, a process."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "dataset",
        help="build a training set of 180 000 rows, and the test lap, from the plant",
        description="Build a training set of 180 000 rows (10 Hz, 5 h) and the test lap from the plant. An interrupted "
        "build goes on where it stopped; the same seed gives the same bytes.",
    )
    p.add_argument(
        "--set",
        choices=("P", "R", "R-hot"),
        default="R",
        help="R: road cycles and mountain tracks; P: hot cycles only; R-hot: R with the cycles of P",
    )
    p.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    p.add_argument("--out", metavar="FILE.npz", help="lap.npz goes beside it (default: build/data/SET.npz)")
    p.add_argument("--json", metavar="FILE", help="write the figures of the set as JSON ('-': standard output)")
    p.add_argument("--plot", metavar="FILE", help="histograms of rates and temperatures (.svg, .png)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Build it; returns the exit status."""
    from rt_runner.tool_process import option, run_tool

    names = ("set", "seed", "out", "json", "plot")
    return run_tool("tools.dataset", [w for n in names for w in option(n, getattr(args, n))], args.debug)
