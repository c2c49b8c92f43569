"""The hub as a process: what it does with clients that misbehave, with its socket, and at its end."""

import fcntl
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from rt_runner.bus import BusChoice, HubProcess, open_bus
from rt_runner.errors import SetupError
from rt_runner.fd_bus import CLASSIC, FD
from tests.support.buses import Client, Hub, build, raw_client, wait_until


def frame(can_id: int, data: bytes = b"") -> bytes:
    return CLASSIC.pack(can_id, len(data), data)


def message(can_id: int) -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False)


def test_core_by_scripted_clock():
    done = subprocess.run([build("tests/c/test_hub_core.c")], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ok\n", "")


GARBAGE = [
    *(bytes(n) for n in (0, 1, 15, 17, 71, 73, 100, 60_000)),
    b"\xff" * 16,
    b"\xff" * 72,
    CLASSIC.pack(1, 9, b""),
    FD.pack(1, 65, 0, b""),
    CLASSIC.pack(0x800, 1, b"x"),
    b'{"ready":true}\n',
]


def test_garbage_is_counted_dropped_and_seen_by_nobody(hub):
    reader, c_reader, bad = hub.open(), hub.client("recv", 2), raw_client(hub.hub.path)
    bad.send(frame(0x111))
    for datagram in GARBAGE:
        bad.send(datagram)
    bad.send(frame(0x222))
    assert [reader.recv(5).arbitration_id for _ in range(2)] == [0x111, 0x222]
    assert (reader.recv(0.1), reader.rejected) == (None, 0)
    c = c_reader.counters()
    assert (c["received"], c["rejected"]) == (2, 0)
    final = hub.hub.counters(signal.SIGTERM)
    assert (final["rejected"], final["frames"], final["stalled"]) == (len(GARBAGE), 2, 0)
    bad.close()


def test_descriptors_sent_along_are_not_kept(hub):
    """SCM_RIGHTS to a hub that takes no ancillary data: the kernel closes them, the frame passes."""
    reader, bad = hub.open(), raw_client(hub.hub.path)
    bad.send(frame(0x41))
    assert reader.recv(5).arbitration_id == 0x41  # both are accepted now
    before = len(os.listdir(f"/proc/{hub.hub.process.pid}/fd"))
    r, w = os.pipe()
    for _ in range(200):
        socket.send_fds(bad, [frame(0x42)], [r, w])
        assert reader.recv(5).arbitration_id == 0x42
    assert len(os.listdir(f"/proc/{hub.hub.process.pid}/fd")) == before
    os.close(r), os.close(w), bad.close()


@pytest.fixture
def fake_hub(tmp_path):
    """A listening socket that the test answers itself."""
    path = tmp_path / "fake"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen(1)
        listener.settimeout(10)
        yield listener, f"rt_hub:{path}"


def test_clients_survive_garbage_from_a_broken_hub(fake_hub):
    listener, bus = fake_hub
    with open_bus(bus) as reader:
        server = listener.accept()[0]
        for datagram in [g for g in GARBAGE if g]:
            server.send(datagram)
        server.send(frame(0x55))
        assert reader.recv(5).arbitration_id == 0x55
        assert reader.rejected == len(GARBAGE) - 1
        server.send(bytes(3))
        assert reader.recv(0.05) is None
        server.close()
        with pytest.raises(can.CanOperationError, match="has closed the connection"):
            reader.recv(1)


def test_frames_of_a_hub_that_died_are_still_read(fake_hub):
    """It dies with a frame of ours unread, which resets the connection before what it had queued for us."""
    listener, bus = fake_hub
    with open_bus(bus) as reader:
        server = listener.accept()[0]
        reader.send(message(1))
        server.send(frame(0x31))
        server.send(frame(0x32))
        server.close()
        assert [reader.recv(5).arbitration_id for _ in range(2)] == [0x31, 0x32]
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="has closed the connection"):
                reader.recv(5)


