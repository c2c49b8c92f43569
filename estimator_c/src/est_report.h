/* The two JSON lines of the estimator process: what it was granted, and what came of it.
 *
 * For outside the loop only: both write with stdio. A failing stream is the caller's to check (ferror). */
#ifndef EST_REPORT_H
#define EST_REPORT_H

#include <stdio.h>

#include "est_cycle.h"
#include "rt_grant.h"

typedef struct {
    const char *setting;
    const char *weights_sha256;
    const char *dbc_sha256;
    const char *build_sha256;
    int64_t period_us;
    const char *canary;       /* "none", "shown" (not above the job: nothing is blamed on the machine for it), "conclusive" */
    const rt_granted *granted;
} est_report_identity;

typedef struct {
    rt_environment start;     /* before the loop */
    rt_environment warm;      /* after warm-up */
    rt_environment end;
    bool warm_valid;          /* the run was longer than its warm-up */
    const char *stopped_by;   /* "signal", "end", "bus", "input", "misses" */
} est_report_run;

/* {"ready":true,"policy":…,"warnings":[…]} and a newline, flushed. */
void est_report_ready(FILE *out, const est_report_identity *identity);

/* {"final":true,"jobs":…} and a newline, flushed. Times in µs; null where there are too few samples, or none. The figures
 * at top level are those after warm-up; `scratch` is overwritten. Counters are since start. "histograms" has every metric of both
 * windows with its buckets that are not empty, [low_ns, high_ns, count]: tens of kB. */
void est_report_final(FILE *out, const est_cycle *cycle, const est_report_run *run, rt_stats *scratch);

#endif
