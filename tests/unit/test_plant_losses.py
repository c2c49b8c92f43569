"""Loss map and loss components against the table of operating points."""

import numpy as np
import pytest

from plant_sim.dq_map import SPEED_STEP_RPM, THETA_GRID, TORQUE_STEP_NM, build_dq_map
from plant_sim.losses import LossModel, heat_split
from plant_sim.lptn import build_lptn
from plant_sim.network import build_network
from plant_sim.nodes import N_NODES, THETA_W
from plant_sim.params import load_params
from plant_sim.vehicle import motoring_limit_nm

PARAMS = load_params()
DQ = build_dq_map(PARAMS.machine)
NETWORK = build_network(PARAMS)
MODEL = LossModel(PARAMS, NETWORK, DQ)
WARM = np.full(N_NODES, 110.0)

# T, n, I, copper DC, copper AC, teeth, yoke, rotor, magnet, mechanical, total, efficiency %, adiabatic K/s
POINTS = [
    (160.0, 3580.0, 330, 3583, 97, 186, 194, 84, 25, 47, 4217, 93.4, 2.19),
    (113.0, 5070.0, 256, 2156, 117, 278, 276, 103, 33, 73, 3036, 95.2, 1.32),
    (68.2, 8400.0, 209, 1440, 214, 418, 330, 186, 67, 149, 2804, 95.5, 0.88),
    (52.4, 10930.0, 222, 1625, 409, 501, 338, 315, 124, 225, 3536, 94.4, 1.00),
    (48.9, 8000.0, 143, 675, 91, 368, 328, 115, 37, 138, 1752, 95.9, 0.41),
]


@pytest.mark.parametrize("point", POINTS, ids=lambda p: f"{p[0]:.0f}Nm@{p[1]:.0f}")
def test_loss_table(point):
    torque, speed, current, dc, ac, teeth, yoke, rotor, magnet, mechanical, total, efficiency, rate = point
    heat, losses = MODEL.heat(WARM, torque, speed)
    assert DQ.lookup(110.0, torque, speed)[0] == pytest.approx(current, rel=0.01)
    assert losses.total_w == pytest.approx(total, rel=0.01)
    parts = (
        losses.copper_dc_w,
        losses.copper_ac_w,
        losses.teeth_w,
        losses.yoke_w,
        losses.rotor_fe_w,
        losses.magnet_w,
    )
    assert parts == pytest.approx((dc, ac, teeth, yoke, rotor, magnet), rel=0.02, abs=1.0)
    assert losses.mechanical_w == pytest.approx(mechanical, abs=1.0)
    assert heat.sum() == pytest.approx(losses.total_w, rel=1e-12)
    assert heat[THETA_W] / NETWORK.capacity_j_k[THETA_W] == pytest.approx(rate, abs=0.01)
    power = torque * speed * np.pi / 30.0
    assert 100.0 * power / (power + losses.total_w) == pytest.approx(efficiency, abs=0.1)


def test_efficiency_never_exceeds_97_percent_and_holds_93_at_full_power():
    best = 0.0
    for speed in np.arange(200.0, 11200.0, 200.0):
        for torque in np.arange(5.0, motoring_limit_nm(speed, PARAMS.machine) + 1e-9, 5.0):
            power = torque * speed * np.pi / 30.0
            best = max(best, power / (power + MODEL.heat(WARM, torque, speed)[1].total_w))
    assert 0.955 < best <= 0.97
    for torque, speed in ((113.0, 5070.0), (68.2, 8400.0), (52.4, 10930.0)):
        power = torque * speed * np.pi / 30.0
        assert power / (power + MODEL.heat(WARM, torque, speed)[1].total_w) >= 0.93


def test_the_envelope_is_feasible_up_to_160_degc():
    for a, theta in enumerate(THETA_GRID):
        if theta > 160.0:
            continue
        for k in range(DQ.feasible.shape[2]):
            limit = 0.98 * motoring_limit_nm(k * SPEED_STEP_RPM, PARAMS.machine)
            for j in range(int(limit / TORQUE_STEP_NM) + 1):
                assert DQ.feasible[a, j, k], (theta, j * TORQUE_STEP_NM, k * SPEED_STEP_RPM)


def test_sign_of_torque_does_not_matter_and_edges_hold():
    assert DQ.lookup(90.0, -70.0, 6100.0) == DQ.lookup(90.0, 70.0, 6100.0)
    assert DQ.lookup(500.0, 400.0, 20000.0) == pytest.approx(tuple(DQ.table[-1, -1, -1]))
    np.testing.assert_allclose(DQ.lookup(80.0, 25.0, 4000.0), DQ.table[1, 5, 20])


def test_every_watt_lands_in_a_node():
    np.testing.assert_allclose(heat_split().sum(axis=0), 1.0, atol=1e-15)
    heat, losses = MODEL.heat(WARM, 0.0, 0.0)
    assert losses.total_w == 0.0
    assert not heat.any()


@pytest.mark.parametrize(
    ("torque", "speed", "seconds", "tolerance"),
    [
        (160.0, 500.0, 57.0, 7.0),
        (113.0, 5070.0, 126.0, 2.0),
        (71.6, 8000.0, 232.0, 4.0),
        (52.4, 10930.0, 160.0, 3.0),
    ],
)
def test_time_to_155_degc(torque, speed, seconds, tolerance):
    lptn, boundary = build_lptn(PARAMS, 0.05), np.array([65.0, 25.0, 70.0])
    theta, steps = np.full(N_NODES, 60.0), 0
    while theta[THETA_W] < 155.0:
        theta = lptn.step(theta, MODEL.heat(theta, torque, speed)[0], speed, boundary)
        steps += 1
        assert steps < 8000
    assert steps * 0.05 == pytest.approx(seconds, abs=tolerance)
