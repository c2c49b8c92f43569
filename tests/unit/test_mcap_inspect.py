"""``rt-runner inspect``: the figures of a log, its gaps and damage, on a terminal and elsewhere."""

import io
import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.inspect import as_json, plain_lines, show
from rt_runner.mcap_log import LogWriter, summarise

DBC = load_dbc()
ROOT = Path(__file__).resolve().parents[2]
T0_NS = 1_700_000_000_000_000_000
RESULT = {
    "verdict": "pass",
    "accuracy": {"theta_w": {"est_rmse_degc": 0.1, "raw_rmse_degc": 1.1, "est_max_degc": None}},
    "findings": [{"what": "log", "verdict": "pass", "evidence": "none missing"}],
}


def write(path: Path, *, lose=(), repeat=(), damage=(), period_s: float | None = None, step_ms: int = 10) -> Path:
    """100 motor frames with faults at the given places, 20 estimates 5 ms apart, one frame nobody knows."""
    plant, estimator = Encoder(DBC, "PLANT"), Encoder(DBC, "ESTIMATOR")
    run = {"scenario": "lap"} if period_s is None else {"scenario": "lap", "period_s": period_s}
    with LogWriter(path, DBC, run) as log:
        for i in range(100):
            t_ns = T0_NS + i * step_ms * 1_000_000
            frame = plant.encode("MotorState", derating_active=0, torque_nm=1.0, speed_rpm=1.0, tick=i)
            data = bytearray(frame.data)
            data[6] ^= i in damage
            for _ in range(0 if i in lose else 2 if i in repeat else 1):
                log.write(t_ns, frame.arbitration_id, data)
        for i in range(20):
            frame = estimator.encode("Estimate", status=2, theta_w_est_degc=1.0, theta_r_est_degc=1.0, tick=i)
            log.write(T0_NS + i * 5_000_000, frame.arbitration_id, frame.data)
        log.write(T0_NS, 0x123, b"")
        log.metadata("result", {"json": json.dumps(RESULT)})
    return path


def motor(path: Path):
    return next(m for m in summarise(path).messages if m.name == "MotorState")


def test_a_clean_log(tmp_path):
    summary = summarise(write(tmp_path / "a.mcap"))
    assert (summary.frames, summary.complete, summary.unknown) == (121, True, {"0x123": 1})
    assert summary.duration_s == pytest.approx(0.99)
    m = motor(tmp_path / "a.mcap")
    assert (m.frames, m.mean_ms, m.min_ms, m.max_ms, m.rate_ok) == (100, 10.0, 10.0, 10.0, True)
    assert (m.lost, m.counter_gaps, m.repeated, m.wrong_sequence, m.wrong_crc) == (0, 0, 0, 0, 0)
    assert summary.result == RESULT


def test_losses_repeats_jumps_and_damage_are_told_apart(tmp_path):
    path = write(tmp_path / "a.mcap", lose={10, 11, 30, *range(50, 58)}, repeat={70}, damage={80})
    m = motor(path)
    assert m.lost == 2 + 1 + 8 + 1, "a damaged frame is missing in the sequence as well"
    assert m.counter_gaps == 4
    assert m.repeated == 1
    assert m.wrong_sequence == 1, "eight in a row are more than the timeout allows"
    assert m.wrong_crc == 1
    assert m.max_ms == pytest.approx(90.0)


def test_a_wrong_rate_is_pointed_out(tmp_path):
    path = write(tmp_path / "a.mcap", step_ms=12)
    assert motor(path).rate_ok is False
    assert any("MotorState" in line and "too slow" in line for line in plain_lines(summarise(path)))


@pytest.mark.parametrize(("period_s", "rate_ok"), [(None, False), (0.005, True)])
def test_frames_sent_per_job_are_judged_by_the_loop_s_period(tmp_path, period_s, rate_ok):
    summary = summarise(write(tmp_path / "a.mcap", period_s=period_s))
    assert next(m for m in summary.messages if m.name == "Estimate").rate_ok is rate_ok


