#include "est_report.h"

#include <inttypes.h>

#include "rt_report.h"

static const int64_t NS_PER_S = 1000000000;

static const char *boolean(bool value) {
    return value ? "true" : "false";
}

static void put_string(FILE *out, const char *text) {
    (void)fputc('"', out);
    for (const char *c = text; *c != '\0'; c++) {
        if (*c == '"' || *c == '\\') {
            (void)fprintf(out, "\\%c", *c);
        } else if ((unsigned char)*c < 0x20U) {
            (void)fprintf(out, "\\u%04x", (unsigned)(unsigned char)*c);
        } else {
            (void)fputc(*c, out);
        }
    }
    (void)fputc('"', out);
}

void est_report_ready(FILE *out, const est_report_identity *identity) {
    const rt_granted *granted = identity->granted;
    (void)fprintf(out, "{\"ready\":true,\"policy\":\"%s\",\"priority\":%d,\"core\":", rt_policy_name(granted->policy),
                  granted->priority);
    if (granted->core >= 0) {
        (void)fprintf(out, "%d", granted->core);
    } else {
        (void)fputs("null", out);
    }
    (void)fprintf(out, ",\"mlock\":%s,\"locked_kb\":%" PRId64 ",\"period_us\":%" PRId64 ",\"canary\":\"%s\",\"setting\":",
                  boolean(granted->mlock), granted->locked_kb, identity->period_us, identity->canary);
    put_string(out, identity->setting);
    (void)fprintf(out, ",\"weights_hash\":\"%s\",\"dbc_hash\":\"%s\",\"build_hash\":\"%s\",\"warnings\":[",
                  identity->weights_sha256, identity->dbc_sha256, identity->build_sha256);
    for (int i = 0; i < granted->warnings; i++) {
        (void)fputs(i > 0 ? "," : "", out);
        put_string(out, granted->warning[i]);
    }
    (void)fputs("]}\n", out);
    (void)fflush(out);
}

static void put_us(FILE *out, const char *name, bool available, double ns) {
    if (available) {
        (void)fprintf(out, ",\"%s\":%.3f", name, ns * 1e-3);
    } else {
        (void)fprintf(out, ",\"%s\":null", name);
    }
}

static void put_summary(FILE *out, const char *name, const rt_summary *s) {
    (void)fprintf(out, "\"%s\":{\"count\":%" PRIu64, name, s->count);
    for (size_t i = 0; i < RT_STATS_QUANTILES; i++) {
        put_us(out, rt_stats_quantile_name[i], s->quantile_status[i] != RT_QUANTILE_NA, (double)s->quantile_ns[i]);
    }
    put_us(out, "min", s->count > 0, (double)s->min_ns);
    put_us(out, "max", s->count > 0, (double)s->max_ns);
    put_us(out, "mean", s->count > 0, s->mean_ns);
    put_us(out, "std", s->count > 1, s->std_ns);
    if (s->count > 0) {
        (void)fprintf(out, ",\"min_index\":%" PRIu64 ",\"max_index\":%" PRIu64, s->min_index, s->max_index);
    }
    (void)fprintf(out, ",\"underflow\":%" PRIu64 ",\"overflow\":%" PRIu64 "}", s->underflow, s->overflow);
}

static void put_stats(FILE *out, const char *name, const rt_stats *stats) {
    rt_summary summary;
    rt_stats_summary(stats, &summary);
    put_summary(out, name, &summary);
}

static void put_metrics(FILE *out, const rt_stats stats[RT_METRICS]) {
    for (size_t i = 0; i < RT_METRICS; i++) {
        (void)fputs(i > 0 ? "," : "", out);
        put_stats(out, rt_metric_name[i], &stats[i]);
    }
}

static void put_last_second(FILE *out, const est_cycle *cycle, rt_stats *scratch) {
    /* The window ends with the last release that ran. */
    for (size_t i = 0; i < RT_METRICS; i++) {
        rt_summary summary;
        rt_recent_summary(&cycle->task.recent[i], cycle->last_release_ns, NS_PER_S, scratch, &summary);
        (void)fputs(i > 0 ? "," : "", out);
        put_summary(out, rt_metric_name[i], &summary);
    }
}

