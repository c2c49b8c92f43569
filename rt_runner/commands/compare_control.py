"""``rt-runner compare-control``: all controllers on all feedbacks. The figures come from ``tools.compare_control``."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "compare-control",
        help="no derating, linear rules, the paper's MPC and ours, on truth, sensor and estimators: one table",
        description="Drive the whole lap in closed loop under every controller, with every source of its temperatures, "
        "without and with sensor faults, model in the loop, on all cores.",
    )
    p.add_argument("--controllers", metavar="A,B", help="none, rule-150-155, rule-145-160, paper, mpc-S, mpc-M")
    p.add_argument("--feedback", metavar="A,B", help="ideal, raw, paper, default (default: all)")
    p.add_argument("--cases", metavar="A,B", help="nominal, offset, noise, stuck, dropout (default: the first three)")
    p.add_argument("--seconds", type=float, metavar="S", help="drive no longer than this (default: the lap)")
    p.add_argument("--seed", type=int, metavar="N", help="of the sensors' noise (default: 1)")
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")
    p.add_argument("--doc", metavar="FILE.md", help="rewrite the table between the markers of this document")
    p.add_argument("--figures", metavar="DIR", help="draw the lap there: control_lap.svg")
    p.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Compare; returns the exit status."""
    from rt_runner.tool_process import option, run_tool

    names = ("controllers", "feedback", "cases", "seconds", "seed", "json", "doc", "figures", "workers")
    return run_tool("tools.compare_control", [w for n in names for w in option(n, getattr(args, n))], args.debug)
