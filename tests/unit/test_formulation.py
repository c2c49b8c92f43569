"""The generator's contract: same bytes twice, bad inputs are one clear line, the table in C is the table in TOML."""

from __future__ import annotations

import ctypes as ct
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import pytest

from estimator_c.formulation.c_printer import c_function
from estimator_c.formulation.errors import FormulationError
from estimator_c.formulation.settings import FIELDS, load_settings
from estimator_c.formulation.weights import load_weights
from tests.support.nets import random_net
from tools.libest import ROOT, SETTINGS, WEIGHTS, Lib, Setting, compile_library


def run_generator(
    weights: Path, out: Path, *options: str, settings: Path = SETTINGS, **env: str
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "estimator_c.formulation.generate", "--weights", str(weights)]
    command += ["--settings", str(settings), "--out", str(out), *options]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, **env}, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("real", ["double", "float"])
def test_generating_twice_gives_the_same_bytes(real: str, tmp_path: Path) -> None:
    for folder, seed in (("a", "1"), ("b", "2")):
        done = run_generator(WEIGHTS, tmp_path / folder, "--real", real, PYTHONHASHSEED=seed)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    pairs = [f"{name}.{kind}" for name in ("est_settings", "thermal_net", "train_envelope") for kind in "ch"]
    kernels = [f"thermal_net_{name}.c" for name in (("avx2", "avx512", "select") if real == "double" else ("select",))]
    assert names == sorted([*pairs, *kernels, "real.h"])
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_unchanged_files_keep_their_time_stamp(tmp_path: Path) -> None:
    run_generator(WEIGHTS, tmp_path)
    os.utime(tmp_path / "thermal_net.c", (1, 1))
    run_generator(WEIGHTS, tmp_path)
    assert (tmp_path / "thermal_net.c").stat().st_mtime == 1


def test_generated_code_is_c11_without_warnings_or_memory(tmp_path: Path) -> None:
    run_generator(WEIGHTS, tmp_path)
    flags = ["-std=c11", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O1"]
    for source in ("thermal_net.c", "train_envelope.c", "est_settings.c"):
        subprocess.run(
            ["gcc", *flags, f"-I{tmp_path}", "-c", str(tmp_path / source), "-o", str(tmp_path / f"{source}.o")],
            check=True,
        )
        symbols = subprocess.run(
            ["nm", "-u", str(tmp_path / f"{source}.o")], capture_output=True, text=True, check=True
        ).stdout.split()
        assert set(symbols) - {"U"} <= {"strcmp", "_GLOBAL_OFFSET_TABLE_"}


def test_identity_is_the_sha256_of_the_file(tmp_path: Path) -> None:
    weights = load_weights(WEIGHTS)
    assert weights.sha256 == hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    assert f"{weights.hash24:06x}" == weights.sha256[:6]
    lib = Lib(compile_library(WEIGHTS))
    assert lib.sha256 == weights.sha256
    assert ct.c_uint32.in_dll(lib.c, "net_weights_hash24").value == weights.hash24


Change = Callable[[dict[str, Any]], Any]
CORRUPTIONS: dict[str, tuple[str, Change]] = {
    "format": ("format", lambda d: d.update(format="something/2")),
    "cell": ("cell", lambda d: d.update(cell="gru")),
    "cell of no name": ("cell", lambda d: d.update(cell=["lstm"])),
    "layers": ("layers", lambda d: d.update(layers=2)),
    "gates": ("gate_order", lambda d: d.update(gate_order="ifog")),
    "step": ("dt_s", lambda d: d.update(dt_s=0.2)),
    "hidden": ("hidden", lambda d: d.update(hidden="8")),
    "hidden true": ("hidden", lambda d: d.update(hidden=True)),
    "missing": ("W_h", lambda d: d.pop("W_h")),
    "short": ("W_u", lambda d: d["W_u"].pop()),
    "ragged": ("W_u", lambda d: d["W_u"][3].pop()),
    "nan": ("b", lambda d: d["b"].__setitem__(2, math.nan)),
    "text": ("b_y", lambda d: d["b_y"].__setitem__(0, "0.1")),
    "null": ("W_y", lambda d: d["W_y"][0].__setitem__(0, None)),
    "order": ("inputs", lambda d: d["inputs"].reverse()),
    "inputs": ("inputs", lambda d: d.update(inputs=7)),
    "no scale": ("inputs.torque_nm.scale", lambda d: d["inputs"][1].pop("scale")),
    "zero scale": ("outputs.scale", lambda d: d["outputs"][0].update(scale=0.0)),
    "other size": ("W_u", lambda d: d.update(hidden=4)),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corrupt_weights_name_file_field_and_remedy(name: str, tmp_path: Path) -> None:
    field, change = CORRUPTIONS[name]
    document = json.loads(random_net(tmp_path).read_text())
    change(document)
    path = tmp_path / "net.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FormulationError) as caught:
        load_weights(path)
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{path}: {field}: ")
    assert "make train" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b'{"format": ', b"\xff\xfe", b"[1, 2]"])
