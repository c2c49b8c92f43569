"""ctypes binding of the core's parts: the filter, the sensor monitor, the slow observer and the offset calibration."""

from __future__ import annotations

import ctypes as ct
from dataclasses import dataclass
from typing import Any

import numpy as np

from tools.libest import Calibration, Lib, Setting

f64 = ct.c_double


def _ptr(array: np.ndarray) -> Any:
    return array.ctypes.data_as(ct.POINTER(f64))


def _f64(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


class Ekf:
    """One ekf_t: doubles only, seen as arrays."""

    def __init__(self, lib: Lib, setting: Setting) -> None:
        self._c, self.size = lib.c, 2 + lib.memory
        self._state = np.zeros(self.size + self.size**2 + 4)
        self._c.ekf_init(_ptr(self._state), ct.byref(setting))

    def start(self, theta: Any, variance: Any, memory: Any) -> None:
        arrays = [_f64(a) for a in (theta, variance, memory)]
        self._c.ekf_start(_ptr(self._state), *(_ptr(a) for a in arrays))

    def predict(self, u: Any) -> None:
        array = _f64(u)
        self._c.ekf_predict(_ptr(self._state), _ptr(array))

    def update(self, channel: int, y: float, share: float = 1.0) -> None:
        self._c.ekf_update(_ptr(self._state), ct.c_int(channel), f64(y), f64(share))

    def shift(self, channel: int, shift: float, variance: float) -> None:
        self._c.ekf_shift(_ptr(self._state), ct.c_int(channel), f64(shift), f64(variance))

    @property
    def x(self) -> np.ndarray:
        """[theta, memory], a copy."""
        return self._state[: self.size].copy()

    @property
    def p(self) -> np.ndarray:
        """Covariance of x, a copy."""
        return self._state[self.size : self.size + self.size**2].reshape(self.size, self.size).copy()

    @property
    def q(self) -> np.ndarray:
        return self._state[-4:-2].copy()

    @property
    def r(self) -> np.ndarray:
        return self._state[-2:].copy()


class MonitorInput(ct.Structure):
    """monitor_input_t."""

    _fields_ = tuple((name, f64) for name in ("y", "raw", "residual", "variance", "slow", "slow_raw", "rate"))


class Verdict(ct.Structure):
    """monitor_verdict_t."""

    _fields_ = (("share", f64), ("offset", f64), ("forget", ct.c_int32), ("resume", ct.c_bool), ("level", f64),
                ("settled", ct.c_bool), ("creep", ct.c_bool))  # fmt: skip


class _MonitorHead(ct.Structure):
    """The beginning of sensor_monitor_t; what follows it is its own."""

    _fields_ = (("r", f64), ("gate", f64), ("drift", f64), ("range_low", f64), ("range_high", f64), ("fault", ct.c_int),
                ("trusted", ct.c_bool), ("spread_r", f64), ("distrusted_steps", ct.c_int32))  # fmt: skip


class Monitor:
    """One sensor_monitor_t."""

    SIZE = 1 << 12

    def __init__(self, lib: Lib, setting: Setting, channel: int = 0) -> None:
        self._c, self._memory = lib.c, ct.create_string_buffer(self.SIZE)
        self._c.sensor_monitor_step.restype = Verdict
        self._c.sensor_monitor_late.restype = f64
        self._c.sensor_monitor_init(self._memory, ct.byref(setting), ct.c_int(channel))

    def step(
        self, y: float, prediction: float = 100.0, *, raw: float | None = None, variance: float = 1e-3,
        slow: float = 0.0, slow_raw: float | None = None, rate: float = 0.0,
    ) -> Verdict:  # fmt: skip
        """Judge y against its prediction; raw: y unless given."""
        given = MonitorInput(
            y, y if raw is None else raw, y - prediction, variance, slow, slow if slow_raw is None else slow_raw, rate
        )
        return self._c.sensor_monitor_step(self._memory, ct.byref(given))

    def late(self, y: float, prediction: float = 100.0, variance: float = 1e-3) -> float:
        return self._c.sensor_monitor_late(self._memory, f64(y), f64(y - prediction), f64(variance))

    @property
    def _head(self) -> _MonitorHead:
        return _MonitorHead.from_buffer_copy(self._memory)

    @property
    def fault(self) -> int:
        """Class as published."""
        return self._head.fault

    @property
    def trusted(self) -> bool:
        return self._head.trusted

    @property
    def spread_r(self) -> float:
        """Variance that the values' weight stands for, K²."""
        return self._head.spread_r

    @property
    def bytes(self) -> bytes:
        return self._memory.raw


class SlowObserver:
    """One slow_observer_t: doubles only."""

    def __init__(self, lib: Lib, theta: Any, memory: Any = None) -> None:
        self._c, n = lib.c, lib.memory
        self._state = np.zeros(2 + n + 10)
        self._at = {name: 2 + n + 2 * k for k, name in enumerate(("bias", "rate", "age_s", "innovation", "raw"))}
        arrays = [_f64(theta), np.zeros(n) if memory is None else _f64(memory)]
        self._c.slow_observer_start(_ptr(self._state), *(_ptr(a) for a in arrays))

    def predict(self, u: Any) -> None:
        array = _f64(u)
        self._c.slow_observer_predict(_ptr(self._state), _ptr(array))

    def measure(self, channel: int, y: float) -> None:
        self._c.slow_observer_measure(_ptr(self._state), ct.c_int(channel), f64(y))

    def follow(self, channel: int) -> None:
        self._c.slow_observer_follow(_ptr(self._state), ct.c_int(channel))

    def shift(self, channel: int, shift: float) -> None:
        self._c.slow_observer_shift(_ptr(self._state), ct.c_int(channel), f64(shift))

    def __getattr__(self, name: str) -> np.ndarray:
        if name == "theta":
            return self._state[:2].copy()
        at = self.__dict__["_at"][name]
        return self._state[at : at + 2].copy()

    @property
    def state(self) -> np.ndarray:
        return self._state.copy()


class _CalibrationState(ct.Structure):
    """offset_calibration_t."""

    _fields_ = (
        ("enabled", ct.c_bool), ("soaked", ct.c_bool), ("datasheet_degc", f64), ("coolant_degc", f64),
        ("wait", ct.c_int32), ("count", ct.c_int32 * 2), ("mean", f64 * 2), ("m2", f64 * 2), ("result", Calibration),
    )  # fmt: skip


@dataclass(frozen=True)
class CalibrationResult:
    """estimator_calibration_t as arrays."""

    state: int
    offset_degc: np.ndarray
    sigma_degc: np.ndarray


class OffsetCalibration:
    """One offset_calibration_t."""

    def __init__(
        self, lib: Lib, datasheet_degc: float = -1.0, sigma_degc: float = 0.2, delay_steps: int = 15,
        enabled: bool = True,
    ) -> None:  # fmt: skip
        self._c, self._self = lib.c, _CalibrationState()
        self._c.offset_calibration_measure.restype = ct.c_bool
        self._c.offset_calibration_init(
            ct.byref(self._self), f64(datasheet_degc), f64(sigma_degc), ct.c_int32(delay_steps), ct.c_bool(enabled)
        )

    def coolant(self, degc: float, soaked: bool) -> None:
        self._c.offset_calibration_coolant(ct.byref(self._self), f64(degc), ct.c_bool(soaked))

    def measure(self, w: float, r: float) -> bool:
        raw = _f64([w, r])
        return self._c.offset_calibration_measure(ct.byref(self._self), _ptr(raw))

    @property
    def result(self) -> CalibrationResult:
        found = self._self.result
        return CalibrationResult(found.state, np.array(found.offset_degc[:]), np.array(found.sigma_degc[:]))
