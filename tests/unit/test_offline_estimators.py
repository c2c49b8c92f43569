"""The baselines: each against an independent, plain statement of what it is."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator_c.formulation.lstm_numpy import lstm_sequence, lstm_step
from estimator_c.formulation.weights import load_weights
from tests.support.nets import random_net
from tools.estimators import lptn
from tools.estimators.drive import DELAY_STEPS, Drive, interval_means, run, run_each
from tools.estimators.fixed_gain import FixedGain
from tools.estimators.lptn_kf import LptnKf
from tools.estimators.net import memory_size, pack, scratch_size, step
from tools.estimators.plain import MovingAverage
from tools.estimators.registry import GATED, OFFLINE, UnknownEstimator, make, offline
from tools.estimators.tuned import load_tuned
from tools.estimators.ukf import Ukf, square_root
from tools.libest import WEIGHTS

INF = math.inf
NET = load_weights(WEIGHTS)


def rolling_inputs(n, seed=0):
    """Smooth torque and speed of a lively drive, (10 n,) each."""
    rng, t = np.random.default_rng(seed), np.arange(10 * n) * 0.01
    torque = 60.0 + 50.0 * np.sin(t / 7.0 + rng.uniform(0, 6)) + 20.0 * np.sin(t / 1.7)
    speed = 5500.0 + 2500.0 * np.sin(t / 11.0 + rng.uniform(0, 6))
    return torque, speed


def net_truth(u, start, memory=None):
    """Temperatures (n, 2) at the nodes when the net itself is the plant, and its memory starts at zero or as given."""
    c, h = NET.empty_memory() if memory is None else memory
    theta = np.empty((len(u), 2))
    theta[0] = start
    for k in range(1, len(u)):
        c, h, rate = lstm_step(NET, np.concatenate([u[k], theta[k - 1]]), c, h)
        theta[k] = theta[k - 1] + 0.1 * rate
    return theta


def sensor(truth, rng=None, std=0.0):
    late = np.concatenate([np.repeat(truth[:1], DELAY_STEPS, axis=0), truth[:-DELAY_STEPS]])
    return late - 1.0 + (0.0 if rng is None else std * rng.standard_normal(truth.shape))


def drive_of(n=600, seed=0, std=0.3, start=(120.0, 90.0)):
    torque, speed = rolling_inputs(n, seed)
    u = interval_means(torque, speed)
    truth = net_truth(u, np.array(start))
    return Drive(torque, speed, u, sensor(truth, np.random.default_rng(seed), std)), truth


# ---- the compiled net -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("cell", ["lstm", "gru"])
@pytest.mark.parametrize(("hidden", "layers"), [(3, 1), (8, 1), (5, 2)])
def test_the_compiled_net_is_the_numpy_net(tmp_path, cell, hidden, layers):
    weights = load_weights(random_net(tmp_path, cell=cell, hidden=hidden, layers=layers))
    net, rng = pack(weights), np.random.default_rng(1)
    x = np.column_stack([rng.uniform(0, 11000, 40), rng.uniform(-80, 160, 40), np.full((40, 2), 100.0)])
    rates, c, h = lstm_sequence(weights, x)
    state = np.zeros(2 + memory_size(net))
    for row, rate in zip(x, rates, strict=True):
        state[:2] = row[2:]
        step(net, row[:2], state, np.empty(scratch_size(net)))
        np.testing.assert_allclose((state[:2] - row[2:]) / 0.1, rate, atol=1e-9)
    np.testing.assert_allclose(state[2:], np.concatenate([c if cell == "lstm" else c[:0], h]), atol=1e-12)


# ---- delay, offset, gain --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["fixed-gain", "ukf"])
def test_delay_and_offset_leave_no_error_when_the_net_is_the_plant(name):
    drive, truth = drive_of(std=0.0)
    error = np.abs(run(make(name), drive).theta_degc - truth)[300:]
    assert error.max() < 0.02  # the start's spin-up is all that is not known; it has faded
    late = np.abs(drive.y - truth)[300:]
    assert late.max() > 1.2


def test_the_fixed_gain_observer_is_its_equations():
    """Against a restatement that runs from the start for every estimate, on numpy's net."""
    drive, _ = drive_of(60)
    gain = np.array([0.1, 0.02])
    found = run(FixedGain("fixed-gain", pack(NET), (0.1, 0.02), (INF, INF)), drive).theta_degc
    y = drive.y + 1.0
    theta = y[:DELAY_STEPS].mean(axis=0)
    c, h = NET.empty_memory()
    for _ in range(5):
        c, h, _rate = lstm_step(NET, np.concatenate([drive.u[1], theta]), c, h)
    for row in range(DELAY_STEPS, 60):
        node = row - DELAY_STEPS
        if node > 0:
            c, h, rate = lstm_step(NET, np.concatenate([drive.u[node], theta]), c, h)
            theta = theta + 0.1 * rate
        theta = theta + gain * (y[row] - theta)
        now, c_now, h_now = theta, c, h
        for k in range(node + 1, row + 1):
            c_now, h_now, rate = lstm_step(NET, np.concatenate([drive.u[k], now]), c_now, h_now)
            now = now + 0.1 * rate
        np.testing.assert_allclose(found[row], now, atol=1e-9)
    assert np.isnan(found[:DELAY_STEPS]).all()


