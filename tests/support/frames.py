"""Golden frames: for every message of the DBC, physical values and the bytes of a sender's first frame.

The bytes were checked by hand against the table of the DBC (payload) and with cantools (CRC); they change only
with the contract.
"""

GOLDEN: list[tuple[str, dict[str, float], str]] = [
    (
        "MotorState",
        {"derating_active": 0.0, "torque_nm": -65.54, "speed_rpm": 9830.0, "tick": 52428.0},
        "e60166e69899cccc",
    ),
    (
        "TempMeas",
        {"theta_w_meas_degc": 155.984375, "theta_r_meas_degc": 411.984375, "tick": 49151.0},
        "3e01ff3fff7fffbf",
    ),
    ("Reference", {"speed_demand_mps": 16.383, "slope_rad": 0.0, "tick": 49151.0}, "0d01ff3f0000ffbf"),
    (
        "Coolant",
        {"soaked": 1.0, "coolant_degc": 155.984375, "ambient_degc": 411.984375, "tick": 49151.0},
        "4411ff3fff7fffbf",
    ),
    (
        "Estimate",
        {"status": 1.0, "theta_w_est_degc": 52.39453125, "theta_r_est_degc": 103.59375, "tick": 52428.0},
        "751165669899cccc",
    ),
    (
        "EstimateInnov",
        {"sweeps": 3.0, "innov_w_degc": -25.6015625, "innov_r_degc": 25.59765625, "tick": 52428.0},
        "8d3166e69919cccc",
    ),
    (
        "EstValidity",
        {
            "outside_speed": 1.0,
            "outside_torque": 0.0,
            "outside_theta_w": 1.0,
            "outside_theta_r": 0.0,
            "outside_joint": 1.0,
            "scope": 2.0,
            "novelty": 21.845,
            "tick": 52428.0,
        },
        "e55105005555cccc",
    ),
    (
        "EstWinding",
        {
            "sensor_w_fault": 5.0,
            "sensor_w_trusted": 1.0,
            "sigma_w_degc": 16.383,
            "upper_w_degc": 77.99609375,
            "tick": 49151.0,
        },
        "d9d1ff3fff7fffbf",
    ),
    (
        "EstRotor",
        {
            "sensor_r_fault": 2.0,
            "sensor_r_trusted": 0.0,
            "sigma_r_degc": 32.767,
            "upper_r_degc": 13.99609375,
            "tick": 52428.0,
        },
        "2921ff7fff3fcccc",
    ),
    (
        "EstTimingA",
        {
            "miss_late": 0.0,
            "warmup": 0.0,
            "stale_input": 0.0,
            "after_skip": 0.0,
            "release_index": 11983725.0,
            "wake_lat_us": 1438046.9,
        },
        "3d016ddbb6b56ddb",
    ),
    ("EstTimingB", {"miss_cause": 1.0, "exec_wall_us": 838860.7, "resp_us": 1258291.0}, "f011ffff7ffeffbf"),
    (
        "EstTimingC",
        {"output": 2.0, "cut": 0.0, "queued": 1.0, "in_age_motor_us": 559240.5, "in_age_temp_us": 1118481.0},
        "16a1555555aaaaaa",
    ),
    ("EstTimingD", {"exec_cpu_us": 838860.7, "canary_us": 1258291.0}, "f701ffff7ffeffbf"),
    ("EstReleases", {"releases": 5592405.0, "jobs": 11184810.0}, "0f01555555aaaaaa"),
    ("EstMisses", {"miss_late": 16383.0, "miss_skipped": 32767.0, "overrun": 49151.0}, "5301ff3fff7fffbf"),
    ("EstInputFaults", {"crc_errors": 16383.0, "seq_errors": 32767.0, "stale_inputs": 49151.0}, "fd01ff3fff7fffbf"),
    ("EstBusFaults", {"rx_drops": 16383.0, "tx_drops": 32767.0, "rejected": 49151.0}, "d501ff3fff7fffbf"),
    (
        "EstCoreFaults",
        {"stray_ticks": 7.0, "restarts": 16383.0, "held_intervals": 32767.0, "late_measurements": 49151.0},
        "3971ff3fff7fffbf",
    ),
    (
        "EstCoreFaults2",
        {"repeated_ticks": 11.0, "off_grid": 16383.0, "invalid_inputs": 32767.0, "unconverged": 49151.0},
        "33b1ff3fff7fffbf",
    ),
    (
        "EstCalibration",
        {
            "calibration_state": 2.0,
            "offset_w_degc": 63.99609375,
            "offset_r_degc": -64.0,
            "offset_sigma_w_degc": 0.425,
            "offset_sigma_r_degc": 0.85,
        },
        "ff21ff3f00c055aa",
    ),
    ("EstOverload", {"waiting": 9.0, "queued": 16383.0, "cut": 32767.0, "rebased": 49151.0}, "8491ff3fff7fffbf"),
    ("EstMissRun", {"consec_miss_max": 16383.0, "mk_worst": 85.0, "phase_us": 11184810.0}, "f201ff3f55aaaaaa"),
    ("EstOutputs", {"held": 16383.0, "predicted": 32767.0, "invalidated": 49151.0}, "e501ff3fff7fffbf"),
    (
        "EstEnvironment",
        {"minor_faults": 16383.0, "major_faults": 32767.0, "invol_switches": 49151.0},
        "1801ff3fff7fffbf",
    ),
    ("EstMachine", {"run_delay_ms": 1638.3, "steal_ms": 327670.0, "migrations": 49151.0}, "c901ff3fff7fffbf"),
    ("EstCanary", {"canary_p99_us": 559240.5, "canary_max_us": 1118481.0}, "de01555555aaaaaa"),
    ("EstWakeStat", {"p99_us": 559240.5, "max_us": 1118481.0}, "ab01555555aaaaaa"),
    ("EstExecStat", {"p99_us": 559240.5, "max_us": 1118481.0}, "c101555555aaaaaa"),
    ("EstRespStat", {"p99_us": 559240.5, "max_us": 1118481.0}, "1701555555aaaaaa"),
    (
        "TruthTemp",
        {"theta_w_true_degc": 27.998046875, "theta_r_true_degc": 155.998046875, "tick": 49151.0},
        "16f1ffcfff7fffbf",
    ),
    ("TruthVehicle", {"v_true_mps": 16.383, "distance_m": 52428.7, "tick": 49151.0}, "56f1fff3ff7fffbf"),
    (
        "TruthFault",
        {"fault_w": 341.0, "fault_r": 170.0, "tick": 49151.0},
        "01015501aa00ffbf",
    ),
    ("PlantSample", {"sample_us": 5592405.0, "send_us": 2730.0, "tick": 49151.0}, "e1515555a5aaffbf"),
    ("PlantStatus", {"ticks_late": 16383.0, "late_max_ms": 3276.7, "tx_retries": 49151.0}, "5901ff3fff7fffbf"),
    ("EstIdentity", {"dbc_hash": 5592405.0, "weights_hash": 11184810.0}, "c701555555aaaaaa"),
    ("EstBuild", {"build_hash": 5592405.0, "setting_id": 0.0}, "eb01555555000000"),
    (
        "EstGranted",
        {"policy": 0.0, "priority": 33.0, "core": 127.0, "mlock": 0.0, "period_us": 13981011.0},
        "a301217f005355d5",
    ),
    ("PlantIdentity", {"params_hash": 5592405.0, "scenario_hash": 11184810.0}, "d301555555aaaaaa"),
]