static void put_tally(FILE *out, const rt_tally *t) {
    (void)fprintf(out,
                  "\"releases\":%" PRIu64 ",\"jobs\":%" PRIu64 ",\"miss_late\":%" PRIu64 ",\"miss_skipped\":%" PRIu64
                  ",\"overrun\":%" PRIu64 ",\"consec_miss_max\":%" PRIu64 ",\"mk_worst\":%" PRIu64 ",\"queued\":%" PRIu64
                  ",\"queued_now\":%" PRIu64,
                  t->releases, t->jobs, t->miss_late, t->miss_skipped, t->overrun, t->consec_miss_max, t->mk_worst, t->queued,
                  t->queued_now);
}

/* What the policy did, and the (m, K) monitor of the judged releases (null without one). */
static void put_reaction(FILE *out, const est_cycle *cycle) {
    const rt_task *task = &cycle->task;
    (void)fprintf(out,
                  ",\"cut\":%" PRIu64 ",\"rebased\":%" PRIu64 ",\"phase_us\":%.3f,\"migrations\":%" PRIu64
                  ",\"outputs\":{\"computed\":%" PRIu64 ",\"held\":%" PRIu64 ",\"predicted\":%" PRIu64 ",\"invalid\":%" PRIu64 "}",
                  task->cut_jobs, task->rebased, (double)task->phase_ns * 1e-3, task->migrations,
                  cycle->output_jobs[TIMING_OUTPUT_COMPUTED], cycle->output_jobs[TIMING_OUTPUT_HELD],
                  cycle->output_jobs[TIMING_OUTPUT_PREDICTED], cycle->output_jobs[TIMING_OUTPUT_INVALID]);
    if (task->config.mk_k > 0) {
        (void)fprintf(out, ",\"mk\":{\"m\":%" PRIu32 ",\"k\":%" PRIu32 ",\"worst\":%" PRIu64 ",\"violations\":%" PRIu64 "}",
                      task->config.mk_m, task->config.mk_k, task->judged.mk_misses_max, task->judged.mk_violations);
    } else {
        (void)fputs(",\"mk\":null", out);
    }
}

static void put_rx(FILE *out, const est_rx *rx, const char *name) {
    const uint32_t *counts = rx->e2e.counts;
    (void)fprintf(out,
                  "\"%s\":{\"ok\":%" PRIu32 ",\"repeated\":%" PRIu32 ",\"lost\":%" PRIu32 ",\"wrong_sequence\":%" PRIu32
                  ",\"wrong_crc\":%" PRIu32 ",\"frames_lost\":%" PRIu32 ",\"unavailable\":%" PRIu64 ",\"timeouts\":%" PRIu64 ",",
                  name, counts[E2E_OK], counts[E2E_REPEATED], counts[E2E_LOST], counts[E2E_WRONG_SEQUENCE],
                  counts[E2E_WRONG_CRC], rx->e2e.frames_lost, rx->unavailable, rx->timeouts);
    put_stats(out, "gap_us", &rx->gap_ns);
    (void)fputc(',', out);
    put_stats(out, "in_age_us", &rx->age_ns);
    (void)fputc('}', out);
}

static void put_faults(FILE *out, const char *name, const rt_environment *from, const rt_environment *to) {
    (void)fprintf(out,
                  ",\"%s\":{\"minor\":%" PRId64 ",\"major\":%" PRId64 "}", name, to->minor_faults - from->minor_faults,
                  to->major_faults - from->major_faults);
}

static void put_environment(FILE *out, const est_report_run *run) {
    if (run->warm_valid) {
        put_faults(out, "faults", &run->warm, &run->end);
    } else {
        (void)fputs(",\"faults\":null", out);
    }
    put_faults(out, "faults_since_start", &run->start, &run->end);
    (void)fprintf(out, ",\"invol_switches\":%" PRId64 ",\"vol_switches\":%" PRId64,
                  run->end.invol_switches - run->start.invol_switches, run->end.vol_switches - run->start.vol_switches);
    if (run->start.run_delay_ns >= 0 && run->end.run_delay_ns >= 0) {
        put_us(out, "run_delay_us", true, (double)(run->end.run_delay_ns - run->start.run_delay_ns));
    }
    if (run->start.steal_ticks >= 0 && run->end.steal_ticks >= 0) {
        (void)fprintf(out, ",\"steal_ticks\":%" PRId64, run->end.steal_ticks - run->start.steal_ticks);
    }
}

