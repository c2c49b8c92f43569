#include "ctl_report.h"

#include <inttypes.h>

#include "rt_report.h"

static const char *boolean(bool value) {
    return value ? "true" : "false";
}

/* Our own texts and numbers only: nothing in them needs more than this. */
static void put_string(FILE *out, const char *text) {
    (void)fputc('"', out);
    for (const char *c = text; *c != '\0'; c++) {
        const bool special = *c == '"' || *c == '\\';
        (void)fprintf(out, special ? "\\%c" : "%c", (unsigned char)*c < 0x20U ? ' ' : *c);
    }
    (void)fputc('"', out);
}

void ctl_report_ready(FILE *out, const ctl_report_identity *identity) {
    const rt_granted *granted = identity->granted;
    (void)fprintf(out, "{\"ready\":true,\"policy\":\"%s\",\"priority\":%d,\"core\":", rt_policy_name(granted->policy),
                  granted->priority);
    if (granted->core >= 0) {
        (void)fprintf(out, "%d", granted->core);
    } else {
        (void)fputs("null", out);
    }
    (void)fprintf(out, ",\"mlock\":%s,\"locked_kb\":%" PRId64 ",\"period_us\":%" PRId64 ",\"controller\":\"%s\"",
                  boolean(granted->mlock), granted->locked_kb, identity->period_us, identity->controller);
    (void)fprintf(out, ",\"weights_hash\":\"%s\",\"dbc_hash\":\"%s\",\"build_hash\":\"%s\""
                  ",\"preview_hash\":\"%06" PRIx32 "\",\"warnings\":[", identity->weights_sha256,
                  identity->dbc_sha256, identity->build_sha256,
                  identity->preview_hash);
    for (int i = 0; i < granted->warnings; i++) {
        (void)fputs(i > 0 ? "," : "", out);
        put_string(out, granted->warning[i]);
    }
    (void)fputs("]}\n", out);
    (void)fflush(out);
}

static void put_us(FILE *out, const char *name, bool available, int64_t ns) {
    if (available) {
        (void)fprintf(out, "\"%s\":%.3f", name, (double)ns * 1e-3);
    } else {
        (void)fprintf(out, "\"%s\":null", name);
    }
}

static void put_stats(FILE *out, const char *name, const rt_stats *stats) {
    rt_summary s;
    rt_stats_summary(stats, &s);
    (void)fprintf(out, ",\"%s\":{\"count\":%" PRIu64, name, s.count);
    for (size_t i = 0; i < RT_STATS_QUANTILES; i++) {
        (void)fputc(',', out);
        put_us(out, rt_stats_quantile_name[i], s.quantile_status[i] != RT_QUANTILE_NA, s.quantile_ns[i]);
    }
    (void)fputc(',', out);
    put_us(out, "max", s.count > 0, s.max_ns);
    (void)fputc('}', out);
}

static void put_tally(FILE *out, const rt_tally *t) {
    (void)fprintf(out,
                  "\"releases\":%" PRIu64 ",\"jobs\":%" PRIu64 ",\"miss_late\":%" PRIu64 ",\"miss_skipped\":%" PRIu64
                  ",\"overrun\":%" PRIu64 ",\"consec_miss_max\":%" PRIu64 ",\"mk_worst\":%" PRIu64,
                  t->releases, t->jobs, t->miss_late, t->miss_skipped, t->overrun, t->consec_miss_max, t->mk_worst);
}

static void put_core(FILE *out, const ctl_cycle *cycle) {
    static const char *const source_names[] = {"driver", "plan", "shifted_plan", "rule"};
    const controller_counters_t *c = &cycle->controller.counters;
    (void)fprintf(out,
                  ",\"controller\":{\"solves\":%" PRIu32 ",\"failed\":%" PRIu32 ",\"slack_jumps\":%" PRIu32
                  ",\"unconverged\":%" PRIu32
                  ",\"shifted\":%" PRIu32 ",\"rule_steps\":%" PRIu32 ",\"clamped\":%" PRIu32 ",\"no_estimate\":%" PRIu32
                  ",\"bad_inputs\":%" PRIu32 ",\"mute\":%" PRIu64 "},\"origins\":{",
                  c->solves, c->failed, c->slack_jumps, c->unconverged, c->shifted, c->rule_steps, c->clamped,
                  c->no_estimate, c->bad_inputs, cycle->mute_jobs);
    for (size_t i = 0; i < sizeof source_names / sizeof source_names[0]; i++) {
        (void)fprintf(out, "%s\"%s\":%" PRIu64, i > 0 ? "," : "", source_names[i], cycle->sources[i]);
    }
    (void)fputc('}', out);
}

static void put_rx(FILE *out, const ctl_cycle *cycle) {
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        const ctl_rx *rx = &cycle->bus.rx[i];
        const uint32_t *counts = rx->e2e.counts;
        (void)fprintf(out,
                      "%s\"%s\":{\"ok\":%" PRIu32 ",\"repeated\":%" PRIu32 ",\"lost\":%" PRIu32
                      ",\"wrong_sequence\":%" PRIu32 ",\"wrong_crc\":%" PRIu32 ",\"timeouts\":%" PRIu64 "}",
                      i > 0 ? "," : "", drive_messages[ctl_rx_index[i]].name, counts[E2E_OK], counts[E2E_REPEATED],
                      counts[E2E_LOST], counts[E2E_WRONG_SEQUENCE], counts[E2E_WRONG_CRC], rx->timeouts);
    }
}

void ctl_report_final(FILE *out, const ctl_cycle *cycle, const ctl_report_run *run) {
    ctl_counters counters;
    ctl_cycle_counters(cycle, &counters);
    (void)fprintf(out, "{\"final\":true,\"stopped_by\":\"%s\",", run->stopped_by);
    put_tally(out, &cycle->task.total);
    (void)fprintf(out,
                  ",\"commands_sent\":%" PRIu64 ",\"commands_lost\":%" PRIu64 ",\"crc_errors\":%" PRIu64
                  ",\"seq_errors\":%" PRIu64 ",\"stale_inputs\":%" PRIu64 ",\"rx_drops\":%" PRIu64
                  ",\"tx_drops\":%" PRIu64
                  ",\"rejected\":%" PRIu64 ",\"foreign\":%" PRIu64,
                  cycle->commands_sent, cycle->commands_lost, counters.crc_errors, counters.seq_errors,
                  counters.stale_inputs,
                  counters.rx_drops, counters.tx_drops, counters.rejected, cycle->bus.foreign);
    put_core(out, cycle);
    for (size_t i = 0; i < RT_METRICS; i++) {
        put_stats(out, rt_metric_name[i], &cycle->task.stats[i]);
    }
    (void)fputs(",\"judged\":{", out);
    put_tally(out, &cycle->task.judged);
    (void)fputs("},\"rx\":{", out);
    put_rx(out, cycle);
    (void)fputc('}', out);
    if (run->warm_valid) {
        (void)fprintf(out, ",\"faults\":{\"minor\":%" PRId64 ",\"major\":%" PRId64 "}",
                      run->end.minor_faults - run->warm.minor_faults, run->end.major_faults - run->warm.major_faults);
    }
    (void)fprintf(out, ",\"invol_switches\":%" PRId64, run->end.invol_switches - run->start.invol_switches);
    rt_report_histograms(out, &cycle->task);
    (void)fputs("}\n", out);
    (void)fflush(out);
}