def test_the_c_port_call_by_call(tmp_path):
    done = subprocess.run([build("tests/c/test_hub_client.c"), tmp_path / "bus"], capture_output=True, text=True,
                          timeout=120)  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "ok\n", "")


def test_the_c_port_survives_garbage_and_does_not_loop_on_it(fake_hub):
    listener, bus = fake_hub
    client = Client(bus, "recv", 1)
    server = listener.accept()[0]
    for i in range(200):  # more than one call skips
        server.send(GARBAGE[1 + i % (len(GARBAGE) - 1)])
    server.send(frame(0x77, b"abc"))
    status, out, _ = client.end()
    assert (status, out[0].split()[:3]) == (0, ["00000077", "00", "616263"])
    assert json.loads(out[-1])["rejected"] == 200
    server.close()


def test_a_stopped_client_is_disconnected_and_named_and_the_others_lose_nothing(hub):
    stopped = hub.client("count", 10_000_000)
    stopped.process.send_signal(signal.SIGSTOP)
    count = 60_000  # more than its queue holds
    reader, sender = hub.client("count", count), hub.client("send", count)
    assert sender.counters()["sent"] == count
    assert reader.counters()["received"] == count
    stopped.process.send_signal(signal.SIGCONT)
    status, _, err = stopped.end()
    assert status == 3
    assert "the hub closed the connection" in err
    status, out, err = hub.hub.end(signal.SIGTERM)
    assert status == 0
    assert json.loads(out[-1])["stalled"] == 1
    assert 900 < json.loads(out[-1])["blocked_ms"] < 20_000
    assert err.count("\n") == 1
    assert f"disconnected client {stopped.process.pid} (test_hub_port): it has not read for 1 s" in err


def test_the_last_frames_of_a_killed_client_arrive(hub):
    """It dies with frames unread, and with frames of its own that the hub has not taken yet."""
    reader = hub.open()
    dying = raw_client(hub.hub.path)
    reader.send(message(0x001))
    wait_until(lambda: dying.recv(100, socket.MSG_PEEK))
    hub.hub.process.send_signal(signal.SIGSTOP)
    dying.settimeout(None)  # with a time limit Python asks poll first, which says no at a quarter of the room
    for i in range(100):
        dying.send(frame(0x100 + i))
    dying.close()
    hub.hub.process.send_signal(signal.SIGCONT)
    assert [reader.recv(5).arbitration_id for _ in range(100)] == [0x100 + i for i in range(100)]


def test_a_client_that_has_connected_misses_nothing_sent_afterwards(hub):
    """connect returns before the hub accepts: a frame sent in between must still arrive."""
    with hub.open() as sender:
        for i in range(300):
            with open_bus(hub.bus) as late:
                sender.send(message(i))
                assert late.recv(5) is not None, f"round {i}"


def test_killed_hub_is_one_line_for_python_and_for_c(hub):
    reader, client = hub.open(), hub.client("recv", 5)
    reader.send(message(0x10))
    wait_until(lambda: "00000010" in client.read_line())
    hub.hub.process.kill()
    hub.hub.process.wait()
    with pytest.raises(can.CanOperationError, match=rf"rt_hub {hub.hub.path}: the hub has closed the connection"):
        reader.recv(5)
    with pytest.raises(can.CanOperationError, match="the hub has closed the connection"):
        reader.send(message(1))
    status, _, err = client.end()
    assert (status, err.count("\n")) == (3, 1)
    assert "rt_hub: the hub closed the connection" in err
    with pytest.raises(SetupError, match=r"no hub at .* \(Connection refused\): start one") as e:
        open_bus(hub.bus)
    assert "\n" not in str(e.value)
    again = Hub(hub.hub.path)  # the stale socket is replaced
    assert again.ready["ready"] is True
    with open_bus(hub.bus) as a, open_bus(hub.bus) as b:
        a.send(message(3))
        assert b.recv(5).arbitration_id == 3
    again.counters(signal.SIGTERM)


