"""The real processes in virtual time (``tools/vcan-lab -V``): two runs write the same log, byte for byte.

Hub, plant, estimator, logger and runner as in any run, on a kernel whose clock stands still while they compute and
jumps when all of them sleep. What differs between two such runs would be a race of ours.
"""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rt_runner.log_reader import LogReader
from tests.support.runs import ROOT, load_result

pytestmark = pytest.mark.virtual
LIMIT_S = 240
SECONDS = 3
START_NS = 1_767_225_600 * 10**9  # the lab's clock starts here
MS = 1_000_000


@pytest.fixture(scope="module")
def lab():
    """`tools/vcan-lab -V`, with its kernel built; without one the tests fail where RT_REQUIRE_VIRTUAL=1 asks for it."""
    check = subprocess.run([ROOT / "tools" / "vcan-lab-kernel", "--check"], check=False, stdout=subprocess.DEVNULL)
    if check.returncode != 0:
        text = "no kernel with virtual time: run tools/vcan-lab-kernel (six CPU minutes, once)"
        if os.environ.get("RT_REQUIRE_VIRTUAL") == "1":
            pytest.fail(text)
        pytest.skip(text)
    return [ROOT / "tools" / "vcan-lab", "-t", str(LIMIT_S), "-V", "--"]


def in_lab(lab, script, folder: Path):
    """Run a shell script there, ``$RT`` being rt-runner."""
    rt = f"{sys.executable} -m rt_runner.cli"
    done = subprocess.run(
        [*lab, "env", f"RT={rt}", "bash", "-c", script],
        cwd=ROOT,
        env={**os.environ, "OUT": str(folder)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S + 60,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done


@pytest.fixture(scope="module")
def runs(lab, tmp_path_factory):
    """Twice the same, each time on a freshly started kernel: a run on vcan0, one on the hub, one with another seed."""
    folder = tmp_path_factory.mktemp("virtual")
    for number in (1, 2):
        (folder / str(number)).mkdir()
        script = f"""cd {ROOT}
        one() {{ $RT run hot-lap --duration {SECONDS} --log $OUT/$1.mcap --json $OUT/$1.json "${{@:2}}"; [ $? = 3 ]; }}
        one vcan0 --bus vcan0 && one hub --bus hub && {{ [ {number} = 2 ] || one seed --bus vcan0 --seed 2; }}"""
        in_lab(lab, script, folder / str(number))
    return folder


@pytest.mark.parametrize("bus", ["vcan0", "hub"])
def test_two_runs_write_the_same_bytes(runs, bus):
    logs = [(runs / n / f"{bus}.mcap").read_bytes() for n in "12"]
    first, second = ([*LogReader(runs / n / f"{bus}.mcap").raw()] for n in "12")
    different = next(((x, y) for x, y in zip(first, second, strict=False) if x != y), None)
    assert different is None, f"the first frame that is not the same: {different}"
    assert len(first) == len(second) > 200 * SECONDS
    assert hashlib.sha256(logs[0]).digest() == hashlib.sha256(logs[1]).digest(), "frames the same, the rest is not"
    results = [load_result(runs / n / f"{bus}.json") for n in "12"]
    assert results[0] == results[1]


@pytest.mark.parametrize("bus", ["vcan0", "hub"])
def test_nothing_is_late_where_computing_takes_no_time(runs, bus):
    """Stamps on the grids of plant (10 ms) and estimator (100 ms), to 10 us; no release missed."""
    frames = list(LogReader(runs / "1" / f"{bus}.mcap").frames({"MotorState", "Estimate", "EstTimingA"}))
    assert START_NS < frames[0].t_ns < START_NS + 600 * 10**9
    for name, period_ns in (("MotorState", 10 * MS), ("Estimate", 100 * MS)):
        stamps = [f.t_ns for f in frames if f.name == name]
        assert len(stamps) >= SECONDS * 1000 * MS // period_ns
        assert max(abs(t - stamps[0] - k * period_ns) for k, t in enumerate(stamps)) < 10_000
    index = [f.values["release_index"] for f in frames if f.name == "EstTimingA"]
    assert index == list(range(1, len(index) + 1))


def test_another_seed_is_another_log(runs):
    """What keeps the test of equality from passing on anything."""
    first, other = ([f.data for f in LogReader(runs / "1" / f"{n}.mcap").raw()] for n in ("vcan0", "seed"))
    assert len(first) == len(other)
    assert first != other


def test_time_jumps_when_all_sleep(lab, tmp_path):
    """An hour of sleep, and a deadline that is met to the microsecond."""
    script = f"""{sys.executable} - <<'END'
import json, os, time
start = time.monotonic_ns()
time.sleep(3600)
json.dump({{"slept": time.monotonic_ns() - start, "lab": os.environ["RT_LAB"]}}, open("{tmp_path}/slept.json", "w"))
END"""
    in_lab(lab, script, tmp_path)
    slept = json.loads((tmp_path / "slept.json").read_text())
    assert abs(slept["slept"] - 3600 * 10**9) < MS
    assert slept["lab"] == "virtual"
