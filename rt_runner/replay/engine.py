"""The C estimator as a process that is told which job ran when: records in, its frames out."""

import json
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass

from rt_runner import paths
from rt_runner.errors import RtError, SetupError
from rt_runner.log_reader import RawFrame
from rt_runner.records import CONTROL_ID, END, RECORD, control

ENGINE_S = 1200.0


@dataclass(frozen=True)
class Answer:
    """What it said: frames in their order (stamp: the job's), and its identity."""

    frames: list[RawFrame]
    ready: dict


def run_engine(records: Iterable[bytes], setting: str, period_ns: int) -> Answer:
    """Feed records (frames and jobs) to ``rt_estimator --replay`` and read it to its end.

    Raises
    ------
    SetupError
        It is not built, or refuses the setting or the period. RtError: it refuses the records.
    """
    command = [
        str(paths.binary("rt_estimator")),
        "--replay",
        "--setting",
        setting,
        "--period-us",
        str(period_ns // 1000),
    ]
    try:
        done = subprocess.run(
            command, input=b"".join(records) + control(0, END), capture_output=True, timeout=ENGINE_S, check=False
        )
    except OSError as e:
        raise SetupError(f"{command[0]} does not run here ({e.strerror}): run 'make build'") from None
    except subprocess.TimeoutExpired:
        raise RtError(f"{command[0]} did not end within {ENGINE_S:g} s") from None
    lines = done.stderr.decode(errors="replace").splitlines()
    if done.returncode != 0:
        raise RtError(lines[-1] if lines else f"{command[0]} ended with exit status {done.returncode}")
    ready = next((json.loads(line) for line in lines if line.startswith('{"ready"')), {})
    frames = [
        RawFrame(t_ns, can_id, data[:length], length, 0)
        for t_ns, can_id, length, data in RECORD.iter_unpack(done.stdout)
        if can_id != CONTROL_ID
    ]
    return Answer(frames, ready)
