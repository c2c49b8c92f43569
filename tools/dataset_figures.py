"""Figures of a data set: shares by temperature, ranges, and where in speed and torque the rows lie."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.rows import COLUMNS, Rows

WINDING_BANDS_DEGC = (-np.inf, 60.0, 80.0, 100.0, 120.0, 140.0, 150.0, 160.0, np.inf)
ROTOR_BANDS_DEGC = (-np.inf, 60.0, 90.0, 120.0, 140.0, np.inf)
SPEED_EDGES_RPM = (0.0, 2000.0, 4000.0, 6000.0, 8000.0, 10000.0, np.inf)
TORQUE_EDGES_NM = (-np.inf, -40.0, -5.0, 5.0, 40.0, 80.0, 120.0, np.inf)
QUANTILES = (0.001, 0.05, 0.5, 0.95, 0.999)
Array = NDArray[np.float64]


def hot_share(theta_w_degc: Array) -> float:
    """Share of rows with the winding at 150..160 °C."""
    return float(np.mean((theta_w_degc >= 150.0) & (theta_w_degc <= 160.0)))


def describe(rows: Rows) -> dict[str, Any]:
    """All figures, ready for JSON; shares sum to 1, an open end of a band is None."""
    values = dict(zip(COLUMNS, np.column_stack([rows.x, rows.rates_degc_s]).T, strict=True))
    hits = np.histogram2d(
        np.maximum(values["n_rpm"], 0.0),
        values["torque_nm"],
        bins=[_finite(SPEED_EDGES_RPM), _finite(TORQUE_EDGES_NM)],
    )[0]
    return {
        "rows": len(rows.x),
        "trajectories": len(np.unique(rows.trajectory)),
        "sha256": rows.sha256,
        "share_150_160": hot_share(values["theta_w_degc"]),
        "share_theta_w": _shares(values["theta_w_degc"], WINDING_BANDS_DEGC),
        "share_theta_r": _shares(values["theta_r_degc"], ROTOR_BANDS_DEGC),
        "range": {
            name: {
                "min": float(v.min()),
                "max": float(v.max()),
                "mean": float(v.mean()),
                "std": float(v.std()),
                **{f"p{100 * q:g}": float(x) for q, x in zip(QUANTILES, np.quantile(v, QUANTILES), strict=True)},
            }
            for name, v in values.items()
        },
        "coverage": {
            "speed_edges_rpm": _open(SPEED_EDGES_RPM),
            "torque_edges_nm": _open(TORQUE_EDGES_NM),
            "share": (hits / len(rows.x)).tolist(),
        },
    }


def table(figures: dict[str, Any]) -> str:
    """The figures as lines for a terminal."""
    lines = [f"{'':18s}{'min':>10s}{'5 %':>10s}{'median':>10s}{'95 %':>10s}{'max':>10s}{'std':>10s}"]
    for name, r in figures["range"].items():
        digits = 1 if name in COLUMNS[:4] else 3
        cells = (r["min"], r["p5"], r["p50"], r["p95"], r["max"], r["std"])
        lines.append(f"{name:18s}" + "".join(f"{value:10.{digits}f}" for value in cells))
    for key, title in (("share_theta_w", "winding, °C"), ("share_theta_r", "rotor, °C")):
        bands = figures[key]
        lines += ["", f"{title:18s}" + "".join(f"{_band(b['from'], b['to']):>10s}" for b in bands)]
        lines.append(f"{'share of rows, %':18s}" + "".join(f"{100 * b['share']:10.1f}" for b in bands))
    c = figures["coverage"]
    torque, speed = c["torque_edges_nm"], c["speed_edges_rpm"]
    bands = (_band(*torque[i : i + 2]) for i in range(len(torque) - 1))
    lines += ["", f"{'% of rows, Nm ->':18s}" + "".join(f"{band:>10s}" for band in bands)]
    for i, row in enumerate(c["share"]):
        lines.append(f"{_band(*speed[i : i + 2]) + ' rpm':18s}" + "".join(f"{100 * share:10.2f}" for share in row))
    return "\n".join(lines)


def _shares(values: Array, edges: tuple[float, ...]) -> list[dict[str, float | None]]:
    counts = np.histogram(values, bins=_finite(edges))[0] / values.size
    ends = _open(edges)
    return [{"from": ends[i], "to": ends[i + 1], "share": float(c)} for i, c in enumerate(counts)]


def _finite(edges: tuple[float, ...]) -> Array:
    return np.clip(edges, -1e9, 1e9)


def _open(edges: tuple[float, ...]) -> list[float | None]:
    return [float(e) if np.isfinite(e) else None for e in edges]


def _band(low: float | None, high: float | None) -> str:
    if low is None:
        return f"< {high:g}"
    return f">= {low:g}" if high is None else f"{low:g}..{high:g}"
