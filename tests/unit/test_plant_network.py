"""The thermal network: its 70 nodes, its table of figures, and the properties of its exact step."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim.dq_map import build_dq_map
from plant_sim.errors import ParameterError
from plant_sim.expm import expm_integral
from plant_sim.losses import LossModel
from plant_sim.lptn import build_lptn
from plant_sim.network import boundary_links, build_network, jacket_h, speed_links
from plant_sim.nodes import INDEX, N_NODES, NODES, THETA_W
from plant_sim.params import load_params

PARAMS = load_params()
NETWORK = build_network(PARAMS)
LPTN = build_lptn(PARAMS)
LOSSES = LossModel(PARAMS, NETWORK, build_dq_map(PARAMS.machine))
BOUNDARY = np.array([65.0, 25.0, 70.0])
TABLE = json.loads(Path(__file__).with_name("test_plant_network_table.json").read_text())


def test_seventy_nodes_with_the_tabled_capacities():
    assert N_NODES == len(set(NODES)) == 70
    assert [name for name, _ in TABLE["nodes"]] == list(NODES)
    assert NETWORK.capacity_j_k.sum() == pytest.approx(17503.0, abs=1.0)
    for name, capacity in TABLE["nodes"]:
        assert NETWORK.capacity_j_k[INDEX[name]] == pytest.approx(capacity, rel=5e-3), name


@pytest.mark.parametrize("speed", ["static", "0", "4000", "8000", "10000"])
def test_conductances_derive_to_the_table(speed):
    links = NETWORK.static if speed == "static" else speed_links(PARAMS, float(speed))
    expected = {
        frozenset((a, b)): g for a, b, g in (TABLE["static"] if speed == "static" else TABLE["speed"][speed])
    }
    derived = {frozenset((a, b)): g for a, b, g in links}
    assert derived.keys() == expected.keys()
    for link, g in expected.items():
        assert derived[link] == pytest.approx(g, rel=5e-3), link


def test_masses_and_copper():
    m = PARAMS.material
    assert NETWORK.copper_m3.sum() * m.rho_cu == pytest.approx(3.03, abs=0.01)
    assert np.count_nonzero(NETWORK.copper_m3) == 20
    assert LOSSES.teeth_kg == pytest.approx(3.02, abs=0.01)
    assert LOSSES.yoke_kg == pytest.approx(5.05, abs=0.01)


@pytest.mark.parametrize("speed", [0.0, 500.0, 3580.0, 8000.0, 11200.0])
def test_row_sums_are_boundary_conductances(speed):
    laplacian, boundary = NETWORK.matrices(speed)
    np.testing.assert_allclose(laplacian.sum(axis=1), boundary.sum(axis=1), atol=1e-10)
    assert (boundary >= 0.0).all()


def test_step_is_positive_contractive_and_keeps_uniform_temperature():
    assert (LPTN.a_d >= 0.0).all()
    assert (LPTN.b_d >= 0.0).all()
    assert (LPTN.b_b >= 0.0).all()
    assert LPTN.a_d.shape[0] == 113
    radius = np.abs(np.linalg.eigvals(LPTN.a_d)).max()
    assert radius < 1.0
    np.testing.assert_allclose(LPTN.a_d.sum(axis=2) + LPTN.b_b.sum(axis=2), 1.0, atol=1e-12)


def test_slowest_time_constants():
    for speed, tau in ((8000.0, 630.0), (4000.0, 836.0)):
        laplacian, _ = NETWORK.matrices(speed)
        rates = np.linalg.eigvals(laplacian / NETWORK.capacity_j_k[:, None]).real
        assert 1.0 / rates.min() == pytest.approx(tau, rel=0.01)


def test_energy_balance_at_constant_operation():
    """Heat in = heat stored + heat carried off, the latter by Simpson's rule over half steps."""
    half = build_lptn(PARAMS, 0.005)
    speed, steps = 8000.0, 3000
    theta = np.full(N_NODES, 80.0)
    for _ in range(400):  # let the fast gap nodes settle so that the quadrature is smooth
        theta = half.step(theta, LOSSES.heat(theta, 60.0, speed)[0], speed, BOUNDARY)
    heat = LOSSES.heat(theta, 60.0, speed)[0]

    def outflow(t):
        out = NETWORK.advection_w_k * (t[INDEX["CO_DE"]] - BOUNDARY[0])
        return out + sum(g * (t[INDEX[n]] - BOUNDARY[c]) for n, c, g in boundary_links(PARAMS, speed))

    begin, lost, flow = theta.copy(), 0.0, outflow(theta)
    for _ in range(steps):
        middle = half.step(theta, heat, speed, BOUNDARY)
        theta = half.step(middle, heat, speed, BOUNDARY)
        end = outflow(theta)
        lost += 0.01 / 6.0 * (flow + 4.0 * outflow(middle) + end)
        flow = end
    stored = float(NETWORK.capacity_j_k @ (theta - begin))
    put_in = heat.sum() * steps * 0.01
    assert abs(put_in - stored - lost) < 1e-6 * put_in
    assert stored > 0.1 * put_in  # the balance is not one of a steady state


