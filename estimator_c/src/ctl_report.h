/* The two JSON lines of the controller process: what it was granted, and what came of it.
 *
 * For outside the loop only: both write with stdio. A failing stream is the caller's to check (ferror). */
#ifndef CTL_REPORT_H
#define CTL_REPORT_H

#include <stdio.h>

#include "ctl_cycle.h"
#include "rt_grant.h"

typedef struct {
    const char *controller;
    const char *weights_sha256;
    const char *dbc_sha256;
    const char *build_sha256;
    uint32_t preview_hash;
    int64_t period_us;
    const rt_granted *granted;
} ctl_report_identity;

typedef struct {
    rt_environment start;     /* before the loop */
    rt_environment warm;      /* after warm-up */
    rt_environment end;
    bool warm_valid;          /* the run was longer than its warm-up */
    const char *stopped_by;   /* "signal", "end", "bus", "input" */
} ctl_report_run;

/* {"ready":true,"policy":…,"warnings":[…]} and a newline, flushed. */
void ctl_report_ready(FILE *out, const ctl_report_identity *identity);

/* {"final":true,"jobs":…} and a newline, flushed. Times in µs, after warm-up; null where there are too few samples.
 * "histograms" as in rt_report.h. */
void ctl_report_final(FILE *out, const ctl_cycle *cycle, const ctl_report_run *run);

#endif
