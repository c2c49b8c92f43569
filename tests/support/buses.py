"""Buses for tests: the hub and the C client built with sanitizers, and a bus string for each transport."""

import functools
import json
import os
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

from rt_runner.bus import look_up, open_bus

ROOT = Path(__file__).resolve().parents[2]
C = ROOT / "estimator_c"
FLAGS = ["-std=c11", "-g", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-D_GNU_SOURCE",
         "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]  # fmt: skip
TRANSPORTS = ["hub", pytest.param("socketcan", marks=pytest.mark.vcan)]


@functools.cache
def build(source: str) -> Path:
    """Compile a program of the bus (``estimator_c/apps/rt_hub.c``, ``tests/c/test_hub_*.c``) with sanitizers."""
    folder = tempfile.TemporaryDirectory(prefix="rt-bus-")
    _FOLDERS.append(folder)
    out = Path(folder.name) / Path(source).stem
    files = [ROOT / source, C / "src" / "hub.c", C / "src" / "can_port.c"]
    subprocess.run(["gcc", *FLAGS, f"-I{C / 'src'}", *files, "-o", out, "-lm"], check=True)
    return out


_FOLDERS: list[tempfile.TemporaryDirectory] = []


_PROGRAMS: list[subprocess.Popen] = []


def end_leftovers() -> None:
    """Kill what a failed test has left running."""
    while _PROGRAMS:
        p = _PROGRAMS.pop()
        if p.poll() is None:
            p.kill()
            p.communicate()


class Program:
    """A C program under test. A sanitizer's report, which goes to stderr, fails the test that ends it."""

    def __init__(self, source: str, *arguments: object) -> None:
        # Unbuffered: communicate() reads the descriptor and would miss what readline has read ahead.
        self.process = subprocess.Popen([build(source), *map(str, arguments)], bufsize=0,
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
        _PROGRAMS.append(self.process)
        self.ready: dict = {}
        if line := self.read_line():
            self.ready = json.loads(line)

    def read_line(self) -> str:
        """The next line of stdout, empty at its end."""
        return self.process.stdout.readline().decode()  # type: ignore[union-attr]

    def end(self, sig: int | None = None, timeout_s: float = 60.0) -> tuple[int, list[str], str]:
        """Wait for the end (after a signal); exit status, lines of stdout, stderr."""
        if sig is not None:
            self.process.send_signal(sig)
        try:
            out, err = self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            out, err = self.process.communicate()
            raise AssertionError(f"did not end within {timeout_s:g} s: {out!r} {err!r}") from None
        out, err = out.decode(), err.decode()
        assert "Sanitizer" not in err, err
        assert "runtime error" not in err, err
        return self.process.returncode, out.splitlines(), err

    def counters(self, sig: int | None = None) -> dict:
        """End with status 0; its last line."""
        status, out, err = self.end(sig)
        assert status == 0, (status, out, err)
        return json.loads(out[-1])


class Hub(Program):
    """The hub, at ``path``; ``counters(SIGTERM)`` ends it."""

    def __init__(self, path: Path, *options: object) -> None:
        super().__init__("estimator_c/apps/rt_hub.c", "--socket", path, *options)
        self.path = path
        self.bus = f"rt_hub:{path}"


class Client(Program):
    """The C client ``tests/c/test_hub_port.c`` on a bus."""

    def __init__(self, bus: str, mode: str, *arguments: object) -> None:
        super().__init__("tests/c/test_hub_port.c", bus, mode, *arguments)


def have_vcan() -> None:
    """Skip with a reason where there is no vcan0; fail where RT_REQUIRE_VCAN=1 says there must be one."""
    vcan0 = look_up("vcan0")
    if vcan0.up and vcan0.is_can:
        return
    text = "no vcan0 on this machine: not tested on SocketCAN (tools/vcan-lab -- pytest -m vcan)"
    if os.environ.get("RT_REQUIRE_VCAN") == "1":
        pytest.fail(text)
    pytest.skip(text)


def raw_client(path: Path) -> socket.socket:
    """A client of the hub that may send anything."""
    s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    s.connect(str(path))
    s.settimeout(10)
    return s


def drain(bus, quiet_s: float = 0.3) -> list:
    """All messages until none has come for a while."""
    messages = []
    while (m := bus.recv(quiet_s)) is not None:
        messages.append(m)
    return messages


def wait_until(condition, timeout_s: float = 20.0) -> None:
    """Wait for something another process does."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


class Buses:
    """Opens buses on one transport and closes them with the test."""

    def __init__(self, bus: str, hub: Hub | None) -> None:
        self.bus, self.hub = bus, hub
        self._open: list = []

    def open(self, **options):
        """A new python-can bus of ours."""
        self._open.append(open_bus(self.bus, **options))
        return self._open[-1]

    def client(self, mode: str, *arguments: object) -> Client:
        """A C client, ready."""
        c = Client(self.bus, mode, *arguments)
        assert c.ready == {"ready": True}, c.end()
        return c

    def close(self) -> None:
        """Close all; the hub must end well, whatever the test did to it."""
        for bus in self._open:
            bus.shutdown()
        if self.hub is not None and self.hub.process.poll() is None:
            self.hub.process.send_signal(signal.SIGCONT)
            assert self.hub.counters(signal.SIGTERM)["final"]
            assert not self.hub.path.exists()
