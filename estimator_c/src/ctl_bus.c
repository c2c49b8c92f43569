#include "ctl_bus.h"

#include <math.h>
#include <string.h>

const enum drive_index ctl_rx_index[CTL_RX_COUNT] = {
    DRIVE_INDEX_MOTOR_STATE, DRIVE_INDEX_ESTIMATE, DRIVE_INDEX_EST_WINDING, DRIVE_INDEX_VEHICLE_STATE};

static const timing_frames_table timing_table = {
    .job = {DRIVE_INDEX_CTL_TIMING_A, DRIVE_INDEX_CTL_TIMING_B, DRIVE_INDEX_CTL_TIMING_C, DRIVE_INDEX_CTL_TIMING_D},
    .counter = {DRIVE_INDEX_CTL_RELEASES, DRIVE_INDEX_CTL_MISSES, DRIVE_INDEX_CTL_OVERLOAD, DRIVE_INDEX_CTL_MISS_RUN,
                DRIVE_INDEX_CTL_OUTPUTS, DRIVE_INDEX_CTL_ENVIRONMENT, DRIVE_INDEX_CTL_MACHINE, DRIVE_INDEX_CTL_CANARY,
                DRIVE_INDEX_CTL_WAKE_STAT, DRIVE_INDEX_CTL_EXEC_STAT, DRIVE_INDEX_CTL_RESP_STAT},
};

static const int64_t NS_PER_MS = 1000000;

void ctl_bus_init(ctl_bus *self) {
    memset(self, 0, sizeof *self);
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        const drive_message_info_t *info = &drive_messages[ctl_rx_index[i]];
        (void)e2e_receiver_init(&self->rx[i].e2e, info->data_id_list, info->length, info->max_delta);
    }
    for (int i = 0; i < DRIVE_MESSAGE_COUNT; i++) {
        e2e_sender_init(&self->tx[i], drive_messages[i].data_id_list);
    }
}

/* ---- receive ---------------------------------------------------------------------------------------------------- */

static bool decode_motor(const struct canfd_frame *frame, ctl_input *out) {
    struct drive_motor_state_t raw;
    if (drive_motor_state_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->tick = raw.tick;
    out->motor.torque_nm = drive_motor_state_torque_nm_to_phys(raw.torque_nm);
    out->motor.speed_rpm = drive_motor_state_speed_rpm_to_phys(raw.speed_rpm);
    return true;
}

static bool decode_estimate(const struct canfd_frame *frame, ctl_input *out) {
    enum { OK = 2, PREDICTING = 3, OPEN_LOOP = 6, FALLBACK = 7 }; /* value table of Estimate.status */
    struct drive_estimate_t raw;
    if (drive_estimate_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->tick = raw.tick;
    out->estimate.theta_w_degc = drive_estimate_theta_w_est_degc_to_phys(raw.theta_w_est_degc);
    out->estimate.theta_r_degc = drive_estimate_theta_r_est_degc_to_phys(raw.theta_r_est_degc);
    out->estimate.usable =
        raw.status == OK || raw.status == PREDICTING || raw.status == OPEN_LOOP || raw.status == FALLBACK;
    return true;
}

static bool decode_winding(const struct canfd_frame *frame, ctl_input *out) {
    struct drive_est_winding_t raw;
    if (drive_est_winding_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->tick = raw.tick;
    out->winding.sigma_degc = drive_est_winding_sigma_w_degc_to_phys(raw.sigma_w_degc);
    out->winding.upper_degc = drive_est_winding_upper_w_degc_to_phys(raw.upper_w_degc);
    return true;
}

static bool decode_vehicle(const struct canfd_frame *frame, ctl_input *out) {
    struct drive_vehicle_state_t raw;
    if (drive_vehicle_state_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->tick = raw.tick;
    out->vehicle.v_mps = drive_vehicle_state_v_mps_to_phys(raw.v_mps);
    out->vehicle.distance_m = drive_vehicle_state_distance_m_to_phys(raw.distance_m);
    return true;
}

static int listened(canid_t id) {
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        if (drive_messages[ctl_rx_index[i]].can_id == id) {
            return i;
        }
    }
    return -1;
}

bool ctl_bus_accept(ctl_bus *self, const struct canfd_frame *frame, int64_t at_ns, ctl_input *out) {
    static bool (*const decode[CTL_RX_COUNT])(const struct canfd_frame *, ctl_input *) = {decode_motor, decode_estimate,
                                                                                        decode_winding, decode_vehicle};
    const int id = listened(frame->can_id & CAN_EFF_MASK);
    if (id < 0) {
        self->foreign++;
        return false;
    }
    if ((frame->can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG)) != 0 || (frame->flags & CANFD_FDF) != 0 ||
        frame->len > CAN_MAX_DLEN) {
        self->rejected++;
        return false;
    }
    ctl_rx *rx = &self->rx[id];
    if (!e2e_is_usable(e2e_check(&rx->e2e, frame->data, frame->len))) {
        return false;
    }
    if (!decode[id](frame, out)) {
        self->rejected++;
        return false;
    }
    out->id = (ctl_rx_id)id;
    self->accepted++;
    if (!rx->alive || out->tick != rx->last_tick) { /* a sender whose model stands still grows stale */
        rx->alive = true;
        rx->last_tick = out->tick;
        rx->last_ns = at_ns;
    }
    return true;
}

bool ctl_bus_stale(ctl_bus *self, int64_t now_ns) {
    bool any = false;
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        ctl_rx *rx = &self->rx[i];
        const int64_t timeout_ns = (int64_t)drive_messages[ctl_rx_index[i]].timeout_ms * NS_PER_MS;
        const bool stale = rx->alive && now_ns - rx->last_ns > timeout_ns;
        rx->timeouts += stale && !rx->stale ? 1U : 0U;
        rx->stale = stale;
        any = any || stale;
    }
    return any;
}

int64_t ctl_bus_in_age_ns(const ctl_bus *self, ctl_rx_id id, int64_t now_ns) {
    const ctl_rx *rx = &self->rx[id];
    return !rx->alive ? TIMING_NA : now_ns > rx->last_ns ? now_ns - rx->last_ns : 0;
}

void ctl_bus_read_faults(const ctl_bus *self, ctl_bus_faults *out) {
    memset(out, 0, sizeof *out);
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        const uint32_t *counts = self->rx[i].e2e.counts;
        out->crc_errors += counts[E2E_WRONG_CRC];
        out->seq_errors += (uint64_t)counts[E2E_REPEATED] + counts[E2E_LOST] + counts[E2E_WRONG_SEQUENCE];
    }
}

