"""Which bus a run uses and why; opening a bus by its name; the hub as a process of the run.

A bus string is what every process is told: ``socketcan:vcan0`` or ``rt_hub:/path/to/hub.sock``.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rt_runner import paths
from rt_runner.children import Child
from rt_runner.errors import SetupError, UsageError

_SIOCGIFFLAGS, _SIOCGIFHWADDR = 0x8913, 0x8927
_IFF_UP, _ARPHRD_CAN, _IFNAMSIZ = 0x1, 280, 16
_SOCKET_PATH_MAX = 107
_HUB_READY_S = 5.0
HUB_PRIORITY = 40  # SCHED_FIFO: below the loops it serves, above whatever else its core does


@dataclass(frozen=True)
class Interface:
    """What the kernel says about a network interface (in this process's network namespace)."""

    name: str
    exists: bool
    is_can: bool = False
    up: bool = False


@dataclass(frozen=True)
class BusChoice:
    """The bus of a run. ``channel`` is the interface, empty for a hub that has not been started yet."""

    kind: Literal["socketcan", "rt_hub"]
    channel: str
    reason: str

    @property
    def name(self) -> str:
        """What people call it: ``hub`` or the interface."""
        return "hub" if self.kind == "rt_hub" else self.channel

    @property
    def bus(self) -> str:
        """The bus string for the processes."""
        return f"{self.kind}:{self.channel}"


def look_up(name: str) -> Interface:
    """Ask the kernel about an interface; by ioctl, since /sys may show another network namespace."""
    request = struct.pack(f"{_IFNAMSIZ}s24x", os.fsencode(name))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
        try:
            flags = struct.unpack_from("=H", fcntl.ioctl(s, _SIOCGIFFLAGS, request), _IFNAMSIZ)[0]
            family = struct.unpack_from("=H", fcntl.ioctl(s, _SIOCGIFHWADDR, request), _IFNAMSIZ)[0]
        except OSError:
            return Interface(name, exists=False)
    return Interface(name, exists=True, is_can=family == _ARPHRD_CAN, up=bool(flags & _IFF_UP))


def can_trouble() -> str | None:
    """Why this kernel has no CAN, None where it has. Asking loads the modules where they exist."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as e:
        return f"this kernel has no CAN support (socket(AF_CAN): {e.strerror})"
    return None


def choose_bus(wanted: str = "auto") -> BusChoice:
    """Choose the bus: ``auto`` (vcan0 if it is there and up, else the hub), ``hub``, or an interface by name.

    ``rt_hub:PATH`` is a hub that runs already, somebody else's: it is used and left as it is.

    Raises
    ------
    SetupError
        The interface asked for is missing, down, or no CAN interface.
    UsageError
        No interface can have that name.
    """
    if wanted == "hub":
        return BusChoice("rt_hub", "", "asked for")
    kind, _, path = wanted.partition(":")
    if kind == "rt_hub" and path:
        return BusChoice("rt_hub", path, "asked for")
    name = "vcan0" if wanted == "auto" else wanted
    if not 0 < len(os.fsencode(name)) < _IFNAMSIZ or any(c in "/:" or c.isspace() for c in name):
        raise UsageError(f"--bus {wanted!r}: not a bus; give auto, hub, or a CAN interface such as vcan0")
    interface = look_up(name)
    if not interface.exists:
        trouble = f"{name} does not exist" + (f": {why}" if (why := can_trouble()) else "")
    elif not interface.is_can:
        trouble = f"{name} is not a CAN interface"
    elif not interface.up:
        trouble = f"{name} is down"
    else:
        return BusChoice("socketcan", name, f"{name} exists and is up" if wanted == "auto" else "asked for")
    if wanted == "auto":
        return BusChoice("rt_hub", "", trouble)
    if interface.exists and not interface.is_can:
        remedy = "name a CAN interface"
    elif name.startswith("vcan"):
        remedy = f"create it with 'rt-runner vcan up --name {name}'"
    else:
        remedy = f"bring it up with its bit rate (ip link set {name} up type can bitrate ...)"
    raise SetupError(f"bus {name}: {trouble}; {remedy}, or take --bus hub")


def open_bus(bus: str, **options):
    """Open a bus by its bus string for python-can.

    Parameters
    ----------
    bus : str
        ``socketcan:IFACE`` or ``rt_hub:PATH``.
    **options
        ``can_filters`` as in python-can; ``receive=False`` for a client that only sends.

    Returns
    -------
    FdBus
        A ``can.BusABC`` that also counts ``rx_drops`` and ``rejected`` and keeps integer stamps (``rx_ns``).

    Raises
    ------
    UsageError
        The string names no bus.
    SetupError
        The bus cannot be opened. One line: what, where, what to do.
    """
    import can

    from rt_runner.hub_bus import HubBus
    from rt_runner.socketcan_bus import SocketcanBus

    kind, _, channel = bus.partition(":")
    if kind not in ("socketcan", "rt_hub") or not channel:
        raise UsageError(f"{bus!r} is not a bus: give socketcan:IFACE or rt_hub:PATH")
    try:
        return (HubBus if kind == "rt_hub" else SocketcanBus)(channel, **options)
    except can.CanInitializationError as e:
        remedy = "; 'rt-runner vcan up' creates vcan0, --bus hub needs no CAN" if kind == "socketcan" else ""
        raise SetupError(f"{bus}: {e}{remedy}") from e


def runtime_dir() -> Path:
    """Make a private folder, short enough for a socket path; the caller removes it."""
    for base in (os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir(), "/tmp"):
        if base and os.access(base, os.W_OK | os.X_OK) and len(os.fsencode(base)) + 32 < _SOCKET_PATH_MAX:
            return Path(tempfile.mkdtemp(prefix="rt-hub-", dir=base))
    raise SetupError("no folder for the hub's socket: set TMPDIR to a writable folder with a short path")


class HubProcess:
    """The hub binary, for as long as one run needs it, on a socket in a folder of its own.

    Parameters
    ----------
    stall_s : float
        How long a client may leave the bus waiting before the hub disconnects it.
    priority : int, optional
        SCHED_FIFO priority to ask for; ``refused`` says why the system did not grant it.

    Raises
    ------
    SetupError
        The binary is missing or did not start; nothing is left behind.
    """

    def __init__(self, stall_s: float = 2.0, cores: set[int] | None = None, priority: int | None = None) -> None:
        binary = paths.binary("rt_hub")
        self.counters: dict = {}
        self.refused = ""
        self._folder = runtime_dir()
        self.socket_path = self._folder / "bus"
        self.child: Child | None = None
        try:
            command = [str(binary), "--socket", str(self.socket_path), "--stall-s", f"{stall_s:g}"]
            self.child = Child("hub", command, cores)
            self.child.wait_line("ready", _HUB_READY_S)
            if priority is not None:
                self._raise_priority(self.child.process.pid, priority)
        except BaseException:
            self.stop()
            raise

    def _raise_priority(self, pid: int, priority: int) -> None:
        try:
            os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as e:
            self.refused = f"SCHED_FIFO priority {priority} refused ({e.strerror}): frames wait for the processor"

    @property
    def bus(self) -> str:
        """The bus string for the processes."""
        return f"rt_hub:{self.socket_path}"

    def ended(self) -> bool:
        """Whether the hub has ended by itself."""
        return self.child is None or self.child.ended()

    def stop(self) -> dict:
        """End the hub and remove its folder; harmless when repeated.

        Returns
        -------
        dict
            Its counters (frames, delivered, rejected, clients, refused, stalled, blocked_ms);
            empty if it was lost.
        """
        if self.child is not None:
            self.child.stop(3.0)
            while not self.child.lines.empty():
                line = self.child.lines.get()
                if isinstance(line, dict) and line.get("final"):
                    self.counters = line
        shutil.rmtree(self._folder, ignore_errors=True)
        return self.counters

    @staticmethod
    @contextlib.contextmanager
    def serving(
        choice: BusChoice,
        say: Callable[[str], None] | None = None,
        cores: set[int] | None = None,
        priority: int | None = None,
    ) -> Iterator[str]:
        """Have the chosen bus for the length of a ``with``: start the hub if it is one, give the bus string.

        ``say`` is told in one line if the hub was refused its priority, was lost or had to disconnect a client;
        ``cores`` and ``priority`` are those of the hub.
        """
        if choice.kind != "rt_hub" or choice.channel:
            yield choice.bus
            return
        hub = HubProcess(cores=cores, priority=priority)
        if hub.refused and say is not None:
            say(f"warning: hub: {hub.refused}")
        try:
            yield hub.bus
        finally:
            counters = hub.stop()
            if say is not None and hub.child is not None:
                if not counters:  # it did not live to say them
                    say(f"error: {hub.child.obituary()}")
                elif counters.get("stalled"):
                    say(f"warning: hub: {hub.child.last_words()}")
