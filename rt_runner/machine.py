"""What this machine is and what it takes from us: cores, stolen time, a description for the log."""

import os
import platform
from pathlib import Path

from rt_runner.errors import UsageError


def split_cores(wanted: int | None = None) -> tuple[int, set[int]]:
    """The estimator's core and the cores of everything else.

    The estimator gets ``wanted``, else the last core this process may use; the others share what is left,
    or that same core where there is but one.
    """
    allowed = os.sched_getaffinity(0)
    core = wanted if wanted is not None else max(allowed)
    return core, (allowed - {core}) or allowed


def check_core(core: int | None) -> None:
    """Refuse a core that this process may not use.

    Raises
    ------
    UsageError
        Its number is none of the allowed ones.
    """
    allowed = sorted(os.sched_getaffinity(0))
    if core is not None and core not in allowed:
        raise UsageError(f"--core {core}: this process may use {', '.join(map(str, allowed))}")


def steal_ms(core: int) -> float | None:
    """Time a hypervisor has taken from ``core`` since boot, None where the kernel does not say."""
    try:
        for line in Path("/proc/stat").read_text().splitlines():
            fields = line.split()
            if fields[0] == f"cpu{core}" and len(fields) > 8:
                return int(fields[8]) * 1000.0 / os.sysconf("SC_CLK_TCK")
    except OSError:
        pass
    return None


def describe() -> dict[str, str]:
    """Facts for the log's ``run`` metadata."""
    return {
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "cores": ",".join(map(str, sorted(os.sched_getaffinity(0)))),
    }
