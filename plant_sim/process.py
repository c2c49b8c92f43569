"""The plant as a process: the model advanced on a clock and published on a bus, or in lock-step over pipes."""

import copy
import errno
import gc
import hashlib
import json
import select
import sys
import time
from dataclasses import asdict, replace
from typing import BinaryIO

import can

from plant_sim.faults import parse_fault
from plant_sim.mismatch import Mismatch
from plant_sim.obedience import FREE, Obedience
from plant_sim.params import load_params
from plant_sim.plant import CycleSpec, Plant, PlantSample
from plant_sim.publisher import Publisher
from rt_runner.bus import open_bus
from rt_runner.config import Scenario, load_scenario, with_duration, with_faults
from rt_runner.dbc import load_dbc
from rt_runner.errors import SetupError
from rt_runner.records import END, TICK, control, pack, read_until_control

TICK_NS = 10_000_000
TX_PATIENCE = 100  # tries of 0.1 s each
RX_MAX = 500  # frames read before a step; the rest waits for the next one
TICKS_PER_INTERVAL = 10  # lock-step advances by 0.1 s


def _scenario(args) -> Scenario:
    return with_faults(with_duration(load_scenario(args.scenario), args.duration), args.fault)


def make_plant(scenario: Scenario, seed: int) -> Plant:
    """The scenario's plant, advanced off line to the second it starts at."""
    cycle, sensor = scenario.cycle, scenario.sensor
    path = str(scenario.path.parent / cycle.path) if cycle.path else None
    params = Mismatch(**asdict(scenario.plant)).apply(load_params())
    params = replace(
        params,
        sensor=replace(params.sensor, mean_k=sensor.offset_degc, variance_k2=sensor.variance, delay_s=sensor.delay_s),
    )
    plant = Plant(
        params,
        CycleSpec(kind=cycle.kind, path=path, theta0_degc=cycle.theta0_degc),
        seed=seed,
        faults=[parse_fault(text) for text in scenario.all_faults],
        key_on_s=cycle.key_on_s,
    )
    plant.advance(cycle.start_s)
    return plant


def _publisher(scenario: Scenario, plant: Plant) -> Publisher:
    digest = hashlib.sha256(repr(plant.params).encode()).hexdigest()  # dataclasses print in a fixed order
    return Publisher(load_dbc(), digest, scenario.sha256)


class _Course:
    """The plant on its way, obeying whom it has to: the driver, or what was heard of a controller."""

    def __init__(self, plant: Plant, publisher: Publisher, obeys: bool) -> None:
        self.plant = plant
        self._publisher = publisher
        self._obedience = Obedience(load_dbc(), plant.tick) if obeys else None

    def hear(self, arbitration_id: int, data: bytes) -> None:
        if self._obedience is not None:
            self._obedience.hear(arbitration_id, data, self.plant.tick)

    def step(self) -> tuple[PlantSample, list[can.Message]]:
        """The next tick and what is to be sent of it."""
        obedience, plant = self._obedience, self.plant
        if obedience is None:
            sample = plant.step()
            return sample, self._publisher.frames(sample)
        decision = obedience.decide(plant.tick) if plant.driving else FREE
        sample = plant.step(decision.derate, decision.command)
        if sample.tick % TICKS_PER_INTERVAL == 0:
            obedience.measured(sample.tick, sample.theta_w_meas_degc, sample.theta_r_meas_degc)
        return sample, self._publisher.frames(sample, decision, obedience)


