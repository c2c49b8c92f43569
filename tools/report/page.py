"""Builds the one HTML text: tables, chart data, and the assets inlined. Loads nothing from anywhere else."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from rt_runner.timing.figures import as_json
from tools.report import deadline, tables
from tools.report.charts import build_charts, time_range
from tools.report.data import ReportData

ASSETS = Path(__file__).resolve().parents[1] / "report_assets"


def figures(data: ReportData) -> dict[str, Any]:
    """The figures that the page shows, as plain JSON values."""
    return {
        "title": data.title,
        "source": data.source,
        "started": data.started,
        "lockstep": data.lockstep,
        "result": data.result,
        "result_from_log": data.result_from_log,
        "notices": list(data.notices),
        "frames": [asdict(f) for f in data.frames],
        "identity": dict(data.identity),
        "environment": dict(data.environment),
        "timing": None if data.timing is None else as_json(data.timing),
    }


def build_page(data: ReportData) -> str:
    """The complete page."""
    charts = build_charts(data)
    content = {
        "figures": figures(data),
        "t_range": time_range(data),
        "cycle_start_s": data.cycle_start_s,
        "charts": charts,
    }
    by_id = {c["id"]: _chart(c) for c in charts}
    pairs = '<div class="grid cols2" style="margin-top:0">{}{}</div>'
    body = "\n".join(
        [
            tables.header(data),
            tables.key_figures(data),
            _toolbar(),
            by_id["winding"],
            by_id["rotor"],
            pairs.format(by_id["winding-error"], by_id["rotor-error"]),
            by_id["drive"],
            by_id["response"],
            by_id["histogram"],
            deadline.section(data.timing),
            tables.frames_table(data.frames),
            tables.identity(data),
            "<footer>charts drawn with uPlot (MIT, © Leon Sorokin) · this file loads nothing from a network</footer>",
        ]
    )
    return _fill(
        _asset("page.html"),
        {
            "title": escape(f"{data.title} · {data.result.get('verdict', '')}"),
            "style": _style(),
            "body": body,
            "data": script_json(content),
            "script": "\n".join(_asset(n) for n in ("uPlot.iife.min.js", "charts.js", "report.js")),
        },
    )


def script_json(content: Any) -> str:
    """JSON that cannot end the <script> it stands in, nor be cut by a line separator; NaN is refused."""
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _style() -> str:
    dark = _asset("dark.css")
    themes = (
        f'@media screen and (prefers-color-scheme: dark) {{ :root:not([data-theme="light"]) {{ {dark} }} }}\n'
        f':root[data-theme="dark"] {{ {dark} }}'
    )
    return f"{_asset('uPlot.min.css')}\n{_asset('report.css')}\n{themes}"


def _fill(template: str, parts: dict[str, str]) -> str:
    # One pass: what is filled in is never searched for placeholders again.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def _toolbar() -> str:
    buttons = (("left", "◀", "earlier"), ("right", "▶", "later"), ("out", "−", "zoom out"), ("in", "+", "zoom in"))
    row = "".join(f'<button type="button" id="{i}" title="{t}" aria-label="{t}">{s}</button>' for i, s, t in buttons)
    return (
        f'<div class="bar"><h2>Signals over time</h2><span class="window">drag to zoom, double-click to reset · '
        f'<span id="window"></span></span>{row}<button type="button" id="reset">whole log</button></div>'
    )


def _chart(chart: dict[str, Any]) -> str:
    empty = "" if chart["series"] else '<p class="none">the log has no data for this chart</p>'
    return (
        f'<section class="panel chart" id="chart-{chart["id"]}"><header><h3>{tables.esc(chart["title"])}</h3>'
        f'<div class="legend"></div></header><p class="note">{tables.esc(chart["note"])}</p>'
        f'<div class="plot">{empty}</div></section>'
    )