/* ---- send ------------------------------------------------------------------------------------------------------- */

/* Packs `raw` of message NAME into `frame` and protects it. */
#define SEAL(self, index, name, raw, frame)                                              \
    do {                                                                                 \
        memset((frame), 0, sizeof *(frame));                                             \
        (void)drive_##name##_pack((frame)->data, &(raw), sizeof(frame)->data);           \
        timing_frames_seal((self)->tx, index, frame);                                    \
    } while (0)

static void torques(ctl_bus *self, const controller_out_t *in, bool mute, uint16_t tick, struct canfd_frame *frame) {
    struct drive_torque_command_t raw;
    memset(&raw, 0, sizeof raw);
    raw.derating = in->derating ? 1U : 0U;
    raw.origin = drive_torque_command_origin_to_raw((double)in->source);
    raw.clamped = in->clamped ? 1U : 0U;
    raw.torque_acc_nm = drive_torque_command_torque_acc_nm_to_raw(mute ? (double)NAN : in->drive_nm);
    raw.torque_brk_nm = drive_torque_command_torque_brk_nm_to_raw(mute ? (double)NAN : -in->regen_nm);
    raw.torque_fric_nm = drive_torque_command_torque_fric_nm_to_raw(mute ? (double)NAN : -in->friction_nm);
    raw.tick = tick;
    SEAL(self, DRIVE_INDEX_TORQUE_COMMAND, torque_command, raw, frame);
}

static double solver_status(const controller_out_t *in) {
    static const double said[] = {[MPC_OK] = 0.0, [MPC_MAX_ITERATIONS] = 1.0, [MPC_FAILED] = 2.0};
    return in->solved ? said[in->status] : (double)NAN;
}

void ctl_bus_command(ctl_bus *self, const controller_out_t *in, bool mute, uint16_t tick,
                     struct canfd_frame frames[CTL_COMMAND_FRAMES]) {
    struct drive_ctl_state_t state;
    struct drive_ctl_solve_t solve;
    memset(&state, 0, sizeof state);
    memset(&solve, 0, sizeof solve);
    torques(self, in, mute, tick, &frames[0]);
    state.solver_status = drive_ctl_state_solver_status_to_raw(solver_status(in));
    state.theta_w_peak_degc = drive_ctl_state_theta_w_peak_degc_to_raw(in->predicted_peak_degc);
    state.theta_w_end_degc = drive_ctl_state_theta_w_end_degc_to_raw(in->predicted_end_degc);
    state.tick = tick;
    SEAL(self, DRIVE_INDEX_CTL_STATE, ctl_state, state, &frames[1]);
    solve.sweeps = drive_ctl_solve_sweeps_to_raw((double)in->iterations);
    solve.slack_degc = drive_ctl_solve_slack_degc_to_raw(in->slack_k);
    solve.margin_degc = drive_ctl_solve_margin_degc_to_raw(in->margin_k);
    solve.tick = tick;
    SEAL(self, DRIVE_INDEX_CTL_SOLVE, ctl_solve, solve, &frames[2]);
}

void ctl_bus_timing(ctl_bus *self, const timing_job *in, struct canfd_frame frames[TIMING_JOB_FRAMES]) {
    timing_frames_job(&timing_table, self->tx, in, frames);
}

static void input_faults(ctl_bus *self, const ctl_counters *in, struct canfd_frame *frame) {
    struct drive_ctl_input_faults_t raw;
    memset(&raw, 0, sizeof raw);
    raw.crc_errors = drive_ctl_input_faults_crc_errors_to_raw((double)in->crc_errors);
    raw.seq_errors = drive_ctl_input_faults_seq_errors_to_raw((double)in->seq_errors);
    raw.stale_inputs = drive_ctl_input_faults_stale_inputs_to_raw((double)in->stale_inputs);
    SEAL(self, DRIVE_INDEX_CTL_INPUT_FAULTS, ctl_input_faults, raw, frame);
}

