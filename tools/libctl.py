"""ctypes binding of the controller's C: what its process runs, driven from Python, by tools and tests."""

from __future__ import annotations

import atexit
import ctypes as ct
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator_c.formulation.simd import ISAS, Isa
from rt_runner import paths
from rt_runner.errors import SetupError

ROOT = Path(__file__).resolve().parents[1]
BASE = ROOT / "estimator_c"
WEIGHTS = BASE / "weights" / "lstm8.json"
SETTINGS, MPC_SETTINGS = BASE / "settings", BASE / "settings" / "mpc"
SOURCES = ("mpc", "ocp_qp", "controller", "pi_driver", "derating_rule")
PERIOD_S = 0.1
INTERVALS = 40  # MPC_INTERVALS_MAX
OK, MAX_ITERATIONS, FAILED = range(3)  # mpc_status_t
BY_DRIVER, BY_MPC, BY_SHIFTED, BY_RULE = range(4)  # controller_source_t
UNKNOWN, BAD_PERIOD, BAD_ROAD, NO_NET = range(1, 5)  # controller_error_t

f64 = ct.c_double
Array = NDArray[np.float64]


class Vehicle(ct.Structure):
    """mpc_vehicle_t."""

    _fields_ = tuple(
        (name, f64)
        for name in (
            "mass_kg", "drag_kg_m", "roll_coeff", "gravity_mps2", "gear_per_m", "v_max_mps", "drive_nm", "drive_w",
            "regen_nm", "regen_w", "regen_from_mps", "regen_full_mps", "friction_nm", "kp_nm_per_mps", "ki_nm_per_m",
            "u_min_nm", "u_max_nm", "integral_max_nm",
        )
    )  # fmt: skip


class MpcSetting(ct.Structure):
    """mpc_setting_t."""

    _fields_ = (
        ("name", ct.c_char_p), ("id", ct.c_int32), ("intervals", ct.c_int32), ("substeps", ct.c_int32 * INTERVALS),
        ("mode", ct.c_int32), ("speed", f64), ("friction", f64), ("torque", f64), ("torque_change", f64),
        ("slack", f64), ("slack_square", f64), ("above_reference", f64), ("above_v_max", f64), ("theta_w_degc", f64),
        ("theta_r_degc", f64), ("margin_min_k", f64), ("margin_max_k", f64), ("margin_sigma", f64),
        ("max_iterations", ct.c_int32), ("tolerance_nm", f64),
    )  # fmt: skip


class Problem(ct.Structure):
    """mpc_problem_t; its memory begins on 64 bytes."""

    _fields_ = (
        ("v_mps", f64), ("torque_nm", f64), ("theta", f64 * 2), ("_align", f64 * 4), ("memory", f64 * 16),
        ("limit", f64 * 2), ("v_ref_mps", f64 * INTERVALS), ("slope_rad", f64 * INTERVALS), ("_end", f64 * 6),
    )  # fmt: skip


class Result(ct.Structure):
    """mpc_result_t."""

    _fields_ = (
        ("torque_nm", f64 * INTERVALS), ("friction_nm", f64 * INTERVALS), ("v_mps", f64 * (INTERVALS + 1)),
        ("theta", (f64 * 2) * (INTERVALS + 1)), ("multiplier", (f64 * 2) * INTERVALS), ("cost", f64), ("kkt_nm", f64),
        ("slack_k", f64), ("iterations", ct.c_int32), ("qp_iterations", ct.c_int32), ("sets", ct.c_int32),
        ("rolls", ct.c_int32),
    )  # fmt: skip


class Road(ct.Structure):
    """controller_road_t."""

    _fields_ = (
        ("v_ref_mps", ct.POINTER(f64)), ("slope_rad", ct.POINTER(f64)), ("count", ct.c_int32), ("step_m", f64),
        ("lookahead_m", f64),
    )  # fmt: skip


class Counters(ct.Structure):
    """controller_counters_t."""

    _fields_ = tuple(
        (name, ct.c_uint32)
        for name in ("solves", "failed", "slack_jumps", "unconverged", "shifted", "rule_steps", "clamped",
                     "no_estimate", "bad_inputs")
    )  # fmt: skip


