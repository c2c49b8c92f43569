"""Shows a `LogSummary`: a table on a terminal, plain lines where none is, JSON for programs."""

import sys
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, TextIO

from rt_runner.log_summary import LogSummary, MessageSummary
from rt_runner.present import sensor_lines

COLUMNS = ("id", "message", "frames", "cycle", "mean", "min", "max", "lost", "rep", "seq", "crc", "")
_LEGEND = "times in ms; lost, rep, seq, crc: frames missing, repeated, out of sequence, damaged"


def as_json(summary: LogSummary) -> dict[str, Any]:
    """The figures, ready for JSON."""
    out = asdict(summary)
    out["duration_s"] = summary.duration_s
    for entry, message in zip(out["messages"], summary.messages, strict=True):
        entry["rate_ok"] = message.rate_ok
    return out


def show(summary: LogSummary, stream: TextIO | None = None) -> None:
    """Print it to ``stream`` (standard output)."""
    out: TextIO = sys.stdout if stream is None else stream
    if out.isatty():
        _show_table(summary, out)
        return
    for line in plain_lines(summary):
        print(line, file=out)


def plain_lines(summary: LogSummary) -> list[str]:
    """What is printed where there is no terminal."""
    rows = [COLUMNS, *(_row(m) for m in summary.messages if m.frames)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
    left = {1, len(COLUMNS) - 1}  # the name and the remark; figures to the right
    table = [
        "  ".join(c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(r, widths, strict=True)))
        for r in rows
    ]
    return [*_head(summary), "", *(line.rstrip() for line in table), _LEGEND, "", *_tail(summary)]


def _show_table(summary: LogSummary, stream: TextIO) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(file=stream, highlight=False)
    for line in _head(summary):
        console.print(line, markup=False)
    table = Table(caption=_LEGEND, caption_justify="left", header_style="bold")
    for i, name in enumerate(COLUMNS):
        table.add_column(name, justify="left" if i in (1, len(COLUMNS) - 1) else "right")
    for message in summary.messages:
        if message.frames:
            table.add_row(*_row(message), style=None if _is_clean(message) else "yellow")
    console.print(table)
    for line in _tail(summary):
        console.print(line, markup=False)


def _head(summary: LogSummary) -> list[str]:
    lines = [f"{summary.path}: {summary.bytes / 1e6:.2f} MB, {summary.frames} frames in {summary.duration_s:.1f} s"]
    if summary.start_ns is not None and summary.start_ns > 10**17:  # lock-step logs start at 0, not on a date
        start = datetime.fromtimestamp(summary.start_ns / 1e9, UTC)
        lines.append(f"started {start:%Y-%m-%d %H:%M:%S} UTC")
    return lines


def _tail(summary: LogSummary) -> list[str]:
    absent = {m.sender for m in summary.messages} - {m.sender for m in summary.messages if m.frames}
    silent = [m.name for m in summary.messages if not m.frames and m.sender not in absent]
    lines = [f"not on the bus: {', '.join(sorted(absent))}"] if absent else []
    lines += [f"no frames of: {', '.join(silent)}"] if silent else []
    if summary.unknown:
        unknown = ", ".join(f"{can_id} ({count})" for can_id, count in summary.unknown.items())
        lines.append(f"ids that are not in the DBC: {unknown}")
    if summary.attachments:
        lines.append("attachments: " + ", ".join(f"{n} ({b} bytes)" for n, b in summary.attachments.items()))
    if summary.run:
        lines.append("run: " + ", ".join(f"{k}={v}" for k, v in summary.run.items()))
    return lines + _verdict(summary.result) + _recomputed(summary.differences)


def _recomputed(differences: list[str] | None) -> list[str]:
    if differences is None:
        return []
    if differences:
        return [f"recomputed from the frames: ANOTHER RESULT in {', '.join(differences)}"]
    return ["recomputed from the frames: the same result"]


def _verdict(result: dict[str, Any] | None) -> list[str]:
    if result is None:
        return ["verdict: none, the run did not get that far"]
    lines = [f"verdict: {result.get('verdict', 'unknown')}"]
    for channel, figures in result.get("accuracy", {}).items():
        rmse = [figures.get(k) for k in ("est_rmse_degc", "raw_rmse_degc", "est_max_degc")]
        estimate, raw, worst = ("n/a" if v is None else f"{v:.3f} degC" for v in rmse)
        lines.append(f"  {channel}: estimate RMSE {estimate} (sensor {raw}), worst {worst}")
    lines += [f"  {line}" for line in sensor_lines(result)]
    for finding in result.get("findings", []):
        lines.append(f"  {finding.get('what')}: {finding.get('verdict')}: {finding.get('evidence')}")
    return lines


def _row(m: MessageSummary) -> tuple[str, ...]:
    times = ("–" if t is None else f"{t:.2f}" for t in (m.mean_ms, m.min_ms, m.max_ms))
    counts = (str(n or "·") for n in (m.lost, m.repeated, m.wrong_sequence, m.wrong_crc))
    return (m.can_id, m.name, str(m.frames), f"{m.cycle_ms:g}", *times, *counts, _remark(m))


def _remark(m: MessageSummary) -> str:
    remarks = ["simulation only"] if m.simulation_only else []
    if m.rate_ok is False and m.mean_ms:
        remarks.append("too fast" if m.mean_ms < m.cycle_ms else "too slow")
    if m.timed_out:
        remarks.append(f"silent beyond its timeout of {m.timeout_ms:g}")
    return ", ".join(remarks)


def _is_clean(m: MessageSummary) -> bool:
    return m.rate_ok is not False and not (m.timed_out or m.lost or m.repeated or m.wrong_sequence or m.wrong_crc)
