/* What a process says of its loop once a second, put together alike for each of them: the task's tallies and quantiles, and what
 * the kernel says since the end of warm-up.
 *
 * No allocation, no lock, no printing; one thread, that of the loop. The caller owns the object. */
#ifndef TIMING_WATCH_H
#define TIMING_WATCH_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_grant.h"
#include "rt_machine.h"
#include "rt_task.h"
#include "timing_frames.h"

/* Zeroed it watches the process alone, without run delay and steal time. */
typedef struct {
    const rt_machine *machine; /* NULL: none; outlives the object */
    rt_environment warm;       /* at the first job after warm-up */
    int64_t warm_run_delay_ns;
    int64_t warm_steal_ns;
    bool warm_known;
} timing_watch;

/* Takes note of the kernel's figures at the first job that is judged: what is published counts from there. Every job;
 * about 1 µs, once. Cannot fail: what is not available stays so. */
void timing_watch_job(timing_watch *self, const rt_job *job);

/* The counters of now, but for `held`, `predicted` and `invalidated`, which are 0. About 1 µs and three quantiles. */
void timing_watch_counters(const timing_watch *self, const rt_task *task, timing_counters *out);

#endif
