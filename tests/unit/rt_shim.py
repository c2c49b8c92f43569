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
            *(str(Path(__file__).with_name(name)) for name in ("rt_task_shim.c", "rt_world_shim.c")),
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


# ---- a machine in virtual time (rt_world_shim.c) --------------------------------------------------------------------

STEP_FIELDS = (
    "interrupts", "wake_ns", "iterations", "cpu_ns", "away_ns", "publish_ns", "rest_ns", "sent", "stale", "core",
)  # fmt: skip
MACHINE_FIELDS = ("start_ns", "canary", "canary_lat_ns", "theft_is_cpu")
JOB_FIELDS = (
    "slept_until_ns", "index", "release_ns", "start_ns", "start_cpu_ns", "stepped_ns", "stepped_cpu_ns", "published_ns",
    "done_ns", "asked", "asked_ns", "expired", "late_now", "wake_lat_ns", "exec_wall_ns", "exec_cpu_ns", "preempt_ns",
    "resp_ns", "stolen_ns", "canary_ns", "warmup", "after_skip", "queued", "cut", "miss_late", "cause", "releases",
    "jobs", "miss_skipped", "queued_now", "overrun", "phase_ns", "broken",
)  # fmt: skip
TALLY_FIELDS: tuple[str, ...] = (
    "releases", "jobs", "miss_late", "miss_skipped", "overrun", "consec_miss_max", "mk_worst", "queued", "queued_now",
    "mk_misses_max", "mk_violations",
)  # fmt: skip
METRICS = 10
CAUSES = 7
HEARD = 4096
ROWS = 2240


class World:
    """The task in a machine of virtual time; one `run` after another."""

    def __init__(self, library: ct.CDLL) -> None:
        self.c = library
        library.world_run.restype = I64
        library.world_task_size.restype = library.world_histogram.restype = ct.c_size_t
        library.world_metric.restype = ct.c_char_p
        self._task = ct.create_string_buffer(library.world_task_size())
        self._heard = (I64 * (2 * HEARD))()
        self._rows = (I64 * (3 * ROWS))()

    def run(self, config, machine: dict, thefts: list[tuple[int, int]], steps: list[dict]):
        """Returns (jobs that ran, or None for a refused configuration; the canary's wake-ups)."""
        n = len(steps)
        flat = [step[name] for step in steps for name in STEP_FIELDS]
        out, heard = (I64 * (n * len(JOB_FIELDS)))(), ct.c_size_t(HEARD)
        ran = self.c.world_run(
            self._task,
            ct.byref(config),
            (I64 * len(MACHINE_FIELDS))(*(machine[name] for name in MACHINE_FIELDS)),
            (I64 * max(1, 2 * len(thefts)))(*(at for span in thefts for at in span)),
            ct.c_size_t(len(thefts)),
            (I64 * len(flat))(*flat),
            ct.c_size_t(n),
            out,
            self._heard,
            ct.byref(heard),
        )
        if ran < 0:
            return None, []
        values, width = list(out), len(JOB_FIELDS)
        jobs = [dict(zip(JOB_FIELDS, values[i * width : (i + 1) * width], strict=True)) for i in range(ran)]
        records = self._heard[: 2 * heard.value]
        return jobs, list(zip(records[::2], records[1::2], strict=True))

    def counters(self) -> tuple[dict[str, dict[str, int]], list[list[int]], list[int]]:
        """Of the last run: tallies; causes of jobs, skips, judged misses; [cut, rebased, phase, migrations]."""
        tallies = [(U64 * len(TALLY_FIELDS))() for _ in range(3)]
        causes, other = (U64 * (3 * CAUSES))(), (I64 * 4)()
        self.c.world_counters(self._task, *tallies, causes, other)
        names = ("total", "warmup", "judged")
        named = {n: dict(zip(TALLY_FIELDS, t, strict=True)) for n, t in zip(names, tallies, strict=True)}
        return named, [list(causes)[i * CAUSES : (i + 1) * CAUSES] for i in range(3)], list(other)

    def histogram(self, metric: int, warmup: bool):
        """(name, summary, {(low, high): count}) of the last run."""
        summary = Summary()
        used = self.c.world_histogram(
            self._task, ct.c_size_t(metric), int(warmup), ct.byref(summary), self._rows, ct.c_size_t(ROWS)
        )
        rows = self._rows[: 3 * used]
        buckets = {(rows[i], rows[i + 1]): rows[i + 2] for i in range(0, 3 * used, 3)}
        return self.c.world_metric(ct.c_size_t(metric)).decode(), summary, buckets