static void put_estimator(FILE *out, const estimator_counters_t *c) {
    (void)fprintf(out,
                  ",\"estimator\":{\"restarts\":%" PRIu32 ",\"held_intervals\":%" PRIu32 ",\"repeated_ticks\":%" PRIu32
                  ",\"invalid_inputs\":%" PRIu32 ",\"off_grid\":%" PRIu32 ",\"late_measurements\":%" PRIu32
                  ",\"unconverged\":%" PRIu32 ",\"stray_ticks\":%" PRIu32 "}",
                  c->restarts, c->held_intervals, c->repeated_ticks, c->invalid_inputs, c->off_grid, c->late_measurements,
                  c->unconverged, c->stray_ticks);
}

static void put_list(FILE *out, const char *name, const uint64_t *values, const char *const *names, size_t count) {
    (void)fprintf(out, ",\"%s\":{", name);
    for (size_t i = 0; i < count; i++) {
        (void)fprintf(out, "%s\"%s\":%" PRIu64, i > 0 ? "," : "", names[i], values[i]);
    }
    (void)fputc('}', out);
}

void est_report_final(FILE *out, const est_cycle *cycle, const est_report_run *run, rt_stats *scratch) {
    static const char *const status_names[] = {"init", "starting", "ok", "predicting",
                                               "input_stale", "invalid", "open_loop", "fallback"};
    est_counters counters;
    est_io_counters io;
    est_cycle_counters(cycle, &counters);
    cycle->io.counters(cycle->io.ctx, &io);
    (void)fprintf(out, "{\"final\":true,\"stopped_by\":\"%s\",", run->stopped_by);
    put_tally(out, &cycle->task.total);
    (void)fprintf(out, ",\"estimates_sent\":%" PRIu64 ",\"estimates_lost\":%" PRIu64, cycle->estimates_sent,
                  cycle->estimates_lost);
    (void)fprintf(out,
                  ",\"crc_errors\":%" PRIu64 ",\"seq_errors\":%" PRIu64 ",\"stale_inputs\":%" PRIu64 ",\"rx_drops\":%" PRIu64
                  ",\"tx_drops\":%" PRIu64 ",\"rejected\":%" PRIu64 ",\"error_frames\":%" PRIu64 ",\"foreign\":%" PRIu64
                  ",\"frames_received\":%" PRIu64
                  ",\"frames_sent\":%" PRIu64,
                  counters.crc_errors, counters.seq_errors, counters.stale_inputs, counters.rx_drops, counters.tx_drops,
                  counters.rejected, io.error_frames, cycle->bus.foreign, io.received, io.sent);
    put_reaction(out, cycle);
    put_list(out, "causes", cycle->task.causes, rt_cause_name, RT_CAUSES);
    put_list(out, "skipped_causes", cycle->task.skipped_causes, rt_cause_name, RT_CAUSES);
    put_list(out, "judged_causes", cycle->task.judged_causes, rt_cause_name, RT_CAUSES);
    put_list(out, "status_jobs", cycle->status_jobs, status_names, sizeof status_names / sizeof status_names[0]);
    put_estimator(out, &cycle->estimator.counters);
    (void)fputc(',', out);
    put_metrics(out, cycle->task.stats);
    (void)fputs(",\"judged\":{", out);
    put_tally(out, &cycle->task.judged);
    (void)fputs("},\"warmup\":{", out);
    put_tally(out, &cycle->task.warmup);
    (void)fputc(',', out);
    put_metrics(out, cycle->task.warmup_stats);
    (void)fputs("},\"last_second\":{", out);
    put_last_second(out, cycle, scratch);
    (void)fputs("},\"rx\":{", out);
    put_rx(out, &cycle->bus.rx[EST_RX_MOTOR_STATE], drive_messages[DRIVE_INDEX_MOTOR_STATE].name);
    (void)fputc(',', out);
    put_rx(out, &cycle->bus.rx[EST_RX_TEMP_MEAS], drive_messages[DRIVE_INDEX_TEMP_MEAS].name);
    (void)fputc(',', out);
    put_rx(out, &cycle->bus.rx[EST_RX_COOLANT], drive_messages[DRIVE_INDEX_COOLANT].name);
    (void)fputc('}', out);
    put_environment(out, run);
    rt_report_histograms(out, &cycle->task);
    (void)fputs("}\n", out);
    (void)fflush(out);
}
