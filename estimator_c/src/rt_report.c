#include "rt_report.h"

#include <inttypes.h>
#include <stddef.h>

static void put_histogram(FILE *out, const rt_stats *stats) {
    const char *comma = "";
    (void)fprintf(out, "{\"count\":%" PRIu64, stats->count);
    if (stats->count > 0) {
        (void)fprintf(out,
                      ",\"min_ns\":%" PRId64 ",\"min_index\":%" PRIu64 ",\"max_ns\":%" PRId64 ",\"max_index\":%" PRIu64
                      ",\"mean_ns\":%.3f,\"std_ns\":",
                      stats->min_ns, stats->min_index, stats->max_ns, stats->max_index, stats->mean_ns);
        rt_summary summary;
        rt_stats_summary(stats, &summary);
        (void)fprintf(out, stats->count > 1 ? "%.3f" : "null", summary.std_ns);
    } else {
        (void)fputs(",\"min_ns\":null,\"min_index\":null,\"max_ns\":null,\"max_index\":null,\"mean_ns\":null,\"std_ns\":null", out);
    }
    (void)fprintf(out, ",\"underflow\":%" PRIu64 ",\"overflow\":%" PRIu64 ",\"buckets\":[", stats->underflow, stats->overflow);
    for (size_t i = 0; i < RT_STATS_BUCKETS; i++) {
        int64_t low_ns = 0;
        int64_t high_ns = 0;
        if (stats->bucket[i] > 0) {
            rt_stats_bucket_bounds(i, &low_ns, &high_ns);
            (void)fprintf(out, "%s[%" PRId64 ",%" PRId64 ",%" PRIu64 "]", comma, low_ns, high_ns, stats->bucket[i]);
            comma = ",";
        }
    }
    (void)fputs("]}", out);
}

static void put_window(FILE *out, const char *name, const rt_stats stats[RT_METRICS]) {
    (void)fprintf(out, "\"%s\":{", name);
    for (size_t i = 0; i < RT_METRICS; i++) {
        (void)fprintf(out, "%s\"%s\":", i > 0 ? "," : "", rt_metric_name[i]);
        put_histogram(out, &stats[i]);
    }
    (void)fputc('}', out);
}

void rt_report_histograms(FILE *out, const rt_task *task) {
    (void)fputs(",\"histograms\":{", out);
    put_window(out, "warmup", task->warmup_stats);
    (void)fputc(',', out);
    put_window(out, "judged", task->stats);
    (void)fputc('}', out);
}
