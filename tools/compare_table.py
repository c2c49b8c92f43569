"""The comparison as a table: for a terminal, and for docs/estimator.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tools.compare_cases import CHANNELS, Case, Target
from tools.rows import DataError

BEGIN, END = "<!-- compare:begin -->", "<!-- compare:end -->"
MARGIN = 0.05  # a baseline within 5 % is no better
JUDGED = "default"
NONE = "–"
Found = dict[str, dict[str, dict[str, Any]]]


def plain(found: Found, cases: Sequence[Case], seeds: int, channel: str) -> str:
    """For a terminal: RMSE / largest error over the lap, then the fault's window, detection, false alarms, recovery."""
    parts = []
    parts.append(f"{channel}, {seeds} seeds; RMSE / largest error in °C, from 10 s to the end of the lap")
    parts.append(_aligned(found, cases, lambda f: _pair(f, "rmse", "max")))
    faulty = [case for case in cases if any(v.faults for v in case.variants)]
    if faulty:
        parts.append("\nin the time of the fault: RMSE / largest error in °C")
        parts.append(_aligned(found, faulty, lambda f: _pair(f, "rmse_window", "max_window")))
    parts.append("\nabove 140 °C: RMSE in °C")
    parts.append(_aligned(found, cases, lambda f: _number(f["rmse_hot"])))
    parts.append("\ndetection s / false alarms per hour / recovery s (* not in every run)")
    parts.append(_aligned(found, cases, _reaction))
    verdicts = [*_targets(found, cases, channel), *_better(found, cases)]
    return "\n".join([*parts, *(["", *verdicts] if verdicts else [])])


def markdown(found: Found, cases: Sequence[Case], seeds: int, channel: str) -> str:
    """For the documentation: the same figures, mean ± standard deviation over the seeds."""
    names = list(found)
    faulty = [case for case in cases if any(v.faults for v in case.variants)]
    parts = [
        f"`rt-runner compare --seeds {seeds}`, {channel}, mean ± standard deviation over {seeds} seeds; RMSE / largest "
        "error in °C, from 10 s to the end of the lap. Targets are for `default`.",
        _table(["case", "target", *names], [_main_row(found, names, case, channel) for case in cases]),
    ]
    if faulty:
        parts += ["In the time of the fault:", _table(
            ["case", *names],
            [[case.name, *(_pair(found[n][case.name], "rmse_window", "max_window", True) for n in names)]
             for case in faulty],
        )]  # fmt: skip
    parts += ["Where the winding is above 140 °C, RMSE in °C:", _table(
        ["case", *names],
        [[case.name, *(_spread(found[n][case.name], "rmse_hot") for n in names)] for case in cases],
    )]  # fmt: skip
    parts += [
        "Detection in s / false alarms per hour / recovery in s (– none; \\* not in every run):",
        _table(["case", *names], [[case.name, *(_reaction(found[n][case.name]).replace("*", "\\*") for n in names)]
                                  for case in cases]),
    ]  # fmt: skip
    named = [n for n in names if any(found[n][case.name]["classes_in_window"] for case in faulty)]
    if named:
        parts += ["What the published class says while the fault lasts, share of time:", _table(
            ["case", *named], [[case.name, *(_classes(found[n][case.name]) for n in named)] for case in faulty],
        )]  # fmt: skip
    verdicts = [*_targets(found, cases, channel), *_better(found, cases)]
    return "\n\n".join(parts + (["\n".join(f"- {line}" for line in verdicts)] if verdicts else []))


def check_document(path: Path) -> None:
    """Refuse a document without the two markers.

    Raises
    ------
    DataError
        Missing, or not exactly one of each in this order.
    """
    inserted(path, "")


