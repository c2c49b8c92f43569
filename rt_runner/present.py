"""What a run shows its user: a progress line on a terminal, lines elsewhere, the result at the end."""

import json
import os
import sys
from pathlib import Path

from rt_runner.errors import UsageError

EXIT = {"pass": 0, "fail": 2, "inconclusive": 3}


class Progress:
    """A single rewritten line on a terminal; without one, plain lines, ten seconds apart.

    Parameters
    ----------
    total_s : expected duration; 0 where the cycle decides
    """

    def __init__(self, total_s: float, stream=None) -> None:
        self._total_s, self._stream = total_s, stream or sys.stderr
        self._tty = self._stream.isatty()
        self._open = False
        self._next_s = 10.0

    def line(self, text: str) -> None:
        """One line that stays."""
        self.close()
        print(text, file=self._stream, flush=True)

    def update(self, p: dict) -> None:
        """Show ``{"t_s", "theta_w_est_degc", "theta_w_true_degc", "frames", "resp_us"}``; absent ones are left out."""
        t = p.get("t_s") or 0.0
        parts = [f"{t:6.1f} s" + (f" of {self._total_s:g}" if self._total_s else "")]
        if p.get("theta_w_est_degc") is not None:
            parts.append(f"winding {p['theta_w_est_degc']:6.2f} degC")
            if p.get("theta_w_true_degc") is not None:
                parts[-1] += f" (truth {p['theta_w_true_degc']:6.2f})"
        if p.get("resp_us") is not None:
            parts.append(f"response {p['resp_us']:.0f} us")
        parts.append(f"{p.get('frames', 0)} frames")
        text = " · ".join(parts)
        if self._tty:
            print(f"\r\x1b[K{text}", end="", file=self._stream, flush=True)
            self._open = True
        elif t >= self._next_s:
            self._next_s = t - t % 10 + 10
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the progress line behind."""
        if self._open:
            print(file=self._stream, flush=True)
            self._open = False


def deliver(result: dict, log: Path, json_file: str | None) -> int:
    """Print the result, then write it where asked; returns the exit status.

    Raises
    ------
    UsageError
        The JSON file cannot be written.
    """
    print(summary(result, log), file=sys.stderr if json_file == "-" else sys.stdout, flush=True)
    write_json(result, json_file)
    crashed = any(f["what"] == "run" and f["verdict"] == "fail" for f in result["findings"])
    return 1 if crashed else EXIT[result["verdict"]]


def write_json(figures: dict, json_file: str | None) -> None:
    """Write figures as JSON to a file, to standard output for ``-``, nowhere for None."""
    if json_file is None:
        return
    text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
    if json_file == "-":
        sys.stdout.write(text)
        return
    path = Path(json_file)
    try:
        if path.exists() and not path.is_file():
            path.write_text(text)  # a device or a pipe is written to, never replaced
            return
        part = path.with_name(path.name + ".part")
        part.write_text(text)
        part.replace(path)
    except (OSError, ValueError) as e:
        raise UsageError(f"cannot write --json {json_file!r}: {getattr(e, 'strerror', None) or e}") from e


def check_json_path(json_file: str | None, log: str | None) -> None:
    """Refuse before a run what could not be written after it.

    Raises
    ------
    UsageError
        No such folder, a folder itself, or the log's own path.
    """
    if json_file in (None, "-"):
        return
    path = Path(json_file)
    if not path.name or path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise UsageError(
            f"cannot write --json {json_file!r}: give a file in a folder that exists and may be written to"
        )
    if log is not None and path.resolve() == Path(log).resolve():
        raise UsageError(f"--json and --log are the same file {json_file}: give two")


def summary(result: dict, log: Path | None) -> str:
    """The result as a few aligned lines."""
    lines = [""]
    for channel, title in (("theta_w", "winding"), ("theta_r", "rotor")):
        a = result["accuracy"][channel]
        if a["est_rmse_degc"] is not None:
            raw = "n/a" if a["raw_rmse_degc"] is None else f"{a['raw_rmse_degc']:.3f}"
            lines.append(
                f"{title:<10} estimate RMSE {a['est_rmse_degc']:.3f} degC (max {a['est_max_degc']:.3f}), "
                f"raw sensor {raw} degC"
            )
    lines += sensor_lines(result)
    lines += node_lines(result["timing"]["estimator"])
    g = result["granted"]
    if g["policy"] is not None:
        lines.append(
            f"{'granted':<10} {g['policy']}, core {g['core']}, memory {'locked' if g['mlock'] else 'not locked'}"
        )
    if "controller" in result["timing"]:
        lines += controller_lines(result)
    lines.append(
        f"{'log':<10} {result['log']['frames']} frames, {result['log']['dropped']} dropped"
        + (f", {log}" if log else "")
    )
    for f in result["findings"]:
        lines.append(f"{f['verdict']:<12} {f['what']}: {f['evidence']}")
    lines.append(f"verdict: {result['verdict']}")
    return "\n".join(lines)


def controller_lines(result: dict) -> list[str]:
    """The controller's loop, and what became of it, under a line of its own."""
    c = result["controller"]
    words = (("mute", "commands not available"), ("shifted", "by the shifted plan"), ("by_rule", "by the rule"),
             ("clamped", "clamped"), ("failed", "solves failed"), ("unconverged", "not converged"))  # fmt: skip
    shown = [f"{c[key]} {word}" for key, word in words if c[key]]
    lines = [f"controller {c['name']}:" if c["name"] else "controller:", *node_lines(result["timing"]["controller"])]
    return lines + ([f"{'commands':<10} {', '.join(shown)}"] if shown else [])


