"""Programs that know nothing of us on our buses: python-can's logger, cantools' monitor, can-utils."""

import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from tests.support.buses import ROOT, have_vcan, wait_until


def message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def interface_of(buses) -> list[str]:
    kind, _, channel = buses.bus.partition(":")
    return [kind, channel]


def test_python_can_finds_the_interface_by_its_entry_point(hub):
    with can.Bus(interface="rt_hub", channel=str(hub.hub.path)) as a, hub.open() as b:
        a.send(message(0x12, b"plugin"))
        assert bytes(b.recv(5).data) == b"plugin"


def test_python_can_logger_writes_what_passes(buses, tmp_path):
    interface, channel = interface_of(buses)
    out = tmp_path / "bus.asc"
    a = buses.open()
    p = subprocess.Popen([sys.executable, "-m", "can.logger", "-i", interface, "-c", channel, "-f", out],
                         stdout=subprocess.PIPE, stderr=subprocess.STDOUT)  # fmt: skip

    def arrived() -> bool:  # it says nothing when it is ready: keep sending until it writes
        a.send(message(0x321, b"\xca\xfe"))
        return out.exists() and "CA FE" in out.read_text()

    def stopped() -> bool:
        p.send_signal(signal.SIGINT)
        return p.poll() is not None

    try:
        for _ in range(3000):
            if arrived() or p.poll() is not None:
                break
            time.sleep(0.01)
        a.send(message(0x322, b"\x01"))
        wait_until(stopped)
        text = out.read_text()
        assert "321" in text, p.communicate()
        assert "CA FE" in text
    finally:
        p.kill()
        p.communicate()


def test_cantools_monitor_shows_decoded_signals(buses):
    interface, channel = interface_of(buses)
    a = buses.open()
    master, slave = pty.openpty()
    command = [shutil.which("cantools", path=Path(sys.executable).parent) or "cantools", "monitor", "-i", interface,
               "-c", channel, ROOT / "dbc" / "drive.dbc"]  # fmt: skip
    p = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, close_fds=True,
                         env={**os.environ, "TERM": "xterm", "LINES": "40", "COLUMNS": "120"})  # fmt: skip
    os.close(slave)
    screen, deadline = b"", time.monotonic() + 60
    try:
        while b"torque_nm" not in screen and time.monotonic() < deadline and p.poll() is None:
            a.send(message(0x0A0, bytes(8)))
            if select.select([master], [], [], 0.05)[0]:
                try:
                    screen += os.read(master, 65536)
                except OSError:
                    break
        assert b"MotorState" in screen, screen[-2000:]
        assert b"torque_nm" in screen
    finally:
        p.kill()
        p.wait()
        os.close(master)


@pytest.mark.vcan
def test_can_utils_and_we_understand_each_other(vcan):
    for tool in ("candump", "cansend"):
        assert shutil.which(tool), f"{tool} is missing: tools/apt-install can-utils"
    candump = subprocess.Popen(["candump", "-L", "-n", "2", "vcan0"], stdout=subprocess.PIPE, text=True)
    b, a, c = vcan.open(), vcan.open(), vcan.client("recv", 1)
    subprocess.run(["cansend", "vcan0", "123#DEADBEEF"], check=True)
    got = b.recv(5)
    assert (got.arbitration_id, bytes(got.data)) == (0x123, bytes.fromhex("DEADBEEF"))
    _, out, _ = c.end()
    assert out[0].startswith("00000123 00 DEADBEEF ")
    # candump says nothing when it is ready: if it missed the first, it sees these
    for _ in range(50):
        if candump.poll() is not None:
            break
        a.send(message(0x456, b"\x01\x02"))
        time.sleep(0.02)
    assert "456#0102" in candump.communicate(timeout=20)[0]


@pytest.mark.vcan
def test_python_cans_own_socketcan_and_ours_understand_each_other():
    have_vcan()
    from rt_runner.bus import open_bus

    with can.Bus(interface="socketcan", channel="vcan0", fd=True) as theirs, open_bus("socketcan:vcan0") as ours:
        theirs.send(message(0x77, b"theirs"))
        assert bytes(ours.recv(5).data) == b"theirs"
        ours.send(can.Message(arbitration_id=0x78, data=bytes(48), is_fd=True, bitrate_switch=True))
        got = theirs.recv(5)
        assert (got.arbitration_id, got.is_fd, got.bitrate_switch, len(got.data)) == (0x78, True, True, 48)


@pytest.mark.vcan
def test_an_interface_that_goes_down_is_one_line():
    have_vcan()
    from rt_runner.bus import open_bus
    from tests.support.buses import Client

    ip = shutil.which("ip", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
    subprocess.run([ip, "link", "add", "dev", "vcan8", "type", "vcan"], check=True)
    try:
        subprocess.run([ip, "link", "set", "vcan8", "up"], check=True)
        with open_bus("socketcan:vcan8") as bus:
            client = Client("socketcan:vcan8", "recv", 1)
            subprocess.run([ip, "link", "set", "vcan8", "down"], check=True)
            with pytest.raises(can.CanOperationError, match="socketcan vcan8: Network is down"):
                bus.recv(5)
            status, _, err = client.end()
            assert (status, err.count("\n")) == (3, 1)
            assert "Network is down" in err
    finally:
        subprocess.run([ip, "link", "delete", "vcan8"], check=True)
