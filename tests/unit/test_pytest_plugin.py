"""The plugin's fixtures, each in a test run of its own: which bus, skip or fail, what is left behind."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from rt_runner.bus import choose_bus, look_up
from rt_runner.errors import UsageError
from rt_runner.testing.scenario_file import scenario_file
from tests.support.plugin import PLUGIN

pytest_plugins = ["pytester"]
ROOT = Path(__file__).resolve().parents[2]
QUICK = ("-p", "no:cacheprovider", "-p", "no:hypothesispytest")  # the latter costs a second to import
NO_VCAN = pytest.mark.skipif(look_up("vcan0").exists, reason="there is a vcan0 here: its absence cannot be tested")


@pytest.fixture
def run(pytester, monkeypatch):
    """Run a test module with the plugin; the result."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("RT_REQUIRE_VCAN", raising=False)

    def run_module(text: str, *arguments: str):
        pytester.makepyfile(text)
        return pytester.runpytest_inprocess(*PLUGIN, *QUICK, *arguments)

    return run_module


def test_a_test_has_a_bus_that_python_can_opens_by_its_names(run):
    result = run("""
        import can, pathlib

        def test_frames_pass(virtual_bus):
            assert (virtual_bus.name, virtual_bus.interface) == ("hub", "rt_hub")
            reader = virtual_bus.open()
            with can.Bus(interface=virtual_bus.interface, channel=virtual_bus.channel, receive=False) as sender:
                sender.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"abc"))
                assert bytes(reader.recv(5.0).data) == b"abc"
            pathlib.Path("socket").write_text(virtual_bus.channel)

        def test_nothing_of_it_is_left(virtual_bus):
            before = pathlib.Path(pathlib.Path("socket").read_text())
            assert not before.exists() and not before.parent.exists()
            assert pathlib.Path(virtual_bus.channel).exists()
    """, "--rt-bus=hub")  # fmt: skip
    result.assert_outcomes(passed=2)


def test_marker_goes_before_option_and_option_before_ini(run, pytester):
    pytester.makeini("[pytest]\nrt_bus = nosuch0\n")
    text = """
        import pytest

        @pytest.mark.rt_bus("hub")
        def test_marked(virtual_bus):
            assert virtual_bus.name == "hub"

        def test_plain(virtual_bus):
            assert virtual_bus.name == "hub"
    """
    run(text, "--strict-markers", "--rt-bus=hub").assert_outcomes(passed=2)
    result = run(text, "-rs")
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(["*SKIPPED*nosuch0*"])


def test_a_marker_that_names_no_bus_fails(run):
    result = run("""
        import pytest

        @pytest.mark.rt_bus
        def test_marked(virtual_bus):
            pass
    """)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(['*rt_bus("hub")*'])


