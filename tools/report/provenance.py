"""What ran, by its hashes, and on what: pairs of words for the two lists at the foot of the page."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from rt_runner.mcap_log import LogReader, LogSummary

Pairs = tuple[tuple[str, str], ...]
# key of the run's metadata -> words for it; the rest of the metadata follows under its own name
ELSEWHERE = ("title", "scenario", "bus", "seed", "period_s", "setting", "scenario_sha256")


def identity(reader: LogReader, run: Mapping[str, str], last: Mapping[str, Mapping[str, float | None]]) -> Pairs:
    """Hashes as the estimator and the plant sent them, checked against what the log has attached."""

    def sent(message: str, signal: str) -> str | None:
        value = last.get(message, {}).get(signal)
        return None if value is None else f"{int(value):06x}"

    dbc = reader.attachments.get("drive.dbc")
    pairs = [
        (
            "DBC",
            _checked(sent("EstIdentity", "dbc_hash"), hashlib.sha256(dbc).hexdigest() if dbc is not None else None),
        ),
        ("weights", sent("EstIdentity", "weights_hash")),
        ("estimator build", sent("EstBuild", "build_hash")),
        ("estimator setting", run.get("setting")),
        ("plant parameters", sent("PlantIdentity", "params_hash")),
        ("scenario", _checked(sent("PlantIdentity", "scenario_hash"), run.get("scenario_sha256"))),
    ]
    pairs += [
        (f"attached {name}", f"{len(data)} B, sha256 {hashlib.sha256(data).hexdigest()[:16]}")
        for name, data in sorted(reader.attachments.items())
    ]
    return tuple((name, value if value is not None else "not in the log") for name, value in pairs)


def _checked(sent: str | None, attached_sha256: str | None) -> str | None:
    """The 24 bits a process sent, and whether the file in the log has them."""
    if sent is None:
        return None if attached_sha256 is None else f"{attached_sha256[:6]} (from the log's file; no process sent it)"
    if attached_sha256 is None:
        return sent
    return (
        f"{sent} ✓ the log's file"
        if attached_sha256.startswith(sent)
        else f"{sent} ✕ the log's file is {attached_sha256[:6]}"
    )


def environment(run: Mapping[str, str], result: Mapping[str, Any], summary: LogSummary) -> Pairs:
    """The machine, and the counters that explain a bad run."""
    pairs = [(key.replace("_", " "), value) for key, value in run.items() if key not in ELSEWHERE]
    steal_ms = (result.get("environment") or {}).get("steal_ms")
    if steal_ms is not None:
        pairs.append(("time stolen from the core", f"{steal_ms:.0f} ms"))
    for key, title in (("input_faults", "estimator's inputs"), ("bus_faults", "estimator's bus"), ("plant", "plant")):
        counts = result.get(key) or {}
        words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in counts.items() if value is not None)
        if words:
            pairs.append((title, words))
    pairs.append(("log file", f"{summary.bytes / 1e6:.2f} MB, {'finished' if summary.complete else 'never finished'}"))
    return tuple(pairs)
