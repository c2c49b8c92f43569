"""The controller around the MPC: set-up, driver and rule, fall-backs, doubt, clamp, and a short hot drive."""

from __future__ import annotations

import ctypes as ct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.generate import generate
from estimator_c.formulation.mpc_net import generate_mpc, supported
from estimator_c.formulation.mpc_settings import load_mpc_settings, load_vehicle
from estimator_c.formulation.weights import load_weights
from plant_sim.driver import driver_step
from plant_sim.params import load_params
from plant_sim.vehicle import motor_speed_rpm, motoring_limit_nm, regen_limit_nm
from tests.support.mpc_drives import drive, hot_plant, recorder
from tools.libctl import (
    BAD_PERIOD,
    BAD_ROAD,
    BASE,
    BY_DRIVER,
    BY_MPC,
    BY_RULE,
    BY_SHIFTED,
    FAILED,
    MPC_SETTINGS,
    NO_NET,
    OK,
    ROOT,
    SETTINGS,
    SOURCES,
    UNKNOWN,
    WEIGHTS,
    Controller,
    Lib,
    Out,
    Vehicle,
    compile_library,
    load,
)  # fmt: skip

ROAD = np.full(3000, 25.0), np.zeros(3000)


def settled(lib: Lib, name: str = "mpc-S", theta: float = 120.0, steps: int = 5) -> Controller:
    """A controller that has driven a few steps at 20 m/s on a flat road that asks for 25."""
    controller = Controller(lib, name, *ROAD)
    assert controller.error == 0
    for k in range(steps):
        feed(controller, theta, 2.0 * k)
        controller.step()
    return controller


def repeat(controller: Controller, steps: int, theta: float, x_m: float, v_mps: float = 20.0) -> Out:
    """The last of so many steps with the same inputs."""
    out = Out()
    for _ in range(steps):
        feed(controller, theta, x_m, v_mps)
        out = controller.step()
    return out


def feed(controller: Controller, theta: float | None, x_m: float, v_mps: float = 20.0) -> None:
    if theta is not None:
        controller.estimate(theta, 0.8 * theta)
    controller.motion(x_m, v_mps)
    controller.motor(40.0, 300.0 * v_mps)


# ---- set-up ---------------------------------------------------------------------------------------------------
def test_what_cannot_be_set_up_is_refused() -> None:
    lib, (v_ref, slope) = load(), ROAD
    for name in ("", "rule", "rule-150", "rule-155-150", "rule-150-155x", "MPC-M", "none "):
        assert Controller(lib, name, v_ref, slope).error == UNKNOWN
    for period_s in (0.0, -0.1, 0.03, 0.2, 0.005, 0.014, np.nan):
        assert Controller(lib, "none", v_ref, slope, period_s=period_s).error == BAD_PERIOD
    for period_s in (0.01, 0.02, 0.05, 0.1):
        assert Controller(lib, "none", v_ref, slope, period_s=period_s).error == 0
    assert Controller(lib, "none", v_ref[:1], slope[:1]).error == BAD_ROAD
    assert Controller(lib, "none", v_ref, slope, step_m=0.0).error == BAD_ROAD
    assert Controller(lib, "none", np.where(np.arange(3000) == 7, np.nan, v_ref), slope).error == BAD_ROAD


def test_car_of_the_controller_is_the_plants() -> None:
    """Two statements, one car: a plant that differs on purpose differs in its own files."""
    params, car = load_params(), load_vehicle(MPC_SETTINGS)
    v, m, d = params.vehicle, params.machine, params.driver
    plant = {
        "mass_kg": v.mass_kg, "drag_kg_m": 0.5 * v.drag_coeff * v.frontal_area_m2 * v.rho_air_kg_m3,
        "roll_coeff": v.roll_coeff, "gravity_mps2": v.gravity_mps2, "gear_per_m": v.gear_ratio / v.wheel_radius_m,
        "v_max_mps": v.v_max_mps, "drive_nm": m.torque_max_nm, "drive_w": m.power_max_w,
        "regen_nm": m.regen_torque_max_nm, "regen_w": m.regen_power_max_w, "regen_from_mps": m.regen_v_lo_mps,
        "regen_full_mps": m.regen_v_hi_mps, "friction_nm": -d.u_min_nm, "kp_nm_per_mps": d.kp_nm_per_mps,
        "ki_nm_per_m": d.ki_nm_per_m, "u_min_nm": d.u_min_nm, "u_max_nm": d.u_max_nm,
        "integral_max_nm": d.integral_max_nm,
    }  # fmt: skip
    assert set(plant) == set(car)
    for key, value in plant.items():
        assert car[key] == pytest.approx(value, rel=1e-12), key
        assert getattr(load().vehicle, key) == car[key]


