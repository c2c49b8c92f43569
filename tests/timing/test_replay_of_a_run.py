"""Same frames, same estimates: what a real-time run published is what the core says of the frames in its log.

One run over the hub with a fault in it. Which frames a job had read, the log does not say outright: Estimate.tick names
the newest MotorState, but a TempMeas or Coolant right behind it may have come too late. Every possibility is followed
as long as it explains what was published; one must last to the end. Its frames then go through the binary in lock-step,
and every payload must come out again, byte for byte, counters and checksums included.
"""

import math
from dataclasses import dataclass, replace

import pytest

from plant_sim.faults import parse_fault
from rt_runner.codec import Decoder
from rt_runner.dbc import load_dbc
from rt_runner.log_reader import LogReader
from rt_runner.records import END, Record
from tests.support.libest import Estimator, load
from tests.support.runs import load_result, rt_runner
from tests.timing.estimator_process import CONTENT, MS, binary, lockstep, tick_record, to_bytes

FAULT = "offset:-20@430-440"
SCENARIO = f"""title = "twenty seconds with a fault"
duration_s = 20.0
faults = ["{FAULT}"]
[cycle]
kind = "lap"
start_s = 425.0
"""
INPUTS = ("MotorState", "TempMeas", "Coolant")
PERIOD_NS = 100 * MS
INPUT_STALE = 4.0  # Estimate.status, as are the next
ESTIMATES = (2.0, 3.0, 6.0, 7.0)  # running, predicting, open loop, fallback
DBC = load_dbc()
SIGNALS = {signal.name: signal for message in DBC for signal in message.signals}


@dataclass(frozen=True)
class Input:
    """One frame that the estimator listens to."""

    can_id: int
    data: bytes
    name: str
    values: dict


@dataclass(frozen=True)
class Job:
    """What one job published (decoded and as bytes), and how many inputs stood in the log before that."""

    values: dict
    payload: tuple[bytes, ...]
    inputs_before: int

    @property
    def stale(self):
        """The machine held the plant up: at the job's start the newest MotorState was older than its timeout, 50 ms."""
        return self.values["Estimate.status"] == INPUT_STALE


@dataclass(frozen=True)
class Run:
    """A log as inputs and jobs, in its order, up to the plant's last frame."""

    inputs: list[Input]
    jobs: list[Job]
    result: dict


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay")
    scenario, log, out = folder / "mine.toml", folder / "run.mcap", folder / "run.json"
    scenario.write_text(SCENARIO)
    done = rt_runner("run", scenario, "--bus", "hub", "--seed", 7, "--log", log, "--json", out)
    assert done.returncode in (0, 2, 3), done.stdout + done.stderr  # machine and limits are not what is tested
    decoder, inputs, jobs, pending = Decoder(DBC), [], [], []
    for frame in LogReader(log).raw():
        decoded = decoder.decode(frame.can_id, frame.data)
        if decoded is None:
            continue
        if decoded.name in INPUTS:
            inputs.append(Input(frame.can_id, frame.data, decoded.name, decoded.values))
        elif decoded.name in CONTENT:
            pending.append((decoded.name, decoded.values, frame.data))
            if len(pending) == len(CONTENT):
                assert [name for name, _, _ in pending] == list(CONTENT)
                values = {f"{name}.{k}": v for name, signals, _ in pending for k, v in signals.items()}
                jobs.append(Job(values, tuple(data for _, _, data in pending), len(inputs)))
                pending = []
    driven = [job for job in jobs if job.inputs_before < len(inputs)]
    return Run(inputs, driven, load_result(out))


def feed(core, frame):
    """One decoded frame into the core, as the process does it."""
    v, nan = frame.values, math.nan
    if frame.name == "MotorState":
        torque, speed = v["torque_nm"], v["speed_rpm"]
        valid = torque is not None and speed is not None
        core.feed_motor(int(v["tick"]), torque if valid else nan, speed if valid else nan, valid)
    elif frame.name == "TempMeas":
        w, r = v["theta_w_meas_degc"], v["theta_r_meas_degc"]
        core.feed_temp(int(v["tick"]), nan if w is None else w, nan if r is None else r, w is not None, r is not None)
    else:
        coolant = v["coolant_degc"]
        core.feed_coolant(nan if coolant is None else coolant, bool(v["soaked"]), coolant is not None)


def carried(name, value):
    """A value as a receiver gets it back."""
    if math.isnan(value):
        return None
    signal = SIGNALS[name]
    return signal.to_raw(value) * signal.factor + signal.offset


def published(out):
    """What the bus carries of a step's output: the part of a job's frames that depends on the core alone."""
    w, r = out.channel
    values = {
        "Estimate.status": float(out.status),
        "Estimate.tick": float(out.tick16),
        "Estimate.theta_w_est_degc": carried("theta_w_est_degc", out.theta_w_degc),
        "Estimate.theta_r_est_degc": carried("theta_r_est_degc", out.theta_r_degc),
        "EstimateInnov.sweeps": float(min(out.sweeps, 14)),
        "EstimateInnov.innov_w_degc": carried("innov_w_degc", out.innov_w_degc),
        "EstimateInnov.innov_r_degc": carried("innov_r_degc", out.innov_r_degc),
    }
    for message, channel, ch in (("EstWinding", w, "w"), ("EstRotor", r, "r")):
        values |= {
            f"{message}.sensor_{ch}_fault": float(channel.fault),
            f"{message}.sensor_{ch}_trusted": float(channel.trusted),
            f"{message}.sigma_{ch}_degc": carried(f"sigma_{ch}_degc", channel.sigma_degc),
            f"{message}.upper_{ch}_degc": carried(f"upper_{ch}_degc", channel.upper_degc),
        }
    return values


