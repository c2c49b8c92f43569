"""Which bus is taken, and what is said where it cannot be had."""

import dataclasses

import pytest

import rt_runner.bus as bus_module
from rt_runner.bus import BusChoice, Interface, choose_bus, look_up, open_bus, runtime_dir
from rt_runner.errors import RtError, SetupError, UsageError

UP = Interface("vcan0", exists=True, is_can=True, up=True)


@pytest.fixture
def kernel(monkeypatch):
    """Pretend what the kernel says: kernel(interface, trouble)."""

    def pretend(interface: Interface, trouble: str | None = None) -> None:
        monkeypatch.setattr(bus_module, "look_up", lambda name: dataclasses.replace(interface, name=name))
        monkeypatch.setattr(bus_module, "can_trouble", lambda: trouble)

    return pretend


def test_auto_takes_vcan0_where_it_is_up(kernel):
    kernel(UP)
    choice = choose_bus()
    assert (choice.kind, choice.channel, choice.name, choice.bus) == ("socketcan", "vcan0", "vcan0", "socketcan:vcan0")
    assert choice.reason == "vcan0 exists and is up"


@pytest.mark.parametrize(
    ("interface", "trouble", "reason"),
    [
        (Interface("", exists=False), None, "vcan0 does not exist"),
        (Interface("", exists=False), "no CAN here", "vcan0 does not exist: no CAN here"),
        (Interface("", exists=True, is_can=True), None, "vcan0 is down"),
        (Interface("", exists=True, up=True), None, "vcan0 is not a CAN interface"),
    ],
)
def test_auto_takes_the_hub_elsewhere_and_says_why(kernel, interface, trouble, reason):
    kernel(interface, trouble)
    choice = choose_bus("auto")
    assert choice == BusChoice("rt_hub", "", reason)
    assert choice.name == "hub"


def test_the_hub_is_taken_when_asked_for_even_where_there_is_a_vcan0(kernel):
    kernel(UP)
    assert choose_bus("hub") == BusChoice("rt_hub", "", "asked for")


@pytest.mark.parametrize(
    ("name", "interface", "trouble", "line"),
    [
        ("vcan0", Interface("", exists=False), "no CAN here",
         "bus vcan0: vcan0 does not exist: no CAN here; create it with 'rt-runner vcan up --name vcan0', "
         "or take --bus hub"),
        ("can0", Interface("", exists=True, is_can=True), None,
         "bus can0: can0 is down; bring it up with its bit rate (ip link set can0 up type can bitrate ...), "
         "or take --bus hub"),
        ("eth0", Interface("", exists=True, up=True), None,
         "bus eth0: eth0 is not a CAN interface; name a CAN interface, or take --bus hub"),
    ],
)  # fmt: skip
def test_a_named_bus_is_that_one_or_an_error(kernel, name, interface, trouble, line):
    kernel(interface, trouble)
    with pytest.raises(SetupError) as e:
        choose_bus(name)
    assert str(e.value) == line
    kernel(UP)
    assert choose_bus(name).bus == f"socketcan:{name}"


@pytest.mark.parametrize("name", ["", "a b", "x/y", "sixteen-letters-", "line\nbreak"])
def test_what_cannot_be_an_interface_is_a_usage_error(name):
    with pytest.raises(UsageError, match="not a bus") as e:
        choose_bus(name)
    assert "\n" not in str(e.value)


def test_look_up_asks_the_kernel():
    assert look_up("lo") == Interface("lo", exists=True, is_can=False, up=True)
    assert look_up("nowhere0") == Interface("nowhere0", exists=False)


@pytest.mark.parametrize("bus", ["", "hub", "rt_hub:", "socketcan:", "udp:1", "socketcan"])
def test_open_bus_refuses_what_is_no_bus(bus):
    with pytest.raises(UsageError, match="is not a bus"):
        open_bus(bus)


@pytest.mark.parametrize("bus", ["rt_hub:/nowhere/bus", "rt_hub:/" + 200 * "x", "socketcan:nowhere0"])
def test_open_bus_says_in_one_line_what_is_missing(bus):
    with pytest.raises(SetupError) as e:
        open_bus(bus)
    assert str(e.value).startswith(f"{bus}: ")
    assert "\n" not in str(e.value)


def test_runtime_dir_is_private_and_short(monkeypatch, tmp_path):
    deep = tmp_path / ("d" * 90)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    folder = runtime_dir()
    try:
        assert not folder.is_relative_to(deep), "a socket path there would be too long"
        assert folder.stat().st_mode & 0o777 == 0o700
    finally:
        folder.rmdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/nowhere")
    monkeypatch.setattr("tempfile.gettempdir", lambda: "/nowhere")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(RtError, match="set TMPDIR"):
        runtime_dir()
