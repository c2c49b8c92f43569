#include "timing_frames.h"

#include <math.h>
#include <string.h>

const timing_frames_table timing_frames_estimator = {
    .job = {DRIVE_INDEX_EST_TIMING_A, DRIVE_INDEX_EST_TIMING_B, DRIVE_INDEX_EST_TIMING_C, DRIVE_INDEX_EST_TIMING_D},
    .counter = {DRIVE_INDEX_EST_RELEASES, DRIVE_INDEX_EST_MISSES, DRIVE_INDEX_EST_OVERLOAD, DRIVE_INDEX_EST_MISS_RUN,
                DRIVE_INDEX_EST_OUTPUTS, DRIVE_INDEX_EST_ENVIRONMENT, DRIVE_INDEX_EST_MACHINE, DRIVE_INDEX_EST_CANARY,
                DRIVE_INDEX_EST_WAKE_STAT, DRIVE_INDEX_EST_EXEC_STAT, DRIVE_INDEX_EST_RESP_STAT},
};

static double us_of(int64_t ns) {
    return ns < 0 ? (double)NAN : (double)ns * 1e-3;
}

static double ms_of(int64_t ns) {
    return ns < 0 ? (double)NAN : (double)ns * 1e-6;
}

void timing_frames_seal(e2e_sender_t tx[DRIVE_MESSAGE_COUNT], enum drive_index index, struct canfd_frame *frame) {
    frame->can_id = drive_messages[index].can_id;
    frame->len = drive_messages[index].length;
    (void)e2e_protect(&tx[index], frame->data, frame->len);
}

/* Packs `raw` by the layout NAME into an emptied `frame`. */
#define PACK(name, raw, frame)                                                           \
    do {                                                                                 \
        memset((frame), 0, sizeof *(frame));                                             \
        (void)drive_##name##_pack((frame)->data, &(raw), sizeof(frame)->data);           \
    } while (0)

/* ---- per job ---------------------------------------------------------------------------------------------------- */

static void job_a(const timing_job *in, struct canfd_frame *frame) {
    struct drive_est_timing_a_t raw;
    memset(&raw, 0, sizeof raw);
    raw.miss_late = in->miss_late ? 1U : 0U;
    raw.warmup = in->warmup ? 1U : 0U;
    raw.stale_input = in->stale_input ? 1U : 0U;
    raw.after_skip = in->after_skip ? 1U : 0U;
    raw.release_index = (uint32_t)(in->release_index & 0xFFFFFFU);
    raw.wake_lat_us = drive_est_timing_a_wake_lat_us_to_raw(us_of(in->wake_lat_ns));
    PACK(est_timing_a, raw, frame);
}

static void job_b(const timing_job *in, struct canfd_frame *frame) {
    struct drive_est_timing_b_t raw;
    memset(&raw, 0, sizeof raw);
    raw.miss_cause = drive_est_timing_b_miss_cause_to_raw((double)in->miss_cause);
    raw.exec_wall_us = drive_est_timing_b_exec_wall_us_to_raw(us_of(in->exec_wall_ns));
    raw.resp_us = drive_est_timing_b_resp_us_to_raw(us_of(in->resp_ns));
    PACK(est_timing_b, raw, frame);
}

static void job_c(const timing_job *in, struct canfd_frame *frame) {
    struct drive_est_timing_c_t raw;
    memset(&raw, 0, sizeof raw);
    raw.output = drive_est_timing_c_output_to_raw((double)in->output);
    raw.cut = in->cut ? 1U : 0U;
    raw.queued = in->queued ? 1U : 0U;
    raw.in_age_motor_us = drive_est_timing_c_in_age_motor_us_to_raw(us_of(in->in_age_ns[0]));
    raw.in_age_temp_us = drive_est_timing_c_in_age_temp_us_to_raw(us_of(in->in_age_ns[1]));
    PACK(est_timing_c, raw, frame);
}

static void job_d(const timing_job *in, struct canfd_frame *frame) {
    struct drive_est_timing_d_t raw;
    memset(&raw, 0, sizeof raw);
    raw.exec_cpu_us = drive_est_timing_d_exec_cpu_us_to_raw(us_of(in->exec_cpu_ns));
    raw.canary_us = drive_est_timing_d_canary_us_to_raw(us_of(in->canary_ns));
    PACK(est_timing_d, raw, frame);
}

void timing_frames_job(const timing_frames_table *table, e2e_sender_t tx[DRIVE_MESSAGE_COUNT], const timing_job *in,
                       struct canfd_frame frames[TIMING_JOB_FRAMES]) {
    static void (*const pack[TIMING_JOB_FRAMES])(const timing_job *, struct canfd_frame *) = {job_a, job_b, job_c, job_d};
    for (size_t i = 0; i < TIMING_JOB_FRAMES; i++) {
        pack[i](in, &frames[i]);
        timing_frames_seal(tx, table->job[i], &frames[i]);
    }
}

