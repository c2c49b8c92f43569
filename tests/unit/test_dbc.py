"""The DBC: it says what the project agreed on, and a broken one is refused with one clear line."""

import hashlib
import tomllib
from pathlib import Path

import cantools
import pytest

from rt_runner.dbc import DEFAULT_DBC, DbcError, load_dbc, parse_dbc
from rt_runner.result import CAUSES

SETTINGS = Path(__file__).resolve().parents[2] / "estimator_c" / "settings"

# name: id, sender, cycle ms, {signal: (start, length, signed, factor, offset, has not_available)}
U16, S16 = (16, False), (16, True)
CONTRACT = {
    "MotorState": (0x0A0, "PLANT", 10, {
        "derating_active": (12, 1, False, 1, 0, False), "torque_nm": (16, *S16, 0.01, 0, True),
        "speed_rpm": (32, *U16, 0.25, 0, True), "tick": (48, *U16, 1, 0, False)}),
    "TempMeas": (0x1A0, "PLANT", 100, {
        "theta_w_meas_degc": (16, *U16, 1 / 64, -100, True), "theta_r_meas_degc": (32, *U16, 1 / 64, -100, True),
        "tick": (48, *U16, 1, 0, False)}),
    "Reference": (0x1B0, "PLANT", 100, {
        "speed_demand_mps": (16, *U16, 0.001, 0, True), "slope_rad": (32, *S16, 0.0001, 0, True),
        "tick": (48, *U16, 1, 0, False)}),
    "Coolant": (0x1C0, "PLANT", 1000, {
        "soaked": (12, 1, False, 1, 0, False), "coolant_degc": (16, *U16, 1 / 64, -100, True),
        "ambient_degc": (32, *U16, 1 / 64, -100, True), "tick": (48, *U16, 1, 0, False)}),
    "Estimate": (0x2A0, "ESTIMATOR", 100, {
        "status": (12, 4, False, 1, 0, True), "theta_w_est_degc": (16, *U16, 1 / 256, -50, True),
        "theta_r_est_degc": (32, *U16, 1 / 256, -50, True), "tick": (48, *U16, 1, 0, False)}),
    "EstimateInnov": (0x2A1, "ESTIMATOR", 100, {
        "sweeps": (12, 4, False, 1, 0, False), "innov_w_degc": (16, *S16, 1 / 256, 0, True),
        "innov_r_degc": (32, *S16, 1 / 256, 0, True), "tick": (48, *U16, 1, 0, False)}),
    "EstValidity": (0x2A2, "ESTIMATOR", 100, {
        "outside_speed": (12, 1, False, 1, 0, False), "outside_torque": (13, 1, False, 1, 0, False),
        "outside_theta_w": (14, 1, False, 1, 0, False), "outside_theta_r": (15, 1, False, 1, 0, False),
        "outside_joint": (16, 1, False, 1, 0, False), "scope": (17, 2, False, 1, 0, False),
        "novelty": (32, *U16, 0.001, 0, True), "tick": (48, *U16, 1, 0, False)}),
    **{name: (can_id, "ESTIMATOR", 100, {
        f"sensor_{c}_fault": (12, 3, False, 1, 0, False), f"sensor_{c}_trusted": (15, 1, False, 1, 0, False),
        f"sigma_{c}_degc": (16, *U16, 0.001, 0, True), f"upper_{c}_degc": (32, *U16, 1 / 256, -50, True),
        "tick": (48, *U16, 1, 0, False)})
       for name, can_id, c in (("EstWinding", 0x2A3, "w"), ("EstRotor", 0x2A4, "r"))},
    "EstTimingA": (0x2A8, "ESTIMATOR", 100, {
        "miss_late": (12, 1, False, 1, 0, False), "warmup": (13, 1, False, 1, 0, False),
        "stale_input": (14, 1, False, 1, 0, False), "after_skip": (15, 1, False, 1, 0, False),
        "release_index": (16, 24, False, 1, 0, False), "wake_lat_us": (40, 24, False, 0.1, 0, True)}),
    "EstTimingB": (0x2A9, "ESTIMATOR", 100, {
        "miss_cause": (12, 4, False, 1, 0, True), "exec_wall_us": (16, 24, False, 0.1, 0, True),
        "resp_us": (40, 24, False, 0.1, 0, True)}),
    "EstTimingC": (0x2AA, "ESTIMATOR", 100, {
        "output": (12, 2, False, 1, 0, False), "cut": (14, 1, False, 1, 0, False),
        "queued": (15, 1, False, 1, 0, False), "in_age_motor_us": (16, 24, False, 0.1, 0, True),
        "in_age_temp_us": (40, 24, False, 0.1, 0, True)}),
    "EstTimingD": (0x2AB, "ESTIMATOR", 100, {
        "exec_cpu_us": (16, 24, False, 0.1, 0, True), "canary_us": (40, 24, False, 0.1, 0, True)}),
    "EstReleases": (0x4A0, "ESTIMATOR", 1000, {
        "releases": (16, 24, False, 1, 0, False), "jobs": (40, 24, False, 1, 0, False)}),
    "EstMisses": (0x4A1, "ESTIMATOR", 1000, {
        n: (s, *U16, 1, 0, False) for n, s in (("miss_late", 16), ("miss_skipped", 32), ("overrun", 48))}),
    "EstInputFaults": (0x4A2, "ESTIMATOR", 1000, {
        n: (s, *U16, 1, 0, False) for n, s in (("crc_errors", 16), ("seq_errors", 32), ("stale_inputs", 48))}),
    "EstBusFaults": (0x4A3, "ESTIMATOR", 1000, {
        n: (s, *U16, 1, 0, False) for n, s in (("rx_drops", 16), ("tx_drops", 32), ("rejected", 48))}),
    "EstCoreFaults": (0x4A4, "ESTIMATOR", 1000, {
        "stray_ticks": (12, 4, False, 1, 0, False),
        "restarts": (16, *U16, 1, 0, False), "held_intervals": (32, *U16, 1, 0, False),
        "late_measurements": (48, *U16, 1, 0, False)}),
    "EstCoreFaults2": (0x4A5, "ESTIMATOR", 1000, {
        "repeated_ticks": (12, 4, False, 1, 0, False),
        "off_grid": (16, *U16, 1, 0, False), "invalid_inputs": (32, *U16, 1, 0, False),
        "unconverged": (48, *U16, 1, 0, False)}),
    "EstCalibration": (0x4A6, "ESTIMATOR", 1000, {
        "calibration_state": (12, 4, False, 1, 0, False), "offset_w_degc": (16, *S16, 1 / 256, 0, True),
        "offset_r_degc": (32, *S16, 1 / 256, 0, True), "offset_sigma_w_degc": (48, 8, False, 0.005, 0, True),
        "offset_sigma_r_degc": (56, 8, False, 0.005, 0, True)}),
    "EstOverload": (0x4A7, "ESTIMATOR", 1000, {
        "waiting": (12, 4, False, 1, 0, False),
        **{n: (s, *U16, 1, 0, False) for n, s in (("queued", 16), ("cut", 32), ("rebased", 48))}}),
    **{name: (can_id, "ESTIMATOR", 1000, {n: (s, *U16, 1, 0, False) for n, s in zip(names, (16, 32, 48), strict=True)})
       for name, can_id, names in (("EstOutputs", 0x4A9, ("held", "predicted", "invalidated")),
                                   ("EstEnvironment", 0x4AA, ("minor_faults", "major_faults", "invol_switches")))},
    "EstMissRun": (0x4A8, "ESTIMATOR", 1000, {
        "consec_miss_max": (16, *U16, 1, 0, False), "mk_worst": (32, 8, False, 1, 0, False),
        "phase_us": (40, 24, False, 1, 0, True)}),
    "EstMachine": (0x4AB, "ESTIMATOR", 1000, {
        "run_delay_ms": (16, *U16, 0.1, 0, True), "steal_ms": (32, *U16, 10, 0, True),
        "migrations": (48, *U16, 1, 0, False)}),
    **{name: (can_id, "ESTIMATOR", 1000, {
        f"{of}p99_us": (16, 24, False, 0.1, 0, True), f"{of}max_us": (40, 24, False, 0.1, 0, True)})
       for name, can_id, of in (("EstCanary", 0x4AC, "canary_"), ("EstWakeStat", 0x4AD, ""),
                                ("EstExecStat", 0x4AE, ""), ("EstRespStat", 0x4AF, ""))},
    "TruthTemp": (0x6A0, "PLANT", 100, {
        "theta_w_true_degc": (12, 18, False, 1 / 512, -100, True),
        "theta_r_true_degc": (30, 18, False, 1 / 512, -100, True), "tick": (48, *U16, 1, 0, False)}),
    "TruthVehicle": (0x6A1, "PLANT", 100, {
        "v_true_mps": (12, 16, False, 0.001, 0, True), "distance_m": (28, 20, False, 0.1, 0, True),
        "tick": (48, *U16, 1, 0, False)}),
    "TruthFault": (0x6A2, "PLANT", 100, {
        "fault_w": (16, *U16, 1, 0, False), "fault_r": (32, *U16, 1, 0, False), "tick": (48, *U16, 1, 0, False)}),
    "PlantSample": (0x6A3, "PLANT", 10, {
        "sample_us": (12, 24, False, 1, 0, True), "send_us": (36, 12, False, 1, 0, True),
        "tick": (48, *U16, 1, 0, False)}),
    "PlantStatus": (0x6B0, "PLANT", 1000, {
        "ticks_late": (16, *U16, 1, 0, False), "late_max_ms": (32, *U16, 0.1, 0, True),
        "tx_retries": (48, *U16, 1, 0, False)}),
    "EstIdentity": (0x7A0, "ESTIMATOR", 10000, {
        "dbc_hash": (16, 24, False, 1, 0, False), "weights_hash": (40, 24, False, 1, 0, False)}),
    "EstBuild": (0x7A1, "ESTIMATOR", 10000, {
        "build_hash": (16, 24, False, 1, 0, False), "setting_id": (40, 8, False, 1, 0, True)}),
    "EstGranted": (0x7A2, "ESTIMATOR", 10000, {
        "policy": (12, 4, False, 1, 0, False), "priority": (16, 8, False, 1, 0, True),
        "core": (24, 8, False, 1, 0, True), "mlock": (32, 1, False, 1, 0, False),
        "period_us": (40, 24, False, 1, 0, True)}),
    "PlantIdentity": (0x7B0, "PLANT", 10000, {
        "params_hash": (16, 24, False, 1, 0, False), "scenario_hash": (40, 24, False, 1, 0, False)}),
    "TorqueCommand": (0x0B0, "CONTROLLER", 100, {
        "derating": (12, 1, False, 1, 0, False), "origin": (13, 2, False, 1, 0, False),
        "clamped": (15, 1, False, 1, 0, False), "torque_acc_nm": (16, 11, False, 0.1, 0, True),
        "torque_brk_nm": (27, 10, False, 0.1, 0, True), "torque_fric_nm": (37, 11, False, 0.25, 0, True),
        "tick": (48, *U16, 1, 0, False)}),
    "VehicleState": (0x1D0, "PLANT", 100, {
        "v_mps": (12, 16, False, 0.001, 0, True), "distance_m": (28, 20, False, 0.1, 0, True),
        "tick": (48, *U16, 1, 0, False)}),
    "CtlState": (0x2B0, "CONTROLLER", 100, {
        "solver_status": (12, 4, False, 1, 0, True), "theta_w_peak_degc": (16, *U16, 1 / 256, -50, True),
        "theta_w_end_degc": (32, *U16, 1 / 256, -50, True), "tick": (48, *U16, 1, 0, False)}),
    "CtlSolve": (0x2B1, "CONTROLLER", 100, {
        "sweeps": (12, 4, False, 1, 0, False), "slack_degc": (16, *U16, 1 / 256, 0, True),
        "margin_degc": (32, *U16, 1 / 256, 0, True), "tick": (48, *U16, 1, 0, False)}),
    **{name: (can_id, "CONTROLLER", 1000, {
        nibble: (12, 4, False, 1, 0, False),
        **{n: (s, *U16, 1, 0, False) for n, s in zip(names, (16, 32, 48), strict=True)}})
       for name, can_id, nibble, names in (
           ("CtlFallbacks", 0x4B4, "mute", ("shifted", "by_rule", "clamped")),
           ("CtlSolves", 0x4B5, "bad_inputs", ("failed", "unconverged", "no_estimate")))},
    **{name: (can_id, "CONTROLLER", 1000, {n: (s, *U16, 1, 0, False) for n, s in zip(names, (16, 32, 48), strict=True)})
       for name, can_id, names in (("CtlInputFaults", 0x4B2, ("crc_errors", "seq_errors", "stale_inputs")),
                                   ("CtlBusFaults", 0x4B3, ("rx_drops", "tx_drops", "rejected")))},
    "PlantControl": (0x6B1, "PLANT", 1000, {
        "obeys": (12, 2, False, 1, 0, False), "commands": (16, *U16, 1, 0, False),
        "refused": (32, *U16, 1, 0, False), "fallback_ticks": (48, *U16, 1, 0, False)}),
    "CtlIdentity": (0x7A8, "CONTROLLER", 10000, {
        "dbc_hash": (16, 24, False, 1, 0, False), "weights_hash": (40, 24, False, 1, 0, False)}),
    "CtlBuild": (0x7A9, "CONTROLLER", 10000, {
        "controller_id": (12, 4, False, 1, 0, False), "build_hash": (16, 24, False, 1, 0, False),
        "preview_hash": (40, 24, False, 1, 0, False)}),
}  # fmt: skip

