"""Build training data from the plant: data set R (recommended), P (the paper's protocol), and the test lap.

``rt-runner dataset --set R --seed 1 --out build/data/R.npz``, or ``python -m tools.dataset`` with the same options,
writes the set; the lap goes beside it as ``lap.npz``. Rows are 10-Hz intervals: mean speed and torque over the
interval, temperatures at its start, forward-difference rates. The same seed gives the same bytes, in one go or
interrupted: finished drives wait in ``FILE.parts`` until the set is complete.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from plant_sim.errors import PlantError
from plant_sim.params import PlantParams, load_params
from tools import dataset_figures
from tools.dataset_recipe import CYCLE_S, LAP_S, RECIPES, Chain, Kind, Recipe, drive, lap_rows
from tools.dataset_store import DriveStore, fingerprint
from tools.files import write_json, write_whole
from tools.rows import COLUMNS, DataError, Rows, hash_of, rows_from

__all__ = ["COLUMNS", "RECIPES", "DataSet", "Recipe", "build_lap", "build_set", "hot_share", "main", "write_npz"]

Report = Callable[[int, int, str], None]  # finished drives, all drives, a line about the last one


@dataclass(frozen=True, eq=False)
class DataSet:
    """Rows (N, 6) of many trajectories in order; ``trajectory`` tells which row belongs to which run."""

    values: NDArray[np.float64]
    trajectory: NDArray[np.int32]

    @property
    def sha256(self) -> str:
        """Hash over the rows (little-endian float64, row by row, then the trajectory numbers)."""
        return hash_of(self.values, self.trajectory)

    @property
    def rows(self) -> Rows:
        """The same as the trainer and the evaluation take it."""
        return rows_from(self.values, self.trajectory)

    def column(self, name: str) -> NDArray[np.float64]:
        """One column by name."""
        return self.values[:, COLUMNS.index(name)]

    def arrays(self) -> dict[str, Any]:
        """Everything that the file holds; ``t_s`` counts from the start of each trajectory."""
        changes = np.flatnonzero(np.diff(self.trajectory, prepend=-1))
        start = np.repeat(changes, np.diff(np.append(changes, self.trajectory.size)))
        out: dict[str, Any] = {name: self.column(name).copy() for name in COLUMNS}
        return out | {
            "t_s": (np.arange(self.trajectory.size) - start) * 0.1,
            "trajectory": self.trajectory,
            "sha256": np.array(self.sha256),
        }


def build_set(
    params: PlantParams,
    name: str,
    seed: int,
    report: Report = lambda done, of, text: None,
    store: DriveStore | None = None,
) -> DataSet:
    """Build data set R or P; the same seed gives the same rows, with or without a store to go on from.

    Raises
    ------
    PlantError
        If a drive ended early or produced a value that is not finite.
    """
    recipe = RECIPES[name]
    blocks: list[NDArray[np.float64]] = []
    chains: dict[Kind, Chain] = {}
    fresh: set[Kind] = set()  # kinds with a drive simulated now: what the store holds after it is not its successor
    for number, (kind, k) in enumerate(recipe.drives):
        kept = store.load(number) if store is not None and kind not in fresh else None
        if kept is None:
            fresh.add(kind)
            before = chains[kind] if k > 0 else Chain.begin(kind, seed)
            rows, chains[kind] = drive(params, recipe, seed, kind, k, before)
            _check(rows, f"data set {name}, seed {seed}, trajectory {number}", CYCLE_S if kind == "road" else LAP_S)
            if store is not None:
                store.save(number, rows, chains[kind])
        else:
            rows, chains[kind] = kept
        blocks.append(rows)
        verb = "kept" if kept is not None else "driven"
        theta = rows[:, COLUMNS.index("theta_w_degc")]
        report(
            number + 1,
            len(recipe.drives),
            f"{kind} {k + 1}, {rows.shape[0]} rows {verb}, winding {theta.min():.0f}..{theta.max():.0f} °C",
        )
    labels = [np.full(len(rows), i, dtype=np.int32) for i, rows in enumerate(blocks)]
    return DataSet(np.concatenate(blocks), np.concatenate(labels))


def _check(rows: NDArray[np.float64], what: str, duration_s: int) -> None:
    if rows.shape[0] != duration_s * 10 or not np.isfinite(rows).all():
        raise PlantError(
            f"{what}: {rows.shape[0]} rows instead of {duration_s * 10}, or not finite; change the seed and "
            f"report the defect"
        )


def build_lap(params: PlantParams) -> DataSet:
    """Drive the synthetic test lap, underated, from 60 °C; never part of a training set."""
    block = lap_rows(params)
    return DataSet(block, np.zeros(block.shape[0], dtype=np.int32))


def hot_share(data: DataSet) -> float:
    """Share of rows with the winding at 150..160 °C."""
    return dataset_figures.hot_share(data.column("theta_w_degc"))


def write_npz(path: Path, data: DataSet) -> None:
    """Write a data set so that a reader never sees half a file; the same rows give the same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **data.arrays())
    write_whole(path, buffer.getvalue())


