"""What slices say: quantiles, ratios with an interval from a bootstrap over slices, and what noise alone gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tools.bench_loop_slices import Floats, Kind, Slice

DRAWS = 400
WAKE_LIMIT, RESPONSE_LIMIT, FRAME_LIMIT_US = 1.15, 3.0, 150.0
TARGET_PERIOD_MS = 10.0
MIN_SLICES = 4  # fewer give no interval worth the name
STOLEN = ("grid", "cyclictest")
_SHOWN = (("p50", 50.0), ("p99", 99.0))


def quantile(samples: Floats, percent: float) -> float | None:
    """Nearest rank; None where there are too few samples for it."""
    if samples.size * (1.0 - percent / 100.0) < 1.0:
        return None
    return float(np.quantile(samples, percent / 100.0, method="inverted_cdf"))


def describe(samples: Floats) -> dict[str, float | int | None]:
    """Count, quantiles and maximum in us."""
    out: dict[str, float | int | None] = {"count": int(samples.size)}
    for name, percent in _SHOWN:
        value = quantile(samples, percent)
        out[name] = None if value is None else round(value, 3)
    out["max"] = round(float(samples.max()), 3) if samples.size else None
    return out


def ratio(ours: Sequence[Floats], theirs: Sequence[Floats], percent: float, rng: np.random.Generator) -> dict[str, Any]:
    """Ratio of one quantile, its 95 % interval, and the interval of a ratio that is truly 1 on this machine.

    The slices are drawn again with replacement, not the samples: neighbours in time are alike. ``noise``: their slices
    against as many of their own.
    """

    def drawn(slices: Sequence[Floats]) -> float | None:
        return quantile(np.concatenate([slices[i] for i in rng.integers(len(slices), size=len(slices))]), percent)

    def many(over: Sequence[Floats], under: Sequence[Floats]) -> list[float] | None:
        pairs = [(drawn(over), drawn(under)) for _ in range(DRAWS)]
        ratios = [a / b for a, b in pairs if a is not None and b]
        return [round(float(x), 3) for x in np.quantile(ratios, (0.025, 0.975))] if len(ratios) > DRAWS // 2 else None

    if not ours or not theirs:
        return {"value": None, "interval": None, "noise": None}
    top, bottom = quantile(np.concatenate(ours), percent), quantile(np.concatenate(theirs), percent)
    value = None if top is None or not bottom else round(top / bottom, 3)
    few = value is None or min(len(ours), len(theirs)) < MIN_SLICES
    return {
        "value": value,
        "interval": None if few else many(ours, theirs),
        "noise": None if few else many(theirs, theirs),
    }


def of_period(found: Mapping[Kind, Sequence[Slice]], seed: int = 1) -> dict[str, Any]:
    """All figures of one period."""
    rng = np.random.default_rng(seed)

    def column(kind: Kind, name: str) -> list[Floats]:
        return [getattr(s, name) for s in found.get(kind, ()) if getattr(s, name).size]

    def pooled(kind: Kind, name: str) -> Floats:
        return np.concatenate([*column(kind, name), np.empty(0)])

    grid, test = column(Kind.GRID, "wake_us"), column(Kind.CYCLICTEST, "wake_us")
    bare, compute = pooled(Kind.ECHO, "rtt_us"), pooled(Kind.GRID, "exec_us")
    response, frame = pooled(Kind.GRID, "resp_us"), pooled(Kind.FRAME, "rtt_us")
    costs = (quantile(bare, 50.0), quantile(compute, 50.0))
    floor_us = None if costs[0] is None or costs[1] is None else costs[0] + costs[1]

    def against_floor(samples: Floats) -> float | None:
        p50 = quantile(samples, 50.0)
        return None if p50 is None or not floor_us else round(p50 / floor_us, 3)

    return {
        "wake_us": {
            "ours": describe(pooled(Kind.GRID, "wake_us")),
            "cyclictest": describe(pooled(Kind.CYCLICTEST, "wake_us")),
        },
        "wake_ratio": {name: ratio(grid, test, percent, rng) for name, percent in _SHOWN},
        "bare_round_trip_us": describe(bare),
        "compute_us": describe(compute),
        "response_us": describe(response),
        "frame_to_estimate_us": describe(frame),
        "response_ratio": against_floor(response),
        "frame_ratio": against_floor(frame),
        "slices": {kind.name.lower(): len(s) for kind, s in found.items()},
        "asked": {kind.name.lower(): sum(x.asked for x in s) for kind, s in found.items()},
        "unanswered": {kind.name.lower(): sum(x.unanswered for x in s) for kind, s in found.items()},
        "lost_frames": sum(x.lost for s in found.values() for x in s),
        "steal_ms": {kind.name.lower(): round(sum(x.steal_ms for x in s), 1) for kind, s in found.items()},
    }


def targets(periods: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Each target with what was measured; ``met`` None where it was not, or not well enough to say."""
    out: dict[str, Any] = {}
    for period, figures in periods.items():
        wake = figures["wake_ratio"]["p99"]
        out[f"wake_p99_{period}_ms"] = {"limit": WAKE_LIMIT, **wake, "met": _met(wake, WAKE_LIMIT)}
    at = periods.get(f"{TARGET_PERIOD_MS:g}")
    if at is not None:
        for name in ("response_ratio", "frame_ratio"):
            value = at[name]
            out[f"{name}_p50_10_ms"] = {
                "limit": RESPONSE_LIMIT, "value": value, "met": None if value is None else value <= RESPONSE_LIMIT,
            }  # fmt: skip
        value = at["frame_to_estimate_us"]["p50"]
        out["frame_to_estimate_p50_us"] = {
            "limit": FRAME_LIMIT_US, "value": value, "met": None if value is None else value <= FRAME_LIMIT_US,
        }  # fmt: skip
    return out