# The controller's loop tells its timing in the estimator's layout: what sends it packs both with the same code.
TIMING = ("TimingA", "TimingB", "TimingC", "TimingD", "Releases", "Misses", "Overload", "MissRun", "Outputs",
          "Environment", "Machine", "Canary", "WakeStat", "ExecStat", "RespStat", "Granted")  # fmt: skip
OTHER_NAME = {"in_age_temp_us": "in_age_estimate_us"}


def shifted(name: str) -> tuple:
    can_id, _, cycle, signals = CONTRACT[f"Est{name}"]
    by = 8 if name == "Granted" else 16
    return can_id + by, "CONTROLLER", cycle, {OTHER_NAME.get(n, n): layout for n, layout in signals.items()}


CONTRACT.update({f"Ctl{name}": shifted(name) for name in TIMING})


def test_the_file_is_the_agreed_contract():
    dbc = load_dbc()
    found = {
        m.name: (m.frame_id, m.sender, m.cycle_ms, {
            s.name: (s.start, s.length, s.is_signed, s.factor, s.offset, s.raw_na is not None) for s in m.payload
        })
        for m in dbc
    }  # fmt: skip
    assert found == CONTRACT
    assert all(m.length == 8 and not m.codec.is_extended_frame for m in dbc)
    assert {m.name for m in dbc if m.simulation_only} == {"TruthTemp", "TruthVehicle", "TruthFault", "PlantSample"}
    content = {"Estimate", "EstimateInnov", "EstValidity", "EstWinding", "EstRotor"}
    content |= {"TorqueCommand", "CtlState", "CtlSolve"}
    assert {m.name for m in dbc if m.per_job} == content | {f"{who}Timing{x}" for who in ("Est", "Ctl") for x in "ABCD"}
    assert dbc["EstBuild"].signals[-1].raw_max == 254, "any setting has a number"