def test_a_gain_of_one_follows_the_sensor_and_zero_ignores_it():
    drive, _ = drive_of(80)
    y = drive.y + np.where(np.arange(80) >= 40, 30.0, 0.0)[:, None]
    moved = Drive(drive.torque_nm, drive.speed_rpm, drive.u, y)
    alone = FixedGain("open-loop", pack(NET), (0.0, 0.0), (INF, INF))
    np.testing.assert_array_equal(run(alone, drive).theta_degc, run(alone, moved).theta_degc)
    follower = FixedGain("follower", pack(NET), (1.0, 1.0), (INF, INF))
    jump = run(follower, moved).theta_degc[60] - run(follower, drive).theta_degc[60]
    assert (jump > 27.0).all()


# ---- Kalman filters -------------------------------------------------------------------------------------------------
def test_the_ukf_is_a_kalman_filter_where_the_model_is_linear():
    """A net whose cells do nothing has constant rates: then the exact filter is two scalar ones."""
    quiet = pack(NET)._replace(w_y=np.zeros((2, NET.hidden)), b_y=np.array([0.3, -0.2]))
    drive, _ = drive_of(120)
    q, r = (1e-3, 4e-4), (0.1, 0.2)
    found = run(Ukf("ukf", quiet, q, r, INF), drive).theta_degc
    rate = NET.out_offset + NET.out_scale * np.array([0.3, -0.2])
    y = drive.y + 1.0
    mean, variance = y[:DELAY_STEPS].mean(axis=0), np.full(2, 10.0)
    for row in range(DELAY_STEPS, 120):
        if row > DELAY_STEPS:
            mean, variance = mean + 0.1 * rate, variance + q
        gain = variance / (variance + r)
        mean, variance = mean + gain * (y[row] - mean), (1.0 - gain) * variance
        np.testing.assert_allclose(found[row], mean + DELAY_STEPS * 0.1 * rate, atol=1e-8)


@given(st.integers(1, 6), st.integers(0, 6), st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_the_square_root_is_one_for_singular_covariances_too(n, rank, seed):
    part = np.random.default_rng(seed).standard_normal((n, min(rank, n)))
    cov, root = part @ part.T, np.empty((n, n))
    square_root(cov, root)
    np.testing.assert_allclose(root @ root.T, cov, atol=1e-6 * max(1.0, np.abs(cov).max()))
    assert (np.triu(root, 1) == 0).all()


def test_the_network_steps_as_its_equations_say_and_its_slope_is_the_derivative():
    p, heat = load_tuned().network, np.array([2000.0, 150.0, 300.0, 200.0, 150.0])
    theta, slope = np.array([140.0, 120.0, 100.0, 110.0]), np.empty((4, 4))
    after = theta.copy()
    lptn.step(p, 7000.0, heat, after, slope)
    stored = np.dot([p.c_w, p.c_t, p.c_y, p.c_r], after - theta) / 0.1  # W into the four nodes
    copper = 2000.0 * (1 + 3.93e-3 * 120.0) + 150.0 / (1 + 3.93e-3 * 120.0)
    out = (p.g_we0 + 0.7 * p.g_we1) * 75.0 + p.g_yc * 35.0 + p.g_rc * 45.0
    assert stored == pytest.approx(copper + 650.0 - out, rel=1e-9)  # what flows between nodes cancels
    for k in range(4):
        high, low, unused = theta.copy(), theta.copy(), np.empty((4, 4))
        high[k] += 1e-3
        low[k] -= 1e-3
        lptn.step(p, 7000.0, heat, high, unused)
        lptn.step(p, 7000.0, heat, low, unused)
        np.testing.assert_allclose(slope[:, k], (high - low) / 2e-3, atol=1e-7)


def test_the_loss_map_is_the_machines():
    """At 110 °C the table's losses, referred back, are those of the machine at a grid point."""
    heat = lptn.heats(np.array([[8400.0, 68.2], [8400.0, -68.2], [0.0, 0.0]]))
    np.testing.assert_array_equal(heat[0], heat[1])
    resist = 1 + 3.93e-3 * 90.0
    assert heat[0, 0] * resist == pytest.approx(1440.0, rel=0.02)  # specification, table 2.2
    assert heat[0, 1] / resist == pytest.approx(214.0, rel=0.02)
    assert heat[0, 2:4] == pytest.approx([418.0, 330.0], rel=0.02)
    assert heat[0, 4] == pytest.approx(186.0 + 67.0 + 149.0 / 2, rel=0.02)
    assert heat[2, :2] == pytest.approx([0.0, 0.0], abs=1.0)


def test_the_network_filter_is_the_kalman_filter_of_the_textbook():
    """Against matrices, H and a joint update of both channels; starts at the coolant's and the winding's mean."""
    drive, _ = drive_of(50)
    tuned, r = load_tuned(), np.diag([0.1, 0.2])
    found = run(LptnKf("kf", tuned.network, tuned.lptn_q_k2, (0.1, 0.2), INF), drive).theta_degc
    heat, y = lptn.heats(drive.u), drive.y + 1.0
    h = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0]])
    w, rotor = y[:DELAY_STEPS].mean(axis=0)
    theta, cov = np.array([w, (w + 65.0) / 2, (w + 65.0) / 2, rotor]), np.diag([10.0, 400.0, 400.0, 10.0])
    slope = np.empty((4, 4))
    for row in range(DELAY_STEPS, 50):
        node = row - DELAY_STEPS
        if node > 0:
            lptn.step(tuned.network, drive.u[node, 0], heat[node], theta, slope)
            cov = slope @ cov @ slope.T + np.diag(tuned.lptn_q_k2)
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
        theta, cov = theta + gain @ (y[row] - h @ theta), (np.eye(4) - gain @ h) @ cov
        now = theta.copy()
        for k in range(node + 1, row + 1):
            lptn.step(tuned.network, drive.u[k, 0], heat[k], now, slope)
        np.testing.assert_allclose(found[row], now[[0, 3]], atol=1e-9)


