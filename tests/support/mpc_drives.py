"""Short drives of the plant under the controller's C, and the MPC problems met on the way."""

from __future__ import annotations

import ctypes as ct
from dataclasses import dataclass
from functools import cache

import numpy as np

from estimator_c.formulation.mpc import MpcData
from plant_sim.cycles import CycleSpec
from plant_sim.driver import TorqueCommand
from plant_sim.params import load_params
from plant_sim.plant import Plant
from tools.libctl import INTERVALS, ROOT, Array, Controller, Lib, Out, Problem, load

RECORDER = ROOT / "tests" / "support" / "mpc_recorder.c"


@cache
def recorder() -> Lib:
    """The library with its calls to the MPC tapped, see mpc_recorder.c."""
    return load(flags=("-O2", "-Wl,--wrap=mpc_solve", str(RECORDER)))


@dataclass(frozen=True, eq=False)
class Step:
    """One problem as the controller asked it, and its guess of motor and friction torque, (40,) each."""

    problem: Problem
    torque_nm: Array
    friction_nm: Array

    def data(self, intervals: int) -> MpcData:
        """The same for the oracle."""
        p = self.problem
        return MpcData(
            p.v_mps,
            p.torque_nm,
            *(np.array(a[:]) for a in (p.theta, p.limit, p.memory)),
            *(np.array(a[:intervals]) for a in (p.v_ref_mps, p.slope_rad)),
        )


def hot_plant(start_s: float, theta0_degc: float) -> Plant:
    """The lap, `start_s` driven without derating from a machine of one temperature."""
    plant = Plant(load_params(), CycleSpec(kind="lap", theta0_degc=theta0_degc), seed=1)
    plant.advance(start_s)
    return plant


def drive(lib: Lib, name: str, plant: Plant, seconds: float) -> tuple[list[Out], Array, Controller]:
    """(outputs, plant rows at 100 Hz, controller) of a drive with ideal feedback at 0.1 s."""
    cycle = plant.cycle
    controller = Controller(lib, name, cycle.v_ref_mps, cycle.slope_rad, cycle.step)
    assert controller.error == 0
    rows, outs = [plant.drive(10)[0]], []
    for _ in range(round(10 * seconds)):
        last = rows[-1]
        controller.estimate(float(last[-1, 6]), float(last[-1, 7]))
        controller.motion(float(last[-1, 3]), float(last[-1, 2]))
        for row in last:
            controller.motor(float(row[0]), float(row[1]))
        out = controller.step()
        outs.append(out)
        rows.append(plant.drive(10, 1.0, TorqueCommand(out.drive_nm, out.regen_nm, out.friction_nm))[0])
    return outs, np.concatenate(rows), controller


@cache
def recorded(name: str, start_s: float, seconds: float, theta0_degc: float = 60.0) -> tuple[Step, ...]:
    """The problems of such a drive, in order."""
    lib = recorder()
    count = ct.c_int.in_dll(lib.c, "recorded_count")
    count.value = 0
    drive(lib, name, hot_plant(start_s, theta0_degc), seconds)
    problems = (Problem * 4000).in_dll(lib.c, "recorded_problem")
    guesses = np.array((ct.c_double * (4000 * 2 * INTERVALS)).in_dll(lib.c, "recorded_guess")).reshape(4000, 2, -1)
    return tuple(
        Step(Problem.from_buffer_copy(problems[k]), guesses[k, 0].copy(), guesses[k, 1].copy())
        for k in range(count.value)
    )
