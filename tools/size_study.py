"""How large should the net be? Trains nets of several sizes with one budget; lap error against cost, one plot.

    python -m tools.size_study --data build/data/R.npz --lap build/data/lap.npz --out docs/figures/size_study

Writes OUT.json and OUT.svg and prints the table. A net once trained is kept in the cache folder and taken from there as
long as data and settings are the same. Cost is instructions per step of the generated C, counted by valgrind
(`tools.bench_net`); `--no-bench` counts multiply-adds instead.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import load_weights
from tools.evaluate import DataError, Rows, evaluate, load_rows
from tools.lstm_torch import write_document
from tools.train import document_of, fit
from tools.train_configs import TUNED, Settings
from tools.train_fit import Checkpoint
from tools.train_progress import ProgressLine

EPOCHS = 400


@dataclass(frozen=True)
class Shape:
    """A net by its cells."""

    cell: str
    hidden: int
    layers: int = 1

    @property
    def name(self) -> str:
        return f"{self.cell.upper()} {f'{self.layers}x' if self.layers > 1 else ''}{self.hidden}"

    @property
    def multiply_adds(self) -> int:
        """Products of one step: gates of every layer, and the output layer."""
        gates = {"lstm": 4, "gru": 3}[self.cell]
        inputs = [4] + [self.hidden] * (self.layers - 1)
        return sum(gates * self.hidden * (n + self.hidden) for n in inputs) + 2 * self.hidden


SHAPES = (
    Shape("lstm", 4),
    Shape("gru", 8),
    Shape("lstm", 8),
    Shape("lstm", 8, layers=2),
    Shape("lstm", 16),
    Shape("lstm", 32),
)


@dataclass(frozen=True)
class Result:
    """One net of the study: errors on the lap in %, °C; instructions, None where not counted."""

    name: str
    multiply_adds: int
    validation: float
    nrmse_w: float
    nrmse_r: float
    open_loop_max_degc_w: float
    open_loop_max_degc_r: float
    step_instructions: int | None
    mhe_instructions: int | None


def settings_of(shape: Shape, epochs: int, seed: int) -> Settings:
    """The tuned configuration, every net with the same number of epochs."""
    return dataclasses.replace(
        TUNED, cell=shape.cell, hidden=shape.hidden, layers=shape.layers, epochs=epochs, seed=seed
    )


def trained(shape: Shape, rows: Rows, cache: Path, epochs: int, seed: int, say: Callable[[str], None]) -> Path:
    """Weights file of a net of this shape: from the cache, or trained now; an interrupted training goes on."""
    settings = settings_of(shape, epochs, seed)
    path = cache / f"{shape.cell}{shape.layers}x{shape.hidden}-{epochs}-{seed}.json"
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        made = {f.name: found["training"].get(f.name) for f in dataclasses.fields(Settings)}
        if found["data_sha256"] == rows.sha256 and made == dataclasses.asdict(settings):
            say(f"{shape.name}: taken from {path}")
            return path
    say(f"{shape.name}: {epochs} epochs")
    kept = path.with_suffix(".checkpoint")
    line = ProgressLine(epochs)
    try:
        try:
            result = fit(rows, settings, report=line, checkpoint=Checkpoint(kept, resume=kept.exists()))
        except DataError:  # of another study
            result = fit(rows, settings, report=line, checkpoint=Checkpoint(kept))
    finally:
        line.close()
    if result.ended != "complete":
        raise KeyboardInterrupt
    write_document(path, document_of(result, rows, None, settings))
    return path


def instructions(path: Path) -> tuple[int | None, int | None]:
    """Instructions per step of the net and per step of the estimator, in C.

    Raises
    ------
    DataError
        The benchmark failed.
    """
    command = [sys.executable, "-m", "tools.bench_net", "--weights", str(path), "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise DataError(f"no count of instructions for {path}: {reason}; mend that, or give --no-bench")
    figures = json.loads(done.stdout[done.stdout.index("{") :])
    return _count(figures, "forward_instructions"), _count(figures, "mhe_step_instructions")


def _count(figures: dict[str, Any], name: str) -> int | None:
    return round(figures[name]) if figures.get(name) is not None else None


def judge(shape: Shape, path: Path, lap: Rows, bench: bool) -> Result:
    """Errors of a trained net on the lap, and what a step of it costs."""
    figures = evaluate(load_weights(path), lap)
    document = json.loads(path.read_text(encoding="utf-8"))
    held = document["metrics"]["validation"]
    scales = [port["scale"] for port in document["outputs"]]
    squares = [(held[f"rmse_degc_s_{c}"] / scale) ** 2 for c, scale in zip("wr", scales, strict=True)]
    step, mhe = instructions(path) if bench else (None, None)
    return Result(
        shape.name,
        shape.multiply_adds,
        (sum(squares) / 2) ** 0.5,
        100 * figures["nrmse_w"],
        100 * figures["nrmse_r"],
        figures["open_loop_max_degc_w"],
        figures["open_loop_max_degc_r"],
        step,
        mhe,
    )


def table(results: Sequence[Result]) -> str:
    """The study as a Markdown table."""
    lines = [
        "| net | multiply-adds | instructions per step | per estimate | validation | NRMSE, % | open loop, °C |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in results:
        step = "–" if r.step_instructions is None else f"{r.step_instructions}"
        mhe = "–" if r.mhe_instructions is None else f"{r.mhe_instructions}"
        lines.append(
            f"| {r.name} | {r.multiply_adds} | {step} | {mhe} | {r.validation:.4f} | {r.nrmse_w:.2f} / {r.nrmse_r:.2f}"
            f" | {r.open_loop_max_degc_w:.1f} / {r.open_loop_max_degc_r:.1f} |"
        )
    return "\n".join(lines)


def draw(path: Path, results: Sequence[Result], epochs: int) -> None:
    """Lap error against cost, both channels in one picture."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    counted = all(r.step_instructions is not None for r in results)
    cost = [r.step_instructions if counted and r.step_instructions else r.multiply_adds for r in results]
    with rc_context({"svg.hashsalt": "rt"}):
        figure = Figure(figsize=(7.0, 4.0), layout="constrained")
        axes = figure.subplots()
        for label, marker, pick in (("winding", "o", "nrmse_w"), ("rotor", "s", "nrmse_r")):
            axes.plot(cost, [getattr(r, pick) for r in results], marker, label=label)
        for x, r in zip(cost, results, strict=True):
            axes.plot((x, x), (r.nrmse_w, r.nrmse_r), color="0.7", lw=0.8, zorder=0)
            axes.annotate(
                r.name,
                (x, max(r.nrmse_w, r.nrmse_r)),
                (0, 7),
                textcoords="offset points",
                ha="right" if r.name == "LSTM 2x8" else "center",
            )
        axes.set_xscale("log")
        axes.set_ylim(0.0, 1.2 * max(max(r.nrmse_w, r.nrmse_r) for r in results))
        axes.margins(x=0.12)
        axes.set_xlabel("instructions per step of the generated C" if counted else "multiply-adds per step")
        axes.set_ylabel("NRMSE on the unseen lap, %")
        axes.set_title(f"{epochs} epochs each")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; errors are one line on stderr and exit code 1."""
    parser = argparse.ArgumentParser(prog="python -m tools.size_study", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("build/data/R.npz"), help="default %(default)s")
    parser.add_argument("--lap", type=Path, default=Path("build/data/lap.npz"), help="default %(default)s")
    parser.add_argument("--cache", type=Path, default=Path("build/size_study"), help="default %(default)s")
    parser.add_argument("--out", type=Path, default=Path("build/size_study/study"), help="default %(default)s")
    parser.add_argument("--epochs", type=int, default=EPOCHS, help="of every net, default %(default)s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="names out of the table, with commas between, such as 'LSTM 8,GRU 8'")
    parser.add_argument("--no-bench", action="store_true", help="count multiply-adds, not instructions")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    try:
        shapes = _chosen(args.only)
        rows, lap = load_rows(args.data), load_rows(args.lap)
        results = []
        for shape in shapes:
            path = trained(shape, rows, args.cache, args.epochs, args.seed, lambda text: print(text, flush=True))
            results.append(judge(shape, path, lap, not args.no_bench))
        draw(args.out.with_suffix(".svg"), results, args.epochs)
        text = {"epochs": args.epochs, "seed": args.seed, "data_sha256": rows.sha256, "lap_sha256": lap.sha256}
        text["nets"] = [dataclasses.asdict(r) for r in results]
        args.out.with_suffix(".json").write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
    except (DataError, FormulationError) as error:
        print(f"size_study: {error}", file=sys.stderr)
        return 1
    except ImportError as error:
        print(f"size_study: {error}; pip install -e '.[train]'", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("size_study: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    print(table(results))
    return 0


def _chosen(only: str | None) -> list[Shape]:
    names = [shape.name for shape in SHAPES]
    wanted = names if only is None else [name.strip() for name in only.split(",")]
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise DataError(f"--only: no net {', '.join(unknown)}; there are {', '.join(names)}")
    return [shape for shape in SHAPES if shape.name in wanted]


if __name__ == "__main__":
    sys.exit(main())
