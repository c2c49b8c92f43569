"""``rt-runner vcan``, ``tools/vcan-lab`` and ``tools/apt-install``: a CAN where there is none."""

import hashlib
import json
import os
import signal
import subprocess
import time

import pytest

from rt_runner.bus import can_trouble, choose_bus, look_up
from rt_runner.errors import SetupError
from tests.support.buses import ROOT, have_vcan
from tests.support.runs import rt_runner

LAB = ROOT / "tools" / "vcan-lab"


# ---- the verb ----------------------------------------------------------------------------------------------
def test_status_says_what_is_and_writes_json(tmp_path):
    out = tmp_path / "vcan.json"
    done = rt_runner("vcan", "status", "--name", "vcan9", "--json", out)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("vcan9 does not exist")
    found = json.loads(out.read_text())
    assert (found["name"], found["exists"], found["up"]) == ("vcan9", False, False)
    assert found["can_support"] == (can_trouble() is None)


def test_up_says_in_one_line_why_not():
    if can_trouble() is None:
        pytest.skip("this kernel has CAN: 'vcan up' works here")
    done = rt_runner("vcan", "up", "--name", "vcan9")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    for part in ("cannot create vcan9", "no CAN support", "--bus hub", "tools/vcan-lab"):
        assert part in done.stderr


@pytest.mark.parametrize("name", ["lo", "a b", "--", "x" * 16])
def test_what_is_no_can_interface_is_refused(name):
    for action in ("up", "down"):
        done = rt_runner("vcan", action, f"--name={name}")
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
    assert look_up("lo").up


@pytest.mark.vcan
def test_up_and_down():
    have_vcan()
    assert rt_runner("vcan", "down", "--name", "vcan7").returncode == 0
    with pytest.raises(SetupError, match="vcan7 does not exist; create it with 'rt-runner vcan up --name vcan7'"):
        choose_bus("vcan7")
    for _ in range(2):
        done = rt_runner("vcan", "up", "--name", "vcan7")
        assert (done.returncode, done.stdout, done.stderr) == (0, "vcan7 is up\n", "")
    assert choose_bus("vcan7").bus == "socketcan:vcan7"
    assert rt_runner("vcan", "status", "--name", "vcan7").returncode == 0
    subprocess.run(["ip", "link", "set", "vcan7", "down"], check=True)
    with pytest.raises(SetupError, match="vcan7 is down"):
        choose_bus("vcan7")
    assert rt_runner("vcan", "up", "--name", "vcan7").stdout == "vcan7 is up\n"
    assert rt_runner("vcan", "down", "--name", "vcan7").returncode == 0
    assert not look_up("vcan7").exists


# ---- the lab -----------------------------------------------------------------------------------------------
def lab(*arguments, **options) -> subprocess.CompletedProcess:
    return subprocess.run([LAB, *arguments], capture_output=True, timeout=300, **options)


@pytest.fixture(scope="module")
def working_lab():
    """The lab, or a skip that says why there is none; a failure where RT_REQUIRE_VCAN=1."""
    if os.environ.get("RT_LAB"):
        pytest.skip("this is the lab")
    done = lab("-t", "120", "--", "true")
    if done.returncode != 0:
        text = f"tools/vcan-lab does not work here: {done.stderr.decode()[-300:]}"
        if os.environ.get("RT_REQUIRE_VCAN") == "1" or os.environ.get("CI") == "true":
            pytest.fail(text)
        pytest.skip(text)


def test_lab_has_interfaces_directory_environment_and_arguments(working_lab, tmp_path):
    code = 'ip -br link; pwd; umask; printf "<%s>" "$@" "$RT_TEST"; exit 7'
    done = lab("--", "bash", "-c", code, "x", "a b", "$x", "q'\"q", "",
               cwd=tmp_path, env={**os.environ, "RT_TEST": "two\nlines"}, umask=0o027)  # fmt: skip
    lines = done.stdout.decode().split("\n")
    assert done.returncode == 7
    assert [line.split()[0] for line in lines[:3]] == ["lo", "vcan0", "vcan1"]
    assert lines[3:5] == [str(tmp_path), "0027"]
    assert "\n".join(lines[5:]) == "<a b><$x><q'\"q><><two\nlines>"


def test_lab_passes_all_output_and_separates_it(working_lab):
    code = 'f=$(mktemp); head -c 3000000 /dev/urandom >"$f"; sha256sum <"$f" >&2; cat "$f"; rm "$f"'
    done = lab("--", "bash", "-c", code)
    assert len(done.stdout) == 3_000_000
    assert hashlib.sha256(done.stdout).hexdigest() == done.stderr.split()[0].decode()


def test_lab_limits_time_and_leaves_nobody(working_lab):
    t0 = time.monotonic()
    done = lab("-t", "2", "--", "sleep", "100")
    assert done.returncode == 124
    assert 2 <= time.monotonic() - t0 < 30
    done = lab("--", "bash", "-c", "sleep 100 & echo left; exit 3")
    assert (done.returncode, done.stdout) == (3, b"left\n")
    assert time.monotonic() - t0 < 60


@pytest.mark.parametrize("sig", [signal.SIGTERM, signal.SIGINT])
def test_lab_passes_signals_on(working_lab, sig):
    code = 'trap "echo told; exit 9" TERM INT; echo started; while :; do sleep 0.1; done'
    p = subprocess.Popen([LAB, "-t", "60", "--", "bash", "-c", code], stdout=subprocess.PIPE)
    assert p.stdout.readline() == b"started\n"
    p.send_signal(sig)
    assert (p.communicate(timeout=60)[0], p.returncode) == (b"told\n", 9)


@pytest.mark.parametrize("arguments", [[], ["-t", "x", "true"], ["--nonsense"], ["-t"]])
def test_lab_says_in_one_line_what_it_cannot_take(arguments):
    done = lab(*arguments)
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (125, b"", 1)


# ---- packages ----------------------------------------------------------------------------------------------
def test_apt_install_does_nothing_where_nothing_is_missing():
    done = subprocess.run([ROOT / "tools" / "apt-install", "bash", "coreutils"], capture_output=True, timeout=30)
    if done.returncode == 1 and not os.path.exists("/usr/bin/dpkg-query"):
        pytest.skip("no Debian")
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.parametrize("arguments", [[], ["-y"], ["a b"], ["../x"]])
def test_apt_install_refuses_what_is_no_package(arguments):
    done = subprocess.run([ROOT / "tools" / "apt-install", *arguments], capture_output=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (2, b"", 1)
