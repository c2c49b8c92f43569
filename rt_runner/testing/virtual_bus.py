"""A bus for one test: the hub on a socket of its own, or a CAN interface that nobody else tests on meanwhile."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Iterator

from rt_runner import machine
from rt_runner.bus import HUB_PRIORITY, BusChoice, HubProcess, can_trouble, choose_bus, open_bus
from rt_runner.errors import SetupError

REQUIRE_VCAN = "RT_REQUIRE_VCAN"
_TURN_POLL_S = 0.05


class NoBus(SetupError):
    """The bus asked for is not on this machine: a reason to skip, unless it must be there."""


class VirtualBus:
    """What a test gets.

    Attributes
    ----------
    name : ``hub``, or the interface
    reason : why it is this one
    interface, channel : for ``can.Bus(interface=…, channel=…)`` and other people's tools
    bus : both in one, ``socketcan:vcan0`` or ``rt_hub:/path``, for our own processes
    """

    def __init__(self, choice: BusChoice, bus: str) -> None:
        self.name, self.reason, self.bus = choice.name, choice.reason, bus
        self.interface, _, self.channel = bus.partition(":")
        self._open: list = []

    def __repr__(self) -> str:
        return f"<VirtualBus {self.name}: {self.reason}>"

    def open(self, **options):
        """A new ``can.BusABC`` on it, closed with the test.

        ``receive=False`` for a client that only sends: on the hub one that neither reads nor says so holds the others
        up, and is disconnected after two seconds. ``can_filters`` as in python-can.
        """
        self._open.append(open_bus(self.bus, **options))
        return self._open[-1]

    def close(self) -> None:
        """Close what was opened."""
        while self._open:
            self._open.pop().shutdown()


@contextlib.contextmanager
def virtual_bus(wanted: str = "auto") -> Iterator[VirtualBus]:
    """A bus for the length of a ``with``.

    Parameters
    ----------
    wanted : ``auto`` (vcan0 where it is, else the hub), ``hub``, or an interface by name

    Raises
    ------
    NoBus
        It is not on this machine. With RT_REQUIRE_VCAN=1 ``auto`` does not take the hub instead.
    SetupError
        The hub is not built, does not start, or ended before the test did.
    """
    choice = _choose(wanted)
    lost: list[str] = []
    _, others = machine.split_cores()
    with _turn(choice), HubProcess.serving(choice, lost.append, others, HUB_PRIORITY) as bus:
        made = VirtualBus(choice, bus)
        try:
            yield made
        finally:
            made.close()
    if errors := [text for text in lost if text.startswith("error")]:
        raise SetupError(f"the bus ended before the test did: {errors[0].removeprefix('error: ')}")


def must_exist() -> bool:
    """Whether this machine is said to have a vcan0 (the lab, CI)."""
    return os.environ.get(REQUIRE_VCAN) == "1"


def _choose(wanted: str) -> BusChoice:
    if wanted == "auto" and must_exist():
        wanted = "vcan0"
    try:
        return choose_bus(wanted)
    except SetupError as e:
        trouble, option = can_trouble(), "--rt-bus=hub"
        text = str(e).replace("--bus hub", option)
        raise NoBus(text if trouble is None else f"bus {wanted}: {trouble}; run it in the lab, or {option}") from None


@contextlib.contextmanager
def _turn(choice: BusChoice) -> Iterator[None]:
    """Wait until no other test process uses this interface. The hub is the test's own and needs no turn.

    The lock is a name in this network namespace, as the interface is; it ends with its owner, however that ends.
    """
    if choice.kind == "rt_hub":
        yield
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        while True:
            try:
                lock.bind(f"\0rt-runner-test-{choice.channel}")
                break
            except OSError:
                time.sleep(_TURN_POLL_S)
        yield
