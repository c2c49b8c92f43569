"""``rt-runner compare``: all estimators over all faults. The figures come from ``tools.compare``, a process."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "compare",
        help="all estimators over all sensor faults and plant mismatches: one table",
        description="Run the estimator's settings and the baselines (UKF, thermal-network Kalman filter, fixed gain, "
        "open loop, average, raw sensor) over every fault of the catalogue, model in the loop, on all cores.",
    )
    p.add_argument("--seeds", type=int, default=3, metavar="N", help="noise seeds 0 … N - 1 (default: %(default)s)")
    p.add_argument("--estimators", metavar="A,B", help="settings of the C estimator and baselines (default: all)")
    p.add_argument("--cases", metavar="A,B", help="nominal, offset, noise, stuck, dropout, … (default: all)")
    p.add_argument("--channel", choices=("winding", "rotor"), default="winding", help="which sensor has the faults")
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")
    p.add_argument("--doc", metavar="FILE.md", help="rewrite the table between the markers of this document")
    p.add_argument("--figures", metavar="DIR", help="draw the lap, 140 to 165 °C and two faults there")
    p.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Compare; returns the exit status."""
    from rt_runner.tool_process import option, run_tool

    names = ("seeds", "estimators", "cases", "channel", "json", "doc", "figures", "workers")
    return run_tool("tools.compare", [w for n in names for w in option(n, getattr(args, n))], args.debug)