class Out(ct.Structure):
    """controller_out_t."""

    _fields_ = (
        ("drive_nm", f64), ("regen_nm", f64), ("friction_nm", f64), ("source", ct.c_int), ("derating", ct.c_bool),
        ("clamped", ct.c_bool), ("estimate_fresh", ct.c_bool), ("theta_w_degc", f64), ("theta_r_degc", f64),
        ("limit_degc", f64), ("margin_k", f64), ("v_ref_mps", f64), ("solved", ct.c_bool), ("status", ct.c_int),
        ("iterations", ct.c_int32), ("qp_iterations", ct.c_int32), ("kkt_nm", f64), ("slack_k", f64),
        ("predicted_end_degc", f64), ("predicted_peak_degc", f64),
    )  # fmt: skip


class _Head(ct.Structure):
    """The beginning of controller_t."""

    _fields_ = (("name", ct.c_char_p), ("kind", ct.c_int), ("ticks", ct.c_int32), ("phase", ct.c_int32),
                ("road", Road), ("counters", Counters))  # fmt: skip


@cache
def load(weights: Path = WEIGHTS, flags: tuple[str, ...] = ("-O2",)) -> Lib:
    """The controller's library: build/lib where that is asked for and there, else compiled for this run.

    RT_LIBESTIMATOR names another one in its place (an ASan build, say).

    Raises
    ------
    SetupError
        RT_LIBESTIMATOR is no such library, or nothing is built and there are no sources to compile it from.
    """
    if weights != WEIGHTS or flags != ("-O2",):
        return Lib(compile_library(weights, flags))
    named = os.environ.get("RT_LIBESTIMATOR")
    built = Path(named) if named else paths.build_dir() / "lib" / "libestimator.so"
    if not named and not built.exists():
        return Lib(compile_library(weights, flags))
    try:
        return Lib(built)
    except (OSError, AttributeError, ValueError) as error:
        raise SetupError(
            f"{built} is no library of this controller ({error}): run 'make build', or mend RT_LIBESTIMATOR"
        ) from None


def compile_library(weights: Path = WEIGHTS, flags: tuple[str, ...] = ("-O2",), isas: tuple[Isa, ...] = ISAS) -> Path:
    """Generate the C of `weights` and compile it into a folder of this run; returns the shared library."""
    from estimator_c.formulation.generate import generate
    from estimator_c.formulation.mpc_net import generate_mpc

    sources = [BASE / "src" / f"{name}.c" for name in SOURCES]
    missing = [path for path in (weights, MPC_SETTINGS, *sources) if not path.exists()]
    if missing:
        raise SetupError(
            f"{missing[0]} is missing: the controller's library is built from a checkout ('make build' there); "
            "RT_LIBESTIMATOR=FILE.so names a built one"
        )
    folder = Path(tempfile.gettempdir()) / f"rt-libctl-{os.getuid()}-{os.getpid()}"
    key = hashlib.sha256(weights.read_bytes() + repr((flags, isas)).encode()).hexdigest()[:16]
    out = folder / key
    library = out / "libcontroller.so"
    if library.exists():
        return library
    if not folder.exists():
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    generated = [p for p in generate(weights, SETTINGS, out, isas=isas) if p.name.startswith("thermal_net")]
    generated += generate_mpc(weights, MPC_SETTINGS, out, isas)
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-g", "-fPIC", "-shared", *flags, f"-I{BASE / 'src'}", f"-I{out}"]
    command += [str(path) for path in sources]
    command += [str(path) for path in generated if path.suffix == ".c"] + ["-o", str(library), "-lm"]
    subprocess.run(command, check=True, stdout=sys.stderr)
    return library


