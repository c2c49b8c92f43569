"""The log: what goes in comes out, strangers can read it, and no accident makes it unreadable."""

import fcntl
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from rt_runner import log_schema
from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.e2e import E2eStatus
from rt_runner.mcap_log import (
    CHUNK_BYTES,
    LogError,
    LogReader,
    LogWriter,
    prepare_log_path,
    read_log,
    summarise,
)

DBC = load_dbc()
T0_NS = 1_700_000_000_123_456_789
ROOT = Path(__file__).resolve().parents[2]


def frames(count: int) -> Iterator[tuple[int, can.Message]]:
    """A short drive: motor state every 10 ms, measured temperatures every 100 ms."""
    plant = Encoder(DBC, "PLANT")
    for i in range(count):
        t_ns = T0_NS + i * 10_000_000
        speed = None if i % 50 == 7 else 100.0 * i
        yield t_ns, plant.encode("MotorState", derating_active=0, torque_nm=0.01 * i, speed_rpm=speed, tick=i)
        if i % 10 == 0:
            yield t_ns, plant.encode("TempMeas", theta_w_meas_degc=80.0 + i / 64, theta_r_meas_degc=math.nan, tick=i)


def write(path: Path, count: int = 200, flush_every: int = 0) -> Path:
    with LogWriter(path, DBC, {"seed": 7}, {"scenario.toml": b"title = 'x'\n"}) as log:
        for n, (t_ns, frame) in enumerate(frames(count)):
            log.write(t_ns, frame.arbitration_id, frame.data)
            if flush_every and n % flush_every == 0:
                log.flush()
        log.attach("granted.json", b"{}")
        log.metadata("result", {"json": json.dumps({"verdict": "pass"})})
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "drive.mcap")


def test_decoded_frames_come_back(log):
    read = list(read_log(log))
    sent = list(frames(200))
    assert [f.t_ns for f in read] == [t for t, _ in sent], "integer nanoseconds, to the last one"
    assert {f.name for f in read} == {"MotorState", "TempMeas"}
    motor = [f for f in read if f.name == "MotorState"]
    assert motor[3].values == {
        "counter": 4.0, "derating_active": 0.0, "torque_nm": pytest.approx(0.03), "speed_rpm": 300.0, "tick": 3.0,
    }  # fmt: skip
    assert motor[7].values["speed_rpm"] is None
    assert all(f.e2e == 0 for f in read)
    assert all(f.values["theta_r_meas_degc"] is None for f in read if f.name == "TempMeas")


def test_raw_frames_come_back(log):
    raw = [(f.t_ns, f.can_id, f.data, f.dlc, f.flags) for f in LogReader(log).raw()]
    assert raw == [(t, m.arbitration_id, bytes(m.data), 8, 0) for t, m in frames(200)]


def test_metadata_and_attachments(log):
    reader = LogReader(log)
    assert reader.complete
    assert reader.trouble == []
    assert reader.metadata["run"] == {"seed": "7"}
    assert json.loads(reader.metadata["result"]["json"]) == {"verdict": "pass"}
    assert reader.attachments == {
        "drive.dbc": DBC.text, "scenario.toml": b"title = 'x'\n", "granted.json": b"{}",
    }  # fmt: skip


def test_only_the_messages_asked_for(log):
    assert {f.name for f in read_log(log, {"TempMeas"})} == {"TempMeas"}


