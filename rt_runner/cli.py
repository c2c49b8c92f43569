"""``rt-runner``: one verb per file in ``rt_runner.commands``; an error is one line and a non-zero exit status."""

import argparse
import importlib
import io
import os
import signal
import sys

from rt_runner.errors import RtError

VERBS = (
    "run", "mil", "inspect", "timing", "report", "replay", "dataset", "train", "evaluate", "compare",
    "compare_control", "bench", "vcan",
)  # fmt: skip


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        # Status 1: a usage error. argparse's own 2 means "timing failure" here.
        self.print_usage(sys.stderr)
        print(f"{self.prog}: {message}", file=sys.stderr)
        sys.exit(1)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line; nothing heavy is imported for it."""
    parser = _Parser(
        prog="rt-runner",
        description="Real-time runner over CAN: plant, estimator, logs you can trust.",
        epilog="exit status: 0 pass, 1 usage or set-up, 2 limits not met, 3 inconclusive",
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB", parser_class=_Parser)
    for verb in VERBS:
        importlib.import_module(f"rt_runner.commands.{verb}").add_parser(verbs)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    debug = False
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without a degree sign is no reason to fail
    try:
        args = build_parser().parse_args(argv)
        debug = args.debug
        return args.run(args)
    except RtError as e:
        if debug:
            raise
        print(f"rt-runner: {e}", file=sys.stderr)
        return e.exit_code
    except BrokenPipeError:  # `rt-runner inspect LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as e:  # a path nobody foresaw: too long, not searchable ...
        if debug:
            raise
        print(f"rt-runner: {e.filename or 'system'}: {e.strerror or e} (--debug shows where)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
