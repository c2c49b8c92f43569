"""What makes a run repeatable, gathered before it starts: identities, the scenario as run, the files behind it."""

import json
import subprocess
from dataclasses import asdict, dataclass

from rt_runner import machine, paths
from rt_runner.config import Scenario
from rt_runner.dbc import Dbc
from rt_runner.errors import SetupError
from rt_runner.records import END, control

PREFLIGHT_S = 20.0
HASHES = ("dbc_hash", "weights_hash", "build_hash")


@dataclass(frozen=True)
class Provenance:
    """What a log carries beside its frames.

    ``run`` is its metadata record of that name; ``files`` (name -> path) and ``texts`` (name -> text) are attached.
    """

    run: dict[str, str]
    files: dict[str, str]
    texts: dict[str, str]


def preflight(scenario: Scenario, dbc: Dbc) -> dict:
    """Have the estimator start and end without a bus: what it refuses is refused before anything else starts.

    Returns
    -------
    dict
        Its own account: ``setting``, ``dbc_hash``, ``weights_hash``, ``build_hash`` …

    Raises
    ------
    SetupError
        It is not built, refuses the setting or period, or was generated from another DBC.
    """
    e = scenario.estimator
    command = [str(paths.binary("rt_estimator")), "--lockstep", "--no-rt", "--setting", e.setting]
    command += ["--period-us", str(round(e.period_s * 1e6))]
    try:
        done = subprocess.run(command, input=control(0, END), capture_output=True, timeout=PREFLIGHT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"{command[0]} does not run here ({error}): run 'make build'") from None
    lines = done.stderr.decode(errors="replace").splitlines()
    if done.returncode != 0:
        raise SetupError(lines[-1] if lines else f"{command[0]} ended with exit status {done.returncode}")
    ready = next((x for x in map(_parsed, lines) if "ready" in x), {})
    built = str(ready.get("dbc_hash", "")).lower().removeprefix("0x")
    if not built or not dbc.sha256.startswith(built):
        raise SetupError(
            f"the estimator was built from another DBC ({built or 'unknown'}) than {dbc.path} ({dbc.sha256[:6]}): "
            "run 'make build'"
        )
    return ready


def gather(scenario: Scenario, bus: str, seed: int, identity: dict) -> Provenance:
    """Collect it for one run; ``identity`` is what `preflight` returned."""
    run = {
        "scenario": scenario.name,
        "title": scenario.title,
        "bus": bus,
        "seed": str(seed),
        "duration_s": repr(scenario.duration_s),
        "setting": scenario.estimator.setting,
        "period_s": repr(scenario.estimator.period_s),
        "trigger": scenario.estimator.trigger,
        "policy": scenario.timing.policy,
        "faults": ", ".join(scenario.all_faults),
        "scenario_sha256": scenario.sha256,
        **{name: str(identity.get(name, "")) for name in HASHES},
        **machine.describe(),
    }
    effective = {k: v for k, v in asdict(scenario).items() if k not in ("path", "name", "sha256")}
    files = {"scenario.toml": str(scenario.path)}
    if scenario.cycle.path:
        files["cycle.csv"] = str(scenario.path.parent / scenario.cycle.path)
    texts = {
        "scenario_as_run.json": json.dumps(effective, indent=1),
        "hashes.json": json.dumps({name: run[name] for name in (*HASHES, "scenario_sha256")}, indent=1),
    }
    return Provenance(run, files, texts)


def _parsed(line: str) -> dict:
    try:
        value = json.loads(line)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
