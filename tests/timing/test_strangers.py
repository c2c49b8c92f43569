"""Strangers' tools beside a run on a real vcan0: candump sees the very frames we log, cantools shows their signals."""

import os
import pty
import select
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rt_runner.mcap_log import LogReader
from tests.support.buses import have_vcan
from tests.support.runs import ROOT, start_rt_runner


@pytest.mark.vcan
def test_candump_and_cantools_monitor_beside_a_run(tmp_path):
    have_vcan()
    assert shutil.which("candump"), "needs candump: tools/apt-install can-utils"
    log, dump = tmp_path / "run.mcap", tmp_path / "candump.log"
    with dump.open("w") as out:
        candump = subprocess.Popen(["candump", "-L", "-r", "4000000", "vcan0"], stdout=out, stderr=subprocess.PIPE)
    master, slave = pty.openpty()
    cantools = shutil.which("cantools", path=Path(sys.executable).parent) or "cantools"
    monitor = subprocess.Popen(
        [cantools, "monitor", "-c", "vcan0", "-i", "socketcan", ROOT / "dbc" / "drive.dbc"],
        stdin=slave, stdout=slave, stderr=slave, close_fds=True,
        env={**os.environ, "TERM": "xterm", "LINES": "160", "COLUMNS": "120"},
    )  # fmt: skip
    os.close(slave)
    screen = b""
    run = start_rt_runner("run", "hot-lap", "--bus", "vcan0", "--duration", 12, "--log", log)
    try:
        while run.poll() is None:
            if select.select([master], [], [], 0.1)[0]:
                screen += os.read(master, 65536)
        said = run.communicate()
        assert run.returncode in (0, 3), said
    finally:
        for p in (candump, monitor, run):
            if p.poll() is None:
                p.terminate()
            p.wait(10)
        os.close(master)
    for text in (b"MotorState", b"theta_w_est_degc", b"TruthTemp"):
        assert text in screen, screen[-2000:]
    seen = [line.split()[2] for line in dump.read_text().splitlines()]
    ours = [f"{f.can_id:03X}#{f.data.hex().upper()}" for f in LogReader(log).raw()]
    assert len(ours) > 2000
    assert seen == ours, "candump and our log saw different buses"