def test_cantools_loads_it_strictly_and_shows_labels():
    db = cantools.database.load_file(DEFAULT_DBC, strict=True)

    def labels(message: str, signal: str) -> dict[int, str]:
        return {int(k): str(v) for k, v in db.get_message_by_name(message).get_signal_by_name(signal).choices.items()}

    assert labels("Estimate", "status") == {
        0: "init", 1: "starting", 2: "ok", 3: "predicting", 4: "input_stale", 5: "invalid", 6: "open_loop",
        7: "fallback", 15: "not_available",
    }  # fmt: skip
    classes = dict(enumerate(("ok", "offset", "noise", "stuck", "dropout", "spike", "drift", "slow")))
    assert labels("EstWinding", "sensor_w_fault") == labels("EstRotor", "sensor_r_fault") == classes
    states = dict(enumerate(("datasheet", "measuring", "frozen", "refused")))
    assert labels("EstCalibration", "calibration_state") == states
    causes = {**dict(enumerate(CAUSES)), 15: "not_available"}
    assert labels("EstTimingB", "miss_cause") == causes
    assert labels("EstTimingC", "output") == dict(enumerate(("computed", "held", "predicted", "invalid")))


def test_every_setting_of_the_estimator_has_its_label():
    labels = next(s.labels for s in load_dbc()["EstBuild"].signals if s.name == "setting_id")
    settings = {tomllib.loads(p.read_text())["id"]: p.stem for p in SETTINGS.glob("*.toml")}
    assert {code: label for code, label in labels.items() if label != "not_available"} == settings


