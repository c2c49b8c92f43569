"""Transfer to a measured motor: what is known, what is predicted, and that it runs on the real drive."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from estimator_c.formulation.weights import load_weights
from tools.evaluate import Rows, open_loop

if os.environ.get("RT_REQUIRE_TORCH") == "1":
    import torch  # noqa: F401
else:
    pytest.importorskip("torch", reason="torch is absent (extra `train`): transfer is NOT tested here")
pytest.importorskip("matplotlib", reason="matplotlib is absent (extra `train`): transfer is NOT tested here")

from tools import transfer

NET = Path(__file__).parents[2] / "estimator_c" / "weights" / "lstm8.json"


def rows_of(n: int) -> Rows:
    t = 0.1 * np.arange(n)
    x = np.stack((5000.0 + 0.0 * t, 60.0 + 30.0 * np.sin(t / 30.0), 60.0 + 0.05 * t, 60.0 + 0.02 * t), axis=1)
    return Rows(x, np.tile([0.05, 0.02], (n, 1)), np.zeros(n, int), "ab" * 32)


def drive() -> Path:
    folder = os.environ.get("RT_REFERENCE_DATA")
    path = Path(folder or "") / transfer.REFERENCE
    if folder is None or not path.exists():
        if os.environ.get("RT_REQUIRE_REFERENCE") == "1":
            pytest.fail("RT_REQUIRE_REFERENCE=1, but RT_REFERENCE_DATA does not hold the measured drive")
        pytest.skip("RT_REFERENCE_DATA is not set: transfer to the measured motor is NOT tested here")
    return path


def test_prediction_knows_no_temperature_after_the_split():
    """The rest of the drive may be anything: the open loop takes only its speed and torque."""
    net, rows, split = load_weights(NET), rows_of(900), 400
    other = rows.x.copy()
    other[split + 1 :, 2:] += 50.0
    theta = transfer.predict(net, rows, split)[1]
    assert np.array_equal(theta, transfer.predict(net, Rows(other, rows.rates_degc_s, rows.trajectory, ""), split)[1])
    assert np.array_equal(theta[0], rows.x[split, 2:])
    faster = rows.x.copy()
    faster[split + 50 :, 0] += 2000.0
    assert not np.allclose(
        theta[-1], transfer.predict(net, Rows(faster, rows.rates_degc_s, rows.trajectory, ""), split)[1][-1]
    )


def test_prediction_from_the_start_is_the_open_loop_of_the_evaluation():
    net, rows = load_weights(NET), rows_of(700)
    np.testing.assert_allclose(transfer.predict(net, rows, 0)[1], open_loop(net, rows.x), rtol=0, atol=1e-12)


def test_figures_by_hand():
    rows, split = rows_of(900), 400
    theta = rows.x[split:, 2:] + np.array([2.0, -1.0])
    theta[7, 1] += 5.0
    outcome = transfer.judge(transfer.ways(1, 1)[0], 40.0, rows.rates_degc_s[split:] + 0.25, theta, rows, split)
    assert outcome.rate_rmse_degc_s == pytest.approx((0.25, 0.25))
    assert outcome.open_loop_rmse_degc == pytest.approx((2.0, np.sqrt((499 + 16) / 500)))
    assert outcome.open_loop_max_degc == pytest.approx((2.0, 4.0))


def test_learning_sees_only_the_first_part(monkeypatch):
    seen = []

    def spy(rows, settings, start=None):
        seen.append((len(rows.x), start is not None, settings.trained))
        raise KeyboardInterrupt

    monkeypatch.setattr(transfer, "fit", spy)
    rows, net = rows_of(900), load_weights(NET)
    for way in transfer.ways(5, 1)[1:]:
        with pytest.raises(KeyboardInterrupt):
            transfer.learn(way, transfer.first_part(rows, 400), net)
    assert seen == [(400, True, "head"), (400, True, "all"), (400, False, "all")]
    assert transfer.learn(transfer.ways(5, 1)[0], transfer.first_part(rows, 400), net) is net


def test_without_reference_data_one_line_says_what_to_do(monkeypatch, capsys):
    monkeypatch.delenv("RT_REFERENCE_DATA", raising=False)
    assert transfer.main([]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "RT_REFERENCE_DATA" in message
    assert "--drive" in message


def test_fine_tuning_helps_on_the_measured_drive(tmp_path, capsys):
    lines = drive().read_text(encoding="utf-8").splitlines()[:801]  # 2000 s of it
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    out = tmp_path / "transfer"
    assert transfer.main(["--drive", str(path), "--split-s", "1000", "--epochs", "60", "--out", str(out)]) == 0
    outcomes = {o["way"]: o for o in json.loads(out.with_suffix(".json").read_text())["outcomes"]}
    assert len(outcomes) == 4
    untouched, tuned = (outcomes[w]["open_loop_rmse_degc"] for w in ("untouched", "all weights tuned"))
    assert tuned[0] < 0.7 * untouched[0]
    assert b"<svg" in out.with_suffix(".svg").read_bytes()
    assert "| 1000 | from scratch |" in capsys.readouterr().out
    assert transfer.main(["--drive", str(path), "--split-s", "1990", "--out", str(out)]) == 1
    assert "--split-s 1990" in capsys.readouterr().err
