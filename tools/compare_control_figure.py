"""The lap under several controllers: winding temperature, speed lost against the reference, torque of the motor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from plant_sim.state import ROW_THETA_W, ROW_TORQUE, ROW_V, ROW_V_REF, ROW_X
from tools.compare_control_run import LIMIT_DEGC, drive
from tools.plots import save

FEEDBACK = "default"
POINTS = 900  # of a line: more are not seen and make the file large
COLOURS = {"none": "#7a7a7a", "rule-150-155": "#0072B2", "rule-145-160": "#56B4E9", "paper": "#CC79A7",
           "mpc-S": "#E69F00", "mpc-M": "#D55E00"}  # fmt: skip


def draw(folder: Path, controllers: Sequence[str], seconds: float, seed: int) -> Path:
    """Drive each controller's lap with the default estimator and draw it over the road; returns the file."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 1, figsize=(10.0, 8.0), sharex=True, layout="constrained")
    for name in controllers:
        rows = drive(name, FEEDBACK, (), seconds, seed).rows
        per = max(1, len(rows) // POINTS)
        count = len(rows) // per
        mean = rows[: count * per].reshape(count, per, -1).mean(axis=1)
        peak = rows[: count * per, ROW_THETA_W].reshape(count, per).max(axis=1)
        km, style = mean[:, ROW_X] / 1e3, {"color": COLOURS[name], "lw": 1.8 if name == "mpc-M" else 1.0, "label": name}
        axes[0].plot(km, peak, **style)
        axes[1].plot(km, _smooth(mean[:, ROW_V_REF] - mean[:, ROW_V], 9), **style)
        axes[2].plot(km, _smooth(np.maximum(mean[:, ROW_TORQUE], 0.0), 9), **style)
    axes[0].axhline(LIMIT_DEGC, color="#000000", lw=0.8, ls="--")
    for ax, label in zip(axes, ("winding θw, °C", "slower than wanted, m/s", "driving torque, N·m"), strict=True):
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    axes[0].legend(ncols=3, fontsize="small")
    axes[2].set_xlabel("way, km")
    path = folder / "control_lap.svg"
    save(figure, path)
    plt.close(figure)
    return path


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Moving average, for the eye."""
    return np.convolve(values, np.full(width, 1.0 / width), mode="same")
