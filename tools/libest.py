"""ctypes binding of the estimator's C: the same functions the binary runs, driven from Python, by tools and tests."""

from __future__ import annotations

import atexit
import ctypes as ct
import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rt_runner import paths
from rt_runner.errors import SetupError

ROOT = Path(__file__).resolve().parents[1]
CORE = ("mhe", "mhe_loss", "ekf", "slow_observer", "sensor_monitor", "fusion", "offset_calibration", "validity",
        "estimator", "estimator_feed", "estimator_predict", "estimator_publish")  # fmt: skip
MHE = ("src/mhe.c", "src/mhe_loss.c")
SOLVER = tuple(f"src/solver/{name}.c" for name in ("tridiag", "tridiag_pair", "box_qp"))
SOURCES = (*(f"src/{name}.c" for name in CORE), "src/est_batch.c", *SOLVER)
SETTINGS = ROOT / "estimator_c" / "settings"
WEIGHTS = ROOT / "estimator_c" / "weights" / "lstm8.json"
NODES = 16

f64 = ct.c_double
pair = f64 * 2


class Setting(ct.Structure):
    """est_setting_t of the generated est_settings.h (checked against the schema by `load`)."""

    _fields_ = (
        ("name", ct.c_char_p), ("id", ct.c_int32), ("kind", ct.c_int32),
        ("delay_steps", ct.c_int32), ("offset_degc", f64), ("offset_sigma_degc", f64), ("sensor_timeout_s", f64),
        ("range_low_degc", f64), ("range_high_degc", f64), ("key_on_calibration", ct.c_bool),
        ("loss", ct.c_int32), ("loss_scale_degc", f64), ("supervise", ct.c_bool), ("gate_sigma", f64),
        ("drift_degc", pair), ("open_loop_s", f64),
        ("weight_measurement", pair), ("weight_noise", pair), ("weight_arrival", pair),
        ("arrival_from", ct.c_int32), ("weight_prior", pair),
        ("newest_measurement", ct.c_bool), ("hard_bounds", ct.c_bool),
        ("lower_degc", f64), ("upper_degc", f64), ("bound_weight", f64),
        ("mode", ct.c_int32), ("max_sweeps", ct.c_int32), ("tolerance_degc", f64),
        ("spin_up_steps", ct.c_int32), ("max_gap_steps", ct.c_int32),
    )  # fmt: skip


class MheResult(ct.Structure):
    """mhe_result_t."""

    _fields_ = (("theta", pair), ("kkt_degc", f64), ("sweeps", ct.c_int), ("active", ct.c_int))


class Counters(ct.Structure):
    """estimator_counters_t."""

    _fields_ = tuple(
        (name, ct.c_uint32)
        for name in ("restarts", "held_intervals", "repeated_ticks", "invalid_inputs", "off_grid",
                     "late_measurements", "unconverged", "stray_ticks")
    )  # fmt: skip


class Validity(ct.Structure):
    """validity_result_t."""

    KINDS = ("speed", "torque", "theta_w", "theta_r", "joint")
    _fields_ = (
        ("scope", ct.c_int), ("outside_speed", ct.c_bool), ("outside_torque", ct.c_bool),
        ("outside_theta_w", ct.c_bool), ("outside_theta_r", ct.c_bool), ("outside_joint", ct.c_bool),
        ("novelty", f64),
    )  # fmt: skip

    @property
    def flags(self) -> tuple[bool, ...]:
        """outside_*, in the order of KINDS."""
        return tuple(bool(getattr(self, f"outside_{name}")) for name in self.KINDS)


class ValidityMonitor(ct.Structure):
    """validity_t."""

    _fields_ = (("steps", ct.c_int32), ("slow", f64 * 5), ("result", Validity))


class Channel(ct.Structure):
    """estimator_channel_t."""

    _fields_ = (("fault", ct.c_int), ("trusted", ct.c_bool), ("sigma_degc", f64), ("upper_degc", f64),
                ("innov_sigma_degc", f64))  # fmt: skip


class Calibration(ct.Structure):
    """estimator_calibration_t."""

    _fields_ = (("state", ct.c_int), ("offset_degc", pair), ("sigma_degc", pair))


class Out(ct.Structure):
    """estimator_out_t."""

    _fields_ = (
        ("theta_w_degc", f64), ("theta_r_degc", f64), ("innov_w_degc", f64), ("innov_r_degc", f64),
        ("tick", ct.c_int64), ("tick16", ct.c_uint16), ("status", ct.c_int), ("stale_input", ct.c_bool),
        ("intervals", ct.c_int32), ("sweeps", ct.c_int32), ("kkt_degc", f64),
        ("validity", Validity), ("channel", Channel * 2), ("calibration", Calibration),
    )  # fmt: skip