# ---- the plain ones -------------------------------------------------------------------------------------------------
@given(st.lists(st.one_of(st.floats(-50, 200), st.just(math.nan)), min_size=1, max_size=60))
@settings(max_examples=60, deadline=None)
def test_the_moving_average_is_the_mean_of_what_came_and_holds(values):
    y = np.column_stack([values, values])
    drive = Drive(np.zeros(10 * len(y)), np.zeros(10 * len(y)), np.zeros((len(y), 2)), y)
    found, held = run(MovingAverage("average", 15), drive).theta_degc[:, 0], math.nan
    for k in range(len(values)):
        seen = [v for v in values[max(0, k - 14) : k + 1] if not math.isnan(v)]
        held = sum(seen) / len(seen) if seen else held
        assert found[k] == pytest.approx(held, nan_ok=True, abs=1e-9)


# ---- all ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", [*OFFLINE, *GATED, "default"])
def test_what_drives_have_in_common_is_computed_once_and_changes_nothing(name):
    drive, _ = drive_of(200)
    others = [drive.y.copy() for _ in range(3)]
    others[1][120:150, 0] += 20.0
    others[2][150:, 1] = np.nan
    drives = [Drive(drive.torque_nm, drive.speed_rpm, drive.u, y) for y in others]
    estimator = make(name)
    for together, one in zip(run_each(estimator, drives), drives, strict=True):
        np.testing.assert_array_equal(together.theta_degc, run(make(name), one).theta_degc)
    assert not np.array_equal(drives[0].y, drives[1].y)


@pytest.mark.parametrize("name", [n for n in (*OFFLINE, *GATED) if n not in ("raw", "average")])
def test_readings_of_any_kind_leave_the_estimate_finite(name):
    drive, _ = drive_of(120)
    y = drive.y.copy()
    y[40:50] = np.nan
    y[60, 0], y[61, 1] = 900.0, -100.0
    found = run(make(name), Drive(drive.torque_nm, drive.speed_rpm, drive.u, y)).theta_degc
    assert np.isfinite(found[DELAY_STEPS:]).all()


@pytest.mark.parametrize("name", ["fixed-gain", "ukf", "lptn-kf"])
def test_a_gate_refuses_a_jump_that_the_textbook_follows(name):
    drive, _ = drive_of(400)
    y = drive.y.copy()
    y[300:, 0] -= 20.0
    moved = Drive(drive.torque_nm, drive.speed_rpm, drive.u, y)
    followed = run(make(name), drive).theta_degc[360, 0] - run(make(name), moved).theta_degc[360, 0]
    gated = make(f"{name}-gated")
    refused = run(gated, drive).theta_degc[301, 0] - run(gated, moved).theta_degc[301, 0]
    assert followed > 10.0
    assert refused < 0.5


def test_the_network_filter_corrects_towards_the_sensor():
    drive, truth = drive_of(600)
    tuned = load_tuned()
    filtered = run(offline("lptn-kf", tuned), drive).theta_degc[200:]
    alone = run(LptnKf("alone", tuned.network, (0.0,) * 4, (1e9, 1e9), INF), drive).theta_degc[200:]
    assert np.abs(filtered - truth[200:]).mean() < 0.3 < np.abs(alone - truth[200:]).mean()


def test_unknown_names_are_refused_with_what_there_is():
    with pytest.raises(UnknownEstimator, match=r"no estimator 'kalman'.*default.*ukf"):
        make("kalman")
