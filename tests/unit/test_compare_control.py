"""The comparison of controllers: its document's form, its table, what it refuses; ten seconds stand for the lap."""

import json

import pytest

from tools import compare_control_table as table
from tools.compare_control import main

KEYS = {"lap_s", "energy_kwh", "theta_w_max_degc", "ks_above_155", "v_rms", "solve_us"}


def run(*words: str) -> int:
    return main([*words, "--seconds", "10", "--workers", "0"])


def test_the_document_has_the_promised_form(tmp_path, capsys):
    out, doc = tmp_path / "x.json", tmp_path / "x.md"
    doc.write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    words = ("--controllers", "none,rule-150-155", "--feedback", "ideal,raw", "--cases", "nominal,noise")
    assert run(*words, "--json", str(out), "--doc", str(doc)) == 0
    found = json.loads(out.read_text())
    assert list(found) == ["none", "rule-150-155"]
    for feedbacks in found.values():
        assert list(feedbacks) == ["ideal", "raw"]
        for cases in feedbacks.values():
            assert list(cases) == ["nominal", "noise"]
            assert all(set(f) == KEYS and set(f["solve_us"]) == {"p50", "p99", "max"} for f in cases.values())
    text = doc.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert text.count("| none |") == 4
    assert "not finished" in capsys.readouterr().out


def test_who_hears_nothing_drives_alike_whatever_the_sensors_do(tmp_path):
    out = tmp_path / "x.json"
    words = ("--controllers", "none", "--feedback", "ideal,raw,default", "--cases", "nominal")
    assert run(*words, "--json", str(out)) == 0
    laps = [json.dumps(cases["nominal"]) for cases in json.loads(out.read_text())["none"].values()]
    assert len(set(laps)) == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--controllers", "mpc-XL"), "choose from none, rule-150-155"),
        (("--feedback", "hearsay"), "choose from ideal, raw, paper, default"),
        (("--cases", ""), "choose from nominal"),
        (("--seed", "-1"), "give 0 or more"),
        (("--doc", "{empty}"), "needs one line"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, capsys, words, says):
    empty = tmp_path / "empty.md"
    empty.write_text("nothing\n")
    assert run(*(w.format(empty=empty) for w in words)) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert says in lines[0]


def test_a_lap_against_the_one_without_derating():
    figures = {"energy_kwh": 5.0, "theta_w_max_degc": 160.0, "ks_above_155": 1.0, "v_rms": 1.0,
               "solve_us": {"p50": 1.0, "p99": 2.0, "max": 3.0}}  # fmt: skip
    found = {"none": {"ideal": {"nominal": {"lap_s": 700.0, **figures}}},
             "mpc-M": {"ideal": {"nominal": {"lap_s": 707.0, **figures}}}}  # fmt: skip
    assert "+1.00 %" in table.markdown(found)
    assert "+0.00 %" in table.markdown(found)