class Lib:
    """The shared library with typed entry points."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.c = ct.CDLL(str(path))
        self.c.mpc_setting_find.restype = ct.POINTER(MpcSetting)
        self.c.mpc_setting_find.argtypes = [ct.c_char_p]
        self.c.controller_feed_estimate.argtypes = [ct.c_void_p, f64, f64, f64, f64, ct.c_bool]
        self.c.controller_feed_estimate.restype = None
        for name in ("controller_feed_motion", "controller_feed_motor"):
            getattr(self.c, name).argtypes = [ct.c_void_p, f64, f64]
            getattr(self.c, name).restype = None
        self.c.controller_step.argtypes = [ct.c_void_p, ct.POINTER(Out)]
        self.c.controller_step.restype = None
        self.c.mpc_vehicle_step.argtypes = [ct.c_void_p, f64, f64, f64]
        self.c.mpc_vehicle_step.restype = f64
        for name in ("net_select", "ocp_select"):
            getattr(self.c, name).restype = ct.c_char_p
            getattr(self.c, name).argtypes = [ct.c_char_p]
        self.vehicle = Vehicle.in_dll(self.c, "mpc_vehicle")

    def select(self, kernel: str | None) -> bool:
        """Choose the kernels of net and solver (None: the best); False where this processor cannot run them."""
        name = kernel.encode() if kernel is not None else None
        found = self.c.net_select(name), self.c.ocp_select(name)
        return None not in found

    def setting(self, name: str, **changes: Any) -> MpcSetting:
        """A copy of a compiled-in setting, with fields replaced."""
        found = self.c.mpc_setting_find(name.encode())
        if not found:
            raise KeyError(name)
        setting = MpcSetting.from_buffer_copy(found.contents)
        for field, value in changes.items():
            setattr(setting, field, value)
        return setting


class Memory:
    """Zeroed bytes that begin on 64 of them, as the C objects must."""

    def __init__(self, size: int) -> None:
        self._bytes = np.zeros(size + 64, dtype=np.uint8)
        self.at = ct.c_void_p(self._bytes.ctypes.data + (-self._bytes.ctypes.data) % 64)


SIZE = 1 << 20  # of any object here


class Mpc:
    """One mpc_t."""

    def __init__(self, lib: Lib, setting: MpcSetting | str) -> None:
        self.lib, self._memory = lib, Memory(SIZE)
        self.setting = lib.setting(setting) if isinstance(setting, str) else setting
        lib.c.mpc_init(self._memory.at, ct.byref(self.setting), ct.byref(lib.vehicle))

    def solve(self, problem: Problem, torque_nm: Any = None, friction_nm: Any = None) -> tuple[int, Result]:
        """(status, result) from a guess (default: no torque); `problem` is copied to where it may lie."""
        place, result = Memory(ct.sizeof(Problem)), Result()
        ct.memmove(place.at, ct.byref(problem), ct.sizeof(Problem))
        for field, values in (("torque_nm", torque_nm), ("friction_nm", friction_nm)):
            if values is not None:
                getattr(result, field)[: len(values)] = list(values)
        return int(self.lib.c.mpc_solve(self._memory.at, place.at, ct.byref(result))), result


class Controller:
    """One controller_t on a road."""

    def __init__(
        self, lib: Lib, name: str, v_ref_mps: Array, slope_rad: Array, step_m: float = 1.0, period_s: float = PERIOD_S
    ) -> None:
        self.lib, self._memory = lib, Memory(SIZE)
        self._tables = [np.ascontiguousarray(table, dtype=np.float64) for table in (v_ref_mps, slope_rad)]
        at = [table.ctypes.data_as(ct.POINTER(f64)) for table in self._tables]
        road = Road(at[0], at[1], len(self._tables[0]), step_m, 2.0)
        init = lib.c.controller_init
        init.argtypes = [ct.c_void_p, ct.c_char_p, f64, ct.POINTER(Road)]
        self.error = int(init(self._memory.at, name.encode(), period_s, ct.byref(road)))

    def estimate(self, w: float, r: float, sigma: float = 0.0, upper: float | None = None, usable: bool = True) -> None:
        self.lib.c.controller_feed_estimate(self._memory.at, w, r, sigma, w if upper is None else upper, usable)

    def motion(self, x_m: float, v_mps: float) -> None:
        self.lib.c.controller_feed_motion(self._memory.at, x_m, v_mps)

    def motor(self, torque_nm: float, speed_rpm: float) -> None:
        self.lib.c.controller_feed_motor(self._memory.at, torque_nm, speed_rpm)

    def step(self) -> Out:
        out = Out()
        self.lib.c.controller_step(self._memory.at, ct.byref(out))
        return out

    @property
    def counters(self) -> Counters:
        assert self._memory.at.value is not None
        return Counters.from_buffer_copy(_Head.from_address(self._memory.at.value).counters)
