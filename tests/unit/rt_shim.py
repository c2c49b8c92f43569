"""Builds the C timing modules with a scripted clock into a library, under UBSan."""

from __future__ import annotations

import ctypes as ct
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = tuple(
    f"rt_{name}.c"
    for name in ("stats", "tally", "task", "reaction", "backlog", "cause", "theft", "canary", "clock", "grant")
)
QUANTILE_PER_10K = (5000, 9000, 9900, 9990, 9999)
I64 = ct.c_int64
U64 = ct.c_uint64


def _structure(name: str, fields: list[tuple[str, type]]) -> type[ct.Structure]:
    return type(name, (ct.Structure,), {"_fields_": fields})


Reaction = _structure(
    "Reaction",
    [
        ("overrun", ct.c_int),
        ("queue_limit", ct.c_uint32),
        ("budget_ns", I64),
        ("stop_total", U64),
        ("stop_row", U64),
    ],
)
Config = _structure(
    "Config",
    [
        ("period_ns", I64),
        ("deadline_ns", I64),
        ("t0_ns", I64),
        ("warmup_releases", U64),
        ("virtual_time", ct.c_bool),
        ("on_event", ct.c_bool),
        ("reaction", Reaction),
        ("mk_m", ct.c_uint32),
        ("mk_k", ct.c_uint32),
    ],
)
SCRIPT_FIELDS = (
    "interrupts",
    "interrupt_ns",
    "wake_ns",
    "cpu_ns",
    "away_ns",
    "publish_ns",
    "rest_ns",
    "sent",
    "stale",
)
Script = _structure("Script", [(name, I64) for name in SCRIPT_FIELDS])
OUTCOME_FIELDS = (
    "index",
    "release_ns",
    "start_ns",
    "published_ns",
    "done_ns",
    "wake_lat_ns",
    "resp_ns",
    "after_skip",
    "miss_late",
    "cause",
    "warmup",
)
Outcome = _structure("Outcome", [(name, I64) for name in OUTCOME_FIELDS])
COUNTER_FIELDS = ("releases", "jobs", "miss_late", "miss_skipped", "overrun", "consec_miss_max", "mk_worst")
Counters = _structure("Counters", [(name, U64) for name in COUNTER_FIELDS])
Summary = _structure(
    "Summary",
    [
        ("count", U64),
        ("underflow", U64),
        ("overflow", U64),
        ("min_ns", I64),
        ("max_ns", I64),
        ("min_index", U64),
        ("max_index", U64),
        ("mean_ns", ct.c_double),
        ("std_ns", ct.c_double),
        ("quantile_ns", I64 * 5),
        ("quantile_status", ct.c_int * 5),
    ],
)


def build(directory: Path) -> ct.CDLL:
    """Compile the shim into `directory` and load it."""
    library = directory / "rt_shim.so"
    source = ROOT / "estimator_c" / "src"
    subprocess.run(
        [
            "gcc",
            "-std=c11",
            "-O1",
            "-g",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-D_GNU_SOURCE",
            "-fPIC",
            "-shared",
            "-fsanitize=undefined",
            "-fno-sanitize-recover=undefined",
            f"-I{source}",
            "-o",
            str(library),
            str(Path(__file__).with_name("rt_task_shim.c")),
            *(str(source / name) for name in SOURCES),
            "-lm",
            "-lpthread",
        ],
        check=True,
    )
    return ct.CDLL(str(library))


def summarise(library: ct.CDLL, values: list[int]):
    """`rt_summary` of integer values."""
    out = Summary()
    library.shim_stats((I64 * max(1, len(values)))(*values), ct.c_size_t(len(values)), ct.byref(out))
    return out


def run(library: ct.CDLL, config, now_ns: int, steps: list[dict]):
    """Run scripted jobs; returns (status, outcomes, {total, warmup, judged}, wake latency summary)."""
    n = len(steps)
    scripts = (Script * n)(*(Script(**step) for step in steps))
    jobs = (Outcome * n)()
    counters = (Counters * 3)()
    wake = Summary()
    status = library.shim_run(
        ct.byref(config), I64(now_ns), scripts, ct.c_size_t(n), jobs, counters, ct.byref(wake)
    )
    named = {
        window: {field: getattr(counters[i], field) for field in COUNTER_FIELDS}
        for i, window in enumerate(("total", "warmup", "judged"))
    }
    return status, [{field: getattr(job, field) for field in OUTCOME_FIELDS} for job in jobs], named, wake
