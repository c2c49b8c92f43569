"""Whether the estimator here is the one that was logged: hashes of DBC, weights and build, and the setting."""

import tomllib

from rt_runner import paths
from rt_runner.errors import SetupError

HASHES = ("dbc_hash", "weights_hash", "build_hash")


def setting_name(identity: dict[str, int]) -> str:
    """Name of the setting whose number EstBuild carries.

    Raises
    ------
    SetupError
        The log has no EstBuild, or a number that no setting here has.
    """
    if "setting_id" not in identity:
        raise SetupError("no EstBuild frame in the log, which tells the setting: give --setting")
    for name in paths.setting_names():
        with (paths.ROOT / "estimator_c" / "settings" / f"{name}.toml").open("rb") as file:
            if tomllib.load(file).get("id") == identity["setting_id"]:
                return name
    raise SetupError(f"no setting here has the log's number {identity['setting_id']}: give --setting")


def compare_identity(logged: dict[str, int], ready: dict) -> dict[str, dict]:
    """Each hash as logged and as built here (24 bits, hex), and whether they agree; None where one is unknown."""
    found = {}
    for name in HASHES:
        mine = str(ready.get(name, "")).lower().removeprefix("0x")[:6] or None
        theirs = f"{logged[name]:06x}" if name in logged else None
        found[name] = {"logged": theirs, "here": mine, "same": None if None in (mine, theirs) else mine == theirs}
    return found
