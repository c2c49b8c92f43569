/* What the last lines of the processes have in common.
 *
 * For outside the loop only: written with stdio. A failing stream is the caller's to check (ferror). */
#ifndef RT_REPORT_H
#define RT_REPORT_H

#include <stdio.h>

#include "rt_task.h"

/* ,"histograms":{"warmup":{…},"judged":{…}}: every metric of both windows with its buckets that are not empty,
 * [low_ns, high_ns, count]. Tens of kB; no memory of its own. Begins with a comma, for the inside of an object. */
void rt_report_histograms(FILE *out, const rt_task *task);

#endif
