"""The paper's figures for every estimator: the whole lap, 140 to 165 °C, and two faults close up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tools.compare_cases import CHANNELS, Variant
from tools.compare_drives import Lap, drive_lap, sense
from tools.estimators.drive import run_each
from tools.estimators.registry import make
from tools.plots import outline, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
SEED = 0
POINTS = 500  # of a line: more are not seen and make the file large
TRUTH, RAW = "#000000", "#b8b8b8"
# Okabe and Ito's colours, told apart with any colour vision; dashes help where lines lie together.
STYLES: dict[str, dict[str, Any]] = {
    "default": {"color": "#D55E00", "lw": 1.6, "zorder": 6},
    "paper": {"color": "#0072B2", "lw": 1.0},
    "ekf": {"color": "#009E73", "lw": 1.0, "ls": (0, (5, 2))},
    "ukf": {"color": "#CC79A7", "lw": 1.0, "ls": (0, (2, 1.5))},
    "lptn-kf": {"color": "#E69F00", "lw": 1.0},
    "fixed-gain": {"color": "#56B4E9", "lw": 1.0, "ls": (0, (6, 1.5, 1, 1.5))},
    "open-loop": {"color": "#5d4a99", "lw": 1.0, "ls": (0, (1, 1))},
    "average": {"color": "#7a7a7a", "lw": 0.9, "ls": (0, (4, 1.5))},
}
OTHER: dict[str, Any] = {"color": "#8c564b", "lw": 1.0}


@dataclass(frozen=True)
class View:
    """One figure: which run, which seconds, and how far the axes reach (°C; None: all of it)."""

    file: str
    title: str
    variant: Variant
    from_s: float
    to_s: float
    theta_degc: tuple[float, float] | None
    error_degc: tuple[float, float]


NOMINAL = Variant("nominal")
OFFSET, NOISE = (Variant(text, (text,)) for text in ("offset:-20@430-550", "noise:5@430-550"))


def views(channel: str) -> tuple[View, ...]:
    """The four figures of a channel."""
    winding = channel == CHANNELS[0]
    zoom = (140.0, 168.0) if winding else (95.0, 125.0)
    low = (125.0, 172.0) if winding else (75.0, 132.0)
    return (
        View("lap", "the whole lap, nothing wrong", NOMINAL, 0.0, 1e9, None, (-3.5, 3.5)),
        View("zoom", "140 to 165 °C, nothing wrong", NOMINAL, 420.0, 560.0, zoom, (-2.5, 1.5)),
        View("offset", "offset −20 °C from 430 to 550 s", OFFSET, 415.0, 580.0, low, (-4.0, 4.0)),
        View("noise", "noise σ 5 °C from 430 to 550 s", NOISE, 415.0, 580.0, low, (-4.0, 4.0)),
    )


def draw(folder: Path, names: Sequence[str], channel: str) -> list[Path]:
    """Write estimator_*.svg (rotor: estimator_rotor_*.svg) of seed 0; returns the files."""
    lap, column = drive_lap(), CHANNELS.index(channel)
    shown = views(channel)
    variants = list(dict.fromkeys(view.variant for view in shown))
    drives = [sense(lap, SEED, variant.on(channel)) for variant in variants]
    raw = {v: drive.y[:, column] for v, drive in zip(variants, drives, strict=True)}
    found: dict[Variant, dict[str, Array]] = {v: {} for v in variants}
    for name in names:
        if name != "raw":
            for variant, estimates in zip(variants, run_each(make(name), drives), strict=True):
                found[variant][name] = estimates.theta_degc[:, column]
    prefix = "estimator" if channel == CHANNELS[0] else f"estimator_{channel}"
    paths = []
    for view in shown:
        path = folder / f"{prefix}_{view.file}.svg"
        _draw(path, view, lap, column, raw[view.variant], found[view.variant])
        paths.append(path)
    return paths


def _draw(path: Path, view: View, lap: Lap, column: int, raw: Array, found: dict[str, Array]) -> None:
    from matplotlib.figure import Figure

    name = ("winding θw", "rotor θr")[column]
    figure = Figure(figsize=(10.0, 6.6), layout="constrained", dpi=110)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    rows = np.flatnonzero((lap.t_s >= view.from_s) & (lap.t_s <= view.to_s))
    t_s, truth = lap.t_s[rows], lap.truth_degc[rows, column]

    def line(ax: Axes, y: Array, **style: Any) -> None:
        shown = outline(y, POINTS)
        ax.plot(t_s[shown], y[shown], **style)

    line(upper, raw[rows], color=RAW, lw=0.7, label="raw sensor", zorder=1)
    line(lower, raw[rows] - truth, color=RAW, lw=0.5, zorder=1)
    for key, theta in found.items():
        style = {"zorder": 4, **STYLES.get(key, OTHER)}
        line(upper, theta[rows], label=key, **style)
        line(lower, theta[rows] - truth, **style)
    line(upper, truth, color=TRUTH, lw=0.9, label="truth", zorder=7)
    lower.axhline(0.0, color=TRUTH, lw=0.8, zorder=5)
    if view.theta_degc is not None:
        upper.set_ylim(*view.theta_degc)
    lower.set_ylim(*view.error_degc)
    upper.set_ylabel(f"{name}, °C")
    lower.set_ylabel("estimate − truth, °C")
    lower.set_xlabel("time, s")
    if view.variant.window_s is not None:
        for ax in (upper, lower):
            ax.axvspan(*view.variant.window_s, color="#f3ecd8", lw=0, zorder=0)
    for ax in (upper, lower):
        _plain_axes(ax)
        ax.set_xlim(t_s[0], t_s[-1])
    figure.suptitle(f"{view.title} (seed {SEED})", fontsize=11)
    handles, labels = upper.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    save(figure, path)


def _plain_axes(ax: Axes) -> None:
    ax.grid(alpha=0.25, lw=0.5)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)
