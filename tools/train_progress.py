"""What a training run shows: a bar on a terminal, lines elsewhere, and afterwards its loss over the epochs."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from tools.train_fit import Progress


class ProgressLine:
    """A bar with the losses on a terminal; a line now and then elsewhere."""

    def __init__(self, epochs: int, stream: TextIO = sys.stdout, every_s: float = 10.0) -> None:
        self.epochs, self.stream, self.every_s, self.last_s = epochs, stream, every_s, -math.inf
        self.bar = None
        if stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (TextColumn("{task.completed:.0f}/{task.total:.0f}"), BarColumn(None))
            self.bar = Progress(
                *columns, TextColumn("{task.description}"), TimeRemainingColumn(), console=Console(file=stream)
            )
            self.task = self.bar.add_task("", total=epochs)
            self.bar.start()

    def __call__(self, p: Progress) -> None:
        best = f"score {p.score:.4f} (best {p.best_score:.4f})"
        if self.bar is not None:
            text = f"loss {p.loss:.5f}  {best}"
            self.bar.update(self.task, completed=p.epoch, description=text)
        elif p.elapsed_s - self.last_s >= self.every_s or p.epoch == self.epochs:
            self.last_s = p.elapsed_s
            print(
                f"epoch {p.epoch}/{self.epochs}  loss {p.loss:.5f}  validation w {p.val_w:.4f} r {p.val_r:.4f}"
                f"  {best}  {p.elapsed_s:.0f} s",
                file=self.stream,
                flush=True,
            )

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()


def draw_history(path: Path, history: Sequence[Progress], title: str) -> None:
    """Loss and validation over the epochs as a picture; the ending of `path` chooses the format.

    Raises
    ------
    ImportError
        matplotlib is absent (extra `train`).
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "rt"}):
        figure = Figure(figsize=(7.0, 3.6), layout="constrained")
        axes = figure.subplots()
        trained = [p for p in history if math.isfinite(p.loss)]
        axes.semilogy([p.epoch for p in trained], [math.sqrt(p.loss) for p in trained], lw=0.7, label="training")
        for label, pick in (("validation, winding", "val_w"), ("validation, rotor", "val_r")):
            axes.semilogy([p.epoch for p in history], [getattr(p, pick) for p in history], lw=0.9, label=label)
        best = min(history, key=lambda p: p.score)
        axes.plot(best.epoch, best.score, "k*", label=f"kept: epoch {best.epoch}")
        axes.set_xlabel("epoch")
        axes.set_ylabel("root of the mean square error\nin standard deviations of the rate")
        axes.set_title(title)
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(fontsize="small")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
