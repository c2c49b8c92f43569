"""Start one of the offline tools (``python -m tools.NAME``) for a verb of the command line."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence

from rt_runner.errors import RtError, SetupError
from rt_runner.paths import ROOT

EXTRA = {"torch": "train", "matplotlib": "train", "pyarrow": "train"}  # package -> extra that brings it
INTERRUPTED = 128 + signal.SIGINT
_MISSING = re.compile(r"ModuleNotFoundError: No module named '([A-Za-z0-9_]+)")


def run_tool(module: str, arguments: Sequence[str], debug: bool = False) -> int:
    """Run a tool to its end; its standard output is the user's. Returns 0, or 130 where Ctrl-C ended it.

    Ctrl-C reaches the tool, which decides what to keep; so does a request to terminate.

    Raises
    ------
    RtError
        The tool failed: its last line. SetupError where a package is missing, with the extra that brings it.
    """
    # The tools lie beside this package, wherever the user stands.
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    # Handlers, not SIG_IGN: those are reset in the tool, an ignored signal would stay ignored there.
    forward: list[subprocess.Popen[str]] = []
    before = {
        signal.SIGINT: signal.signal(signal.SIGINT, lambda *_: None),
        signal.SIGTERM: signal.signal(signal.SIGTERM, lambda *_: [p.terminate() for p in forward]),
    }
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments], env=environment, stderr=subprocess.PIPE, text=True
        )
        forward.append(process)
        words = (process.communicate()[1] or "").strip().splitlines()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if process.returncode in (0, INTERRUPTED) or debug:
        print("\n".join(words), end="\n" if words else "", file=sys.stderr)
    if process.returncode in (0, INTERRUPTED):
        return process.returncode
    missing = _MISSING.search(words[-1]) if words else None
    if missing is not None:
        name = missing.group(1)
        advice = f"pip install -e '.[{EXTRA[name]}]'" if name in EXTRA else "pip install -e ."
        raise SetupError(f"the package {name} is missing: {advice}")
    raise RtError(words[-1] if words else f"{module} ended with exit status {process.returncode} and no word")


def option(name: str, value: object) -> list[str]:
    """``--name=value``, or nothing where the user gave none; one word, so that a value may begin with a dash."""
    return [] if value is None else [f"--{name}={value}"]
