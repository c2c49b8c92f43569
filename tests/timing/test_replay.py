"""``rt-runner replay``: a log gives the same estimates again, in any format; one bit, one frame off and it says so."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import can
import pytest

from rt_runner.codec import Encoder
from rt_runner.dbc import load_dbc
from rt_runner.e2e import crc8h2f
from rt_runner.errors import SetupError
from rt_runner.log_reader import LogReader, RawFrame
from rt_runner.mcap_log import LogWriter
from rt_runner.replay.search import Replay, replay_frames
from rt_runner.replay.session import missing_jobs, read_session
from tests.support.runs import one_line, rt_runner

DBC = load_dbc()
ID = {m.name: m.frame_id for m in DBC}


@dataclass(frozen=True)
class Log:
    path: Path
    frames: list[RawFrame]

    def at(self, name: str, number: int) -> int:
        """Position of the ``number``-th frame of a name."""
        return [k for k, f in enumerate(self.frames) if f.can_id == ID[name]][number]


def logged(verb, folder, *args):
    path = folder / f"{verb}.mcap"
    done = rt_runner(verb, "hot-lap", "--log", path, *args)
    assert done.returncode in (0, 2, 3), done.stderr
    return Log(path, list(LogReader(path).raw()))


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Eight seconds over the hub, in real time, a sensor with a fault in the second half."""
    fault = "--fault=offset:-20@404-408"
    return logged(
        "run", tmp_path_factory.mktemp("replay"), "--bus", "hub", "--duration", "8", "--period", "0.05", fault
    )


@pytest.fixture(scope="module")
def stepped(tmp_path_factory):
    """Thirty seconds in lock-step."""
    return logged("mil", tmp_path_factory.mktemp("replay"), "--duration", "30")


def replayed(frames, setting=None, period_s=None) -> Replay:
    return replay_frames(frames, DBC, setting, period_s)[1]


def changed(frame: RawFrame, **more) -> RawFrame:
    return frame._replace(**more)


def resealed(frame: RawFrame, data: bytes) -> RawFrame:
    """A frame with other content and a good checksum."""
    message = DBC.by_id[frame.can_id]
    counter = data[1] & 0x0F
    return changed(frame, data=bytes([crc8h2f(data[1:] + message.data_id_list[counter : counter + 1])]) + data[1:])


@pytest.mark.parametrize("kind", ["real", "stepped"])
def test_every_estimate_comes_out_again(kind, request):
    log = request.getfixturevalue(kind)
    out = log.path.with_suffix(".json")
    done = rt_runner("replay", log.path, "--json", out)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    count = Counter(f.can_id for f in log.frames)
    assert figures["identical"] is True
    assert figures["first_difference"] is None
    assert figures["estimates"] == figures["jobs"] == count[ID["Estimate"]] >= 100
    assert figures["frames"] >= 5 * figures["estimates"] + figures["estimates"] * figures["period_s"] * 0.8
    assert figures["lockstep"] is (kind == "stepped")
    faults = {f.values["sensor_w_fault"] for f in LogReader(log.path).frames({"EstWinding"})}
    assert (len(faults) > 1) is (kind == "real"), "the fault was noticed in between"
    assert all(i["same"] for i in figures["identity"].values())
    assert "verdict: identical" in done.stdout


@pytest.mark.parametrize("kind", ["real", "stepped"])
@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_another_format_replays_the_same(kind, suffix, request, tmp_path):
    """candump and ASC keep microseconds, a float has a quarter of one: which frame a job read does not hang on that."""
    log = request.getfixturevalue(kind)
    path = tmp_path / f"log{suffix}"
    with can.Logger(path) as writer:
        for f in log.frames:
            writer.on_message_received(
                can.Message(timestamp=f.t_ns / 1e9, arbitration_id=f.can_id, data=f.data, is_extended_id=False)
            )
    done = rt_runner("replay", path)
    assert done.returncode == 0, done.stdout + done.stderr
    jobs = sum(f.can_id == ID["Estimate"] for f in log.frames)
    assert f"{jobs} of {jobs} estimates" in done.stdout


