"""One line per job, for spreadsheets."""

import csv
from pathlib import Path

from rt_runner.errors import UsageError
from rt_runner.result import CAUSES
from rt_runner.timing.analyse import ProcessTiming
from rt_runner.timing.jobs import NO_NS, OUTPUTS


def write_table(timing: ProcessTiming, path: Path) -> int:
    """Write it as CSV, times in us, empty where not available; returns the number of jobs.

    Raises
    ------
    UsageError : the file cannot be written
    """
    jobs = timing.jobs
    columns = {**jobs.times, **timing.ages}
    flags = list(jobs.flags.items())
    names = ["release", *(name for name, _ in flags), "cause", "output", *(f"{name}_us" for name in columns)]
    try:
        with path.open("w", newline="", encoding="ascii") as file:
            out = csv.writer(file)
            out.writerow(names)
            for k, release in enumerate(jobs.release):
                times = ("" if c[k] == NO_NS else c[k] / 1000 for c in columns.values())
                words = CAUSES[jobs.cause[k]], OUTPUTS[jobs.output[k]]
                out.writerow([release if release >= 0 else "", *(f[k] for _, f in flags), *words, *times])
    except OSError as e:
        raise UsageError(f"cannot write --csv {path}: {e.strerror}; give another file") from None
    return len(jobs)