def test_time_stepping_ends_in_the_steady_state():
    speed, torque = 8000.0, 48.9
    coarse = build_lptn(PARAMS, 0.5)
    theta = np.full(N_NODES, 65.0)
    for _ in range(8000):
        theta = coarse.step(theta, LOSSES.heat(theta, torque, speed)[0], speed, BOUNDARY)
    steady = steady_state(torque, speed)
    assert np.abs(theta - steady).max() < 0.5
    assert 145.0 <= steady[THETA_W] <= 152.0


def test_halving_the_step_changes_the_winding_by_less_than_10_mk():
    """60 s at changing operating points, losses refreshed at 10 or 5 ms."""
    half = build_lptn(PARAMS, 0.005)
    coarse, fine = np.full(N_NODES, 60.0), np.full(N_NODES, 60.0)
    for k in range(6000):
        torque, speed = 80.0 + 70.0 * np.sin(k / 130.0), 6000.0 + 4500.0 * np.sin(k / 700.0)
        torque = min(torque, 60e3 / (speed * np.pi / 30.0))
        coarse = LPTN.step(coarse, LOSSES.heat(coarse, torque, speed)[0], speed, BOUNDARY)
        for _ in range(2):
            fine = half.step(fine, LOSSES.heat(fine, torque, speed)[0], speed, BOUNDARY)
    assert abs(coarse[THETA_W] - fine[THETA_W]) < 0.01
    assert coarse[THETA_W] > 75.0


def test_exponential_against_eigenvectors():
    rng = np.random.default_rng(4)
    q = np.linalg.qr(rng.normal(size=(8, 8)))[0]
    rates = -np.array([1e-4, 1e-2, 0.3, 1.0, 4.0, 20.0, 90.0, 400.0])
    exponential, integral = expm_integral(q @ np.diag(rates) @ q.T)
    np.testing.assert_allclose(exponential, q @ np.diag(np.exp(rates)) @ q.T, atol=1e-13)
    np.testing.assert_allclose(integral, q @ np.diag(np.expm1(rates) / rates) @ q.T, atol=1e-13)


@settings(max_examples=30, deadline=None)
@given(speed=st.floats(0.0, 11200.0), theta0=st.floats(-10.0, 160.0))
def test_without_losses_temperatures_stay_between_the_extremes(speed, theta0):
    theta = np.full(N_NODES, theta0)
    low, high = min(theta0, 25.0), max(theta0, 70.0)
    for _ in range(20):
        theta = LPTN.step(theta, np.zeros(N_NODES), speed, BOUNDARY)
        assert theta.min() >= low - 1e-9
        assert theta.max() <= high + 1e-9


def test_mismatch_variants_move_the_right_way():
    base = steady_state(48.9, 8000.0)[THETA_W]
    for change in (
        {"coolant__flow_lpm": 3.0},
        {"loss__k_ac": 1.65},
        {"material__rho_el20_ohm_m": 1.72e-8 * 1.05},
        {"contact__t_liner_m": 0.00056, "contact__t_liner_gap_m": 8e-5},
    ):
        assert steady_state(48.9, 8000.0, PARAMS.varied(**change))[THETA_W] > base + 0.5, change
    assert jacket_h(PARAMS.varied(coolant__flow_lpm=3.0)) < 0.7 * jacket_h(PARAMS)
    cold = PARAMS.varied(boundary__coolant_degc=50.0).boundary
    assert (
        steady_state(48.9, 8000.0, boundary=np.array([cold.coolant_degc, 25.0, 70.0]))[THETA_W] < base - 10.0
    )


def test_parameter_errors_name_the_figure(tmp_path):
    with pytest.raises(ParameterError, match="loss__kac"):
        PARAMS.varied(loss__kac=1.0)
    with pytest.raises(ParameterError, match="not a finite number"):
        PARAMS.varied(loss__k_ac=float("nan"))
    with pytest.raises(ParameterError, match="flow_lpm"):
        build_network(PARAMS.varied(coolant__flow_lpm=0.0))
    with pytest.raises(ParameterError, match="check the path"):
        load_params(tmp_path / "none.json")
    broken = tmp_path / "broken.json"
    broken.write_text('{"vehicle": {"mass_kg": 1}}')
    with pytest.raises(ParameterError, match=r"broken.json: group 'vehicle': missing"):
        load_params(broken)


def steady_state(torque, speed, params=PARAMS, boundary=BOUNDARY):
    """Node temperatures at which heat in equals heat out, by fixed-point iteration of the losses."""
    network = build_network(params)
    losses = LossModel(params, network, build_dq_map(params.machine))
    laplacian, inputs = network.matrices(speed)
    theta = np.full(N_NODES, 80.0)
    for _ in range(100):
        theta = np.linalg.solve(laplacian, losses.heat(theta, torque, speed)[0] + inputs @ boundary)
    return theta