@pytest.mark.parametrize(
    ("bit", "signal"), [(40, "theta_r_est_degc"), (16, "theta_w_est_degc"), (13, "status"), (9, "counter"), (0, "crc")]
)
def test_one_bit_of_one_estimate_is_named(real, bit, signal, tmp_path):
    k = real.at("Estimate", 77)
    wrong = bytearray(real.frames[k].data)
    wrong[bit // 8] ^= 1 << bit % 8
    frames = [*real.frames[:k], changed(real.frames[k], data=bytes(wrong)), *real.frames[k + 1 :]]
    path, out = tmp_path / "flipped.mcap", tmp_path / "flipped.json"
    with LogWriter(path, DBC) as writer:
        for f in frames:
            writer.write(f.t_ns, f.can_id, f.data)
    done = rt_runner("replay", path, "--json", out)
    assert done.returncode == 2, done.stdout + done.stderr
    found = json.loads(out.read_text())
    assert found["verdict"] == "different"
    assert found["estimates"] == 77
    difference = found["first_difference"]
    assert (difference["frame"], difference["signal"]) == ("Estimate", signal)
    assert difference["t_ns"] == real.frames[k].t_ns
    assert difference["logged"] != difference["replayed"]
    assert difference["logged_data"] == wrong.hex()
    assert difference["replayed_data"] == real.frames[k].data.hex()
    assert f"Estimate.{signal} of release" in done.stdout


def test_an_input_a_little_off_is_noticed(real):
    """Good checksum, another temperature: nothing but the estimates can tell."""
    k = real.at("TempMeas", 30)
    data = bytearray(real.frames[k].data)
    data[2:4] = (int.from_bytes(data[2:4], "little") + 64).to_bytes(2, "little")  # one degree
    outcome = replayed([*real.frames[:k], resealed(real.frames[k], bytes(data)), *real.frames[k + 1 :]])
    assert outcome.verdict == "different"
    assert outcome.difference is not None
    assert outcome.difference.t_ns > real.frames[k].t_ns


@pytest.mark.parametrize("name", ["MotorState", "TempMeas"])
@pytest.mark.parametrize("number", [25, 40])
def test_an_input_that_the_log_lost_is_a_gap_not_a_verdict(real, name, number):
    """The estimator had it: it counted no gap, the replay does."""
    k = real.at(name, number * (10 if name == "MotorState" else 1))
    outcome = replayed([*real.frames[:k], *real.frames[k + 1 :]])
    assert outcome.verdict == "inconclusive"
    assert any("counters of the inputs miss 1 frames" in note for note in outcome.notes)


def test_an_estimate_that_the_log_lost_leaves_it_open(real):
    """All others come out again; this one was not compared."""
    k = real.at("Estimate", 60)
    outcome = replayed([*real.frames[:k], *real.frames[k + 1 :]])
    assert outcome.difference is None
    assert outcome.verdict == "inconclusive"
    assert outcome.attempt is not None
    assert outcome.attempt.comparison.missing_frames == 1


def test_a_job_that_the_log_lost_is_counted(real):
    session = read_session(real.frames, DBC)
    job = session.jobs[60]
    gone = {(t_ns, data) for t_ns, data in job.frames.values()}
    frames = [f for f in real.frames if (f.t_ns, f.data) not in gone]
    assert missing_jobs(read_session(frames, DBC)) == [60]
    outcome = replayed(frames)
    assert outcome.verdict == "inconclusive"
    assert outcome.missing_jobs == 1


def test_a_log_that_begins_in_the_middle_is_not_judged(real):
    outcome = replayed(real.frames[len(real.frames) // 2 :])
    assert outcome.verdict == "inconclusive"
    assert outcome.attempt is None
    assert "what it knew then is not in the log" in outcome.notes[0]


@pytest.mark.parametrize("share", [0.3, 0.71])
def test_an_unfinished_log_is_replayed_as_far_as_it_goes(real, share):
    outcome = replayed(real.frames[: int(share * len(real.frames))])
    assert outcome.verdict == "identical"


def test_without_the_ages_the_ticks_and_the_stamps_say_what_was_read(real):
    """Logs from before EstTimingC."""
    frames = [f for f in real.frames if f.can_id not in (ID["EstTimingC"], ID["EstTimingD"])]
    assert len(frames) < len(real.frames)
    outcome = replayed(frames)
    assert outcome.verdict == "identical"


def test_the_stamps_of_one_format_or_another_do_not_matter(real):
    """A microsecond, a tenth of a millisecond: the ages decide."""
    for resolution_ns in (1_000, 100_000):
        frames = [changed(f, t_ns=round(f.t_ns / resolution_ns) * resolution_ns) for f in real.frames]
        assert replayed(frames).verdict == "identical"


def test_an_estimator_that_came_to_a_bus_that_was_alive(stepped):
    """It saw nothing of what was sent before it opened its socket; where that was, its estimates tell."""
    motors = [f for f in stepped.frames if f.can_id in (ID["MotorState"], ID["TempMeas"], ID["Coolant"])]
    encoder, before = Encoder(DBC, "PLANT"), []
    first = int.from_bytes(motors[0].data[6:8], "little")
    for n in range(300):  # three seconds at other temperatures, and without a gap in the ticks
        tick = (first - 300 + n) % 65536
        values = {"torque_nm": 100.0, "speed_rpm": 9000.0, "derating_active": 0, "tick": tick}
        data = bytes(encoder.encode("MotorState", values).data)
        before.append(RawFrame(n * 10_000_000, ID["MotorState"], data, 8, 0))
        if tick % 10 == 0:
            values = {"theta_w_meas_degc": 150.0, "theta_r_meas_degc": 140.0, "tick": tick}
            data = bytes(encoder.encode("TempMeas", values).data)
            before.append(RawFrame(n * 10_000_000, ID["TempMeas"], data, 8, 0))
    assert motors[0].t_ns > 0
    alive = [*before, *(changed(f, t_ns=f.t_ns + 3_000_000_000) for f in stepped.frames)]
    outcome = replayed(alive)
    assert outcome.verdict == "identical"
    assert any("the bus was alive before the estimator" in note for note in outcome.notes)


def test_another_setting_gives_other_estimates_and_says_where(stepped):
    outcome = replayed(stepped.frames, setting="paper")
    assert outcome.verdict == "different"
    assert outcome.difference is not None
    assert outcome.difference.job < 60


def test_other_weights_are_named_in_the_verdict(stepped, tmp_path):
    """A log of an estimator with other weights: what differs, differs for that reason first of all."""
    frames = list(stepped.frames)
    for k, f in enumerate(frames):
        if f.can_id == ID["EstIdentity"]:
            frames[k] = resealed(f, f.data[:5] + bytes([0xAA, 0xBB, 0xCC]))
        elif f.can_id == ID["Estimate"] and k > len(frames) // 2:
            frames[k] = resealed(f, f.data[:4] + bytes([f.data[4] ^ 1]) + f.data[5:])
    path = tmp_path / "other.mcap"
    with LogWriter(path, DBC) as writer:
        for f in frames:
            writer.write(f.t_ns, f.can_id, f.data)
    done = rt_runner("replay", path)
    assert done.returncode == 2
    assert "weights ccbbaa in the log" in done.stdout
    assert "verdict: different (other weights)" in done.stdout


def test_what_is_no_log_of_a_run_is_one_line(real, tmp_path):
    with pytest.raises(SetupError, match="no job of an estimator"):
        replayed([f for f in real.frames if f.can_id < 0x200])
    with pytest.raises(SetupError, match="nothing to feed"):
        replayed([f for f in real.frames if f.can_id > 0x200])
    with pytest.raises(SetupError, match="give --period"):
        replayed([f for f in real.frames if f.can_id != ID["EstGranted"]])
    assert replayed([f for f in real.frames if f.can_id != ID["EstGranted"]], period_s=0.05).verdict == "identical"
    (tmp_path / "empty.log").write_text("")
    for path in (tmp_path / "empty.log", tmp_path / "none.mcap"):
        done = rt_runner("replay", path)
        assert done.returncode == 1
        assert str(path) in one_line(done.stderr)
    done = rt_runner("replay", real.path, "--setting", "nope")
    assert done.returncode == 1
    assert "there are default" in one_line(done.stderr)