def test_plain_text_says_all_of_it(tmp_path):
    stream = io.StringIO()
    show(summarise(write(tmp_path / "a.mcap", lose={3})), stream)
    text = stream.getvalue()
    for part in ("0x0A0  MotorState", "120 frames", "2023-11-14", "0x123 (1)",
                 "drive.dbc", "scenario=lap", "verdict: pass", "RMSE 0.100 degC (sensor 1.100 degC), worst n/a",
                 "log: pass: none missing", "no frames of: TempMeas", "not on the bus: CONTROLLER\n"):  # fmt: skip
        assert part in text
    assert "\x1b" not in text


def test_a_log_without_result_says_so(tmp_path):
    path = tmp_path / "a.mcap"
    LogWriter(path, DBC).close()
    summary = summarise(path)
    assert (summary.frames, summary.duration_s, summary.result) == (0, 0.0, None)
    assert "verdict: none, the run did not get that far" in plain_lines(summary)


def test_json_holds_the_figures(tmp_path):
    summary = summarise(write(tmp_path / "a.mcap"))
    figures = json.loads(json.dumps(as_json(summary), allow_nan=False))
    assert figures["frames"] == 121
    assert figures["duration_s"] == pytest.approx(0.99)
    assert figures["messages"][0]["name"] == "MotorState"
    assert figures["messages"][0]["rate_ok"] is True


def inspect(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "rt_runner.cli", "inspect", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_verb(tmp_path):
    path = write(tmp_path / "a.mcap")
    ran = inspect(path, "--json", tmp_path / "a.json")
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "verdict: pass" in ran.stdout
    assert json.loads((tmp_path / "a.json").read_text())["frames"] == 121
    assert json.loads(inspect(path, "--json", "-").stdout)["frames"] == 121


def test_on_a_terminal_it_is_a_table(tmp_path):
    path = write(tmp_path / "a.mcap")
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "rt_runner.cli", "inspect", str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=theirs, env={"TERM": "xterm", "COLUMNS": "130"}) as process:
        os.close(theirs)
        text = b""
        while True:
            try:
                block = os.read(ours, 65536)
            except OSError:  # how a closed terminal reads
                break
            if not block:
                break
            text += block
    os.close(ours)
    assert process.returncode == 0
    assert "│ MotorState" in text.decode()


def test_what_cannot_be_read_is_one_line(tmp_path):
    (tmp_path / "junk.mcap").write_bytes(b"junk" * 100)
    for path, says in ((tmp_path / "none.mcap", "cannot read"), (tmp_path / "junk.mcap", "not an MCAP log"),
                       (tmp_path, "cannot read")):  # fmt: skip
        ran = inspect(path)
        assert ran.returncode == 1
        assert ran.stdout == ""
        assert len(ran.stderr.splitlines()) == 1
        assert says in ran.stderr
        assert str(path) in ran.stderr


def test_a_cut_log_is_shown_and_called_so(tmp_path):
    whole = write(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:-100])
    ran = inspect(tmp_path / "cut.mcap")
    assert ran.returncode == 1
    assert len(ran.stderr.splitlines()) == 1
    assert f"{tmp_path / 'cut.mcap'}: the log was never finished" in ran.stderr
    assert "MotorState" in ran.stdout


def test_last_words_do_not_make_a_rate_wrong(tmp_path):
    """Counters come once a second, and once more when the estimator ends."""
    estimator = Encoder(DBC, "ESTIMATOR")
    with LogWriter(tmp_path / "a.mcap", DBC) as log:
        for t_ms in (0, 1000, 2000, 3000, 4000, 5000, 5010):
            frame = estimator.encode("EstReleases", releases=1, jobs=1)
            log.write(T0_NS + t_ms * 1_000_000, frame.arbitration_id, frame.data)
    counters = next(m for m in summarise(tmp_path / "a.mcap").messages if m.name == "EstReleases")
    assert counters.mean_ms == pytest.approx(5010 / 6)
    assert counters.rate_ok is True
