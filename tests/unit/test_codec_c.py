"""The generated C codec and the C end-to-end check: the same bytes and verdicts as in Python, no undefined step."""

import math
import subprocess

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rt_runner.codec import Encoder
from rt_runner.codegen import generate as generate_texts
from rt_runner.codegen import main as codegen
from rt_runner.dbc import DEFAULT_DBC, load_dbc
from rt_runner.e2e import E2eCheck, E2eProtect
from tests.support.codec_c import ROOT, SRC, STRICT, CCodec, gcc, generate
from tests.support.frames import GOLDEN

DBC = load_dbc()
messages = st.sampled_from(DBC.messages)
bus_settings = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@pytest.fixture(scope="module")
def c(tmp_path_factory) -> CCodec:
    return CCodec(DBC, tmp_path_factory.mktemp("codec"))


@st.composite
def message_and_values(draw):
    """Any double a program may come up with, around the valid range and far outside."""
    message = draw(messages)
    values = {}
    for s in message.payload:
        near = st.floats(s.to_physical(s.raw_min) - 5 * s.factor, s.to_physical(s.raw_max) + 5 * s.factor)
        code = st.integers(s.raw_min, s.raw_max).map(lambda r, s=s: (r + 0.5) * s.factor + s.offset)  # ties
        far = st.floats(allow_nan=False)
        values[s.name] = draw(st.one_of(near, code, far, *([st.just(math.nan)] if s.raw_na is not None else [])))
    return message, values


@pytest.mark.parametrize(("name", "values", "golden"), GOLDEN)
def test_golden_bytes(c, name, values, golden):
    assert c.encode(DBC[name], values, c.sender(DBC[name])).hex() == golden


@bus_settings
@given(case=message_and_values())
def test_c_encodes_as_python_does(c, case):
    message, values = case
    python = Encoder(DBC, message.sender).encode(message.name, values)
    assert c.encode(message, values, c.sender(message)).hex() == python.data.hex()


@bus_settings
@given(message=messages, body=st.binary(min_size=8, max_size=8))
def test_c_decodes_as_python_does(c, message, body):
    raw = message.codec.decode(body, scaling=False, decode_choices=False)
    for name, value in c.decode(message, body).items():
        signal = next(s for s in message.payload if s.name == name)
        wanted = signal.to_physical(raw[name])
        assert math.isnan(value) if wanted is None else value == wanted


@bus_settings
@given(
    message=messages,
    max_delta=st.integers(1, 14),
    steps=st.lists(st.tuples(st.integers(0, 15), st.booleans(), st.sampled_from([8, 8, 8, 8, 7, 2, 0]))),
)
def test_c_judges_any_sequence_as_python_does(c, message, max_delta, steps):
    receiver, check = c.receiver(message, max_delta), E2eCheck(message.data_id_list, max_delta, message.length)
    for counter, damaged, length in steps:
        protect = E2eProtect(message.data_id_list)
        protect.counter = counter
        frame = bytearray(8)
        protect.protect(frame)
        frame[5] ^= damaged
        frame = bytes(frame[:length])
        assert c.check(receiver, frame) == check.check(frame)
    assert list(receiver.counts) == check.counts
    assert receiver.frames_lost == check.frames_lost


def test_generating_twice_gives_the_same_bytes(tmp_path):
    first, second = generate(tmp_path / "a"), generate(tmp_path / "b")
    names = sorted(p.name for p in first.iterdir())
    assert names == ["drive.c", "drive.h", "drive_e2e.c", "drive_e2e.h"]
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_generated_files_carry_no_date(monkeypatch):
    monkeypatch.setattr("time.ctime", lambda: "Thu Jan  1 00:00:00 1970")
    for text in generate_texts(DBC).values():
        assert "1970" not in text


def test_unchanged_files_keep_their_time_stamp(tmp_path):
    generate(tmp_path)
    before = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    generate(tmp_path)
    assert {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()} == before


def test_a_dbc_with_findings_is_not_generated_from(tmp_path, capsys):
    broken = tmp_path / "broken.dbc"
    broken.write_text(DEFAULT_DBC.read_text().replace("16383.5]", "20000]", 1))
    assert codegen(["--dbc", str(broken), "--out", str(tmp_path / "gen")]) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert "MotorState.speed_rpm" in error
    assert not (tmp_path / "gen").exists()


def test_c_program_under_the_sanitizers(tmp_path):
    """tests/c/test_e2e.c with ASan and UBSan, and our generated file under the strict flags."""
    gen, program = generate(tmp_path / "gen"), tmp_path / "test_e2e"
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-g1", "-O1"]
    include = ["-I", gen, "-I", SRC]
    for source in (ROOT / "tests/c/test_e2e.c", SRC / "e2e.c", gen / "drive_e2e.c"):
        gcc(*STRICT, *sanitize, *include, "-c", source, "-o", tmp_path / f"{source.stem}.o")
    gcc("-std=c11", "-w", *sanitize, *include, "-c", gen / "drive.c", "-o", tmp_path / "drive.o")
    gcc(*sanitize, *tmp_path.glob("*.o"), "-lm", "-o", program)
    ran = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
