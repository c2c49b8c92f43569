"""What became of the two temperature sensors in a run: the estimator's opinion of them, and the truth beside it.

Fed by `ResultAccumulator` with decoded frames on its unwrapped tick axis; knows nothing but what it is fed.
"""

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

TICK_S = 0.01
CLASSES = ("ok", "offset", "noise", "stuck", "dropout", "spike", "drift", "slow")  # EstWinding.sensor_w_fault
TRUE_KINDS = ("offset", "noise", "stuck", "dropout", "spike", "drift", "slow", "delay", "gain")  # bits of TruthFault
CALIBRATION = ("datasheet", "measuring", "frozen", "refused")
CHANNELS = {"theta_w": "w", "theta_r": "r"}


@dataclass
class _Channel:
    """One sensor over unwrapped ticks."""

    job_tick: list[int] = field(default_factory=list)
    job_class: list[int] = field(default_factory=list)
    job_upper_degc: list[float | None] = field(default_factory=list)
    trusted: int = 0
    fault_tick: list[int] = field(default_factory=list)
    fault_mask: list[int] = field(default_factory=list)


class SensorAccount:
    """Collects what the estimator says of its sensors and what the simulation says is wrong with them."""

    def __init__(self) -> None:
        self._channels = {name: _Channel() for name in CHANNELS}
        self._calibration: dict[str, float | None] = {}

    def add_job(self, channel: str, tick: int, values: dict[str, float | None]) -> None:
        """Take an EstWinding or EstRotor; ``channel`` is theta_w or theta_r."""
        one, c = self._channels[channel], CHANNELS[channel]
        said = values.get(f"sensor_{c}_fault")
        if said is None:
            return
        one.job_tick.append(tick)
        one.job_class.append(int(said))
        one.job_upper_degc.append(values.get(f"upper_{c}_degc"))
        one.trusted += bool(values.get(f"sensor_{c}_trusted"))

    def add_truth(self, tick: int, values: dict[str, float | None]) -> None:
        """Take a TruthFault."""
        for name, c in CHANNELS.items():
            mask, one = values.get(f"fault_{c}"), self._channels[name]
            if mask is not None and (not one.fault_tick or tick > one.fault_tick[-1]):
                one.fault_tick.append(tick)
                one.fault_mask.append(int(mask))

    def add_calibration(self, values: dict[str, float | None]) -> None:
        """Take an EstCalibration; the newest counts."""
        self._calibration = values

    def channel(self, name: str, true_at: Callable[[int], float | None], errors: dict[int, float]) -> dict:
        """The account of one sensor.

        Parameters
        ----------
        name : theta_w or theta_r
        true_at : true temperature at a tick in degC, None where there is none
        errors : tick -> estimate minus truth in K, the judged part of the run

        Returns
        -------
        dict with
            ``class_share``: class -> share of the jobs, classes that occurred; ``trusted_share``;
            ``true_faults``: kinds that were there;
            ``fault_start_s``: start of the first of them, s since the plant's start (modulo 655.36 s where the log
            itself starts later than that);
            ``detection_s``: s from there to the first job that said anything but ok while it lasted, None: never;
            ``max_error_degc``, and ``fault_max_error_degc`` while a fault was there;
            ``above_upper_jobs``: jobs whose upper bound was below the truth.
            None where a figure does not exist.
        """
        one = self._channels[name]
        jobs = len(one.job_tick)
        counts = Counter(one.job_class)
        first = self._first_window(one)
        bounds = [(true_at(t), u) for t, u in zip(one.job_tick, one.job_upper_degc, strict=True) if u is not None]
        judged = [(true, upper) for true, upper in bounds if true is not None]
        during = [abs(e) for tick, e in errors.items() if self._mask_at(one, tick)]
        return {
            "class_share": {CLASSES[k]: round(n / jobs, 6) for k, n in sorted(counts.items()) if k < len(CLASSES)},
            "trusted_share": round(one.trusted / jobs, 6) if jobs else None,
            "true_faults": [
                kind for bit, kind in enumerate(TRUE_KINDS) if any(mask >> bit & 1 for mask in one.fault_mask)
            ],
            "fault_start_s": None if first is None else round(first[0] * TICK_S, 2),
            "detection_s": None if first is None else self._detection_s(one, *first),
            "max_error_degc": max(map(abs, errors.values()), default=None),
            "fault_max_error_degc": max(during, default=None),
            "above_upper_jobs": sum(true > upper for true, upper in judged) if judged else None,
        }

    def calibration(self) -> dict:
        """The newest offset calibration; None where none was seen."""
        v = self._calibration
        state = v.get("calibration_state")
        known = state is not None and int(state) < len(CALIBRATION)
        return {
            "state": CALIBRATION[int(state)] if state is not None and known else None,
            **{k: v.get(k) for k in ("offset_w_degc", "offset_r_degc", "offset_sigma_w_degc", "offset_sigma_r_degc")},
        }

    @staticmethod
    def _first_window(one: _Channel) -> tuple[int, int] | None:
        """Ticks [start, end) of the first stretch with a fault."""
        start = next((i for i, mask in enumerate(one.fault_mask) if mask), None)
        if start is None:
            return None
        rest = one.fault_mask[start:]
        end = next((i for i, mask in enumerate(rest) if not mask), None)
        return one.fault_tick[start], one.fault_tick[-1] + 1 if end is None else one.fault_tick[start + end]

    @staticmethod
    def _detection_s(one: _Channel, start: int, end: int) -> float | None:
        for i in range(bisect_left(one.job_tick, start), len(one.job_tick)):
            if one.job_tick[i] >= end:
                return None
            if one.job_class[i] != 0:
                return round((one.job_tick[i] - start) * TICK_S, 2)
        return None

    @staticmethod
    def _mask_at(one: _Channel, tick: int) -> int:
        i = bisect_right(one.fault_tick, tick) - 1
        return one.fault_mask[i] if i >= 0 else 0
