"""The estimator's whole cycle in virtual time: clock and bus are scripted, what comes out on the bus is exact.

Frames are lost, repeated, damaged and late while the machine wakes the job late, computes long and blocks its sends;
the counters on the bus must be what the definitions (tests/support/timing_model.py) and the profile of protection say.
"""

from __future__ import annotations

import ctypes as ct
import os
import subprocess
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rt_runner import paths
from rt_runner.codec import Decoder, Encoder
from rt_runner.dbc import load_dbc
from tests.support import timing_model as tm
from tests.unit import rt_shim
from tests.unit.rt_shim import I64
from tests.unit.test_rt_virtual_time import MS, TRACE, US, config_of, machine, quiet

PERIOD = 10 * MS
ROOM = 8192
ON_MISS = ("late", "hold", "predict", "invalid")
COMPUTED, HELD, PREDICTED, INVALID = range(4)  # EstTimingC.output


class Arrival(ct.Structure):
    _fields_ = (("at_ns", I64), ("id", ct.c_uint32), ("length", ct.c_uint32), ("data", ct.c_uint8 * 8))


class Departure(ct.Structure):
    _fields_ = (("job", I64), ("id", ct.c_uint32), ("length", ct.c_uint32), ("data", ct.c_uint8 * 8))


class EstWorld:
    """The cycle of the built library in the machine and on the bus of a script."""

    def __init__(self, folder: Path) -> None:
        build = paths.build_dir()
        library = build / "lib" / "libestimator.so"
        if not library.exists():
            assert os.environ.get("CI") != "true", f"{library} is missing"
            pytest.skip(f"{library} is missing; run 'make build'")
        source, here = rt_shim.ROOT / "estimator_c" / "src", Path(__file__).parent
        command = ["gcc", "-std=c11", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-D_GNU_SOURCE", "-fPIC", "-shared"]
        command += [f"-I{source}", f"-I{source / 'solver'}", f"-I{build / 'gen'}", f"-I{here}"]
        command += [str(here / "est_world_shim.c"), "-o", str(folder / "est_world.so")]
        command += [str(library), f"-Wl,-rpath,{library.parent}", "-lpthread"]
        subprocess.run(command, check=True)
        self.c = ct.CDLL(str(folder / "est_world.so"))
        self.c.est_world_run.restype = I64
        self.dbc = load_dbc()
        assert self.c.est_world_open(ct.byref(config_of(tm.Setting(PERIOD, PERIOD)))) == 0

    def run(self, setting: tm.Setting, on_miss: str, how: dict, steps: list[dict], thefts: list, arrivals: list):
        """(jobs, canary's wake-ups, decoded frames by job; those of the final counters under -1)."""
        n, fields = len(steps), rt_shim.JOB_FIELDS
        flat = [step[name] for step in steps for name in rt_shim.STEP_FIELDS]
        out, heard = (I64 * (n * len(fields)))(), (I64 * (2 * rt_shim.HEARD))()
        sent, count, heard_count = (Departure * ROOM)(), ct.c_size_t(ROOM), ct.c_size_t(rt_shim.HEARD)
        ran = self.c.est_world_run(
            ct.byref(config_of(setting)),
            ON_MISS.index(on_miss),
            (I64 * len(rt_shim.MACHINE_FIELDS))(*(machine(setting, **how)[name] for name in rt_shim.MACHINE_FIELDS)),
            (I64 * max(1, 2 * len(thefts)))(*(at for span in thefts for at in span)),
            ct.c_size_t(len(thefts)),
            (I64 * len(flat))(*flat),
            ct.c_size_t(n),
            (Arrival * max(1, len(arrivals)))(*arrivals),
            ct.c_size_t(len(arrivals)),
            out,
            sent,
            ct.byref(count),
            heard,
            ct.byref(heard_count),
        )
        assert ran >= 0, "refused"
        assert count.value < ROOM, "more frames than the test has room for"
        values, width = list(out), len(fields)
        jobs = [dict(zip(fields, values[i * width : (i + 1) * width], strict=True)) for i in range(ran)]
        decoder, frames = Decoder(self.dbc), defaultdict(dict)
        for frame in sent[: count.value]:
            decoded = decoder.decode(frame.id, bytes(frame.data)[: frame.length])
            assert decoded is not None
            lost = decoded.name == "Estimate" and decoded.e2e.name == "LOST"  # the bus had no room for the one before
            assert lost or decoded.e2e.name == "OK", "the estimator's own frames are in sequence"
            frames[frame.job][decoded.name] = decoded.values
        records = heard[: 2 * heard_count.value]
        return jobs, list(zip(records[::2], records[1::2], strict=True)), frames


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return EstWorld(tmp_path_factory.mktemp("est_world"))


@pytest.fixture(scope="module")
def stream(world):
    """What a plant sends in 0.7 s: (at_ns, id, data), MotorState every 10 ms and TempMeas every 100 ms."""
    encoder, frames = Encoder(world.dbc, "PLANT"), []
    for tick in range(1, 71):
        at_ns = tick * PERIOD - 2 * MS
        motor = encoder.encode("MotorState", derating_active=0, torque_nm=50.0, speed_rpm=5000.0, tick=tick)
        frames.append((at_ns, motor.arbitration_id, bytes(motor.data)))
        if tick % 10 == 0:
            temp = encoder.encode("TempMeas", theta_w_meas_degc=60.0, theta_r_meas_degc=50.0, tick=tick)
            frames.append((at_ns + 100 * US, temp.arbitration_id, bytes(temp.data)))
    return frames


# ---- what the bus does to frames ------------------------------------------------------------------------------------


def disturbed(stream: list, faults: list[tuple[int, str, int]]) -> list[tuple[int, int, bytes, bool]]:
    """(at_ns, id, data, damaged) as they arrive, in order of time."""
    fault_of, frames = {at % len(stream): (kind, amount) for at, kind, amount in faults}, []
    for i, (at_ns, can_id, data) in enumerate(stream):
        kind, amount = fault_of.get(i, ("", 0))
        if kind == "lose":
            continue
        if kind == "damage":
            bad = bytearray(data)
            bad[amount % len(bad)] ^= 1 << (amount % 8)
            frames.append((at_ns, can_id, bytes(bad), True))
            continue
        late_ns = amount * MS if kind == "late" else 0
        frames.append((at_ns + late_ns, can_id, data, False))
        if kind == "repeat":
            frames.append((at_ns + 50 * US, can_id, data, False))
    return sorted(frames, key=lambda frame: frame[0])


@dataclass
class Reception:
    """One message as the profile defines it, and its age."""

    max_delta: int
    timeout_ns: int
    counter: int | None = None
    last_ns: int | None = None  # of the newest frame with news
    used_ns: int | None = None  # of the newest one that is intact and no repetition
    last_tick: int | None = None
    verdicts: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def take(self, at_ns: int, data: bytes, damaged: bool) -> None:
        if damaged:
            self.verdicts["crc"] += 1
            return
        before, self.counter = self.counter, data[1] & 15
        delta = 1 if before is None else (self.counter - before) % 16
        if delta != 1:
            self.verdicts["sequence"] += 1
        if delta == 0:
            return
        self.used_ns = at_ns
        tick = int.from_bytes(data[6:8], "little")
        if tick != self.last_tick:
            self.last_tick, self.last_ns = tick, at_ns

    def age_us(self, now_ns: int) -> Any:
        return None if self.used_ns is None else tenths(now_ns - self.used_ns)

    def stale(self, now_ns: int) -> bool:
        return self.last_ns is not None and now_ns - self.last_ns > self.timeout_ns


def receptions(world) -> dict[int, Reception]:
    return {
        m.frame_id: Reception(m.max_delta, m.timeout_ms * MS) for m in world.dbc if m.name in ("MotorState", "TempMeas")
    }


def tenths(ns: int) -> Any:
    """As a signal of 0.1 µs carries it."""
    return pytest.approx(ns / US, abs=0.051)


def stand_ins(on_miss: str, late: bool, in_time_before: bool) -> tuple[int, ...]:
    """What a job may put out; whether a prediction has anything to start from is the estimator's business."""
    if not late or on_miss == "late":
        return (COMPUTED,)
    held = (HELD,) if in_time_before else (INVALID,)
    return {"hold": held, "predict": (PREDICTED, INVALID), "invalid": (INVALID,)}[on_miss]


def check(
    world, setting: tm.Setting, steps: list[dict], thefts: list, arriving: list, on_miss: str = "late", **how: int
) -> tm.Model:
    """Runs the cycle and the models and compares every timing frame and the final counters. Returns the model."""
    arrivals = [Arrival(at_ns, can_id, len(d), (ct.c_uint8 * 8)(*d)) for at_ns, can_id, d, _ in arriving]
    jobs, heard, frames = world.run(setting, on_miss, how, steps, thefts, arrivals)
    motor, temp = (world.dbc[name].frame_id for name in ("MotorState", "TempMeas"))
    outputs: list[int] = []
    model, known, read, stale_jobs, rx = tm.Model(setting), 0, 0, 0, receptions(world)
    for number, (job, step) in enumerate(zip(jobs, steps, strict=False)):
        assert job["broken"] == 0
        while read < len(arriving) and arriving[read][0] <= job["start_ns"]:
            at_ns, can_id, data, damaged = arriving[read]
            rx[can_id].take(at_ns, data, damaged)
            read += 1
        stale = any(message.stale(job["start_ns"]) for message in rx.values())
        stale_jobs += stale
        upto = known
        while upto < len(heard) and heard[upto][1] <= job["published_ns"]:
            upto += 1
        a, b, c, d = (frames[number][f"EstTiming{letter}"] for letter in "ABCD")
        job["asked"], job["asked_ns"] = c["cut"], job["stepped_ns"]  # how often the solver asks is its own business
        stimulus = {name: step[name] if name in ("sent", "stale") else job[name] for name in TRACE}
        due_ns = heard[upto][0] if upto < len(heard) else None
        want = model.run(tm.Trace(**stimulus | {"stale": stale}), heard[known:upto], due_ns)
        known = upto
        assert a["release_index"] == want.index
        assert (a["miss_late"], a["warmup"], a["after_skip"]) == (want.miss_late, want.warmup, want.after_skip)
        assert a["stale_input"] == stale
        assert (c["queued"], c["cut"]) == (want.queued, want.cut)
        assert c["output"] in stand_ins(on_miss, want.late_now, COMPUTED in outputs)
        outputs.append(int(c["output"]))
        assert c["in_age_motor_us"] == rx[motor].age_us(job["start_ns"])
        assert c["in_age_temp_us"] == rx[temp].age_us(job["start_ns"])
        assert d["canary_us"] == (None if want.canary_ns < 0 else tenths(want.canary_ns))
        assert b["miss_cause"] == tm.CAUSES.index(want.cause)
        times = (a["wake_lat_us"], b["exec_wall_us"], b["resp_us"], d["exec_cpu_us"])
        assert times == (*map(tenths, (want.wake_lat_ns, want.exec_wall_ns, want.resp_ns, want.exec_cpu_ns)),)
        assert ("Estimate" in frames[number]) == bool(step["sent"])
    total, last = model.counters("total"), frames[-1]
    releases = {"releases": total["releases"] - total["queued_now"], "jobs": total["jobs"]}  # those decided
    assert {name: last["EstReleases"][name] for name in releases} == releases
    misses = {name: total[name] for name in ("miss_late", "miss_skipped", "overrun")}
    assert {name: last["EstMisses"][name] for name in misses} == misses
    assert last["EstMissRun"]["consec_miss_max"] == total["consec_miss_max"]
    assert last["EstMissRun"]["mk_worst"] == total["mk_worst"]
    assert last["EstMissRun"]["phase_us"] == model.phase_ns // US
    overload = {
        "waiting": total["queued_now"],
        "queued": total["queued"],
        "cut": sum(job.cut for job in model.jobs),
        "rebased": model.rebased,
    }
    assert {name: last["EstOverload"][name] for name in overload} == overload
    put_out = {"held": HELD, "predicted": PREDICTED, "invalidated": INVALID}
    assert {name: last["EstOutputs"][name] for name in put_out} == {n: outputs.count(o) for n, o in put_out.items()}
    assert last["EstInputFaults"]["crc_errors"] == sum(message.verdicts["crc"] for message in rx.values())
    assert last["EstInputFaults"]["seq_errors"] == sum(message.verdicts["sequence"] for message in rx.values())
    assert last["EstInputFaults"]["stale_inputs"] == stale_jobs
    assert last["EstBusFaults"]["tx_drops"] == sum(step["sent"] == 0 for step in steps[: len(jobs)])
    return model


# ---- by name --------------------------------------------------------------------------------------------------------

STEPS = [quiet(cpu_ns=200 * US) for _ in range(60)]
SETTING = tm.Setting(PERIOD, PERIOD, warmup=5)


def counted(world, stream, faults: list[tuple[int, str, int]]) -> dict[str, int]:
    arriving = disturbed(stream, faults)
    check(world, SETTING, STEPS, [], arriving)
    _, _, frames = world.run(
        SETTING, "late", {}, STEPS, [], [Arrival(t, i, len(d), (ct.c_uint8 * 8)(*d)) for t, i, d, _ in arriving]
    )
    return {name: int(value) for name, value in frames[-1]["EstInputFaults"].items() if name.endswith(("rs", "ts"))}


@pytest.mark.parametrize(("kind", "crc", "seq"), [("damage", 5, 5), ("repeat", 0, 5), ("lose", 0, 5), ("late", 0, 15)])
def test_five_frames_disturbed_are_counted_exactly(world, stream, kind, crc, seq):
    faults = [(at, kind, 25) for at in (12, 20, 29, 37, 48)]
    found = counted(world, stream, faults)
    assert (found["crc_errors"], found["seq_errors"], found["stale_inputs"]) == (crc, seq, 0)


def test_a_silence_makes_exactly_the_jobs_stale_that_come_after_its_timeout(world, stream):
    # MotorState of ticks 21 to 29 is lost: the newest one, of 198 ms, is 50 ms old at 248 ms; tick 30 comes at 298 ms
    faults = [(i, "lose", 0) for i, frame in enumerate(stream) if 208 * MS <= frame[0] <= 288 * MS]
    assert counted(world, stream, faults)["stale_inputs"] == 5


# ---- any bus, any machine -------------------------------------------------------------------------------------------

bus_faults = st.lists(
    st.tuples(st.integers(0, 76), st.sampled_from(("lose", "repeat", "damage", "late")), st.integers(0, 60)), max_size=9
)
amount = st.one_of(st.integers(0, 12 * MS), st.sampled_from([PERIOD, 31 * MS]))
troubles = st.lists(
    st.tuples(
        st.integers(0, 39),
        st.sampled_from(("wake_ns", "cpu_ns", "away_ns", "publish_ns", "rest_ns", "sent", "interrupts")),
        amount,
    ),
    max_size=6,
)
est_settings = st.builds(
    tm.Setting,
    period_ns=st.just(PERIOD),
    deadline_ns=st.sampled_from([PERIOD, PERIOD // 2]),
    warmup=st.integers(0, 10),
    policy=st.sampled_from(
        [
            tm.Policy(),
            tm.Policy("rebase"),
            tm.Policy("queue", 2),
            tm.Policy("stop", stop_total=4),
            tm.Policy("cut", budget_ns=MS),
        ]
    ),
    canary=st.integers(0, 2),
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    est_settings,
    st.sampled_from(ON_MISS),
    st.integers(5, 40),
    troubles,
    bus_faults,
    st.lists(st.integers(0, 40), max_size=2),
)
def test_any_bus_and_any_machine(world, stream, setting, on_miss, count, things, faults, stolen):
    steps = [dict(step) for step in STEPS[:count]]
    for at, kind, value in things:
        step = steps[at % count]
        step[kind] = step[kind] + value if kind.endswith("_ns") else 1 - step[kind]
    thefts = [(n * PERIOD - MS, n * PERIOD + 9 * MS) for n in sorted(set(stolen))]
    check(world, setting, steps, thefts, disturbed(stream, faults), on_miss, canary_lat_ns=30 * US)