# ---- driver and rule ------------------------------------------------------------------------------------------
class Command(ct.Structure):
    """pi_command_t."""

    _fields_ = (("drive_nm", ct.c_double), ("regen_nm", ct.c_double), ("friction_nm", ct.c_double), ("cut", ct.c_bool))


def test_driver_is_the_plants_driver() -> None:
    rng, params, integral = np.random.default_rng(2), load_params(), ct.c_double(0.0)
    step = load().c.pi_driver_step
    step.argtypes = [ct.POINTER(ct.c_double), ct.POINTER(Vehicle), *[ct.c_double] * 6]
    step.restype = Command
    expected_integral = 0.0
    for k in range(2000):
        v, v_ref = (0.0, 0.0) if k % 97 == 0 else (rng.uniform(0, 36), rng.uniform(0, 36))
        share, rpm = rng.uniform(), motor_speed_rpm(v, params.vehicle)
        limits = motoring_limit_nm(rpm, params.machine), regen_limit_nm(rpm, v, params.machine)
        asked = driver_step(v, v_ref, expected_integral, *limits, share, 0.1, params.driver)
        found = step(ct.byref(integral), ct.byref(load().vehicle), v, v_ref, *limits, share, 0.1)
        expected_integral = asked.integral_nm
        assert (found.drive_nm, found.regen_nm, found.friction_nm) == pytest.approx(asked[:3], abs=1e-9)
        assert integral.value == pytest.approx(expected_integral, abs=1e-9)


def test_rule_is_linear_in_both_temperatures_and_nothing_without_one() -> None:
    share = load().c.derating_rule_share
    share.argtypes, share.restype = [ct.POINTER(ct.c_double * 4), ct.c_double, ct.c_double], ct.c_double
    rule = (ct.c_double * 4)(150, 145, 155, 160)
    for w, r, expected in (
        (100, 100, 1), (150, 145, 1), (152.5, 100, 0.5), (100, 152.5, 0.5), (152.5, 157, 0.2), (155, 100, 0),
        (170, 100, 0), (100, 161, 0), (np.nan, 100, 0), (100, np.nan, 0), (np.inf, 100, 0),
    ):  # fmt: skip
        assert share(ct.byref(rule), w, r) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", ["none", "rule-150-155"])
def test_baselines(name: str) -> None:
    controller = Controller(load(), name, *ROAD)
    torques = []
    for theta in (100.0, 151.0, 152.5, 156.0):
        out = repeat(controller, 3, theta, 100.0)
        assert out.source == BY_DRIVER
        torques.append(out.drive_nm)
        assert out.derating == (name != "none" and theta > 150.0)
    if name == "none":
        assert min(torques) == max(torques) > 90.0
    else:
        np.testing.assert_allclose(np.array(torques) / torques[0], [1.0, 0.8, 0.5, 0.0], atol=1e-9)


# ---- fall-backs -----------------------------------------------------------------------------------------------
def test_failed_solutions_shifted_plan_then_rule_then_back() -> None:
    lib = recorder()
    controller = settled(lib)
    before = controller.step()
    assert before.source == BY_MPC
    ct.c_int.in_dll(lib.c, "recorder_fails").value = 8
    sources, outs = [], []
    for k in range(10):
        feed(controller, 120.0, 10.0 + 2.0 * k)
        outs.append(controller.step())
        sources.append(outs[-1].source)
    assert sources == [BY_SHIFTED] * 5 + [BY_RULE] * 3 + [BY_MPC] * 2
    assert [out.status for out in outs] == [FAILED] * 8 + [OK] * 2
    assert max(out.drive_nm for out in outs) <= 160.0
    counters = controller.counters
    assert (counters.failed, counters.shifted, counters.rule_steps, counters.slack_jumps) == (8, 5, 3, 0)


def test_rule_in_the_fall_back_derates() -> None:
    lib, torque = recorder(), []
    for theta in (120.0, 152.5):
        controller = settled(lib, theta=theta)
        ct.c_int.in_dll(lib.c, "recorder_fails").value = 6
        out = repeat(controller, 6, theta, 10.0)
        assert out.source == BY_RULE
        torque.append(out.drive_nm)
    assert torque[1] == pytest.approx(0.5 * 60000.0 / (20.0 * load().vehicle.gear_per_m), rel=1e-6)
    assert torque[0] > torque[1]