def possible_cuts(run, job, first):
    """How many inputs the job may have read, `first` at least: to its MotorState, and what follows before the next."""
    newest, cuts = None, []
    for k in range(job.inputs_before + 1):
        if k > 0 and run.inputs[k - 1].name == "MotorState":
            newest = int(run.inputs[k - 1].values["tick"])
        wanted = newest == int(job.values["Estimate.tick"]) if newest is not None else job.values["Estimate.tick"] == 0
        if wanted and k >= first:
            cuts.append(k)
    return cuts


def explanations(run):
    """For each job the number of inputs read: the sequence that explains every job; fails where none does."""
    lib = load()
    core = Estimator(lib, lib.setting("default"))
    alive = {(): core.memory.raw}
    for number, job in enumerate(run.jobs):
        after, seen = {}, []
        for cuts, memory in alive.items():
            first = cuts[-1] if cuts else 0
            for cut in possible_cuts(run, job, first):
                core.memory.raw = memory
                for frame in run.inputs[first:cut]:
                    feed(core, frame)
                found = published(core.step())
                if job.stale and found["Estimate.status"] in ESTIMATES:
                    found["Estimate.status"] = INPUT_STALE  # the core knows no clock; the process does
                if all(job.values[name] == value for name, value in found.items()):
                    after[(*cuts, cut)] = core.memory.raw
                else:
                    seen.append({n: (v, job.values[n]) for n, v in found.items() if job.values[n] != v})
        assert after, f"job {number}: nothing that it can have read explains what it published: {seen}"
        # Two ways that came to the same number of frames and the same memory are one from here on.
        alive = {cuts: memory for (_, memory), cuts in {(c[-1], m): c for c, m in after.items()}.items()}
        assert len(alive) <= 8
    return list(alive)


@pytest.fixture(scope="module")
def cuts(run):
    return explanations(run)


def test_the_run_is_worth_replaying(run):
    """Two hundred jobs, all frames in the log, the fault found in the middle."""
    assert len(run.jobs) >= 150
    assert run.result["log"]["dropped"] == 0
    assert run.result["bus_faults"] == {"rx_drops": 0, "tx_drops": 0, "rejected": 0}
    classes = [job.values["EstWinding.sensor_w_fault"] for job in run.jobs]
    assert classes.count(1.0) > 50
    assert classes[:30].count(0.0) == 30
    temps = [f.values["theta_w_meas_degc"] for f in run.inputs if f.name == "TempMeas"]
    assert min(temps) < min(temps[:20]) - 15.0, f"{parse_fault(FAULT)} is in the measurements"


def test_every_job_follows_from_the_frames_before_it(run, cuts):
    """A way of reading the log explains status, estimate, innovation, class, sigma and bound of all jobs."""
    for found in cuts:
        assert len(found) == len(run.jobs)
        assert list(found) == sorted(found)


@pytest.mark.parametrize("name", ["MotorState", "TempMeas"])
def test_one_value_a_little_off_explains_nothing(run, name):
    """What keeps the test above from passing on anything: a single input, changed by a few codes of the bus."""
    signal = {"MotorState": "torque_nm", "TempMeas": "theta_w_meas_degc"}[name]
    middle = next(k for k, f in enumerate(run.inputs) if f.name == name and k > run.jobs[40].inputs_before)
    values = run.inputs[middle].values
    changed = replace(run.inputs[middle], values={**values, signal: values[signal] + 8 * SIGNALS[signal].factor})
    with pytest.raises(AssertionError, match="explains"):
        explanations(replace(run, inputs=[*run.inputs[:middle], changed, *run.inputs[middle + 1 :]]))


def test_lock_step_gives_the_bytes_of_real_time(run, cuts):
    """The binary on those frames, job by job: every content frame with its counter and checksum."""
    program, replays = binary("release"), []
    for found in cuts:
        records, done = [], 0
        for k, cut in enumerate(found):
            release_ns = (k + 1) * PERIOD_NS
            arrival_ns = release_ns - 60 * MS * run.jobs[k].stale
            records += [Record(arrival_ns, f.can_id, f.data) for f in run.inputs[done:cut]]
            records.append(tick_record(release_ns))
            done = cut
        records.append(tick_record(records[-1].t_ns, END))
        again = lockstep(program, to_bytes(records))
        assert again.status == 0, again.errors
        frames = [f.data for f in again.frames if f.name in CONTENT]
        size = len(CONTENT)
        replays.append([tuple(frames[i : i + size]) for i in range(0, len(frames), size)])
    assert [job.payload for job in run.jobs] in replays
