"""Every estimator over every fault, model in the loop: one table, one JSON document, the figures of docs/estimator.md.

    rt-runner compare [--seeds 3] [--estimators default,ekf] [--cases nominal,offset] [--channel winding|rotor]
                      [--json FILE] [--doc FILE.md] [--figures DIR]

The plant drives the lap once (and once per plant mismatch); each seed's sensor noise, with and without faults, is put
on top, quantised as the bus does, and run through the C core and the baselines. No clock, no bus, no frames: a test
shows that the estimates are those of `rt-runner mil`, to the last bit.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from plant_sim.errors import PlantError
from rt_runner.errors import RtError
from tools import compare_table
from tools.compare_cases import CHANNELS, UnknownCase, chosen
from tools.compare_run import Done, WorkerDied, compare
from tools.estimators.registry import COMPARED, UnknownEstimator, make
from tools.files import write_json, write_whole
from tools.rows import DataError

SEEDS_MAX = 1000


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry."""
    args = _parse(argv)
    shown = sys.stderr if args.json == "-" else sys.stdout
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # asked to end: as by Ctrl-C, workers and all
    try:
        _check(args)
        begun = time.monotonic()
        names, cases = _names(args.estimators) or list(COMPARED), chosen(_names(args.cases))
        for name in names:
            make(name)
        with _progress(shown) as done:
            found = compare(names, cases, args.seeds, args.channel, done, args.workers)
        print(compare_table.plain(found, cases, args.seeds, args.channel), file=shown)
        print(f"{time.monotonic() - begun:.0f} s", file=shown)
        write_json(args.json, found)
        _document(args, found, cases, names, shown)
    except (UnknownEstimator, UnknownCase, DataError, PlantError, RtError, WorkerDied) as error:
        print(f"compare: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"compare: {error.filename}: {error.strerror}; choose another file", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("compare: stopped, nothing is written", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="rt-runner compare", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="noise seeds 0 … N - 1 (default %(default)s)")
    parser.add_argument("--estimators", help=f"names with commas between (default: {','.join(COMPARED)})")
    parser.add_argument("--cases", help="names with commas between (default: all)")
    parser.add_argument("--channel", choices=CHANNELS, default=CHANNELS[0], help="which sensor has the faults")
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--doc", type=Path, metavar="FILE", help="rewrite the table between the file's markers")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="write estimator_*.svg there")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    return parser.parse_args(argv)


def _check(args: argparse.Namespace) -> None:
    if not 1 <= args.seeds <= SEEDS_MAX:
        raise DataError(f"--seeds {args.seeds}: give 1 to {SEEDS_MAX}")
    if args.workers is not None and args.workers < 1:
        raise DataError(f"--workers {args.workers}: give 1 or more")
    if args.doc is not None:
        compare_table.check_document(args.doc)
    if args.figures is not None:
        from tools.plots import check_plot

        check_plot(args.figures / "estimator_lap.svg")


def _names(text: str | None) -> list[str] | None:
    """Names of a list with commas; each once."""
    if text is None:
        return None
    names = list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not names:
        raise DataError("an empty list of names: leave the option out for all")
    return names


def _document(
    args: argparse.Namespace, found: dict[str, Any], cases: Sequence[Any], names: Sequence[str], shown: TextIO
) -> None:
    """Table and figures for the documentation."""
    if args.doc is not None:
        tables = compare_table.markdown(found, cases, args.seeds, args.channel)
        write_whole(args.doc, compare_table.inserted(args.doc, tables).encode())
        print(f"{args.doc}: table rewritten", file=shown)
    if args.figures is not None:
        from tools.compare_figures import draw

        for path in draw(args.figures, names, args.channel):
            print(path, file=shown)


@contextlib.contextmanager
def _progress(stream: TextIO) -> Iterator[Done]:
    """A bar on a terminal, nothing elsewhere."""
    if not stream.isatty():
        yield lambda done, of, text: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[text]}"), console=Console(file=stream), transient=True) as bar:
        task = bar.add_task("runs", total=None, text="the lap, and what is compiled once")
        yield lambda done, of, text: bar.update(task, completed=done, total=of, text=text)


if __name__ == "__main__":
    sys.exit(main())
