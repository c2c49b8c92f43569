"""The DBC lint: each rule is fired by a DBC that has just this fault, and ours has none."""

import cantools
import pytest

from rt_runner.dbc import DEFAULT_DBC, DbcError
from rt_runner.lint_dbc import RULES, lint, main

GOOD = DEFAULT_DBC.read_text(encoding="ascii")
MOTOR_IDS = next(line for line in GOOD.splitlines() if line.startswith('BA_ "HilDataIdList" BO_ 160 '))
TEMP_IDS = next(line for line in GOOD.splitlines() if line.startswith('BA_ "HilDataIdList" BO_ 416 '))
SPEED = ' SG_ speed_rpm : 32|16@1+ (0.25,0) [0|16383.5] "rpm"'
TORQUE = ' SG_ torque_nm : 16|16@1- (0.01,0) [-327.67|327.67] "Nm"'

# rule, what to replace, by what, whether cantools' strict mode lets it through
BROKEN = [
    ("factor", SPEED, SPEED.replace("(0.25,0)", "(0,0)"), True),
    ("encoding", TORQUE, TORQUE.replace("16|16@1-", "23|16@0-"), True),
    ("c_name", "speed_rpm", "register", True),
    ("snake_case", "speed_rpm", "TorqueNm", True),
    ("limits", SPEED, SPEED.replace("16383.5", "20000"), True),
    ("limits", SPEED, SPEED.replace("[0|", "[-1|"), True),
    ("limits", SPEED, SPEED.replace("[0|16383.5]", "[500|100]"), True),
    ("limits", SPEED, SPEED.replace("16383.5", "16383.75"), True),  # the not-available code would be valid
    ("labels", 'VAL_ 160 speed_rpm 65535 "', 'VAL_ 160 speed_rpm 65536 "', True),
    ("not_available", 'VAL_ 160 speed_rpm 65535 "not_available" ;', "", True),
    ("not_available", "VAL_ 160 torque_nm -32768 ", "VAL_ 160 torque_nm 32767 ", True),
    ("start_value", "SG_ 160 torque_nm -32768;", "SG_ 160 torque_nm 99999;", True),
    ("start_value", "SG_ 672 status 15;", "SG_ 672 status 9;", True),
    ("cycle_time", 'BA_ "GenMsgCycleTime" BO_ 160 10;', "", True),
    ("cycle_time", 'BA_ "HilTimeoutMs" BO_ 160 50;', "", True),
    ("cycle_time", 'BA_ "HilTimeoutMs" BO_ 160 50;', 'BA_ "HilTimeoutMs" BO_ 160 9;', True),
    ("frame_id", " 416 ", " 160 ", True),
    ("frame_id", " 416 ", " 2147484064 ", True),
    ("length", "BO_ 160 MotorState: 8", "BO_ 160 MotorState: 16", True),
    ("length", " SG_ tick : 48|16@1+", " SG_ tick : 50|16@1+", False),
    ("overlap", " SG_ torque_nm : 16|16@1-", " SG_ torque_nm : 8|16@1-", False),
    ("node", "BO_ 160 MotorState: 8 PLANT", "BO_ 160 MotorState: 8 Vector__XXX", True),
    ("node", '[0|16383.5] "rpm" ESTIMATOR,CONTROLLER,LOGGER', '[0|16383.5] "rpm" GATEWAY', True),
    ("comment", 'CM_ SG_ 160 speed_rpm "Mechanical speed of the rotor. Unit: rpm.";', "", True),
    ("comment", "Source: 70-node thermal network.", "", True),
    ("unit", '[0|16383.5] "rpm"', '[0|16383.5] "1/min"', True),
    ("protection", 'BA_ "HilCounterSignal" BO_ 160 "counter";', "", True),
    ("protection", 'BA_ "HilCrcSignal" BO_ 160 "crc";', 'BA_ "HilCrcSignal" BO_ 160 "tick";', True),
    ("data_ids", MOTOR_IDS, "", True),
    ("data_ids", MOTOR_IDS, MOTOR_IDS.replace('160 "', '160 "A'), True),
    ("data_ids", TEMP_IDS, MOTOR_IDS.replace("BO_ 160", "BO_ 416"), True),
    ("data_ids", TEMP_IDS, TEMP_IDS[:-35] + '"E914606A6653F6BAB27063C2287C317D";', True),  # counter 0 passes as 9
    ("truth", 'BA_ "HilSimulationOnly" BO_ 1696 1;', "", True),
    ("truth", '[0|4094] "us" LOGGER', '[0|4094] "us" ESTIMATOR,LOGGER', True),
]  # fmt: skip


def test_our_dbc_is_clean():
    assert lint(DEFAULT_DBC.read_bytes()) == []


@pytest.mark.parametrize(("rule", "before", "after", "strict_is_blind"), BROKEN)
def test_rule_fires(rule, before, after, strict_is_blind):
    assert before in GOOD
    everywhere = rule in ("c_name", "snake_case", "frame_id")  # names and ids stand in comments and labels, too
    text = GOOD.replace(before, after, -1 if everywhere else 1)
    findings = lint(text.encode())
    assert rule in {f.rule for f in findings}
    try:
        cantools.database.load_string(text, database_format="dbc", strict=True)
        blind = True
    except cantools.database.Error:
        blind = False
    assert blind == strict_is_blind


def test_every_rule_has_a_fault_that_fires_it():
    assert {rule for rule, *_ in BROKEN} == set(RULES)


def test_same_data_id_lists_are_named_with_both_messages():
    text = GOOD.replace(TEMP_IDS, MOTOR_IDS.replace("BO_ 160", "BO_ 416"))
    finding = next(f for f in lint(text.encode()) if f.rule == "data_ids")
    assert "MotorState" in finding.where
    assert "TempMeas" in finding.where


def test_command_line(tmp_path, capsys):
    assert main([str(DEFAULT_DBC)]) == 0
    broken = tmp_path / "broken.dbc"
    broken.write_text(GOOD.replace(SPEED, SPEED.replace("(0.25,0)", "(0,0)")))
    assert main([str(broken)]) == 1
    assert "factor: MotorState.speed_rpm" in capsys.readouterr().out
    assert main([str(tmp_path / "none.dbc")]) == 1
    assert "cannot read it" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"\xff\xfe", b"BO_ x"])
def test_no_dbc_at_all(content, tmp_path, capsys):
    with pytest.raises(DbcError):
        lint(content)
    path = tmp_path / "x.dbc"
    path.write_bytes(content)
    assert main([str(path)]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
