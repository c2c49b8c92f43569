"""The whole drive on the bus: every message of every node at the cycle time its DBC promises."""

FOR_A_CONTROLLER = ["VehicleState", "PlantControl"]  # the plant sends them to one, and there is none on this bus


def test_the_drive_keeps_its_cycle_times(run_scenario, assert_cycle_times, assert_no_timeouts):
    run = run_scenario("hot-lap", duration_s=5)
    assert_cycle_times(run.log, run.dbc, node="PLANT", ignore=FOR_A_CONTROLLER)
    assert_cycle_times(run.log, run.dbc, node="ESTIMATOR")
    assert_no_timeouts(run.log, run.dbc, node="ESTIMATOR")


def test_a_faster_loop_estimates_as_often_as_it_should(run_scenario):
    run = run_scenario("hot-lap", {"estimator": {"period_s": 0.01}}, duration_s=2, lockstep=True)
    assert run.result["timing"]["estimator"]["jobs"] == 200
    assert run.frames["Estimate"][-1].values["theta_w_est_degc"] > 100.0