TIMING = (*(f"Timing{x}" for x in "ABCD"), "Releases", "Misses", "Overload", "MissRun", "Outputs", "Environment",
          "Machine", "Canary", "WakeStat", "ExecStat", "RespStat")  # fmt: skip


def test_every_process_has_the_timing_frames_in_one_layout():
    """One encoder in C packs them for all: only ids, data ids and the names of a process's inputs differ."""
    dbc = load_dbc()

    def layout(name: str) -> list[tuple]:
        return [(s.start, s.length, s.is_signed, s.factor, s.offset, s.raw_na) for s in dbc[name].signals]

    prefixes = {m.name.removesuffix("TimingA") for m in dbc if m.name.endswith("TimingA")}
    assert "Est" in prefixes
    for prefix in prefixes:
        for name in TIMING:
            assert layout(prefix + name) == layout("Est" + name), prefix + name


def test_not_available_is_all_ones_or_most_negative_and_never_a_valid_code():
    for message in load_dbc():
        for s in message.signals:
            if s.raw_na is not None:
                assert s.raw_na == (-(1 << s.length - 1) if s.is_signed else (1 << s.length) - 1)
                assert not s.raw_min <= s.raw_na <= s.raw_max
                assert s.raw_start == s.raw_na, "before anything was measured there is nothing to show"