static void bus_faults(ctl_bus *self, const ctl_counters *in, struct canfd_frame *frame) {
    struct drive_ctl_bus_faults_t raw;
    memset(&raw, 0, sizeof raw);
    raw.rx_drops = drive_ctl_bus_faults_rx_drops_to_raw((double)in->rx_drops);
    raw.tx_drops = drive_ctl_bus_faults_tx_drops_to_raw((double)in->tx_drops);
    raw.rejected = drive_ctl_bus_faults_rejected_to_raw((double)in->rejected);
    SEAL(self, DRIVE_INDEX_CTL_BUS_FAULTS, ctl_bus_faults, raw, frame);
}

static void fallbacks(ctl_bus *self, const ctl_counters *in, struct canfd_frame *frame) {
    struct drive_ctl_fallbacks_t raw;
    memset(&raw, 0, sizeof raw);
    raw.mute = drive_ctl_fallbacks_mute_to_raw((double)in->mute);
    raw.shifted = drive_ctl_fallbacks_shifted_to_raw((double)in->core.shifted);
    raw.by_rule = drive_ctl_fallbacks_by_rule_to_raw((double)in->core.rule_steps);
    raw.clamped = drive_ctl_fallbacks_clamped_to_raw((double)in->core.clamped);
    SEAL(self, DRIVE_INDEX_CTL_FALLBACKS, ctl_fallbacks, raw, frame);
}

static void solves(ctl_bus *self, const ctl_counters *in, struct canfd_frame *frame) {
    struct drive_ctl_solves_t raw;
    memset(&raw, 0, sizeof raw);
    raw.bad_inputs = drive_ctl_solves_bad_inputs_to_raw((double)in->core.bad_inputs);
    raw.failed = drive_ctl_solves_failed_to_raw((double)in->core.failed);
    raw.unconverged = drive_ctl_solves_unconverged_to_raw((double)in->core.unconverged);
    raw.no_estimate = drive_ctl_solves_no_estimate_to_raw((double)in->core.no_estimate);
    SEAL(self, DRIVE_INDEX_CTL_SOLVES, ctl_solves, raw, frame);
}

void ctl_bus_counter(ctl_bus *self, size_t which, const ctl_counters *in, struct canfd_frame *frame) {
    enum { OWN = CTL_COUNTER_FRAMES - TIMING_COUNTER_FRAMES };
    static void (*const make[OWN])(ctl_bus *, const ctl_counters *, struct canfd_frame *) = {
        input_faults, bus_faults, fallbacks, solves};
    if (which < OWN) {
        make[which](self, in, frame);
    } else {
        timing_frames_counter(&timing_table, self->tx, which - OWN, &in->timing, frame);
    }
}

static void hashes(ctl_bus *self, const ctl_identity *in, struct canfd_frame *frame) {
    struct drive_ctl_identity_t raw;
    memset(&raw, 0, sizeof raw);
    raw.dbc_hash = drive_ctl_identity_dbc_hash_to_raw((double)in->dbc_hash);
    raw.weights_hash = drive_ctl_identity_weights_hash_to_raw((double)in->weights_hash);
    SEAL(self, DRIVE_INDEX_CTL_IDENTITY, ctl_identity, raw, frame);
}

static void build(ctl_bus *self, const ctl_identity *in, struct canfd_frame *frame) {
    struct drive_ctl_build_t raw;
    memset(&raw, 0, sizeof raw);
    raw.controller_id = drive_ctl_build_controller_id_to_raw((double)in->controller_id);
    raw.build_hash = drive_ctl_build_build_hash_to_raw((double)in->build_hash);
    raw.preview_hash = drive_ctl_build_preview_hash_to_raw((double)in->preview_hash);
    SEAL(self, DRIVE_INDEX_CTL_BUILD, ctl_build, raw, frame);
}

static void granted(ctl_bus *self, const ctl_identity *in, struct canfd_frame *frame) {
    struct drive_ctl_granted_t raw;
    memset(&raw, 0, sizeof raw);
    raw.policy = drive_ctl_granted_policy_to_raw((double)in->policy);
    raw.priority = drive_ctl_granted_priority_to_raw((double)in->priority);
    raw.core = drive_ctl_granted_core_to_raw(in->core < 0 ? (double)NAN : (double)in->core);
    raw.mlock = in->mlock ? 1U : 0U;
    raw.period_us = drive_ctl_granted_period_us_to_raw((double)in->period_us);
    SEAL(self, DRIVE_INDEX_CTL_GRANTED, ctl_granted, raw, frame);
}

void ctl_bus_identity(ctl_bus *self, size_t which, const ctl_identity *in, struct canfd_frame *frame) {
    static void (*const make[CTL_IDENTITY_FRAMES])(ctl_bus *, const ctl_identity *, struct canfd_frame *) = {
        hashes, build, granted};
    make[which](self, in, frame);
}