def test_a_stranger_reads_it(log):
    """The mcap library's own reader and plain protobuf: no code of ours."""
    pools: dict[int, type] = {}
    seen = {"can/raw": 0, "signals/MotorState": 0, "signals/TempMeas": 0}
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.attachment_count == 3
        assert summary.statistics.metadata_count == 2
        assert summary.statistics.message_count == 2 * 220
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if schema.id not in pools:
                pool = descriptor_pool.DescriptorPool()
                for f in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.AddSerializedFile(f.SerializeToString())
                pools[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            parsed = pools[schema.id].FromString(message.data)
            assert parsed.SerializeToString(deterministic=True) == message.data, "our bytes are protobuf's own"
            assert message.publish_time == message.log_time
            seen[channel.topic] += 1
    assert seen == {"can/raw": 220, "signals/MotorState": 200, "signals/TempMeas": 20}


def test_the_same_frames_give_the_same_bytes(tmp_path):
    assert write(tmp_path / "a.mcap").read_bytes() == write(tmp_path / "b.mcap").read_bytes()


def test_flushing_changes_the_chunks_but_not_the_content(tmp_path, log):
    flushed = write(tmp_path / "f.mcap", flush_every=13)
    assert list(read_log(flushed)) == list(read_log(log))
    assert list(LogReader(flushed).raw()) == list(LogReader(log).raw())


def test_unknown_extended_and_error_frames_are_logged_raw_only(tmp_path):
    with LogWriter(tmp_path / "u.mcap", DBC) as log:
        assert log.write(1, 0x7FF, b"\x01") is None
        assert log.write(2, 0x0A0, b"\x01" * 8, log_schema.FLAG_EXTENDED) is None
        assert log.write(3, 0x0A0, b"", log_schema.FLAG_REMOTE, dlc=8) is None
        assert log.write(4, 0x04, bytes(8), log_schema.FLAG_ERROR) is None
        assert log.write(5, 0x123, bytes(64), log_schema.FLAG_FD) is None
        assert (log.frames, log.unknown) == (5, 2)
    raw = list(LogReader(tmp_path / "u.mcap").raw())
    assert [(f.can_id, len(f.data), f.dlc, f.flags) for f in raw] == [
        (0x7FF, 1, 1, 0), (0x0A0, 8, 8, 1), (0x0A0, 0, 8, 2), (4, 8, 8, 4), (0x123, 64, 64, 8),
    ]  # fmt: skip
    assert list(read_log(tmp_path / "u.mcap")) == []
    assert summarise(tmp_path / "u.mcap").unknown == {"0x7FF": 1, "0x004": 1, "0x123": 1}


def test_damaged_frames_are_logged_without_values(tmp_path):
    frame = next(frames(1))[1]
    data = bytearray(frame.data)
    data[7] ^= 1
    with LogWriter(tmp_path / "d.mcap", DBC) as log:
        log.write(1, frame.arbitration_id, data)
    (read,) = read_log(tmp_path / "d.mcap")
    assert read.e2e == E2eStatus.WRONG_CRC
    assert set(read.values.values()) == {None}
    assert next(LogReader(tmp_path / "d.mcap").raw()).data == bytes(data)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_cut_anywhere_it_gives_all_frames_before_the_cut(tmp_path, data):
    path = tmp_path / "whole.mcap"
    if not path.exists():
        write(path, 120, flush_every=10)
    whole = path.read_bytes()
    frames_in_whole = list(read_log(path))
    cut = data.draw(st.integers(8, len(whole) - 1))
    part = tmp_path / "part.mcap"
    part.write_bytes(whole[:cut])
    reader = LogReader(part)
    got = list(reader.frames())
    assert got == frames_in_whole[: len(got)]
    assert not reader.complete
    assert any("never finished" in t for t in reader.trouble)
    if cut > len(whole) - 20:  # only the footer is gone
        assert got == frames_in_whole


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damaged_byte_is_survived(tmp_path, data):
    path = tmp_path / "whole.mcap"
    if not path.exists():
        write(path, 60, flush_every=10)
    whole = bytearray(path.read_bytes())
    whole[data.draw(st.integers(8, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    hurt = tmp_path / "hurt.mcap"
    hurt.write_bytes(whole)
    genuine = set(map(str, read_log(path)))
    for frame in read_log(hurt):  # fewer frames at worst, never an invented one
        assert str(frame) in genuine
    summarise(hurt)


def test_a_killed_writer_leaves_what_was_flushed(tmp_path):
    path = tmp_path / "killed.mcap"
    code = f"""
import os, signal
from tests.unit.test_mcap_log import DBC, LogWriter, frames
log = LogWriter({str(path)!r}, DBC)
for n, (t, f) in enumerate(frames(300)):
    log.write(t, f.arbitration_id, f.data)
    if n == 200:
        log.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert ran.returncode == -9
    reader = LogReader(path)
    assert len(list(reader.raw())) == 201
    assert not reader.complete
    assert reader.attachments["drive.dbc"] == DBC.text


def test_chunks_stay_small(tmp_path):
    write(tmp_path / "big.mcap", 4000)
    with (tmp_path / "big.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) > 3
    assert max(c.uncompressed_size for c in summary.chunk_indexes) < CHUNK_BYTES + 1024


def fill(path: Path) -> tuple[int, str]:
    """Write until it fails; returns the frames written and the complaint."""
    log = LogWriter(path, DBC)
    try:
        for n in range(1_000_000):
            t_ns, frame = next(frames(1))
            log.write(t_ns + n, frame.arbitration_id, os.urandom(8))
            if n % 100 == 0:
                log.flush()
    except LogError as e:
        return n + 1, str(e)
    finally:
        log.close()
    raise AssertionError("the disk never filled up")


def test_disk_full(tmp_path):
    """RLIMIT_FSIZE stands in for a full disk: the same error at the same place, on every machine."""
    code = f"""
import resource
from tests.unit.test_mcap_log import *
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
print(json.dumps(fill(Path({str(tmp_path / "full.mcap")!r}))))
"""
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    judge_full(tmp_path / "full.mcap", *json.loads(ran.stdout))


def test_disk_full_for_real(tmp_path):
    """A file system of 256 KiB. Needs to be allowed to mount one."""
    code = f"""
from tests.unit.test_mcap_log import *
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", {str(tmp_path)!r}], check=True)
written, said = fill(Path({str(tmp_path / "full.mcap")!r}))
judge_full(Path({str(tmp_path / "full.mcap")!r}), written, said)
print(said)
"""
    probe = subprocess.run(["unshare", "--mount", "--map-root-user", "true"], capture_output=True, check=False)
    if probe.returncode:
        pytest.skip(f"cannot mount a file system here: {probe.stderr.decode().strip()}")
    command = ["unshare", "--mount", "--map-root-user", sys.executable, "-c", code]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "No space left on device" in ran.stdout


def judge_full(path: Path, written: int, said: str) -> None:
    assert str(path) in said
    assert "make room on the disk" in said
    assert "\n" not in said
    reader = LogReader(path)
    kept = len(list(reader.raw()))
    assert written - 101 <= kept <= written
    assert kept > 100
    assert reader.trouble == ["the log was never finished (no footer): what was written before is shown"]


def test_an_existing_log_is_refused(tmp_path):
    path = write(tmp_path / "a.mcap")
    before = path.read_bytes()
    with pytest.raises(LogError, match="exists already"):
        LogWriter(path, DBC)
    assert path.read_bytes() == before
    with LogWriter(path, DBC, force=True):
        pass
    assert list(read_log(path)) == []


def test_a_log_being_written_is_never_touched(tmp_path):
    path = tmp_path / "busy.mcap"
    with LogWriter(path, DBC) as log:
        t_ns, frame = next(frames(1))
        for force in (False, True):
            with pytest.raises(LogError, match="another logger writes it"):
                LogWriter(path, DBC, force=force)
        with pytest.raises(LogError, match="another logger writes it"):
            prepare_log_path(path, "x")
        log.write(t_ns, frame.arbitration_id, frame.data)
    assert len(list(read_log(path))) == 1


@pytest.mark.parametrize("force", [False, True])
def test_a_path_that_cannot_be_written(tmp_path, force):
    for path in (tmp_path, tmp_path / "none" / "x.mcap", Path("/proc/x.mcap")):
        with pytest.raises(LogError) as caught:
            LogWriter(path, DBC, force=force)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_missing_attachment_is_refused_before_a_file_is_made(tmp_path):
    with pytest.raises(LogError, match=r"none\.toml: cannot attach"):
        LogWriter(tmp_path / "x.mcap", DBC, attachments={"scenario.toml": str(tmp_path / "none.toml")})
    assert not (tmp_path / "x.mcap").exists()


def test_prepare_keeps_older_logs(tmp_path):
    path = tmp_path / "sub" / "run.mcap"
    assert prepare_log_path(path, "x") == path
    path.write_text("one")
    assert prepare_log_path(path, "x") == path
    path.write_text("two")
    prepare_log_path(path, "x")
    assert {p.name: p.read_text() for p in path.parent.iterdir()} == {"run.1.mcap": "one", "run.2.mcap": "two"}


def test_prepare_names_a_new_log_after_the_scenario(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = prepare_log_path(None, "hot-lap")
    assert path.parent == Path("logs")
    assert path.name.startswith("hot-lap-")
    assert path.suffix == ".mcap"
    with pytest.raises(LogError, match="is a directory"):
        prepare_log_path(tmp_path, "hot-lap")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP1\r\n" + bytes(100), bytes(1000)])
def test_what_is_no_log_is_refused(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match="not an MCAP log"):
        LogReader(path)


def test_a_missing_log_is_refused(tmp_path):
    with pytest.raises(LogError, match="cannot read the log"):
        read_log(tmp_path / "none.mcap")


def test_the_lock_is_gone_with_the_writer(tmp_path):
    path = write(tmp_path / "a.mcap", 1)
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