@NO_VCAN
def test_a_bus_that_is_not_there_skips_and_where_it_must_be_fails(run, monkeypatch):
    text = "def test_it(virtual_bus): pass"
    result = run(text, "--rt-bus=vcan0", "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["*SKIPPED*vcan0*--rt-bus=hub*"])
    run(text).assert_outcomes(passed=1)
    monkeypatch.setenv("RT_REQUIRE_VCAN", "1")
    run(text, "--rt-bus=vcan0").assert_outcomes(errors=1)
    run(text).assert_outcomes(errors=1)
    run(text, "--rt-bus=hub").assert_outcomes(passed=1)


def test_a_hub_that_is_not_built_is_one_line(run, monkeypatch, tmp_path):
    monkeypatch.setenv("RT_BUILD_DIR", str(tmp_path))
    result = run("def test_it(virtual_bus): pass", "--rt-bus=hub")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*rt_hub is missing: run 'make build'*"])
    assert "Traceback" not in result.stdout.str()


def test_a_bus_that_ends_before_its_test_is_an_error(run):
    result = run("""
        import os, signal, subprocess, time, pathlib

        def test_it(virtual_bus):
            for folder in pathlib.Path("/proc").glob("[0-9]*"):
                try:
                    words = (folder / "cmdline").read_bytes().split(b"\\0")
                except OSError:
                    continue
                if virtual_bus.channel.encode() in words and words[0].endswith(b"rt_hub"):
                    os.kill(int(folder.name), signal.SIGKILL)
                    time.sleep(0.2)
                    return
            raise AssertionError("no hub found")
    """, "--rt-bus=hub")  # fmt: skip
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*the bus ended before the test did*"])


def test_a_run_in_lock_step_needs_no_bus_and_gives_everything(run):
    result = run("""
        def test_it(run_scenario, tmp_path):
            run = run_scenario("hot-lap", {"plant": {"coolant_degc": 70.0}}, duration_s=2, seed=3, lockstep=True)
            assert (run.status, run.verdict) in ((0, "pass"), (2, "fail"), (3, "inconclusive"))
            assert run.result["seed"] == 3 and run.result["scenario"] == "hot-lap"
            assert len(run.frames["MotorState"]) == 200 and run.frames["NoSuchFrame"] == []
            assert run.frames["Coolant"][0].values["coolant_degc"] == 70.0
            assert run.dbc["Estimate"].sender == "ESTIMATOR"
            assert "verdict" in run.text and run.log.parent == tmp_path
            again = run_scenario("hot-lap", duration_s=1, lockstep=True)
            assert again.log != run.log and len(again.frames["MotorState"]) == 100
    """, "--rt-bus=nosuch0")  # fmt: skip
    result.assert_outcomes(passed=1)


def test_a_run_that_cannot_start_is_one_line_or_given_back(run):
    result = run("""
        def test_fails(run_scenario):
            run_scenario("no-such-scenario", lockstep=True)

        def test_given_back(run_scenario):
            run = run_scenario({"cycle": {"kind": "boat"}}, lockstep=True, check=False)
            assert (run.status, run.verdict, run.result) == (1, "none", {})
            assert "boat" in run.text

        def test_no_toml(run_scenario):
            run_scenario({"title": None}, lockstep=True)
    """)
    result.assert_outcomes(passed=1, failed=2)
    result.stdout.fnmatch_lines(["*unknown scenario 'no-such-scenario'*", "*title = None*"])
    assert "Traceback" not in result.stdout.str()


def test_what_a_test_leaves_running_is_stopped_before_its_bus_is(run):
    result = run("""
        import pathlib, time

        def test_leaves(run_scenario, virtual_bus):
            reader = virtual_bus.open()
            going = run_scenario.start("hot-lap", duration_s=60)
            while (frame := reader.recv(60)).arbitration_id != 0x0A0:
                pass
            assert going.running()
            pathlib.Path("pid").write_text(str(going._process.pid))

        def test_is_gone():
            assert not pathlib.Path("/proc", pathlib.Path("pid").read_text()).exists()
    """, "--rt-bus=hub")  # fmt: skip
    result.assert_outcomes(passed=2)


def test_a_test_run_that_does_not_use_it_imports_nothing_heavy(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makepyfile("""
        import sys

        def test_it():
            heavy = {"can", "cantools", "mcap", "google.protobuf", "numpy", "rich", "rt_runner.bus"}
            assert "rt_runner.pytest_plugin" in sys.modules
            assert not heavy & set(sys.modules)
    """)
    pytester.runpytest_subprocess(*PLUGIN, *QUICK).assert_outcomes(passed=1)


def test_a_file_beside_the_users_tests_is_not_taken_for_ours(run, pytester):
    pytester.path.joinpath("can.py").write_text("raise SystemExit('the wrong can')")
    pytester.path.joinpath("plant_sim.py").write_text("raise SystemExit('the wrong plant')")
    result = run("""
        def test_it(run_scenario):
            assert run_scenario("hot-lap", duration_s=1, lockstep=True).status in (0, 3)
    """, "--import-mode=importlib")  # fmt: skip
    result.assert_outcomes(passed=1)


@NO_VCAN
def test_tests_on_one_interface_take_turns():
    from rt_runner.bus import BusChoice
    from rt_runner.testing.virtual_bus import _turn

    held = BusChoice("socketcan", "vcan77", "asked for")
    code = ("from rt_runner.bus import BusChoice; from rt_runner.testing.virtual_bus import _turn\n"
            "with _turn(BusChoice('socketcan', 'vcan77', '')): print('mine', flush=True)")  # fmt: skip
    with _turn(held):
        other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT,
                                 env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(2.0)
    assert other.communicate(timeout=30)[0] == "mine\n"


def test_a_hub_that_runs_already_can_be_named(tmp_path):
    choice = choose_bus(f"rt_hub:{tmp_path}/bus")
    assert (choice.kind, choice.channel, choice.name) == ("rt_hub", f"{tmp_path}/bus", "hub")
    with pytest.raises(UsageError):
        choose_bus("rt_hub:")


class TestScenarioFile:
    """What is written is what was meant."""

    def test_a_name_without_changes_stays_a_name(self, tmp_path):
        assert scenario_file(tmp_path / "x", "hot-lap", None) == "hot-lap"
        assert not (tmp_path / "x").exists()

    def test_values_of_every_kind_survive(self, tmp_path):
        tree = {
            "title": 'with "quotes", ü and \\ and\nlines', "duration_s": 1.5, "faults": ["stuck@1-2", "x"],
            "timing": {"canary": True, "mk": [1, 10], "policy": "queue:3", "grace_s": 1e-9, "with-dash": float("inf")},
        }  # fmt: skip
        written = tomllib.loads(Path(scenario_file(tmp_path / "d", tree, None)).read_text())
        assert written == tree

    def test_changes_go_into_tables_and_leave_the_rest(self, tmp_path):
        path = Path(scenario_file(tmp_path / "d", "hot-lap", {"sensor": {"variance": 0.5}, "title": "mine"}))
        before = tomllib.loads((ROOT / "rt_runner/scenarios/hot-lap.toml").read_text())
        after = tomllib.loads(path.read_text())
        assert path.stem == "hot-lap"
        assert after["title"] == "mine"
        assert after["sensor"] == {**before.get("sensor", {}), "variance": 0.5}
        assert after["cycle"] == before["cycle"]

    def test_a_cycle_is_found_from_where_the_changed_one_lies(self, tmp_path):
        (tmp_path / "mine.toml").write_text('[cycle]\nkind = "csv"\npath = "drive.csv"\n')
        written = tomllib.loads(
            Path(scenario_file(tmp_path / "d", str(tmp_path / "mine.toml"), {"title": "t"})).read_text()
        )
        assert written["cycle"]["path"] == str(tmp_path / "drive.csv")

    @pytest.mark.parametrize("name", ["nosuch", "no/such.toml"])
    def test_one_that_cannot_be_read_is_a_usage_error(self, tmp_path, name):
        with pytest.raises(UsageError, match="cannot read scenario"):
            scenario_file(tmp_path / "d", name, {"title": "t"})