@contextlib.contextmanager
def progress(title: str, stream: TextIO) -> Iterator[Report]:
    """A bar on a terminal, a line per drive elsewhere."""
    if not stream.isatty():
        yield lambda done, of, text: print(f"{title}: {done}/{of}, {text}", file=stream, flush=True)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[text]}"), console=Console(file=stream)) as bar:
        task = bar.add_task(title, total=None, text="")
        yield lambda done, of, text: bar.update(task, completed=done, total=of, text=text)


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="rt-runner dataset", description="Build a training data set and the test lap from the plant."
    )
    add_options(parser)
    return parser.parse_args(argv)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("--set", choices=sorted(RECIPES), default="R", help="R: cycles, tracks; P: hot cycles; R-hot")
    parser.add_argument("--seed", type=int, default=1, help="default %(default)s")
    parser.add_argument("--out", type=Path, help="file to write; lap.npz goes beside it (default: build/data/SET.npz)")
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON (-: standard output)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="histograms of both rates, .svg or .png")


def main(argv: list[str] | None = None) -> int:
    """Command line entry."""
    args = parse(argv)
    out: Path = args.out or Path("build") / "data" / f"{args.set}.npz"
    parts = out.with_name(f"{out.name}.parts")
    shown = sys.stderr if args.json == "-" else sys.stdout
    try:
        if args.seed < 0:
            raise DataError(f"--seed {args.seed}: give a whole number from 0 on")
        if args.plot is not None:
            from tools.plots import check_plot

            check_plot(args.plot)
        params = load_params()
        with DriveStore(parts, fingerprint(params, RECIPES[args.set], args.seed)) as store:
            with progress(f"set {args.set}, seed {args.seed}", shown) as report:
                data = build_set(params, args.set, args.seed, report, store)
            write_npz(out, data)
            store.remove()
        lap = build_lap(params)
        write_npz(out.with_name("lap.npz"), lap)
        figures = {"set": args.set, "seed": args.seed, "file": str(out), **dataset_figures.describe(data.rows)}
        if args.plot is not None:
            from tools.plots import plot_dataset

            plot_dataset(args.plot, data.rows, f"data set {args.set}, seed {args.seed}")
        write_json(args.json, figures)
    except (PlantError, DataError) as error:
        print(f"dataset: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"dataset: {error.filename or out}: {error.strerror}; make room or choose another --out", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"dataset: stopped; what is finished waits in {parts}: the same command goes on from it", file=sys.stderr)
        return 130
    print(dataset_figures.table(figures), file=shown)
    print(file=shown)
    for path, of in ((out, data), (out.with_name("lap.npz"), lap)):
        theta = of.column("theta_w_degc")
        print(
            f"{path}: {len(of.values)} rows, {hot_share(of):.1%} at 150..160 °C, winding max {theta.max():.1f} °C, "
            f"sha256 {of.sha256}",
            file=shown,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