def inserted(path: Path, tables: str) -> str:
    """The document with `tables` between its markers; all else as it was."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"--doc {path}: {error.strerror}; give a document with {BEGIN} and {END}") from None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in after:
        raise DataError(f"--doc {path}: needs one line {BEGIN} and, after it, one line {END}")
    return f"{before}{BEGIN}\n{tables}\n{END}{after}"


def _main_row(found: Found, names: Sequence[str], case: Case, channel: str) -> list[str]:
    target = NONE
    if case.target is not None and channel == CHANNELS[0]:
        where = " in the window" if case.target.in_window else ""
        verdict = {True: ", met", False: ", **missed**", None: ""}[_met(found, case)]
        target = f"≤ {case.target.rmse_degc:g} / {case.target.max_degc:g}{where}{verdict}"
    return [f"**{case.name}**: {case.title}", target, *(_pair(found[n][case.name], "rmse", "max", True) for n in names)]


def _judged_keys(target: Target) -> tuple[str, str]:
    return ("rmse_window", "max_window") if target.in_window else ("rmse", "max")


def _met(found: Found, case: Case) -> bool | None:
    """Whether the default estimator meets a case's target; None where one of them is not there."""
    if JUDGED not in found or case.target is None:
        return None
    limits = (case.target.rmse_degc, case.target.max_degc)
    figures = [found[JUDGED][case.name][key] for key in _judged_keys(case.target)]
    return all(f is not None and f <= limit for f, limit in zip(figures, limits, strict=True))


def _targets(found: Found, cases: Sequence[Case], channel: str) -> list[str]:
    """One line per target of the default estimator that is missed, or one that says that none is."""
    if JUDGED not in found or channel != CHANNELS[0]:
        return []
    lines, asked = [], [case for case in cases if case.target is not None]
    for case in asked:
        if case.target is not None and _met(found, case) is False:
            shown = _pair(found[JUDGED][case.name], *_judged_keys(case.target))
            where = " in the window" if case.target.in_window else ""
            limits = f"{case.target.rmse_degc:g} / {case.target.max_degc:g}"
            lines.append(f"{JUDGED} misses the target of {case.name}: {shown}{where}, asked for {limits}")
    return lines if lines or not asked else [f"{JUDGED} meets all {len(asked)} targets."]


def _better(found: Found, cases: Sequence[Case]) -> list[str]:
    """One line per row in which a baseline is more than 5 % better than the default estimator."""
    if JUDGED not in found or len(found) < 2:
        return []
    lines = []
    for case in cases:
        for key, what in (("rmse", "RMSE"), ("max", "largest error")):
            ours = found[JUDGED][case.name][key]
            theirs = {n: f[case.name][key] for n, f in found.items() if n != JUDGED and f[case.name][key] is not None}
            ahead = {n: v for n, v in theirs.items() if ours is None or v < (1.0 - MARGIN) * ours}
            if ahead:
                listed = ", ".join(f"{n} {v:.3f}" for n, v in sorted(ahead.items(), key=lambda item: item[1]))
                lines.append(f"{case.name}, {what}: {listed} against {JUDGED} {_number(ours)} °C")
    return lines or [f"No baseline is more than 5 % better than {JUDGED} in any row."]


def _number(value: float | None, digits: int = 3) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def _spread(f: dict[str, Any], key: str, digits: int = 3) -> str:
    value, std = f[key], f.get(f"{key}_std")
    return NONE if value is None else f"{value:.{digits}f}" + (f" ± {std:.{digits}f}" if std is not None else "")


def _pair(f: dict[str, Any], rmse: str, most: str, spread: bool = False) -> str:
    if f[rmse] is None:
        return NONE
    return (f"{_spread(f, rmse)} / {_spread(f, most, 2)}") if spread else f"{_number(f[rmse])} / {_number(f[most], 2)}"


def _reaction(f: dict[str, Any]) -> str:
    detection = _number(f["detection_s"], 1) + ("*" if f["missed"] and f["detection_s"] is not None else "")
    recovery = _number(f["recovery_s"], 1) + ("*" if f["unrecovered"] and f["recovery_s"] is not None else "")
    return f"{detection} / {_number(f['false_alarms_per_h'], 1)} / {recovery}"


def _classes(f: dict[str, Any]) -> str:
    shares = sorted(f["classes_in_window"].items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {share:.0%}" for name, share in shares if share >= 0.005) or NONE


def _aligned(found: Found, cases: Sequence[Case], cell: Callable[[dict[str, Any]], str]) -> str:
    """Cases down, estimators across, columns as wide as they need to be."""
    names = list(found)
    grid = [["", *names], *([case.name, *(cell(found[n][case.name]) for n in names)] for case in cases)]
    widths = [max(len(row[k]) for row in grid) for k in range(len(names) + 1)]
    return "\n".join(
        row[0].ljust(widths[0]) + "".join("  " + text.rjust(w) for text, w in zip(row[1:], widths[1:], strict=True))
        for row in grid
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
