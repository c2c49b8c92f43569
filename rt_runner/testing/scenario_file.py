"""A scenario as a test describes it, name, file or dict, with changes, as something the command line takes."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rt_runner.config import SCENARIO_DIR
from rt_runner.errors import UsageError


def scenario_file(
    folder: Path, scenario: str | os.PathLike[str] | Mapping[str, Any], changes: Mapping[str, Any] | None
) -> str:
    """The scenario's name or path; one that is new or changed is written into ``folder``, which is made then.

    Raises
    ------
    UsageError
        It cannot be read, or holds what TOML cannot.
    """
    if isinstance(scenario, Mapping):
        return _write(folder / "scenario.toml", _merged(scenario, changes or {}))
    name = os.fspath(scenario)
    if not changes:
        return name
    source = Path(name) if name.endswith(".toml") or "/" in name else SCENARIO_DIR / f"{name}.toml"
    try:
        tree = tomllib.loads(source.read_text())
    except OSError as e:
        raise UsageError(f"cannot read scenario {source}: {e.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise UsageError(f"scenario {source} is not valid TOML: {e}") from None
    cycle = tree.get("cycle")
    if isinstance(cycle, dict) and isinstance(cycle.get("path"), str):
        cycle["path"] = str((source.parent / cycle["path"]).resolve())  # the changed one lies elsewhere
    return _write(folder / source.name, _merged(tree, changes))


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in changes.items():
        old = out.get(key)
        out[key] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _write(path: Path, tree: Mapping[str, Any]) -> str:
    lines = [f"{_key(k)} = {_value(k, v)}" for k, v in tree.items() if not isinstance(v, Mapping)]
    for table, values in tree.items():
        if isinstance(values, Mapping):
            lines += ["", f"[{_key(table)}]", *(f"{_key(k)} = {_value(f'{table}.{k}', v)}" for k, v in values.items())]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def _key(key: object) -> str:
    return json.dumps(str(key), ensure_ascii=False)


def _value(where: str, value: Any) -> str:
    """TOML of a plain value. JSON spells texts and numbers as TOML does."""
    if isinstance(value, bool | str | int):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return repr(value)  # inf and nan, too
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(where, v) for v in value)}]"
    raise UsageError(f"scenario: {where} = {value!r}: a scenario holds texts, numbers, true, false and lists of them")
