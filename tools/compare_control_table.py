"""The comparison of controllers as a table: for a terminal, and for docs/control.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tools.rows import DataError

BEGIN, END = "<!-- compare-control:begin -->", "<!-- compare-control:end -->"
HEAD = ("controller", "feedback", "case", "lap s", "against none", "θw max °C", "K·s above 155", "energy kWh",
        "v rms m/s", "solve µs p50 / p99 / max")  # fmt: skip
Found = dict[str, dict[str, dict[str, dict[str, Any]]]]


def rows(found: Found) -> list[tuple[str, ...]]:
    """One row per lap, HEAD's columns."""
    free = _free_s(found)
    out = []
    for controller, feedbacks in found.items():
        for feedback, cases in feedbacks.items():
            for case, f in cases.items():
                lap, solve = f["lap_s"], f["solve_us"]
                against = "–" if lap is None or free is None else f"{100.0 * (lap / free - 1.0):+.2f} %"
                out.append((
                    controller, feedback, case, "not finished" if lap is None else f"{lap:.1f}", against,
                    f"{f['theta_w_max_degc']:.2f}", f"{f['ks_above_155']:.1f}", f"{f['energy_kwh']:.2f}",
                    f"{f['v_rms']:.2f}", f"{solve['p50']:.0f} / {solve['p99']:.0f} / {solve['max']:.0f}",
                ))  # fmt: skip
    return out


def _free_s(found: Found) -> float | None:
    """The lap without derating: none of its feedback matters."""
    for cases in found.get("none", {}).values():
        for f in cases.values():
            return f["lap_s"]
    return None


def plain(found: Found) -> str:
    """For a terminal."""
    lines = [HEAD, *rows(found)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(HEAD))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def markdown(found: Found) -> str:
    """For the documentation."""
    lines = [HEAD, ("---",) * len(HEAD), *rows(found)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def inserted(path: Path, text: str) -> str:
    """The document with ``text`` between its markers; all else as it was.

    Raises
    ------
    DataError
        Not readable, or without exactly one of each marker in this order.
    """
    try:
        whole = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"--doc {path}: {error.strerror}; give a document with {BEGIN} and {END}") from None
    before, begin, rest = whole.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in after:
        raise DataError(f"--doc {path}: needs one line {BEGIN} and, after it, one line {END}")
    return f"{before}{BEGIN}\n{text}\n{END}{after}"
