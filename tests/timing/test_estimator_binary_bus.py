"""The estimator binary on a real bus: conservation laws, what it was granted, and how it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rt_runner.bus import HubProcess, choose_bus
from rt_runner.e2e import E2eStatus
from tests.support.buses import have_vcan
from tests.timing.estimator_process import COUNTERS, IDENTITY, OnBus, Plant, binary, per_job

OK = 2
PR_CAPBSET_DROP = 24
CAP_NET_ADMIN, CAP_IPC_LOCK, CAP_SYS_NICE = 12, 14, 23


@pytest.fixture(params=["hub", pytest.param("vcan0", marks=pytest.mark.vcan)])
def bus(request):
    """A bus string for every process, and what serves it."""
    if request.param == "vcan0":
        have_vcan()
    with HubProcess.serving(choose_bus(request.param)) as name:
        yield name


@pytest.fixture
def hub():
    process = HubProcess()
    yield process
    process.stop()


def check_conservation(run) -> None:
    """releases = jobs + skipped; jobs = estimates sent + counted drops; what was sent arrived, gapless."""
    final = run.final
    assert final["releases"] == final["jobs"] + final["miss_skipped"]
    for window in ("warmup", "judged"):
        assert final[window]["releases"] == final[window]["jobs"] + final[window]["miss_skipped"]
    assert final["jobs"] == final["estimates_sent"] + final["estimates_lost"]
    assert sum(final["causes"].values()) == final["jobs"] == sum(final["status_jobs"].values())
    assert final["resp_us"]["count"] == final["judged"]["jobs"]
    if final["tx_drops"] or run.lost_here:  # the machine was too slow for this rate; then the counts must say so
        assert len(run.named("Estimate")) + run.lost_here >= final["estimates_sent"] >= len(run.named("Estimate"))
        assert {f.e2e for f in run.frames} <= {E2eStatus.OK, E2eStatus.LOST, E2eStatus.WRONG_SEQUENCE}
        return
    jobs = list(per_job(run))
    assert len(jobs) == final["estimates_sent"]
    assert {f.e2e for f in run.frames} == {E2eStatus.OK}
    indices = [a.values["release_index"] for *_, a, _, _, _ in jobs]
    assert indices == sorted(set(indices))
    assert indices[0] == 1
    skipped = 0
    for before, (*_, timing, _, _, _) in zip([0, *indices], jobs, strict=False):
        gap = timing.values["release_index"] - before - 1
        assert timing.values["after_skip"] == (gap > 0)
        skipped += gap
    assert final["miss_skipped"] - skipped in (0, final["releases"] - indices[-1])
    assert sum(a.values["miss_late"] for *_, a, _, _, _ in jobs) == final["miss_late"]
    assert sum(a.values["stale_input"] for *_, a, _, _, _ in jobs) == final["stale_inputs"]
    last = {name: run.named(name)[-1].values for name in COUNTERS}
    assert last["EstReleases"]["releases"] == final["releases"]
    assert last["EstReleases"]["jobs"] == final["jobs"]
    assert last["EstMisses"]["miss_skipped"] == final["miss_skipped"]
    for name in IDENTITY:
        assert run.named(name), f"{name} was not sent at the start"


@pytest.mark.parametrize(("period_ms", "seconds"), [(100, 4.0), (1, 2.5)])
def test_every_job_is_published_and_every_release_accounted_for(bus, period_ms, seconds):
    talk = OnBus(bus, binary("release"), "--period-us", str(period_ms * 1000)).wait(seconds)
    run = talk.finish()
    assert (run.status, run.errors) == (0, [])
    assert run.final["stopped_by"] == "signal"
    check_conservation(run)
    if period_ms == 100:
        assert run.final["tx_drops"] == run.lost_here == 0, "so few frames must never be lost"
    assert seconds * 1000 / period_ms - 2 <= run.final["releases"] <= run.life_s * 1000 / period_ms + 1
    assert 0.5 * talk.sent_ticks < run.final["rx"]["MotorState"]["ok"] <= talk.sent_ticks
    assert run.final["rx"]["Coolant"]["ok"] >= 2, "the kernel's filter lets it through"
    assert run.final["rx"]["MotorState"]["wrong_crc"] == run.final["rejected"] == run.final["rx_drops"] == 0
    assert run.final["rx"]["MotorState"]["in_age_us"]["min"] >= 0
    assert run.named("Estimate")[-1].values["status"] in (1, OK, 3)
    assert run.named("Estimate")[-1].values["tick"] <= talk.sent_ticks
    wake = run.final["wake_lat_us"]
    assert 0 <= wake["min"] <= wake["p50"] <= wake["max"]
    if period_ms == 100:  # fewer than 100 judged jobs: a p99 would be invented
        assert wake["p99"] is None


@pytest.mark.parametrize("kind", ["release", "asan"])
def test_damaged_frames_are_counted_and_ignored(hub, kind):
    talk = OnBus(hub.bus, binary(kind), "--period-us", "20000")
    plant = Plant()
    for tick in range(50):
        data = bytearray(plant.motor(tick, torque_nm=300.0))
        data[3] ^= 0x40
        talk.send(0x0A0, bytes(data))
        talk.send(0x7DF, b"whatever")
        talk.send(0x18FEF0A0, b"extended")
    run = talk.wait(1.0).finish()
    assert (run.status, run.errors) == (0, [])
    check_conservation(run)
    assert run.final["crc_errors"] == 50
    assert run.named("EstInputFaults")[-1].values["crc_errors"] == 50
    assert run.final["seq_errors"] == 0, "a damaged frame does not disturb the sequence"


def test_garbage_datagrams_on_the_hub_hurt_nobody(hub):
    talk = OnBus(hub.bus, binary("release"), "--period-us", "10000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(hub.bus.partition(":")[2])
        stranger.shutdown(socket.SHUT_RD)
        for size in (1, 15, 17, 71, 73, 4000):
            stranger.send(os.urandom(size))
        stranger.send(b"\xa0\0\0\0\xff\xff\xff\xff" + bytes(8))
    run = talk.wait(0.6).finish()
    assert (run.status, run.errors) == (0, [])
    check_conservation(run)


def test_bus_that_ends_is_one_line_and_exit_1_with_the_figures(hub):
    talk = OnBus(hub.bus, binary("release")).wait(0.5)
    hub.stop()
    run = talk.finish(None)
    assert run.status == 1
    assert len(run.errors) == 1
    assert run.errors[0].startswith("rt_estimator: ")
    assert run.final["stopped_by"] == "bus"
    assert run.final["releases"] == run.final["jobs"] + run.final["miss_skipped"]


def test_interrupt_ends_as_cleanly_as_terminate(hub):
    run = OnBus(hub.bus, binary("release"), "--period-us", "1000000").wait(0.3).finish(signal.SIGINT)
    assert (run.status, run.errors) == (0, [])
    assert [f.name for f in run.frames] == list(COUNTERS), "final counters, although no job has run"
    assert run.final["jobs"] == run.final["releases"] == 0
    assert run.final["faults"] is None


def test_granted_is_what_the_system_says(hub):
    core = max(os.sched_getaffinity(0))
    talk = OnBus(hub.bus, binary("release"), "--core", str(core), "--priority", "7", "--period-us", "10000")
    pid, ready = talk.process.pid, talk.ready
    assert os.sched_getaffinity(pid) == {core} == {ready["core"]}
    policy = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}[os.sched_getscheduler(pid)]
    assert policy == ready["policy"]
    assert os.sched_getparam(pid).sched_priority == ready["priority"]
    status = Path(f"/proc/{pid}/status").read_text()
    locked_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmLck"))
    assert (locked_kb > 0) == ready["mlock"]
    assert (policy == "other") == any("SCHED_FIFO" in w for w in ready["warnings"])
    assert (not ready["mlock"]) == any("mlockall" in w for w in ready["warnings"])
    run = talk.wait(0.3).finish()
    granted = run.named("EstGranted")[0].values
    assert granted["policy"] == {"other": 0, "fifo": 1, "rr": 2}[policy]
    assert (granted["priority"], granted["core"], granted["mlock"]) == (ready["priority"], core, ready["mlock"])


def _without_rights() -> None:
    """In the child: no right to raise priority or lock memory, whoever we are."""
    import resource

    libc = ctypes.CDLL(None)
    for capability in (CAP_SYS_NICE, CAP_IPC_LOCK):
        libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))


def test_what_is_refused_is_a_warning_and_it_runs_all_the_same(hub):
    talk = OnBus(hub.bus, binary("release"), "--period-us", "20000", preexec_fn=_without_rights)
    ready = talk.ready
    assert (ready["policy"], ready["priority"], ready["mlock"]) == ("other", 0, False)
    assert any("SCHED_FIFO priority 80 refused" in w for w in ready["warnings"])
    assert any("mlockall refused" in w for w in ready["warnings"])
    assert not any("send buffer" in w for w in ready["warnings"]), "at 20 ms the default holds more than a second"
    run = talk.wait(0.5).finish()
    assert run.status == 0
    check_conservation(run)
    assert run.named("EstGranted")[0].values["mlock"] == 0


def test_a_send_buffer_too_small_for_a_second_is_a_warning(hub):
    def without_net_admin() -> None:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_NET_ADMIN, 0, 0, 0)

    limit = 2 * int(Path("/proc/sys/net/core/wmem_max").read_text())
    talk = OnBus(hub.bus, binary("release"), "--no-rt", "--period-us", "1000", preexec_fn=without_net_admin)
    assert any("send buffer" in w for w in talk.ready["warnings"]) == (limit < 4010 * 800)
    assert talk.wait(0.2).finish().status == 0


def test_core_that_does_not_exist_is_a_warning(hub):
    talk = OnBus(hub.bus, binary("release"), "--core", "1000", "--period-us", "20000")
    assert talk.ready["core"] is None
    assert any("core 1000 is not available" in w for w in talk.ready["warnings"])
    run = talk.wait(0.3).finish()
    assert run.status == 0
    assert run.named("EstGranted")[0].values["core"] is None


def test_no_rt_asks_for_nothing(hub):
    talk = OnBus(hub.bus, binary("release"), "--no-rt", "--period-us", "20000")
    assert (talk.ready["policy"], talk.ready["mlock"], talk.ready["warnings"]) == ("other", False, [])
    assert talk.wait(0.2).finish().status == 0


def test_no_heap_and_no_page_fault_in_the_loop(hub, tmp_path):
    library, count = tmp_path / "malloc_counter.so", tmp_path / "count"
    source = Path(__file__).with_name("malloc_counter.c")
    subprocess.run(["gcc", "-O1", "-fPIC", "-shared", "-o", library, source, "-ldl"], check=True)
    env = {**os.environ, "LD_PRELOAD": str(library), "MALLOC_COUNTER": str(count)}
    talk = OnBus(hub.bus, binary("release"), "--period-us", "2000", env=env)
    run = talk.wait(4.5).finish()
    assert run.status == 0
    sleeps, allocations = map(int, count.read_text().split())
    assert sleeps >= run.final["jobs"] > 500
    assert allocations == 0, f"{allocations} heap calls in {sleeps} periods"
    assert run.named("Estimate")[-1].values["status"] == OK, "the whole estimator was at work"
    if run.ready["mlock"]:
        assert run.final["faults"] == {"minor": 0, "major": 0}
    else:
        print("memory is not locked here: page faults not judged", file=sys.stderr)


def test_a_ready_line_that_nobody_gets_is_one_line_and_exit_1(hub):
    with open("/dev/full", "w") as full:
        for args in (["--help"], ["--bus", hub.bus, "--no-rt"]):
            done = subprocess.run(
                [binary("release"), *args], stdout=full, stderr=subprocess.PIPE, text=True, timeout=10, check=False
            )
            assert done.returncode == 1
            assert done.stderr.startswith("rt_estimator: stdout: cannot write the ")
            assert len(done.stderr.splitlines()) == 1


def test_a_final_line_that_nobody_gets_is_one_line_and_exit_1(hub, tmp_path):
    """The file may grow to the ready line and no further."""
    limit = 'ulimit -f 1; trap "" XFSZ; exec "$@"'
    with (tmp_path / "out").open("w") as out:
        out.write("x" * 200)  # bash counts in units of 1024 bytes: the ready line fits, the final one does not
        out.flush()
        process = subprocess.Popen(["bash", "-c", limit, "-", binary("release"), "--bus", hub.bus, "--no-rt"],
                                   stdout=out, stderr=subprocess.PIPE, text=True)  # fmt: skip
        while "ready" not in (tmp_path / "out").read_text():
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        process.terminate()
        _, err = process.communicate(timeout=20)
    assert process.returncode == 1
    assert err.startswith("rt_estimator: stdout: cannot write the final line")
    assert len(err.splitlines()) == 1


def test_a_set_up_that_needs_the_bus_says_so_and_leaves_nothing(tmp_path):
    done = subprocess.run(
        [binary("release"), "--bus", f"rt_hub:{tmp_path}/none.sock"],
        capture_output=True,
        text=True,
        timeout=10,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())