def test_frames_sent_before_the_end_of_the_hub_are_still_read(hub):
    reader, sender = hub.open(), hub.open()
    last = hub.open()
    for i in range(50):
        sender.send(message(i))
    assert [last.recv(5).arbitration_id for _ in range(50)] == list(range(50))
    assert hub.hub.counters(signal.SIGTERM)["delivered"] == 100
    assert [reader.recv(5).arbitration_id for _ in range(50)] == list(range(50))
    with pytest.raises(can.CanOperationError):
        reader.recv(5)


@pytest.mark.parametrize("sig", [signal.SIGTERM, signal.SIGINT])
def test_ends_cleanly(tmp_path, sig):
    hub = Hub(tmp_path / "bus")
    assert hub.ready == {"ready": True, "socket": str(hub.path), "stall_s": 2, "clients_max": 32,
                         "pid": hub.process.pid}  # fmt: skip
    assert hub.counters(sig) == {"final": True, "frames": 0, "delivered": 0, "rejected": 0, "clients": 0,
                                 "refused": 0, "stalled": 0, "blocked_ms": 0}  # fmt: skip
    assert not hub.path.exists()


def set_up_error(*arguments: object) -> str:
    """Start a hub that must refuse; its one line."""
    done = subprocess.run([build("estimator_c/apps/rt_hub.c"), *map(str, arguments)], capture_output=True, text=True,
                          timeout=30)  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done
    return done.stderr


def test_set_up_errors_are_one_line(tmp_path, hub):
    assert "already listens at" in set_up_error("--socket", hub.hub.path)
    hub.open().send(message(1))  # and the one that is running does not mind
    file = tmp_path / "file"
    file.write_text("precious")
    assert "exists and is not a socket" in set_up_error("--socket", file)
    assert file.read_text() == "precious"
    assert "the path has 200 bytes, a socket's path at most 107" in set_up_error("--socket", "/" + 199 * "x")
    assert "cannot open the folder" in set_up_error("--socket", tmp_path / "no" / "bus")
    assert "--socket PATH is missing" in set_up_error()
    assert "--stall-s 0: give seconds" in set_up_error("--socket", tmp_path / "b", "--stall-s", "0")
    assert "--mode 999" in set_up_error("--socket", tmp_path / "b", "--mode", "999")