def test_command_line_reports_a_broken_file_in_one_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "net.json"
    path.write_bytes(content)
    done = run_generator(path, tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert str(path) in done.stderr
    assert not (tmp_path / "out").exists()


def test_missing_weights_file_is_one_line(tmp_path: Path) -> None:
    done = run_generator(tmp_path / "none.json", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


SETTING_FAULTS = {
    "unknown key": ("delay_steps = 15", "delay_steps = 15\nlag = 3", "sensor.lag"),
    "missing": ("delay_steps = 15", "", "sensor.delay_steps"),
    "type": ("delay_steps = 15", "delay_steps = 1.5", "sensor.delay_steps"),
    "range": ("delay_steps = 15", "delay_steps = 500", "sensor.delay_steps"),
    "not a pair": ("noise = [4.0e3, 4.0e4]", "noise = 3.0", "weights.noise"),
    "infinite": ("noise = [4.0e3, 4.0e4]", "noise = [1.0, inf]", "weights.noise"),
    "flag": ("hard = false", 'hard = "no"', "bounds.hard"),
    "choice": ('loss = "geman-mcclure"', 'loss = "cauchy"', "robust.loss"),
    "sensor range": ("range_low_degc = -38.0", "range_low_degc = 500.0", "sensor"),
    "bounds": ("upper_degc = 200.0", "upper_degc = -100.0", "bounds"),
    "id": ("id = 0", "id = 1", "id"),
    "syntax": ("id = 0", "id = ", "file"),
}


@pytest.mark.parametrize("name", SETTING_FAULTS)
def test_faulty_settings_name_the_field(name: str, tmp_path: Path) -> None:
    old, new, field = SETTING_FAULTS[name]
    shutil.copytree(SETTINGS, tmp_path / "settings")
    path = tmp_path / "settings" / "default.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FormulationError) as caught:
        load_settings(tmp_path / "settings")
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


def test_every_setting_reaches_c_unchanged() -> None:
    lib = Lib(compile_library(WEIGHTS))
    assert [field.c_name for field in FIELDS] == [name for name, *_ in Setting._fields_[2:]]
    settings = load_settings(SETTINGS)
    assert [(s.id, s.name) for s in settings] == [(0, "default"), (1, "paper"), (2, "ekf")]
    for setting in settings:
        in_c = lib.setting(setting.name)
        assert (in_c.id, in_c.name.decode()) == (setting.id, setting.name)
        for name, value in setting.values.items():
            found = getattr(in_c, name)
            assert (tuple(found) if isinstance(value, tuple) else found) == value, name


def test_the_papers_weights_are_its_table() -> None:
    paper = load_settings(SETTINGS)[1].values
    assert paper["weight_measurement"] == (0.02, 0.02)
    assert paper["weight_noise"] == (0.7, 0.7)
    assert paper["weight_arrival"] == (1.0, 1.0)
    assert (paper["lower_degc"], paper["upper_degc"], paper["hard_bounds"]) == (0.0, 155.0, True)


def test_printer_refuses_what_it_does_not_know() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(NotImplementedError, match="f: CasADi operation"):
        c_function(ca.Function("f", [x], [ca.sin(x)], ["x"], ["y"]))
