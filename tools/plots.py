"""The paper's figures for our data and nets: distribution of both rates, predicted against actual, over time.

Written as SVG or PNG by the file name; the same figures give the same file.
"""

from __future__ import annotations

import importlib.util
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tools.files import write_whole
from tools.rows import DataError, Rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".svg", ".png")
ACTUAL, PREDICTED, ERROR = "#1f1f1f", "#d1495b", "#00798c"
RATE_NAMES = ("winding rate dθw/dt, °C/s", "rotor rate dθr/dt, °C/s")
THETA_NAMES = ("winding θw, °C", "rotor θr, °C")
_BINS = 120
Array = NDArray[np.float64]


def check_plot(path: Path) -> None:
    """Refuse, before any work is done, a plot that cannot be written.

    Raises
    ------
    DataError
        Unknown format, or matplotlib is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise DataError(f"--plot {path}: give a file name that ends in {' or '.join(FORMATS)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise DataError("--plot needs the package matplotlib: install the extra with pip install -e '.[train]'")


def plot_dataset(path: Path, rows: Rows, title: str) -> None:
    """Histograms of both rates, as in the paper, and of both temperatures with the range 150..160 °C marked."""
    figure, axes = _figure(2, 2, (10.0, 6.4), title)
    for i, ax in enumerate(axes[0]):
        rate = rows.rates_degc_s[:, i]
        ax.hist(rate, bins=_BINS, color=ERROR)
        ax.set_yscale("log")
        ax.set_xlabel(f"{RATE_NAMES[i]} (mean {rate.mean():.3f}, std {rate.std():.3f})")
        ax.set_ylabel("rows")
    for i, ax in enumerate(axes[1]):
        theta = rows.x[:, 2 + i]
        ax.hist(theta, bins=np.arange(np.floor(theta.min()), np.ceil(theta.max()) + 2.0, 2.0).tolist(), color=ERROR)
        ax.set_xlabel(THETA_NAMES[i])
        ax.set_ylabel("rows")
    hot = (rows.x[:, 2] >= 150.0) & (rows.x[:, 2] <= 160.0)
    axes[1, 0].axvspan(150.0, 160.0, color=PREDICTED, alpha=0.2, lw=0)
    axes[1, 0].set_title(f"150..160 °C: {hot.mean():.1%} of {len(hot)} rows", fontsize=9)
    save(figure, path)


def plot_evaluation(path: Path, t_s: Array, rows: Rows, rates: Array, theta: Array, title: str) -> None:
    """Predicted against actual rates, rates over time, and open-loop against true temperatures.

    Parameters
    ----------
    t_s : (N,)
        Time of the rows.
    rates, theta : (N, 2)
        What the net predicts one step ahead (°C/s), and where its own integration ends up (°C).
    """
    figure, axes = _figure(3, 2, (12.0, 11.0), title)
    for i in range(2):
        actual, predicted = rows.rates_degc_s[:, i], rates[:, i]
        ax = axes[0, i]
        ax.plot(actual, predicted, ".", ms=2, color=ERROR, alpha=0.4, rasterized=True)
        ends = [min(actual.min(), predicted.min()), max(actual.max(), predicted.max())]
        ax.plot(ends, ends, color=ACTUAL, lw=0.8)
        ax.set_xlabel(f"actual {RATE_NAMES[i]}")
        ax.set_ylabel("predicted")
        ax.set_aspect("equal", adjustable="datalim")
        ax = axes[1, i]
        _over_time(ax, t_s, actual, predicted, RATE_NAMES[i])
        ax = axes[2, i]
        _over_time(ax, t_s, rows.x[:, 2 + i], theta[:, i], f"{THETA_NAMES[i]}, open loop")
        ax.set_xlabel("time, s")
    save(figure, path)


def _over_time(ax: Axes, t_s: Array, actual: Array, predicted: Array, name: str) -> None:
    """Two lines and their difference on a scale of its own."""
    ax.plot(t_s, actual, color=ACTUAL, lw=1.0, label="actual")
    ax.plot(t_s, predicted, color=PREDICTED, lw=0.8, label="predicted")
    error = predicted - actual
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)  # room for the error below the lines
    right = ax.twinx()
    largest = max(float(np.abs(error).max()), 1e-9)
    right.plot(t_s, error, color=ERROR, lw=0.6, label="error (right axis)")
    right.axhline(0.0, color=ERROR, lw=0.4)
    right.set_ylim(-1.2 * largest, 9.0 * largest)
    right.set_yticks([-largest, 0.0, largest], [f"{-largest:.2g}", "0", f"{largest:.2g}"])
    right.tick_params(colors=ERROR, labelsize=7)
    ax.set_ylabel(name)
    handles = [*ax.get_lines(), right.get_lines()[0]]
    labels = [str(h.get_label()) for h in handles]
    ax.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=7, ncols=3, frameon=False)


def _figure(n_rows: int, n_columns: int, size: tuple[float, float], title: str) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", dpi=110)
    figure.suptitle(title, fontsize=11)
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    for ax in axes.flat:
        ax.grid(alpha=0.25, lw=0.5)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def outline(y: Array, points: int) -> NDArray[np.int64]:
    """Rows that draw the line y (n,) with about so many points: first and last, and each stretch's lowest and highest.

    No peak is lost, however few the points. NaN are passed over; a stretch of nothing else gives one, and a gap.
    """
    if len(y) <= points:
        return np.arange(len(y))
    rows = [np.array([0, len(y) - 1])]
    for stretch in np.array_split(np.arange(len(y)), max(1, points // 2 - 1)):
        values = y[stretch]
        found = np.isfinite(values)
        rows.append(stretch[[np.nanargmin(values), np.nanargmax(values)]] if found.any() else stretch[:1])
    return np.unique(np.concatenate(rows))


_PATH = re.compile(rb' d="[^"]*"')
_NUMBER = re.compile(rb"-?\d+\.\d{3,}")


def _compact(svg: bytes) -> bytes:
    """Each path on one line and in hundredths of a point, which nobody sees."""

    def short(number: re.Match[bytes]) -> bytes:
        return f"{float(number[0]):.2f}".encode()

    return _PATH.sub(lambda path: _NUMBER.sub(short, b" " + b" ".join(path[0].split())), svg)


def save(figure: Figure, path: Path) -> None:
    """Write the figure as its file's name says; the same figure gives the same bytes."""
    import matplotlib

    kind = path.suffix.lower().lstrip(".")
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "rt-runner"}):
        figure.savefig(buffer, format=kind, metadata={"Date": None} if kind == "svg" else {})
    write_whole(path, _compact(buffer.getvalue()) if kind == "svg" else buffer.getvalue())
