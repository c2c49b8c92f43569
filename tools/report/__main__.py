"""`python -m tools.report LOG -o OUT.html [--json FILE]`: write the page; one line on trouble, exit status 1."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rt_runner.errors import RtError, UsageError
from rt_runner.present import write_json
from tools.report.page import build_page, figures
from tools.report.read import read_report


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(prog="rt-runner report", description="One self-contained HTML page out of a log.")
    parser.add_argument("log", type=Path, metavar="LOG")
    parser.add_argument("-o", "--out", type=Path, metavar="OUT.html", help="default: beside the log")
    parser.add_argument("--json", metavar="FILE", help="write the page's figures as JSON (- for standard output)")
    args = parser.parse_args(argv)
    try:
        make_report(args.log, args.out or args.log.with_suffix(".html"), args.json)
    except RtError as e:
        print(e, file=sys.stderr)
        return e.exit_code
    return 0


def make_report(log: Path, out: Path, json_file: str | None) -> None:
    """Read `log`, write the page to `out` (replaced whole or not at all) and its figures to `json_file`.

    Raises
    ------
    RtError : the log cannot be read, or a file not be written (one line)
    """
    if out.resolve() == log.resolve():
        raise UsageError(f"{out}: is the log itself; give another file with -o")
    data = read_report(log)
    page = build_page(data).encode()
    try:
        part = out.with_name(out.name + ".part")
        part.write_bytes(page)
        part.replace(out)
    except OSError as e:
        raise UsageError(f"cannot write the report {out}: {e.strerror}; give another file with -o") from None
    write_json({**figures(data), "page": str(out), "page_bytes": len(page)}, json_file)
    verdict = data.result.get("verdict", "none")
    print(
        f"report: {out}, {len(page) / 1e6:.2f} MB, verdict {verdict}",
        file=sys.stderr if json_file == "-" else sys.stdout,
    )


if __name__ == "__main__":
    sys.exit(main())
