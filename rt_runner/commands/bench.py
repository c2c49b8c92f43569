"""``rt-runner bench``: what things cost. Each sub-verb is a tool, a process of its own."""


def add_parser(verbs) -> None:
    """Add the verb and its sub-verbs."""
    p = verbs.add_parser("bench", help="what things cost: solver, loop", description="Measure what a part costs.")
    parts = p.add_subparsers(dest="part", required=True, metavar="PART")
    _add_solver(parts)
    _add_loop(parts)


def _add_solver(parts) -> None:
    p = parts.add_parser(
        "solver",
        help="every solver of the estimator's problem on the same recorded steps",
        description="Time, instructions, error against ipopt and memory of the estimator's solver (vector kernels, "
        "portable C, float), of SQP with HPIPM in several forms, and of ipopt, on more than 20 000 recorded steps, in "
        "turns, on one core.",
    )
    p.add_argument("--backend", metavar="A,B", help="simd, portable, portable_f32, hpipm_ocp, … (default: all)")
    p.add_argument("--steps", type=int, metavar="N", help="about so many recorded steps (default: all)")
    p.add_argument("--repeat", type=int, metavar="R", help="passes; the shortest time of a step counts (default: 2)")
    p.add_argument("--core", type=int, metavar="N", help="where to run (default: the last one)")
    p.add_argument("--weights", metavar="FILE", help="the net (default: the estimator's)")
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")
    p.add_argument("--details", metavar="FILE", help="write everything that was measured as JSON")
    p.add_argument("--doc", metavar="FILE.md", help="rewrite the table between the markers of this document")
    p.set_defaults(run=run_solver)


def run_solver(args) -> int:
    """Measure; returns the exit status."""
    from rt_runner.tool_process import option, run_tool

    names = ("backend", "steps", "repeat", "core", "weights", "json", "details", "doc")
    return run_tool("tools.bench_solver", [w for n in names for w in option(n, getattr(args, n))], args.debug)


def _add_loop(parts) -> None:
    p = parts.add_parser(
        "loop",
        help="our wake-up against cyclictest, a frame's round trip against a bare C echo",
        description="Wake-up latency of the estimator's loop against cyclictest, and frame in to estimate out against "
        "a bare C echo, on one core and bus, in turns, at several periods. Ratios with intervals.",
    )
    p.add_argument("--bus", metavar="auto|vcan0|can0|hub", help="default: vcan0 if it exists, else the hub")
    p.add_argument("--seconds", type=float, metavar="S", help="of each kind and period (default: 24)")
    p.add_argument("--periods", metavar="MS,MS", help="in ms (default: 100,10,1)")
    p.add_argument("--core", type=int, metavar="N", help="where to run (default: the last one)")
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON ('-': standard output)")
    p.add_argument("--doc", metavar="FILE.md", help="rewrite the table between the markers of this document")
    p.set_defaults(run=run_loop)


def run_loop(args) -> int:
    """Measure; returns the exit status."""
    from rt_runner.machine import check_core
    from rt_runner.tool_process import option, run_tool

    check_core(args.core)
    names = ("bus", "seconds", "periods", "core", "json", "doc")
    return run_tool("tools.bench_loop", [w for n in names for w in option(n, getattr(args, n))], args.debug)