def _met(found: Mapping[str, Any], limit: float) -> bool | None:
    """Within the limit, beyond it, or (None) on both sides of it by the interval."""
    interval = found["interval"]
    if found["value"] is None or interval is None:
        return None
    if interval[1] <= limit:
        return True
    return False if interval[0] > limit else None


def lines(figures: Mapping[str, Any]) -> list[str]:
    """The figures as text."""
    out = [_machine_line(figures["machine"]), ""]
    head, *body = table(figures)
    widths = [max(len(row[i]) for row in (head, *body)) for i in range(len(head))]
    out += ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in (head, *body)]
    out += ["", "noise: 95 % of what cyclictest gives against itself, slice against slice: within it is no difference"]
    words = {True: "met", False: "MISSED", None: "not decided"}
    for name, t in figures["targets"].items():
        shown = _spread({"interval": None, **t})
        out.append(f"{words[t['met']]:>11}  {name}: {shown}, limit {t['limit']:g}")
    return out


def markdown(figures: Mapping[str, Any]) -> str:
    """The same as a table of a document."""
    head, *body = table(figures)
    rows = [head, ["---", *["---:"] * (len(head) - 1)], *body]
    return "\n".join([_machine_line(figures["machine"]), "", *("| " + " | ".join(row) + " |" for row in rows)])


def table(figures: Mapping[str, Any]) -> list[list[str]]:
    """One column per period."""
    periods = figures["periods"]

    def pair(of: Mapping[str, Any]) -> str:
        return " / ".join("n/a" if of[k] is None else f"{of[k]:.4g}" for k in ("p50", "p99"))

    def noise(of: Mapping[str, Any]) -> str:
        return "n/a" if of["noise"] is None else f"{of['noise'][0]:.2f} … {of['noise'][1]:.2f}"

    def plain(value: float | None) -> str:
        return "n/a" if value is None else f"{value:.2f}"

    rows = [
        ("wake-up, ours: p50 / p99 us", lambda p: pair(p["wake_us"]["ours"])),
        ("wake-up, cyclictest", lambda p: pair(p["wake_us"]["cyclictest"])),
        ("ratio of p50", lambda p: _spread(p["wake_ratio"]["p50"])),
        ("ratio of p99", lambda p: _spread(p["wake_ratio"]["p99"])),
        ("noise of p99", lambda p: noise(p["wake_ratio"]["p99"])),
        ("bare round trip", lambda p: pair(p["bare_round_trip_us"])),
        ("compute (MHE step)", lambda p: pair(p["compute_us"])),
        ("response on the time grid", lambda p: pair(p["response_us"])),
        ("frame in to estimate out", lambda p: pair(p["frame_to_estimate_us"])),
        ("response / (bare + compute), p50", lambda p: plain(p["response_ratio"])),
        ("frame / (bare + compute), p50", lambda p: plain(p["frame_ratio"])),
        ("stolen in ours / cyclictest, ms", lambda p: " / ".join(f"{p['steal_ms'][k]:g}" for k in STOLEN)),
    ]
    return [["", *(f"{name} ms" for name in periods)], *([title, *map(cell, periods.values())] for title, cell in rows)]


def _spread(of: Mapping[str, Any]) -> str:
    if of["value"] is None:
        return "n/a"
    return f"{of['value']:.2f}" + (f" [{of['interval'][0]:.2f} … {of['interval'][1]:.2f}]" if of["interval"] else "")


def _machine_line(machine: Mapping[str, Any]) -> str:
    return (
        f"bus {machine['bus']}, core {machine['core']} of {machine['cores']}, {machine['policy']} priority "
        f"{machine['priority']}, {machine['seconds']:g} s of each kind and period, slices of {machine['slice_s']:g} s, "
        f"load {machine['load_before']:g} before and {machine['load_after']:g} after"
    )
