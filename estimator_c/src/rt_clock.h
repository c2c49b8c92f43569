/* The clocks a real-time task reads, as a table of functions so that a test can script every delay.
 *
 * All times are int64 nanoseconds. The functions of the system clock allocate nothing and may be called from any
 * thread. */
#ifndef RT_CLOCK_H
#define RT_CLOCK_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    void *ctx;                                         /* handed to every function; owned by the caller */
    int64_t (*now_ns)(void *ctx);                      /* monotonic time */
    int64_t (*thread_cpu_ns)(void *ctx);               /* processor time the calling thread has used */
    bool (*sleep_until_ns)(void *ctx, int64_t at_ns);  /* true: `at_ns` reached; false: a signal came first */
    int (*cpu)(void *ctx);                             /* the core the caller runs on, -1: unknown; NULL: not asked */
} rt_clock;

/* CLOCK_MONOTONIC, CLOCK_THREAD_CPUTIME_ID, clock_nanosleep with an absolute time, sched_getcpu. Cannot fail on
 * Linux. */
rt_clock rt_clock_system(void);

/* CLOCK_REALTIME, the clock of the kernel's receive stamps. About 30 ns. */
int64_t rt_clock_realtime_ns(void);

#endif