def test_a_jump_of_the_slack_is_a_failure() -> None:
    lib = recorder()
    controller = settled(lib)
    ct.c_double.in_dll(lib.c, "recorder_slack_jump").value = 2.1
    feed(controller, 120.0, 10.0)
    assert controller.step().source == BY_SHIFTED
    assert controller.counters.slack_jumps == 1
    feed(controller, 156.9, 12.0)  # the estimate itself jumps above the limit: that is no failure
    assert controller.step().source == BY_MPC


def test_without_an_estimate_the_net_runs_on_and_doubt_grows() -> None:
    controller = settled(load(), theta=140.0)
    fresh, margins, thetas = [], [], []
    for k in range(2300):
        feed(controller, None, 10.0 + 0.02 * k)
        out = controller.step()
        fresh.append(out.estimate_fresh)
        margins.append(out.margin_k)
        thetas.append(out.theta_w_degc)
    assert fresh == [True] * 3 + [False] * 2297
    assert [margins[0], margins[99], margins[-1]] == pytest.approx([0.0, 0.05 * 10.0, 10.0])
    assert max(thetas) < 160.0
    assert np.ptp(thetas) > 0.5
    assert controller.counters.no_estimate >= 2297


@pytest.mark.parametrize("name", ["rule-150-155", "mpc-S", "mpc-M", "paper"])
def test_never_an_estimate_no_motor_torque(name: str) -> None:
    controller = Controller(load(), name, *ROAD)
    for theta in (None, np.nan, 1e9, -300.0):
        for v in (20.0, 30.0):
            feed(controller, theta, 10.0, v)
            out = controller.step()
            assert (out.drive_nm, out.regen_nm) == (0.0, 0.0)
            assert out.friction_nm < 0.0 if v > 25.0 else out.friction_nm == 0.0
    assert controller.counters.bad_inputs >= 6


def test_nothing_is_commanded_before_the_first_motion() -> None:
    controller = Controller(load(), "mpc-S", *ROAD)
    controller.estimate(100.0, 90.0)
    for v in (np.nan, -1.0, 1e9):
        controller.motion(0.0, v)
        out = controller.step()
        assert (out.drive_nm, out.regen_nm, out.friction_nm) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("name", ["rule-150-155", "mpc-S", "mpc-M", "paper"])
def test_clamp_above_157(name: str) -> None:
    for v in (20.0, 30.0):  # one drives, one brakes
        controller = settled(load(), name, theta=150.0)
        out = repeat(controller, 3, 157.5, 10.0, v)
        assert (out.drive_nm, out.regen_nm) == (0.0, 0.0)
        assert out.friction_nm < -10.0 if v > 25.0 else True


def test_margin_follows_what_the_estimator_says() -> None:
    for sigma, upper, expected in ((0.0, 150.0, 0.0), (0.3, 150.0, 0.6), (0.1, 150.7, 0.7), (0.0, 190.0, 12.0),
                                   (np.nan, np.nan, 0.0)):  # fmt: skip
        controller = Controller(load(), "mpc-S", *ROAD)
        controller.estimate(150.0, 120.0, sigma, upper)
        controller.motion(0.0, 20.0)
        out = controller.step()
        assert out.margin_k == pytest.approx(expected, abs=1e-9)
        assert out.limit_degc == pytest.approx(155.0 - expected)


def test_between_the_solutions_the_command_is_held() -> None:
    controller = Controller(load(), "mpc-S", *ROAD, period_s=0.02)
    outs = []
    for k in range(20):
        feed(controller, 120.0, 0.4 * k)
        outs.append(controller.step())
    assert [k for k, out in enumerate(outs) if out.solved] == [0, 5, 10, 15]
    assert {out.source for out in outs} == {BY_MPC}
    for k in range(20):
        assert outs[k].drive_nm == outs[k - k % 5].drive_nm


# ---- a drive --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["mpc-S", "mpc-M", "paper"])
def test_hot_drive_holds_the_limit(name: str) -> None:
    plant = hot_plant(455.0, 60.0)
    outs, rows, controller = drive(load(), name, plant, 40.0)
    counters = controller.counters
    assert 154.0 < rows[:, 6].max() < 155.3
    assert any(out.derating for out in outs)
    assert (counters.failed, counters.clamped, counters.rule_steps) == (0, 0, 0)
    assert counters.solves == 400
    assert counters.unconverged <= 2
    again, same, _ = drive(load(), name, hot_plant(455.0, 60.0), 40.0)
    assert np.array_equal(rows, same)
    assert [bytes(a)[:24] for a in outs] == [bytes(b)[:24] for b in again]