@pytest.mark.parametrize("arguments", [["--help"], ["--socket", "hub.sock"]])
def test_a_stdout_that_takes_nothing_is_one_line_and_exit_1(tmp_path, arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run([build("estimator_c/apps/rt_hub.c"), *arguments], cwd=tmp_path, stdout=full,
                              stderr=subprocess.PIPE, text=True, timeout=30)  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("rt_hub: stdout: cannot write the ")
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_two_hubs_started_at_once_do_not_take_each_others_socket(tmp_path):
    for i in range(5):
        path = tmp_path / f"bus{i}"
        stale = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stale.bind(str(path))
        stale.close()
        both = [subprocess.Popen([build("estimator_c/apps/rt_hub.c"), "--socket", path], text=True,
                                 stdout=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(3)]  # fmt: skip
        lines = [p.stdout.readline() for p in both]
        assert sum(bool(line) for line in lines) == 1
        raw_client(path).close()
        for p, line in zip(both, lines, strict=True):
            if line:
                p.terminate()
            out, err = p.communicate(timeout=20)
            assert p.returncode == (0 if line else 1), (out, err)


def test_a_starting_hub_waits_for_another_that_is_starting(tmp_path):
    """Both look whether the socket is stale under a lock of its folder."""
    folder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    p = subprocess.Popen([build("estimator_c/apps/rt_hub.c"), "--socket", tmp_path / "bus"], text=True,
                         stdout=subprocess.PIPE)  # fmt: skip
    try:
        assert select.select([p.stdout], [], [], 0.5)[0] == []
        fcntl.flock(folder, fcntl.LOCK_UN)
        assert '"ready":true' in p.stdout.readline()
        p.terminate()
        assert p.wait(20) == 0
    finally:
        p.kill()
        p.communicate()
        os.close(folder)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_out_of_descriptors_it_waits_without_spinning_and_serves_who_is_in(hub):
    pid = hub.hub.process.pid
    first, second = raw_client(hub.hub.path), raw_client(hub.hub.path)
    first.send(frame(0x1))
    assert second.recv(100) == frame(0x1)  # both are in
    used = len(os.listdir(f"/proc/{pid}/fd"))
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (used, used))
    waiting = raw_client(hub.hub.path)
    before = cpu_s(pid)
    time.sleep(1.0)
    assert cpu_s(pid) - before < 0.3
    first.send(frame(0x2))
    assert second.recv(100) == frame(0x2)
    second.close()  # makes room
    first.settimeout(0.05)
    waiting.send(frame(0x3))
    wait_until(lambda: _receives(first, frame(0x3)))
    first.send(frame(0x4))
    assert waiting.recv(100) == frame(0x4)
    first.close(), waiting.close()


def _receives(client: socket.socket, expected: bytes) -> bool:
    try:
        return client.recv(100) == expected
    except TimeoutError:
        return False


def test_a_process_name_of_fifteen_letters_is_whole(tmp_path):
    hub = Hub(tmp_path / "hub", "--stall-s", "0.05")
    stuck = subprocess.Popen([sys.executable, "-c", STUCK, hub.path], stdout=subprocess.PIPE)
    assert stuck.stdout.readline() == b"in\n"
    client = Client(hub.bus, "send", 30_000)
    assert client.end()[0] == 0
    _, _, err = hub.end(signal.SIGTERM)
    stuck.kill(), stuck.communicate()
    assert f"disconnected client {stuck.pid} (fifteen_letters)" in err


STUCK = """
import socket, sys, time
open("/proc/self/comm", "w").write("fifteen_letters")
s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
s.connect(sys.argv[1])
print("in", flush=True)
time.sleep(60)
"""


def test_a_full_table_refuses_politely(hub):
    clients = [raw_client(hub.hub.path) for _ in range(32)]
    with open_bus(hub.bus) as one_too_many, pytest.raises(can.CanOperationError, match="has closed"):
        one_too_many.recv(5)
    clients[0].close()
    clients[1].send(frame(0x5))
    assert clients[31].recv(100) == frame(0x5)
    with open_bus(hub.bus) as fits:
        clients[1].send(frame(0x6))
        assert fits.recv(5).arbitration_id == 0x6
    for c in clients:
        c.close()
    wait_until(lambda: len(os.listdir(f"/proc/{hub.hub.process.pid}/fd")) < 10)
    assert hub.hub.counters(signal.SIGTERM)["refused"] == 1


CONNECT = "import os, socket, sys; os.setgid(65534); os.setuid(65534); " \
          "socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET).connect(sys.argv[1])"  # fmt: skip


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can try as another user")
@pytest.mark.parametrize(("mode", "allowed"), [("0600", False), ("0666", True)])
def test_who_may_connect(mode, allowed):
    folder = HubProcessFolder()
    hub = Hub(folder.path / "bus", "--mode", mode)
    done = subprocess.run([sys.executable, "-c", CONNECT, str(hub.path)], capture_output=True, text=True, timeout=30)
    assert (done.returncode == 0) == allowed, done.stderr
    assert allowed or "Permission denied" in done.stderr
    hub.counters(signal.SIGTERM)
    folder.path.rmdir()


class HubProcessFolder:
    """A folder that every user may enter; pytest's own are private."""

    def __init__(self) -> None:
        from rt_runner.bus import runtime_dir

        self.path = runtime_dir()
        self.path.chmod(0o755)


def test_ends_with_its_parent(tmp_path):
    code = "import subprocess, sys; p = subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE); " \
           "p.stdout.readline(); print(p.pid)"  # fmt: skip
    path = tmp_path / "bus"
    done = subprocess.run([sys.executable, "-c", code, build("estimator_c/apps/rt_hub.c"), "--socket", path,
                           "--with-parent"], capture_output=True, text=True, timeout=30)  # fmt: skip
    assert done.stdout.strip().isdigit(), done
    wait_until(lambda: not path.exists())


def test_no_memory_is_taken_while_it_runs(hub):
    """VmData (heap, anonymous memory) after 50 000 frames and 200 clients is what it was after the first."""

    def data_kib() -> int:
        status = Path(f"/proc/{hub.hub.process.pid}/status").read_text()
        return int(status.split("VmData:")[1].split()[0])

    reader = hub.client("count", 50_000)
    sender = hub.open(receive=False)
    sender.send(message(1))
    before = data_kib()
    for _ in range(200):
        raw_client(hub.hub.path).close()
    for _ in range(49_999):
        sender.send(message(2))
    reader.counters()
    assert data_kib() == before


@pytest.fixture
def built_hub(monkeypatch, tmp_path):
    """HubProcess starts the sanitized hub."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "rt_hub").symlink_to(build("estimator_c/apps/rt_hub.c"))
    monkeypatch.setenv("RT_BUILD_DIR", str(tmp_path))
    return tmp_path / "bin" / "rt_hub"


def test_hub_process_serves_a_run_and_leaves_nothing(built_hub):
    said = []
    with HubProcess.serving(BusChoice("rt_hub", "", "asked for"), said.append) as bus:
        path = bus.removeprefix("rt_hub:")
        assert os.stat(os.path.dirname(path)).st_mode & 0o777 == 0o700
        with open_bus(bus) as a, open_bus(bus) as b:
            a.send(message(9))
            assert b.recv(5).arbitration_id == 9
    assert said == []
    assert not os.path.exists(os.path.dirname(path))


def test_hub_process_says_that_it_was_lost(built_hub):
    said = []
    with HubProcess.serving(BusChoice("rt_hub", "", "asked for"), said.append) as bus, open_bus(bus) as a:
        (folder,) = [p for p in os.listdir("/proc") if p.isdigit() and bus[7:] in _command(p)]
        os.kill(int(folder), signal.SIGKILL)
        with pytest.raises(can.CanOperationError):
            a.recv(5)
    assert len(said) == 1
    assert "the hub was killed by SIGKILL" in said[0]


def _command(pid: str) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def test_hub_process_that_cannot_start_is_one_line(built_hub):
    built_hub.unlink()
    with pytest.raises(SetupError, match="make build"):
        HubProcess()
    built_hub.write_text("#!/bin/sh\necho 'rt_hub: no luck today' >&2; exit 1\n")
    built_hub.chmod(0o755)
    with pytest.raises(Exception, match="no luck today") as e:
        HubProcess()
    assert "\n" not in str(e.value)


def test_serving_a_kernel_bus_starts_nothing():
    with HubProcess.serving(BusChoice("socketcan", "vcan0", "asked for")) as bus:
        assert bus == "socketcan:vcan0"


def test_the_hub_has_the_priority_it_was_granted():
    said = []
    with HubProcess.serving(BusChoice("rt_hub", "", ""), said.append, priority=7) as bus:
        pids = [int(p.parent.name) for p in Path("/proc").glob("[0-9]*/cmdline") if bus[7:].encode() in _words(p)]
        policies = {(os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority) for pid in pids}
    assert policies == ({(os.SCHED_OTHER, 0)} if said else {(os.SCHED_FIFO, 7)})
    assert all("SCHED_FIFO priority 7 refused" in text for text in said)


def test_a_priority_that_is_refused_is_said_and_the_bus_serves_all_the_same(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    said = []
    with HubProcess.serving(BusChoice("rt_hub", "", ""), said.append, priority=7) as bus, open_bus(bus) as reader:
        with open_bus(bus, receive=False) as sender:
            sender.send(message(0x123))
        assert reader.recv(5.0).arbitration_id == 0x123
    assert len(said) == 1
    assert said[0].startswith("warning: hub: SCHED_FIFO priority 7 refused (Operation not permitted)")


def _words(cmdline: Path) -> list[bytes]:
    try:
        return cmdline.read_bytes().split(b"\0")
    except OSError:
        return []
