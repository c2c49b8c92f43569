"""Train the thermal net on a data set of the plant, or any table of a drive, and write its weights as text.

    rt-runner train --data build/data/R.npz --out net.json [--config paper|tuned]      (or python -m tools.train)

The configuration `paper`, the default, is the paper's Algorithm 1 with its table of settings; `tuned` made the
committed net. Every setting has an option of its own. Whole trajectories are held out; the net that does best on them
is kept. The test lap is never trained or selected on: its figures are computed once, for the file. Ctrl-C stops early
and keeps the best so far; `--resume` goes on where a run was stopped and ends with the same bits as one never stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.weights import LstmWeights, load_weights
from tools.envelope import envelope_of
from tools.evaluate import DataError, Rows, evaluate, load_rows, table
from tools.lstm_torch import weights_document, write_document
from tools.train_configs import CHOICES, CONFIGS, Settings
from tools.train_fit import Checkpoint, Fit, Progress, fit
from tools.train_progress import ProgressLine, draw_history

__all__ = ["Fit", "Progress", "ProgressLine", "as_read", "document_of", "fit", "main"]


def as_read(document: dict) -> LstmWeights:
    """The net as the C generator's strict reader sees it: what is measured is what is embedded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.json"
        write_document(path, document)
        return load_weights(path)


def document_of(result: Fit, rows: Rows, lap: Rows | None, s: Settings) -> dict[str, Any]:
    """Weights document of a fit, with what made it and, if a lap is given, how it does there."""
    document = weights_document(result.net, result.scaling, s.dt_s)
    scale_w, scale_r = result.scaling.out_scale
    metrics: dict[str, object] = {
        "validation": {
            "rmse_degc_s_w": result.best.val_w * scale_w,
            "rmse_degc_s_r": result.best.val_r * scale_r,
            "trajectories": list(result.validation),
        }
    }
    if lap is not None:
        metrics["lap"] = evaluate(as_read(document), lap)
        metrics["lap_sha256"] = lap.sha256
    envelope = envelope_of(rows)  # what the estimator's watch over its inputs is made from
    if envelope is not None:
        document["envelope"] = envelope
    document["data_sha256"] = rows.sha256
    document["training"] = {
        **dataclasses.asdict(s),
        "rows": len(rows.x),
        "best_epoch": result.best.epoch,
        "ended": result.ended,
        "optimizer": "adam",
        "torch": torch.__version__,
    }
    document["metrics"] = metrics
    return document


def parse(argv: Sequence[str] | None) -> tuple[argparse.Namespace, Settings]:
    """Options, and the settings: the named configuration with what was given in its place."""
    parser = argparse.ArgumentParser(prog="python -m tools.train", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set of tools.dataset, or a table of drives")
    parser.add_argument("--lap", type=Path, help="the test lap, for the figures in the weights file")
    parser.add_argument("--out", type=Path, required=True, help="weights file to write")
    parser.add_argument("--config", choices=sorted(CONFIGS), default="paper", help="default %(default)s")
    parser.add_argument("--resume", action="store_true", help="go on with a run that was stopped (OUT.checkpoint)")
    parser.add_argument("--start", type=Path, help="begin with this weights file instead of with random weights")
    parser.add_argument("--budget-s", type=float, default=math.inf, help="stop after this time and keep the best")
    parser.add_argument("--plot", type=Path, help="where the loss over the epochs is drawn; default OUT.loss.svg")
    parser.add_argument("--no-plot", action="store_true", help="draw nothing")
    parser.add_argument("--threads", type=int, default=1)
    group = parser.add_argument_group("settings, in place of the configuration's")
    own = [f for f in dataclasses.fields(Settings) if f.name != "config"]
    for field in own:
        values = "|".join(dict.fromkeys(str(getattr(c, field.name)) for c in CONFIGS.values()))
        group.add_argument(
            "--" + field.name.replace("_", "-"),
            type=_flag if isinstance(field.default, bool) else type(field.default),
            choices=CHOICES.get(field.name),
            help=f"({'|'.join(CONFIGS)}: {values})" if "|" in values else f"({values})",
        )
    args = parser.parse_args(argv)
    given = {f.name: getattr(args, f.name) for f in own if getattr(args, f.name) is not None}
    return args, dataclasses.replace(CONFIGS[args.config], **given)


def _flag(text: str) -> bool:
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"must be true or false, is {text!r}")
    return text == "true"


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; errors are one line on stderr and exit code 1."""
    args, settings = parse(argv)
    torch.set_num_threads(args.threads)
    line: ProgressLine | None = None
    try:
        rows = load_rows(args.data)
        lap = load_rows(args.lap) if args.lap else None
        start = load_weights(args.start) if args.start else None
        checkpoint = Checkpoint(args.out.with_name(args.out.name + ".checkpoint"), args.resume)
        line = ProgressLine(settings.epochs)
        result = fit(rows, settings, args.budget_s, line, start, checkpoint)
        line.close()
        document = document_of(result, rows, lap, settings)
        write_document(args.out, document)
    except (DataError, FormulationError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"train: {error.filename}: {error.strerror}; give a place that can be written", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("train: stopped before the first validation, nothing written", file=sys.stderr)
        return 130
    finally:
        if line is not None:
            line.close()
    print(f"{args.out}: {result.ended}, best epoch {result.best.epoch}, {result.elapsed_s:.0f} s")
    if result.ended != "complete":
        print("the same command with --resume goes on from here")
    if lap is not None:
        print(table(document["metrics"]["lap"]))
    if not args.no_plot:
        plot = args.plot or args.out.with_suffix(".loss.svg")
        try:
            draw_history(plot, result.history, f"{args.out.stem}: configuration {settings.config}, {result.ended}")
            print(f"{plot}: loss over the epochs")
        except ImportError:
            print("train: no loss plot without matplotlib: pip install -e '.[train]'", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
