"""The road ahead as a file: every number comes back, and cycles over time are refused."""

import subprocess
import sys

import numpy as np
import pytest

from plant_sim.cycles import CycleSpec, build_cycle
from plant_sim.errors import CycleError
from plant_sim.params import load_params
from plant_sim.preview import FORMAT, fingerprint24, preview_text

PARAMS = load_params()


def test_every_number_comes_back():
    cycle = build_cycle(CycleSpec("lap"), PARAMS)
    lines = preview_text(cycle, PARAMS).splitlines()
    assert lines[0] == FORMAT
    step, points, ahead = lines[1].split()
    assert (float(step), int(points), float(ahead)) == (1.0, cycle.v_ref_mps.size, PARAMS.driver.lookahead_m)
    table = np.array([[float(word) for word in line.split()] for line in lines[2:]])
    np.testing.assert_array_equal(table, np.stack([cycle.v_ref_mps, cycle.slope_rad], axis=1))


def test_a_cycle_over_time_is_refused():
    with pytest.raises(CycleError, match="drive a lap"):
        preview_text(build_cycle(CycleSpec("class3"), PARAMS), PARAMS)


def test_fingerprints_are_those_of_fnv():
    # FNV-1a of 32 bits of "foobar" is 0xBF9CF968 (the published test vector), folded by xor.
    assert fingerprint24(b"foobar") == 0xBF ^ 0x9CF968
    assert fingerprint24(b"a") != fingerprint24(b"b")


def test_the_command_line_writes_it_or_says_why_not(tmp_path):
    out = tmp_path / "lap.preview"
    command = [sys.executable, "-m", "plant_sim.preview", "--out", str(out), "--scenario"]
    assert subprocess.run([*command, "lap"], check=False).returncode == 0
    assert out.read_text().startswith(FORMAT)
    refused = subprocess.run([*command, "class3"], capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert "runs over time" in refused.stderr
    assert "Traceback" not in refused.stderr
