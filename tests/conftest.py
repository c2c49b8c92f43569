"""For all tests: which of them want the machine for themselves, one folder of compiled libraries, SIGINT as a terminal.

Tests that judge the times of real processes are marked ``alone``, by their place here or by themselves.
`tools/run-tests` runs them one after the other, and everything else side by side.
"""

import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

HERE = Path(__file__).resolve().parent
# A busy machine may hold up any example: how long one takes is no finding.
settings.register_profile("house", deadline=None)
settings.load_profile("house")

ALONE = (
    "timing/", "bus/test_plugin_examples.py",
    "unit/test_rt_threads.py", "unit/test_rt_grant.py", "unit/test_bench_loop.py", "unit/test_pytest_plugin.py",
)  # fmt: skip
LOCKSTEP = (  # no clock runs there
    "timing/test_estimator_binary_lockstep.py", "timing/test_estimator_binary_replay.py",
    "timing/test_mil.py", "timing/test_mil_faults.py",
)  # fmt: skip

# A shell that starts us in the background makes SIGINT ignored, and every process we start would inherit that: Ctrl-C
# could not be tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_libraries = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    """The estimator's libraries for the nets of the tests are compiled once in a run, whichever worker needs them."""
    if not hasattr(config, "workerinput") and "RT_LIBEST_FOLDER" not in os.environ:
        folder = tempfile.mkdtemp(prefix="rt-libest-")
        config.stash[_libraries] = os.environ["RT_LIBEST_FOLDER"] = folder


def pytest_unconfigure(config: pytest.Config) -> None:
    folder = config.stash.get(_libraries, None)
    if folder is not None:
        del os.environ["RT_LIBEST_FOLDER"]
        shutil.rmtree(folder, ignore_errors=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        name = item.path.relative_to(HERE).as_posix()
        if name.startswith(ALONE) and name not in LOCKSTEP:
            item.add_marker("alone")
