"""The figures as text: for a terminal and for docs/solver.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.solver_backends.configs import CONFIGS, Config
from tools.solver_backends.figures import Figures, best_hpipm, ratio

BEGIN, END = "<!-- bench solver: begin -->", "<!-- bench solver: end -->"
NONE = "–"
HEAD = (
    "",
    "median µs",
    "p99",
    "max",
    "of which solve",
    "sweeps",
    "instructions",
    "of which MHE",
    "error °C",
    "state, bytes",
)


class DocumentError(Exception):
    """The document cannot take the table; the message says why."""


def number(value: float | None, form: str) -> str:
    """As text; a dash for None."""
    return NONE if value is None else format(value, form)


def rows(found: dict[str, Figures]) -> list[list[str]]:
    """One row per configuration, the oracle last."""
    every = [*CONFIGS, Config("oracle", "CasADi + ipopt, through Python", "", "")]
    return [
        [
            config.title,
            *(number(f[key], ".1f") for key in ("median_us", "p99_us", "max_us")),
            number(f.get("solve_median_us"), ".1f"),
            number(f.get("sweeps_mean"), ".1f"),
            number(f["instructions"], ",.0f"),
            number(f.get("instructions_mhe"), ",.0f"),
            number(f["max_error_degc"], ".0e"),
            number(f["state_bytes"], ",.0f"),
        ]
        for config in every
        if (f := found.get(config.name)) is not None
    ]


def kind_rows(found: dict[str, Figures]) -> tuple[list[str], list[list[str]]]:
    """Medians by kind of step: (head, rows)."""
    names = [c for c in CONFIGS if c.chief and c.name in found]
    best = best_hpipm(found)
    names += [c for c in CONFIGS if c.name == best and not c.chief]
    if not names:
        return [], []
    kinds = found[names[0].name]["kinds"]
    return ["steps", "number", *(c.name for c in names)], [
        [kind, f"{of_first['steps']:,}", *(_median_and_sweeps(found[c.name]["kinds"][kind]) for c in names)]
        for kind, of_first in kinds.items()
    ]


def _median_and_sweeps(figures: Figures) -> str:
    return f"{figures['median_us']:.1f} ({figures['sweeps_mean']:.1f})"


def verdicts(found: dict[str, Figures]) -> list[str]:
    """Ratios in words."""
    best, lines = best_hpipm(found), []
    for name in ("simd", "portable"):
        times = ratio(found, name, best)
        if times is not None:
            lines.append(f"{name}: {times:.0f} times faster than the fastest HPIPM configuration ({best})")
    times = ratio(found, "simd_quadratic", "hpipm_full_free_quadratic")
    if times is not None:
        lines.append(f"quadratic loss, simd: {times:.0f} times faster than HPIPM (full condensing, bounds where met)")
    return lines


def plain(found: dict[str, Figures], notes: Sequence[str]) -> str:
    """For a terminal."""
    parts = [_aligned([list(HEAD), *rows(found)])]
    head, body = kind_rows(found)
    if head:
        parts += ["\nmedian µs (sweeps) by kind of step", _aligned([head, *body])]
    return "\n".join([*parts, "", *verdicts(found), *notes])


def markdown(found: dict[str, Figures], notes: Sequence[str]) -> str:
    """For the documentation."""
    parts = [_markdown(list(HEAD), rows(found))]
    head, body = kind_rows(found)
    if head:
        parts += ["Median µs (mean sweeps) by kind of step:", _markdown(head, body)]
    return "\n\n".join([*parts, "\n".join(f"- {line}" for line in [*verdicts(found), *notes])])


def inserted(path: Path, tables: str, begin: str = BEGIN, end: str = END) -> str:
    """The document with `tables` between its markers.

    Raises
    ------
    DocumentError
        Missing, or not exactly one of each marker in this order.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DocumentError(f"{path}: {error.strerror}; give a document with the two markers") from error
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise DocumentError(f"{path}: needs the lines {begin} and {end}, once each and in this order")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{tables}\n{end}{rest.split(end)[1]}"


def _aligned(table: list[list[str]]) -> str:
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in table
    )


def _markdown(head: list[str], body: list[list[Any]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