def run_realtime(args) -> int:
    """Publish one tick every 10 ms until the scenario's end, SIGTERM, or the end of stdin.

    A late tick is sent late and counted: physics is never skipped. Returns the exit status.
    """
    scenario = _scenario(args)
    plant = make_plant(scenario, args.seed)
    publisher = _publisher(scenario, plant)
    copy.deepcopy(plant).step()  # compiles, and loads what the first step would load
    course = _Course(plant, publisher, args.obey)
    with open_bus(args.bus, receive=args.obey) as bus:
        _say({"ready": True, "tick": plant.tick, "t_s": plant.tick * TICK_NS / 1e9})
        if sys.stdin.readline().strip() != "go":
            return 0
        gc.collect()
        gc.disable()  # nothing here makes cycles; a collection would only be a late tick
        ticks = round(scenario.duration_s * 100)
        start_ns = time.monotonic_ns() + TICK_NS
        count = 0
        try:
            while not ticks or count < ticks:
                due_ns = start_ns + count * TICK_NS
                ahead_ns = due_ns - time.monotonic_ns()
                if ahead_ns > 0:
                    time.sleep(ahead_ns / 1e9)
                sample_ns, before_ns = time.time_ns(), time.monotonic_ns()
                if args.obey:
                    _hear_all(bus, course)
                sample, (motor_state, *others) = course.step()
                _send(bus, motor_state, publisher)
                send_ns = time.monotonic_ns() - before_ns
                for message in others:
                    _send(bus, message, publisher)
                _send(bus, publisher.sampled(sample.tick, sample_ns, send_ns), publisher)
                late_ns = time.monotonic_ns() - due_ns
                if late_ns > TICK_NS:
                    publisher.ticks_late += 1
                publisher.late_max_ms = max(publisher.late_max_ms, late_ns / 1e6)
                count += 1
                if sample.done or (count % 10 == 0 and _stdin_closed()):
                    break
        except can.CanOperationError as e:
            raise SetupError(
                f"sending on {args.bus} failed at tick {plant.tick}: {e}; see what the other processes said last"
            ) from e
        _say(
            {
                "final": True,
                "ticks": count,
                "ticks_late": publisher.ticks_late,
                "late_max_ms": publisher.late_max_ms,
                "tx_retries": publisher.tx_retries,
            }
        )
    return 0


def _hear_all(bus: can.BusABC, course: _Course) -> None:
    """Everything that has arrived, and no more than a flood's worth of it."""
    for _ in range(RX_MAX):
        message = bus.recv(0.0)
        if message is None:
            return
        if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd):
            course.hear(message.arbitration_id, bytes(message.data))


def _send(bus: can.BusABC, message: can.Message, publisher: Publisher) -> None:
    for _ in range(TX_PATIENCE):
        try:
            return bus.send(message, timeout=0.1)
        except can.CanOperationError as e:
            if e.error_code not in (errno.EAGAIN, errno.ENOBUFS):  # the queue is full: the bus is still there
                raise
            publisher.tx_retries += 1
            time.sleep(0.0005)
    raise can.CanOperationError(f"no room to send for {TX_PATIENCE} tries: nobody takes our frames off the bus")


def run_lockstep(args, inp: BinaryIO, out: BinaryIO) -> int:
    """Advance by 0.1 s for each TICK record read, writing the frames of that time and echoing the TICK.

    Frames before the TICK are what the other processes said; a plant that obeys hears them before it moves on.
    Time on the records starts at 0 with the first tick simulated here. Writes END after the last frame.
    """
    scenario = _scenario(args)
    plant = make_plant(scenario, args.seed)
    publisher = _publisher(scenario, plant)
    course = _Course(plant, publisher, args.obey)
    ticks, first = round(scenario.duration_s * 100), plant.tick
    done = False
    while not done:
        try:
            *heard, mark = read_until_control(inp)
        except EOFError:
            return 0
        if mark.data[0] == END:
            return 0
        for record in heard:
            course.hear(record.can_id, record.data)
        chunk = bytearray()
        for _ in range(TICKS_PER_INTERVAL):
            sample, messages = course.step()
            t_ns = (sample.tick - first) * TICK_NS
            for message in messages:
                chunk += pack(t_ns, message.arbitration_id, bytes(message.data))
            done = sample.done or (ticks > 0 and sample.tick - first >= ticks)
            if done:
                break
        out.write(chunk + control((plant.tick - first) * TICK_NS, END if done else TICK))
        out.flush()
    return 0


def _say(line: dict) -> None:
    print(json.dumps(line), flush=True)


def _stdin_closed() -> bool:
    ready, _, _ = select.select([sys.stdin], [], [], 0)
    return bool(ready) and sys.stdin.read(1) == ""