def test_hash_is_the_file_s():
    digest = hashlib.sha256(DEFAULT_DBC.read_bytes()).hexdigest()
    assert load_dbc().sha256 == digest
    assert load_dbc().hash24 == int(digest, 16) >> 232


def test_max_delta_follows_from_the_timeout():
    assert {m.name: m.max_delta for m in load_dbc()}["MotorState"] == 5
    assert all(1 <= m.max_delta <= 14 for m in load_dbc())


def test_unknown_message_name_lists_the_known_ones():
    with pytest.raises(DbcError, match="Estimate"):
        load_dbc()["estimate"]


GOOD = DEFAULT_DBC.read_text(encoding="ascii")


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("BO_ 160 MotorState", "BO_ 160 Motor State", "not a usable DBC"),
        (": 16|16@1- (0.01,0)", ": 60|16@1- (0.01,0)", "not a usable DBC"),  # runs out of the frame
        ('BA_ "GenMsgCycleTime" BO_ 160 10;', "", "MotorState has no attribute GenMsgCycleTime"),
        ('BA_ "HilTimeoutMs" BO_ 160 50;', 'BA_ "HilTimeoutMs" BO_ 160 0;', "HilTimeoutMs is 0"),
        ('BA_ "HilCrcSignal" BO_ 160 "crc";', 'BA_ "HilCrcSignal" BO_ 160 "crc8";', "needs the CRC"),
        ('BA_ "HilDataIdList" BO_ 160 "', 'BA_ "HilDataIdList" BO_ 160 "00', "not 16 bytes"),
        (" (0.25,0) ", " (0,0) ", "factor 0"),
        (" torque_nm : 16|16@1-", " torque_nm : 23|16@0-", "little-endian"),
    ],
)
def test_a_broken_dbc_is_one_clear_line(tmp_path, before, after, says):
    assert before in GOOD
    path = tmp_path / "broken.dbc"
    path.write_text(GOOD.replace(before, after, 1), encoding="ascii")
    with pytest.raises(DbcError) as caught:
        load_dbc(path)
    text = str(caught.value)
    assert says in text
    assert str(path) in text
    assert "\n" not in text


@pytest.mark.parametrize("content", [b"", b"not a dbc", b"\x00\xff" * 50, b'VERSION ""\n'])
def test_what_is_no_dbc_is_refused(content):
    with pytest.raises(DbcError):
        parse_dbc(content, "x.dbc")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(DbcError, match="cannot read the DBC"):
        load_dbc(tmp_path / "none.dbc")