# ---- what is generated, what is linked ------------------------------------------------------------------------
def test_generated_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = (generate_mpc(WEIGHTS, MPC_SETTINGS, tmp_path / name) for name in "ab")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    assert {p.name for p in generate_mpc(WEIGHTS, MPC_SETTINGS, tmp_path / "c", ())} == {
        "mpc_settings.h", "mpc_settings.c", "ocp_net.h", "ocp_net.c", "ocp_net_select.c", "ocp_net_portable.c"
    }  # fmt: skip


def test_a_net_without_derivatives_is_refused_when_set_up(tmp_path: Path) -> None:
    from tests.support.nets import random_net

    weights = random_net(tmp_path, cell="gru")
    assert not supported(load_weights(weights))
    assert supported(load_weights(WEIGHTS))
    lib = Lib(compile_library(weights, isas=()))
    assert Controller(lib, "mpc-S", *ROAD).error == NO_NET
    assert Controller(lib, "rule-150-155", *ROAD).error == 0


@pytest.mark.parametrize(
    ("find", "replace", "field"),
    [
        ("id = 0", "id = -1", "id"),
        ("id = 0", "id = 1", "id"),
        ("substeps = [1,", "substeps = [2,", "grid.substeps"),
        ("substeps = [1,", "substeps = [1, 200,", "grid.substeps"),
        ('mode = "converged"', 'mode = "best"', "solver.mode"),
        ("speed = 1.0", "speed = nan", "weights.speed"),
        ("speed = 1.0", "sped = 1.0", "weights.sped"),
        ("max_iterations = 12", "max_iterations = 1.5", "solver.max_iterations"),
        ("margin_min_k = 0.0", "margin_min_k = 50.0", "limits"),
    ],
)
def test_bad_settings_are_refused(tmp_path: Path, find: str, replace: str, field: str) -> None:
    for path in MPC_SETTINGS.glob("*.toml"):
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    text = (tmp_path / "mpc-S.toml").read_text(encoding="utf-8")
    assert find in text
    (tmp_path / "mpc-S.toml").write_text(text.replace(find, replace), encoding="utf-8")
    with pytest.raises(FormulationError) as caught:
        load_mpc_settings(tmp_path)
    assert caught.value.field == field


def test_core_calls_nothing_that_allocates_prints_or_reads_a_clock(tmp_path: Path) -> None:
    generated = tmp_path / "gen"
    generate(WEIGHTS, SETTINGS, generated, isas=())
    generate_mpc(WEIGHTS, MPC_SETTINGS, generated, ())
    allowed = {"memset", "memcpy", "memmove", "strcmp", "sscanf", "__isoc99_sscanf", "sin", "cos", "sincos", "sqrt",
               "fmin", "fmax"}  # sscanf: of the name, when it is set up  # fmt: skip
    own = ("net_", "ocp_", "mpc_", "pi_driver_", "derating_rule_", "controller_")
    strict = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-O2", "-fno-stack-protector"]
    include = [f"-I{BASE / 'src'}", f"-I{generated}"]
    for source in [*(BASE / "src" / f"{name}.c" for name in SOURCES), generated / "ocp_net_portable.c"]:
        target = tmp_path / "object.o"
        command = ["gcc", "-std=c11", "-D_GNU_SOURCE", *include, *strict, "-c", str(source), "-o", str(target)]
        subprocess.run(command, check=True)
        listed = subprocess.run(["nm", "-u", str(target)], capture_output=True, text=True, check=True).stdout
        called = {name for name in listed.split() if name != "U"}
        assert {name for name in called if not name.startswith(own)} <= allowed, source


@pytest.fixture(scope="module")
def fuzz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz")
    generated, program = folder / "gen", folder / "test_controller_fuzz"
    sources = [ROOT / "tests" / "c" / "test_controller_fuzz.c", *(BASE / "src" / f"{name}.c" for name in SOURCES)]
    made = [*generate(WEIGHTS, SETTINGS, generated, isas=()), *generate_mpc(WEIGHTS, MPC_SETTINGS, generated, ())]
    sources += [p for p in made if p.suffix == ".c" and p.name.startswith(("thermal_net", "ocp_net", "mpc_"))]
    flags = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
    include = [f"-I{BASE / 'src'}", f"-I{generated}"]
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", *include, *flags, *map(str, sources), "-o", str(program), "-lm"]
    subprocess.run(command, check=True)
    return program


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_hostile_inputs_under_sanitizers(fuzz: Path, seed: int) -> None:
    done = subprocess.run([str(fuzz), "6", str(seed)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
