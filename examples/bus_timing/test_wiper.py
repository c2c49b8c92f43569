"""A node of one's own with a DBC of one's own: started on the test's bus, recorded, judged."""

import subprocess
import sys
from pathlib import Path

import can

HERE = Path(__file__).parent


def test_the_wiper_keeps_its_cycle_times(virtual_bus, tmp_path, assert_cycle_times, assert_no_timeouts):
    log = tmp_path / "wiper.asc"
    with can.Notifier(virtual_bus.open(), [can.Logger(log)]):
        subprocess.run([sys.executable, HERE / "wiper.py", virtual_bus.interface, virtual_bus.channel, "2"], check=True)
    assert_cycle_times(log, HERE / "wiper.dbc", node="WIPER")
    assert_no_timeouts(log, HERE / "wiper.dbc")