@cache
def load(weights: Path | None = None) -> Lib:
    """The estimator's library: compiled from the given weights, or the built one, or (not built) of lstm8.json.

    RT_LIBESTIMATOR names a library to use instead of lib/libestimator.so of the build folder (an ASan build, say).

    Raises
    ------
    SetupError
        RT_LIBESTIMATOR is no such library, or nothing is built and there are no sources to compile it from.
    """
    if weights is not None:
        return Lib(compile_library(weights))
    named = os.environ.get("RT_LIBESTIMATOR")
    built = Path(named) if named else paths.build_dir() / "lib" / "libestimator.so"
    if named or built.exists():
        return _opened(built)
    return Lib(compile_library(WEIGHTS))


def _opened(path: Path) -> Lib:
    try:
        return Lib(path)
    except (OSError, AttributeError, ValueError) as error:
        raise SetupError(
            f"{path} is no library of this estimator ({error}): run 'make build', or mend RT_LIBESTIMATOR"
        ) from None


def compile_library(weights: Path, flags: tuple[str, ...] = ("-O2",)) -> Path:
    """Generate the C of `weights` and compile it into a folder of this run; returns the shared library.

    RT_LIBEST_FOLDER: a folder that several processes of one run share; each library is then compiled once for all.
    """
    from estimator_c.formulation.generate import generate

    sources = [ROOT / "estimator_c" / source for source in SOURCES]
    missing = [path for path in (weights, SETTINGS, *sources) if not path.exists()]
    if missing:
        raise SetupError(
            f"{missing[0]} is missing: the estimator's library is built from a checkout ('make build' there); "
            "RT_LIBESTIMATOR=FILE.so names a built one"
        )
    folder = _folder()
    key = hashlib.sha256(weights.read_bytes() + " ".join(flags).encode()).hexdigest()[:16]
    out = folder / key
    library = out / "libestimator.so"
    with (folder / f"{key}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not library.exists():
            _compile(sources, generate(weights, SETTINGS, out), library, flags)
    return library


def _folder() -> Path:
    shared = os.environ.get("RT_LIBEST_FOLDER")
    if shared:
        return Path(shared)
    folder = Path(tempfile.gettempdir()) / f"rt-libest-{os.getuid()}-{os.getpid()}"
    if not folder.exists():
        folder.mkdir(mode=0o700)
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _compile(sources: Sequence[Path], generated: Sequence[Path], library: Path, flags: tuple[str, ...]) -> None:
    """gcc; the library is there whole or not at all."""
    part, out = library.with_suffix(".part"), library.parent
    base = ROOT / "estimator_c"
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-g1", "-fPIC", "-shared", "-fno-math-errno", *flags]
    command += [f"-I{base / 'src'}", f"-I{base / 'src' / 'solver'}", f"-I{out}"]
    command += [str(source) for source in sources]
    command += [str(path) for path in generated if path.suffix == ".c"] + ["-o", str(part), "-lm"]
    subprocess.run(command, check=True, stdout=sys.stderr)
    part.replace(library)


class Lib:
    """The shared library with typed entry points."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.c = ct.CDLL(str(path))
        self.c.est_setting_find.restype = ct.POINTER(Setting)
        self.c.est_setting_find.argtypes = [ct.c_char_p]
        self.c.mhe_measure.restype = f64
        self.c.mhe_measure.argtypes = [ct.c_void_p, ct.c_int, ct.c_int, f64, f64]
        self.c.mhe_cost.restype = f64
        self.c.mhe_cost.argtypes = [ct.c_void_p, ct.c_void_p]
        self.c.mhe_node.restype = ct.POINTER(f64)
        self.c.mhe_node.argtypes = [ct.c_void_p, ct.c_int]
        self.c.estimator_feed_motor.argtypes = [ct.c_void_p, ct.c_uint16, f64, f64, ct.c_bool]
        self.c.estimator_feed_motor.restype = None
        self.c.estimator_feed_temp.argtypes = [ct.c_void_p, ct.c_uint16, f64, f64, ct.c_bool, ct.c_bool]
        self.c.estimator_feed_temp.restype = None
        self.c.estimator_step.argtypes = [ct.c_void_p, ct.POINTER(Out)]
        self.c.estimator_step.restype = None
        for name in ("mhe_init", "mhe_start", "mhe_advance", "mhe_solve", "estimator_init"):
            getattr(self.c, name).argtypes = None
        self.sha256 = (ct.c_char * 65).in_dll(self.c, "net_weights_sha256").value.decode()
        self.memory = ct.c_int32.in_dll(self.c, "net_memory_size").value
        self.tape = ct.c_int32.in_dll(self.c, "net_tape_size").value

    def select(self, kernel: str) -> bool:
        """Choose a kernel of the net; False where this processor cannot run it."""
        self.c.net_select.restype, self.c.net_select.argtypes = ct.c_char_p, [ct.c_char_p]
        return self.c.net_select(kernel.encode()) == kernel.encode()

    def setting(self, name: str, **changes: Any) -> Setting:
        """A copy of a compiled-in setting, with fields replaced (pairs as tuples)."""
        found = self.c.est_setting_find(name.encode())
        if not found:
            raise KeyError(name)
        setting = Setting.from_buffer_copy(found.contents)
        for field, value in changes.items():
            if not hasattr(Setting, field):
                raise KeyError(field)
            setattr(setting, field, pair(*value) if isinstance(value, tuple) else value)
        return setting

    def lstm_forward(self, u: Any, theta: Any, c: Any, h: Any) -> tuple[np.ndarray, ...]:
        """(c_next, h_next, rate, tape) of one step; c and h over all layers, a GRU's c is empty."""
        outs = [np.zeros(self.memory), np.zeros(2), np.zeros(self.tape)]
        self.c.net_forward(*(_ptr(_f64(a)) for a in (u, theta, self._memory(c, h))), *(_ptr(a) for a in outs))
        return outs[0][: len(c)], outs[0][len(c) :], outs[1], outs[2]

    def lstm_adjoint(self, tape: Any, memory: Any, rate_bar: Any, memory_bar: Any) -> tuple[np.ndarray, ...]:
        """(theta_bar, memory_bar) of one step; memory = c, then h."""
        outs = [np.zeros(2), np.zeros(self.memory)]
        self.c.net_adjoint(*(_ptr(_f64(a)) for a in (tape, memory, rate_bar, memory_bar)), *(_ptr(a) for a in outs))
        return tuple(outs)

    def lstm_slope(self, tape: Any, memory: Any) -> np.ndarray:
        """[drate_w/dtheta_w, drate_r/dtheta_r] of one step."""
        out = np.zeros(2)
        self.c.net_slope(_ptr(_f64(tape)), _ptr(_f64(memory)), _ptr(out))
        return out

    def validity(self, rows: Any) -> list[Validity]:
        """What a monitor that has seen nothing says of rows (n, 4): rpm, Nm, degC, degC, one per interval."""
        monitor, results = ValidityMonitor(), []
        self.c.validity_init(ct.byref(monitor))
        for row in _f64(rows):
            self.c.validity_step(ct.byref(monitor), _ptr(row), _ptr(row[2:]))
            results.append(Validity.from_buffer_copy(monitor.result))
        return results

    def _memory(self, c: Any, h: Any) -> np.ndarray:
        memory = np.concatenate([c, h])
        if len(memory) != self.memory:
            raise ValueError(f"{self.path} was built for a memory of {self.memory}, not {len(memory)}")
        return memory


_KEEP: list[np.ndarray] = []


def _f64(values: Any) -> np.ndarray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    _KEEP[:] = [*_KEEP[-16:], array]  # alive until the call has read it
    return array


def _ptr(array: np.ndarray) -> Any:
    return array.ctypes.data_as(ct.c_void_p)


def _aligned(size: int) -> Any:
    """Memory for a C object, on a boundary of 64 bytes as its type asks."""
    raw = ct.create_string_buffer(size + 64)
    return (ct.c_char * size).from_buffer(raw, -ct.addressof(raw) % 64)


class Mhe:
    """One mhe_t."""

    SIZE = 1 << 16

    def __init__(self, lib: Lib, setting: Setting) -> None:
        self.lib, self.memory, self.count = lib, _aligned(self.SIZE), 0
        lib.c.mhe_init(self.memory, ct.byref(setting))

    def start(self, prior: Any, c: Any, h: Any) -> None:
        self.lib.c.mhe_start(self.memory, _ptr(_f64(prior)), _ptr(_f64(np.concatenate([c, h]))))
        self.count = 1

    def advance(self, u: Any) -> None:
        self.lib.c.mhe_advance(self.memory, _ptr(_f64(u)))
        self.count = min(self.count + 1, NODES)

    def measure(self, age: int, channel: int, y: float, share: float = 1.0) -> float:
        return self.lib.c.mhe_measure(self.memory, age, channel, y, share)

    def solve(self) -> tuple[int, MheResult]:
        result = MheResult()
        return self.lib.c.mhe_solve(self.memory, ct.byref(result)), result

    def feedback(self) -> tuple[int, MheResult]:
        """The estimate after one sweep; `finish` takes its result."""
        result = MheResult()
        return self.lib.c.mhe_feedback(self.memory, ct.byref(result)), result

    def finish(self, result: MheResult) -> int:
        """What `feedback` left; `result` becomes that of `solve`."""
        return self.lib.c.mhe_finish(self.memory, ct.byref(result))

    def theta(self) -> np.ndarray:
        """Temperatures of the window, oldest first: (count, 2)."""
        rows = []
        for age in range(self.count - 1, -1, -1):
            node = self.lib.c.mhe_node(self.memory, age)
            rows.append([node[0], node[1]])
        return np.array(rows)

    def set_theta(self, theta: np.ndarray) -> None:
        """Move the window's temperatures (for derivative checks)."""
        for row, age in enumerate(range(self.count - 1, -1, -1)):
            node = self.lib.c.mhe_node(self.memory, age)
            node[0], node[1] = float(theta[row, 0]), float(theta[row, 1])

    def memory_of(self, age: int, size_c: int) -> tuple[np.ndarray, np.ndarray]:
        """(c, h) on arrival at a node; size_c: elements of c (0 for a GRU)."""
        node = self.lib.c.mhe_node(self.memory, age)
        return np.array(node[8 : 8 + size_c]), np.array(node[8 + size_c : 8 + self.lib.memory])

    def cost(self) -> tuple[float, np.ndarray]:
        gradient = np.zeros((NODES, 2))
        return self.lib.c.mhe_cost(self.memory, _ptr(gradient)), gradient[: self.count]


class Estimator:
    """One estimator_t."""

    SIZE = 1 << 17

    def __init__(self, lib: Lib, setting: Setting) -> None:
        self.lib, self.memory = lib, _aligned(self.SIZE)
        self.error = lib.c.estimator_init(self.memory, ct.byref(setting))
        self._step, self._out = lib.c.estimator_step, Out()

    def feed_motor(self, tick: int, torque_nm: float, speed_rpm: float, valid: bool = True) -> None:
        self.lib.c.estimator_feed_motor(self.memory, tick & 0xFFFF, torque_nm, speed_rpm, valid)

    def feed_temp(self, tick: int, w: float, r: float, w_valid: bool = True, r_valid: bool = True) -> None:
        self.lib.c.estimator_feed_temp(self.memory, tick & 0xFFFF, w, r, w_valid, r_valid)

    def step(self) -> Out:
        self._step(self.memory, ct.byref(self._out))
        return Out.from_buffer_copy(self._out)

    def feed_coolant(self, coolant_degc: float, soaked: bool, valid: bool = True) -> None:
        self.lib.c.estimator_feed_coolant(self.memory, f64(coolant_degc), ct.c_bool(soaked), ct.c_bool(valid))

    def run(
        self,
        torque_nm: Any,
        speed_rpm: Any,
        measured_degc: Any,
        first_tick: int = 0,
        coolant_degc: Any = None,
        soaked: Any = None,
    ) -> np.ndarray:
        """est_batch_run(): torque, speed (10 n,), measurements (n, 2) -> (n, 20), columns as in est_batch.h."""
        measured = _f64(measured_degc)
        torque, speed = _f64(torque_nm).ravel(), _f64(speed_rpm).ravel()
        n = len(measured)
        if measured.shape != (n, 2) or len(torque) != 10 * n or len(speed) != 10 * n:
            raise ValueError(f"{len(torque)} torques, {len(speed)} speeds for measurements {measured.shape}: 10 a row")
        coolant = None if coolant_degc is None else _f64(coolant_degc)
        flags = None if soaked is None else np.ascontiguousarray(soaked, dtype=np.bool_)
        out = np.empty((n, 20))
        self.lib.c.est_batch_run(
            self.memory, ct.c_int64(n), ct.c_uint16(first_tick & 0xFFFF), _ptr(torque), _ptr(speed), _ptr(measured),
            None if coolant is None else _ptr(coolant), None if flags is None else _ptr(flags), _ptr(out),
        )  # fmt: skip
        return out

    @property
    def counters(self) -> Counters:
        offset = (ct.sizeof(Setting) + 7) // 8 * 8
        return Counters.from_buffer_copy(self.memory, offset)