/* ---- once a second ---------------------------------------------------------------------------------------------- */

static void releases(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_releases_t raw;
    memset(&raw, 0, sizeof raw);
    raw.releases = drive_est_releases_releases_to_raw((double)in->releases);
    raw.jobs = drive_est_releases_jobs_to_raw((double)in->jobs);
    PACK(est_releases, raw, frame);
}

static void misses(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_misses_t raw;
    memset(&raw, 0, sizeof raw);
    raw.miss_late = drive_est_misses_miss_late_to_raw((double)in->miss_late);
    raw.miss_skipped = drive_est_misses_miss_skipped_to_raw((double)in->miss_skipped);
    raw.overrun = drive_est_misses_overrun_to_raw((double)in->overrun);
    PACK(est_misses, raw, frame);
}

static void overload(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_overload_t raw;
    memset(&raw, 0, sizeof raw);
    raw.waiting = drive_est_overload_waiting_to_raw((double)in->waiting);
    raw.queued = drive_est_overload_queued_to_raw((double)in->queued);
    raw.cut = drive_est_overload_cut_to_raw((double)in->cut);
    raw.rebased = drive_est_overload_rebased_to_raw((double)in->rebased);
    PACK(est_overload, raw, frame);
}

static void miss_run(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_miss_run_t raw;
    memset(&raw, 0, sizeof raw);
    raw.consec_miss_max = drive_est_miss_run_consec_miss_max_to_raw((double)in->consec_miss_max);
    raw.mk_worst = drive_est_miss_run_mk_worst_to_raw((double)in->mk_worst);
    raw.phase_us = drive_est_miss_run_phase_us_to_raw(us_of(in->phase_ns));
    PACK(est_miss_run, raw, frame);
}

static void outputs(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_outputs_t raw;
    memset(&raw, 0, sizeof raw);
    raw.held = drive_est_outputs_held_to_raw((double)in->held);
    raw.predicted = drive_est_outputs_predicted_to_raw((double)in->predicted);
    raw.invalidated = drive_est_outputs_invalidated_to_raw((double)in->invalidated);
    PACK(est_outputs, raw, frame);
}

static void environment(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_environment_t raw;
    memset(&raw, 0, sizeof raw);
    raw.minor_faults = drive_est_environment_minor_faults_to_raw((double)in->minor_faults);
    raw.major_faults = drive_est_environment_major_faults_to_raw((double)in->major_faults);
    raw.invol_switches = drive_est_environment_invol_switches_to_raw((double)in->invol_switches);
    PACK(est_environment, raw, frame);
}

static void machine(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_machine_t raw;
    memset(&raw, 0, sizeof raw);
    raw.run_delay_ms = drive_est_machine_run_delay_ms_to_raw(ms_of(in->run_delay_ns));
    raw.steal_ms = drive_est_machine_steal_ms_to_raw(ms_of(in->steal_ns));
    raw.migrations = drive_est_machine_migrations_to_raw((double)in->migrations);
    PACK(est_machine, raw, frame);
}

static void canary(const timing_counters *in, struct canfd_frame *frame) {
    struct drive_est_canary_t raw;
    memset(&raw, 0, sizeof raw);
    raw.canary_p99_us = drive_est_canary_canary_p99_us_to_raw(us_of(in->canary.p99_ns));
    raw.canary_max_us = drive_est_canary_canary_max_us_to_raw(us_of(in->canary.max_ns));
    PACK(est_canary, raw, frame);
}

/* EstWakeStat, EstExecStat and EstRespStat have one layout. */
static void stat(const timing_stat *in, struct canfd_frame *frame) {
    struct drive_est_wake_stat_t raw;
    memset(&raw, 0, sizeof raw);
    raw.p99_us = drive_est_wake_stat_p99_us_to_raw(us_of(in->p99_ns));
    raw.max_us = drive_est_wake_stat_max_us_to_raw(us_of(in->max_ns));
    PACK(est_wake_stat, raw, frame);
}

static void wake_stat(const timing_counters *in, struct canfd_frame *frame) {
    stat(&in->wake, frame);
}

static void exec_stat(const timing_counters *in, struct canfd_frame *frame) {
    stat(&in->exec, frame);
}

static void resp_stat(const timing_counters *in, struct canfd_frame *frame) {
    stat(&in->resp, frame);
}

void timing_frames_counter(const timing_frames_table *table, e2e_sender_t tx[DRIVE_MESSAGE_COUNT], size_t which,
                           const timing_counters *in, struct canfd_frame *frame) {
    static void (*const pack[TIMING_COUNTER_FRAMES])(const timing_counters *, struct canfd_frame *) = {
        releases, misses, overload, miss_run, outputs, environment, machine, canary, wake_stat, exec_stat, resp_stat};
    pack[which](in, frame);
    timing_frames_seal(tx, table->counter[which], frame);
}
