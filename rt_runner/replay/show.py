"""The outcome of a replay as a few aligned lines."""

from typing import Any

from rt_runner.replay.differ import Difference

WHAT = {"dbc_hash": "DBC", "weights_hash": "weights", "build_hash": "build"}


def lines(figures: dict[str, Any], difference: Difference | None) -> list[str]:
    """What is shown of `rt_runner.replay.search.as_json`'s figures."""
    other = [WHAT[name] for name, i in figures["identity"].items() if i["same"] is False]
    told = [f"{WHAT[name]} {i['logged']} in the log, {i['here']} here" for name, i in figures["identity"].items()
            if i["same"] is False]  # fmt: skip
    out = [
        f"{'log':<12} {figures['jobs']} jobs at {figures['period_s'] * 1e3:g} ms, {figures['inputs']} inputs, setting "
        f"{figures['setting']}{', in lock-step' if figures['lockstep'] else ''}"
    ]
    if told:
        out.append(f"{'other':<12} the estimator that was logged is not this one: {'; '.join(told)}")
    if figures["ambiguous"]:
        out.append(
            f"{'ambiguous':<12} {figures['ambiguous']} jobs may have read a frame more or less; "
            f"{figures['attempts']} readings tried"
        )
    out += [f"{'note':<12} {note}" for note in figures["notes"]]
    if difference is not None:
        out.append(f"{'different':<12} {difference}")
    out.append(f"{'same':<12} {figures['estimates']} of {figures['jobs']} estimates, {figures['frames']} frames")
    because = f" (other {', '.join(other)})" if other and figures["verdict"] != "identical" else ""
    out.append(f"verdict: {figures['verdict']}{because}")
    return out
