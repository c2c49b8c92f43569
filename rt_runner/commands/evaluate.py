"""``rt-runner evaluate``: how good a net is on a lap. The figures come from ``tools.evaluate``, a process."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "evaluate",
        help="MAE, RMSE, NRMSE, mean and open-loop error of a net on a lap",
        description="Errors of a net's rates on a lap, one step ahead, and of its temperatures in open loop.",
    )
    p.add_argument("--net", metavar="FILE", help="weights, ours or in the plain format (default: the embedded net)")
    p.add_argument(
        "--lap", metavar="FILE", help=".csv, .parquet, .mcap or .npz (default: drive the Nordschleife-like lap now)"
    )
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")
    p.add_argument("--plot", metavar="FILE", help="predicted against actual, and over time (.svg, .png)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Evaluate; returns the exit status."""
    from rt_runner.tool_process import option, run_tool

    names = ("net", "lap", "json", "plot")
    return run_tool("tools.evaluate", [w for n in names for w in option(n, getattr(args, n))], args.debug)