def node_lines(t: dict) -> list[str]:
    """The loop of one node: jobs, durations, policy."""
    period = "n/a" if t["period_s"] is None else f"{t['period_s'] * 1e3:g}"
    lines = [f"{'jobs':<10} {t['jobs']} at {period} ms, {t['miss_late']} late, {t['miss_skipped']} skipped"]
    for key, title in (("wake_lat_us", "wake-up"), ("exec_wall_us", "execution"), ("resp_us", "response")):
        q = t[key]
        if q["max"] is not None:
            shown = (f"{k} {'n/a' if q[k] is None else format(q[k], '.1f')}" for k in ("p50", "p99", "max"))
            lines.append(f"{title:<10} {', '.join(shown)} us")
    return lines + timing_lines(t)


def timing_lines(t: dict) -> list[str]:
    """What the policy did and late jobs put out, where there was anything; none for an older log."""
    shown = [f"{t[key]} {word}" for key, word in (("overrun", "overruns"), ("queued", "ran queued"), ("cut", "cut"),
                                                  ("rebased", "times the grid moved"), ("held", "outputs held"),
                                                  ("predicted", "predicted"), ("invalidated", "declared invalid"))
             if t.get(key)]  # fmt: skip
    return [f"{'policy':<10} {', '.join(shown)}"] if shown else []


def sensor_lines(result: dict) -> list[str]:
    """What became of the sensors, a line each; none where nothing was said about them (an older log)."""
    lines = []
    for channel, title in (("theta_w", "winding"), ("theta_r", "rotor")):
        s = result.get("sensors", {}).get(channel, {})
        if not s.get("class_share"):
            continue
        parts = [", ".join(f"{name} {share:.1%}" for name, share in s["class_share"].items())]
        if s["true_faults"]:
            found = "never noticed" if s["detection_s"] is None else f"noticed after {s['detection_s']:g} s"
            parts.append(f"truly {', '.join(s['true_faults'])} from {s['fault_start_s']:g} s on, {found}")
            if s["fault_max_error_degc"] is not None:
                parts.append(f"error then up to {s['fault_max_error_degc']:.3f} degC")
        if s["above_upper_jobs"]:
            parts.append(f"truth ABOVE the upper bound in {s['above_upper_jobs']} jobs")
        lines.append(f"{'sensor':<10} {title}: {'; '.join(parts)}")
    calibration = result.get("sensors", {}).get("calibration", {})
    if lines and calibration.get("state") not in (None, "datasheet"):
        offsets = (calibration.get(f"offset_{c}_degc") for c in "wr")
        shown = " / ".join("n/a" if o is None else f"{o:.3f}" for o in offsets)
        lines.append(f"{'offset':<10} {calibration['state']}: winding / rotor {shown} degC")
    return lines
