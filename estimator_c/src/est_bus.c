#include "est_bus.h"

#include <math.h>
#include <string.h>

_Static_assert(sizeof(est_bus) <= 112000, "est_bus.h says so");

static const enum drive_index RX_INDEX[EST_RX_COUNT] = {DRIVE_INDEX_MOTOR_STATE, DRIVE_INDEX_TEMP_MEAS,
                                                        DRIVE_INDEX_COOLANT};

static const int64_t NS_PER_MS = 1000000;

void est_bus_init(est_bus *self) {
    memset(self, 0, sizeof *self);
    for (int i = 0; i < EST_RX_COUNT; i++) {
        const drive_message_info_t *info = &drive_messages[RX_INDEX[i]];
        (void)e2e_receiver_init(&self->rx[i].e2e, info->data_id_list, info->length, info->max_delta);
    }
    for (int i = 0; i < DRIVE_MESSAGE_COUNT; i++) {
        e2e_sender_init(&self->tx[i], drive_messages[i].data_id_list);
    }
}

/* ---- receive ---------------------------------------------------------------------------------------------------- */

static bool decode_motor(const struct canfd_frame *frame, est_input *out) {
    struct drive_motor_state_t raw;
    if (drive_motor_state_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->id = EST_RX_MOTOR_STATE;
    out->tick = raw.tick;
    out->motor.torque_nm = drive_motor_state_torque_nm_to_phys(raw.torque_nm);
    out->motor.speed_rpm = drive_motor_state_speed_rpm_to_phys(raw.speed_rpm);
    out->motor.valid = !isnan(out->motor.torque_nm) && !isnan(out->motor.speed_rpm);
    return true;
}

static bool decode_temp(const struct canfd_frame *frame, est_input *out) {
    struct drive_temp_meas_t raw;
    if (drive_temp_meas_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->id = EST_RX_TEMP_MEAS;
    out->tick = raw.tick;
    out->temp.theta_w_degc = drive_temp_meas_theta_w_meas_degc_to_phys(raw.theta_w_meas_degc);
    out->temp.theta_r_degc = drive_temp_meas_theta_r_meas_degc_to_phys(raw.theta_r_meas_degc);
    out->temp.valid_w = !isnan(out->temp.theta_w_degc);
    out->temp.valid_r = !isnan(out->temp.theta_r_degc);
    return true;
}

static bool decode_coolant(const struct canfd_frame *frame, est_input *out) {
    struct drive_coolant_t raw;
    if (drive_coolant_unpack(&raw, frame->data, frame->len) != 0) {
        return false;
    }
    out->id = EST_RX_COOLANT;
    out->tick = raw.tick;
    out->coolant.coolant_degc = drive_coolant_coolant_degc_to_phys(raw.coolant_degc);
    out->coolant.soaked = raw.soaked != 0;
    out->coolant.valid = !isnan(out->coolant.coolant_degc);
    return true;
}

static bool decode(int id, const struct canfd_frame *frame, est_input *out) {
    switch (id) {
    case EST_RX_MOTOR_STATE:
        return decode_motor(frame, out);
    case EST_RX_TEMP_MEAS:
        return decode_temp(frame, out);
    default:
        return decode_coolant(frame, out);
    }
}

static bool complete(const est_input *input) {
    switch (input->id) {
    case EST_RX_MOTOR_STATE:
        return input->motor.valid;
    case EST_RX_TEMP_MEAS:
        return input->temp.valid_w && input->temp.valid_r;
    default:
        return input->coolant.valid;
    }
}

static int listened(canid_t id) {
    for (int i = 0; i < EST_RX_COUNT; i++) {
        if (drive_messages[RX_INDEX[i]].can_id == id) {
            return i;
        }
    }
    return -1;
}

est_bus_verdict est_bus_accept(est_bus *self, const struct canfd_frame *frame, int64_t at_ns, est_input *out) {
    const int id = listened(frame->can_id & CAN_EFF_MASK);
    if (id < 0) {
        self->foreign++;
        return EST_BUS_IGNORED;
    }
    if ((frame->can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG)) != 0 || (frame->flags & CANFD_FDF) != 0 ||
        frame->len > CAN_MAX_DLEN) {
        self->rejected++;
        return EST_BUS_IGNORED;
    }
    est_rx *rx = &self->rx[id];
    if (!e2e_is_usable(e2e_check(&rx->e2e, frame->data, frame->len))) {
        return EST_BUS_IGNORED;
    }
    if (!decode(id, frame, out)) {
        self->rejected++;
        return EST_BUS_IGNORED;
    }
    if (!complete(out)) {
        rx->unavailable++;
    }
    self->accepted++;
    rx->used_ns = at_ns;
    if (id == EST_RX_MOTOR_STATE && rx->alive && out->tick == rx->last_tick) {
        return EST_BUS_INPUT; /* the sender lives, what it sends stands still: let it grow stale */
    }
    if (rx->alive) {
        rt_stats_add(&rx->gap_ns, at_ns - rx->last_ns, self->accepted - 1U);
    }
    rx->alive = true;
    rx->last_tick = out->tick;
    rx->last_ns = at_ns;
    return EST_BUS_INPUT;
}

bool est_bus_stale(est_bus *self, int64_t now_ns, uint64_t index) {
    bool any = false;
    for (int i = 0; i < EST_RX_COUNT; i++) {
        est_rx *rx = &self->rx[i];
        if (!rx->alive) {
            continue;
        }
        /* A frame that arrived after the snapshot was read in the same job: its age is nil, not negative. */
        const int64_t age_ns = now_ns > rx->last_ns ? now_ns - rx->last_ns : 0;
        const bool stale = age_ns > (int64_t)drive_messages[RX_INDEX[i]].timeout_ms * NS_PER_MS;
        rx->timeouts += stale && !rx->stale ? 1U : 0U;
        rx->stale = stale;
        rt_stats_add(&rx->age_ns, age_ns, index);
        any = any || (stale && i != EST_RX_COOLANT);
    }
    return any;
}

int64_t est_bus_in_age_ns(const est_bus *self, est_rx_id id, int64_t now_ns) {
    const est_rx *rx = &self->rx[id];
    const int64_t age_ns = now_ns - rx->used_ns;
    return !rx->alive ? TIMING_NA : age_ns < 0 ? 0 : age_ns;
}

void est_bus_read_faults(const est_bus *self, est_bus_faults *out) {
    memset(out, 0, sizeof *out);
    for (int i = 0; i < EST_RX_COUNT; i++) {
        const uint32_t *counts = self->rx[i].e2e.counts;
        out->crc_errors += counts[E2E_WRONG_CRC];
        out->seq_errors += (uint64_t)counts[E2E_REPEATED] + counts[E2E_LOST] + counts[E2E_WRONG_SEQUENCE];
    }
    out->rejected = self->rejected;
}

/* ---- send ------------------------------------------------------------------------------------------------------- */

/* Packs `raw` of message NAME into `frame` and protects it. */
#define SEAL(self, index, name, raw, frame)                                              \
    do {                                                                                 \
        memset((frame), 0, sizeof *(frame));                                             \
        (void)drive_##name##_pack((frame)->data, &(raw), sizeof(frame)->data);           \
        timing_frames_seal((self)->tx, index, frame);                                    \
    } while (0)

void est_bus_estimate(est_bus *self, const est_output *in, struct canfd_frame *frame) {
    struct drive_estimate_t raw;
    memset(&raw, 0, sizeof raw);
    raw.status = drive_estimate_status_to_raw((double)in->status);
    raw.theta_w_est_degc = drive_estimate_theta_w_est_degc_to_raw(in->theta_w_degc);
    raw.theta_r_est_degc = drive_estimate_theta_r_est_degc_to_raw(in->theta_r_degc);
    raw.tick = in->tick;
    SEAL(self, DRIVE_INDEX_ESTIMATE, estimate, raw, frame);
}

void est_bus_innov(est_bus *self, const est_output *in, struct canfd_frame *frame) {
    struct drive_estimate_innov_t raw;
    memset(&raw, 0, sizeof raw);
    raw.sweeps = drive_estimate_innov_sweeps_to_raw((double)in->sweeps);
    raw.innov_w_degc = drive_estimate_innov_innov_w_degc_to_raw(in->innov_w_degc);
    raw.innov_r_degc = drive_estimate_innov_innov_r_degc_to_raw(in->innov_r_degc);
    raw.tick = in->tick;
    SEAL(self, DRIVE_INDEX_ESTIMATE_INNOV, estimate_innov, raw, frame);
}

void est_bus_validity(est_bus *self, const est_output *in, struct canfd_frame *frame) {
    const validity_result_t *validity = &in->validity;
    struct drive_est_validity_t raw;
    memset(&raw, 0, sizeof raw);
    raw.outside_speed = validity->outside_speed ? 1U : 0U;
    raw.outside_torque = validity->outside_torque ? 1U : 0U;
    raw.outside_theta_w = validity->outside_theta_w ? 1U : 0U;
    raw.outside_theta_r = validity->outside_theta_r ? 1U : 0U;
    raw.outside_joint = validity->outside_joint ? 1U : 0U;
    raw.scope = drive_est_validity_scope_to_raw((double)validity->scope);
    raw.novelty = drive_est_validity_novelty_to_raw(validity->novelty);
    raw.tick = in->tick;
    SEAL(self, DRIVE_INDEX_EST_VALIDITY, est_validity, raw, frame);
}

void est_bus_winding(est_bus *self, const est_output *in, struct canfd_frame *frame) {
    const estimator_channel_t *channel = &in->channel[0];
    struct drive_est_winding_t raw;
    memset(&raw, 0, sizeof raw);
    raw.sensor_w_fault = drive_est_winding_sensor_w_fault_to_raw((double)channel->fault);
    raw.sensor_w_trusted = channel->trusted ? 1U : 0U;
    raw.sigma_w_degc = drive_est_winding_sigma_w_degc_to_raw(channel->sigma_degc);
    raw.upper_w_degc = drive_est_winding_upper_w_degc_to_raw(channel->upper_degc);
    raw.tick = in->tick;
    SEAL(self, DRIVE_INDEX_EST_WINDING, est_winding, raw, frame);
}

void est_bus_rotor(est_bus *self, const est_output *in, struct canfd_frame *frame) {
    const estimator_channel_t *channel = &in->channel[1];
    struct drive_est_rotor_t raw;
    memset(&raw, 0, sizeof raw);
    raw.sensor_r_fault = drive_est_rotor_sensor_r_fault_to_raw((double)channel->fault);
    raw.sensor_r_trusted = channel->trusted ? 1U : 0U;
    raw.sigma_r_degc = drive_est_rotor_sigma_r_degc_to_raw(channel->sigma_degc);
    raw.upper_r_degc = drive_est_rotor_upper_r_degc_to_raw(channel->upper_degc);
    raw.tick = in->tick;
    SEAL(self, DRIVE_INDEX_EST_ROTOR, est_rotor, raw, frame);
}

void est_bus_timing(est_bus *self, const timing_job *in, struct canfd_frame frames[TIMING_JOB_FRAMES]) {
    timing_frames_job(&timing_frames_estimator, self->tx, in, frames);
}

static void input_faults(est_bus *self, const est_counters *in, struct canfd_frame *frame) {
    struct drive_est_input_faults_t raw;
    memset(&raw, 0, sizeof raw);
    raw.crc_errors = drive_est_input_faults_crc_errors_to_raw((double)in->crc_errors);
    raw.seq_errors = drive_est_input_faults_seq_errors_to_raw((double)in->seq_errors);
    raw.stale_inputs = drive_est_input_faults_stale_inputs_to_raw((double)in->stale_inputs);
    SEAL(self, DRIVE_INDEX_EST_INPUT_FAULTS, est_input_faults, raw, frame);
}

static void bus_faults(est_bus *self, const est_counters *in, struct canfd_frame *frame) {
    struct drive_est_bus_faults_t raw;
    memset(&raw, 0, sizeof raw);
    raw.rx_drops = drive_est_bus_faults_rx_drops_to_raw((double)in->rx_drops);
    raw.tx_drops = drive_est_bus_faults_tx_drops_to_raw((double)in->tx_drops);
    raw.rejected = drive_est_bus_faults_rejected_to_raw((double)in->rejected);
    SEAL(self, DRIVE_INDEX_EST_BUS_FAULTS, est_bus_faults, raw, frame);
}

static void core_faults(est_bus *self, const est_counters *in, struct canfd_frame *frame) {
    struct drive_est_core_faults_t raw;
    memset(&raw, 0, sizeof raw);
    raw.stray_ticks = drive_est_core_faults_stray_ticks_to_raw((double)in->stray_ticks);
    raw.restarts = drive_est_core_faults_restarts_to_raw((double)in->restarts);
    raw.held_intervals = drive_est_core_faults_held_intervals_to_raw((double)in->held_intervals);
    raw.late_measurements = drive_est_core_faults_late_measurements_to_raw((double)in->late_measurements);
    SEAL(self, DRIVE_INDEX_EST_CORE_FAULTS, est_core_faults, raw, frame);
}

static void core_faults2(est_bus *self, const est_counters *in, struct canfd_frame *frame) {
    struct drive_est_core_faults2_t raw;
    memset(&raw, 0, sizeof raw);
    raw.repeated_ticks = drive_est_core_faults2_repeated_ticks_to_raw((double)in->repeated_ticks);
    raw.off_grid = drive_est_core_faults2_off_grid_to_raw((double)in->off_grid);
    raw.invalid_inputs = drive_est_core_faults2_invalid_inputs_to_raw((double)in->invalid_inputs);
    raw.unconverged = drive_est_core_faults2_unconverged_to_raw((double)in->unconverged);
    SEAL(self, DRIVE_INDEX_EST_CORE_FAULTS2, est_core_faults2, raw, frame);
}

static void calibration(est_bus *self, const est_counters *in, struct canfd_frame *frame) {
    const estimator_calibration_t *c = &in->calibration;
    struct drive_est_calibration_t raw;
    memset(&raw, 0, sizeof raw);
    raw.calibration_state = drive_est_calibration_calibration_state_to_raw((double)c->state);
    raw.offset_w_degc = drive_est_calibration_offset_w_degc_to_raw(c->offset_degc[0]);
    raw.offset_r_degc = drive_est_calibration_offset_r_degc_to_raw(c->offset_degc[1]);
    raw.offset_sigma_w_degc = drive_est_calibration_offset_sigma_w_degc_to_raw(c->sigma_degc[0]);
    raw.offset_sigma_r_degc = drive_est_calibration_offset_sigma_r_degc_to_raw(c->sigma_degc[1]);
    SEAL(self, DRIVE_INDEX_EST_CALIBRATION, est_calibration, raw, frame);
}

void est_bus_counter(est_bus *self, size_t which, const est_counters *in, struct canfd_frame *frame) {
    enum { BEFORE = 2 }; /* timing frames whose ids come first */
    static void (*const make[EST_OWN_COUNTER_FRAMES])(est_bus *, const est_counters *, struct canfd_frame *) = {
        input_faults, bus_faults, core_faults, core_faults2, calibration};
    if (which >= BEFORE && which < BEFORE + EST_OWN_COUNTER_FRAMES) {
        make[which - BEFORE](self, in, frame);
        return;
    }
    const size_t timing = which < BEFORE ? which : which - EST_OWN_COUNTER_FRAMES;
    timing_frames_counter(&timing_frames_estimator, self->tx, timing, &in->timing, frame);
}

static void hashes(est_bus *self, const est_identity *in, struct canfd_frame *frame) {
    struct drive_est_identity_t raw;
    memset(&raw, 0, sizeof raw);
    raw.dbc_hash = drive_est_identity_dbc_hash_to_raw((double)in->dbc_hash);
    raw.weights_hash = drive_est_identity_weights_hash_to_raw((double)in->weights_hash);
    SEAL(self, DRIVE_INDEX_EST_IDENTITY, est_identity, raw, frame);
}

static void build(est_bus *self, const est_identity *in, struct canfd_frame *frame) {
    struct drive_est_build_t raw;
    memset(&raw, 0, sizeof raw);
    raw.build_hash = drive_est_build_build_hash_to_raw((double)in->build_hash);
    raw.setting_id = drive_est_build_setting_id_to_raw((double)in->setting_id);
    SEAL(self, DRIVE_INDEX_EST_BUILD, est_build, raw, frame);
}

static void granted(est_bus *self, const est_identity *in, struct canfd_frame *frame) {
    struct drive_est_granted_t raw;
    memset(&raw, 0, sizeof raw);
    raw.policy = drive_est_granted_policy_to_raw((double)in->policy);
    raw.priority = drive_est_granted_priority_to_raw((double)in->priority);
    raw.core = drive_est_granted_core_to_raw(in->core < 0 ? (double)NAN : (double)in->core);
    raw.mlock = in->mlock ? 1U : 0U;
    raw.period_us = drive_est_granted_period_us_to_raw((double)in->period_us);
    SEAL(self, DRIVE_INDEX_EST_GRANTED, est_granted, raw, frame);
}

void est_bus_identity(est_bus *self, size_t which, const est_identity *in, struct canfd_frame *frame) {
    static void (*const make[EST_IDENTITY_FRAMES])(est_bus *, const est_identity *, struct canfd_frame *) = {
        hashes, build, granted};
    make[which](self, in, frame);
}
