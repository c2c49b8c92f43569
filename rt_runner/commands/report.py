"""``rt-runner report``: one self-contained HTML page out of a log. The page is built by ``tools.report``, a process."""


def add_parser(verbs) -> None:
    """Add the verb."""
    p = verbs.add_parser(
        "report",
        help="a log as one HTML page: temperatures, errors, timing, frames",
        description="Draw a log as one HTML file that needs no network: figures, charts, tables.",
    )
    p.add_argument("log", metavar="LOG", help="an .mcap file, finished or not")
    p.add_argument("-o", "--out", metavar="OUT.html", help="default: beside the log")
    p.add_argument("--json", metavar="FILE", help="write the page's figures as JSON (- for standard output)")
    p.set_defaults(run=run)


def run(args) -> int:
    """Start the page builder; returns the exit status."""
    import os
    import subprocess
    import sys

    from rt_runner.errors import RtError
    from rt_runner.paths import ROOT

    command = [sys.executable, "-m", "tools.report"]
    command += ["-o", args.out] if args.out else []
    command += [*(["--json", args.json] if args.json else []), "--", args.log]
    # The tools lie beside this package, wherever the user stands.
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    done = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, check=False)
    words = done.stderr.strip().splitlines()
    if done.returncode == 0:
        if words:
            print("\n".join(words), file=sys.stderr)
        return 0
    if args.debug and words:
        print("\n".join(words), file=sys.stderr)
    raise RtError(words[-1] if words else f"the report builder ended with exit status {done.returncode} and no word")
