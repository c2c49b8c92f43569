"""A supervised child: its JSON lines, its last words, its end."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from rt_runner.children import Child, ChildError
from rt_runner.errors import SetupError


def python(code):
    return Child("toy", [sys.executable, "-u", "-c", code])


def test_lines_of_json_and_everything_else():
    child = python('print("hello"); print(\'{"ready": true, "n": 3}\'); input()')
    assert child.wait_line("ready", 10)["n"] == 3
    child.tell("go")
    assert child.reap(10) == 0
    assert child.last_words() == "hello"


def test_a_child_that_dies_leaves_its_last_words():
    child = python('import sys; sys.exit("the bus is on fire")')
    with pytest.raises(ChildError, match=r"toy ended with exit status 1; its last words: the bus is on fire"):
        child.wait_line("ready", 10)


def test_a_child_that_is_killed_says_by_what():
    child = python("print('{\"ready\": true}'); import time; time.sleep(60)")
    child.wait_line("ready", 10)
    os.kill(child.process.pid, signal.SIGKILL)
    with pytest.raises(ChildError, match="SIGKILL"):
        child.wait_line("more", 10)


def test_silence_has_a_limit():
    child = python("import time; time.sleep(60)")
    with pytest.raises(ChildError, match=r"did not answer within 0.2 s"):
        child.wait_line("ready", 0.2)
    assert child.stop() == -signal.SIGTERM


def test_a_deaf_child_is_killed():
    child = python("import signal, time; signal.signal(15, signal.SIG_IGN); print('{\"ready\": 1}'); time.sleep(60)")
    child.wait_line("ready", 10)
    assert child.stop(grace_s=0.2) == -signal.SIGKILL


def test_children_die_with_their_supervisor():
    code = (
        "import sys, time; from rt_runner.children import Child;"
        "c = Child('toy', [sys.executable, '-c', 'import time; time.sleep(60)']);"
        "print('{\"ready\": %d}' % c.process.pid, flush=True); time.sleep(60)"
    )
    supervisor = python(code)
    grandchild = supervisor.wait_line("ready", 20)["ready"]
    os.kill(supervisor.process.pid, signal.SIGKILL)
    supervisor.reap(5)
    for _ in range(100):
        try:
            state = Path(f"/proc/{grandchild}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            return
        if state in "ZX":
            return
        time.sleep(0.05)
    pytest.fail("the child outlived its supervisor")


def test_what_cannot_be_started_is_named():
    with pytest.raises(SetupError, match=r"cannot start the toy: ./no-such-program"):
        Child("toy", ["./no-such-program"])
