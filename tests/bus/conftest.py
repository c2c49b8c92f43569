"""Fixtures: one bus per test, on the hub always, on SocketCAN where there is a vcan0."""

import pytest

from tests.support.buses import TRANSPORTS, Buses, Hub, end_leftovers, have_vcan


@pytest.fixture(autouse=True)
def _no_leftovers():
    yield
    end_leftovers()


@pytest.fixture
def hub(tmp_path):
    """A hub on the test's own socket, built with sanitizers."""
    buses = Buses("", Hub(tmp_path / "bus", "--stall-s", "1"))
    buses.bus = buses.hub.bus
    yield buses
    buses.close()


@pytest.fixture(params=TRANSPORTS)
def buses(request):
    """A bus on each transport."""
    if request.param == "hub":
        yield request.getfixturevalue("hub")
        return
    yield request.getfixturevalue("vcan")


@pytest.fixture
def vcan():
    """The real vcan0; mark the test with ``vcan``."""
    have_vcan()
    made = Buses("socketcan:vcan0", None)
    yield made
    made.close()
