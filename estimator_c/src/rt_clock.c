#include "rt_clock.h"

#include <errno.h>
#include <sched.h>
#include <stddef.h>
#include <time.h>

static const int64_t NS_PER_S = 1000000000;

static int64_t read_ns(clockid_t id) {
    struct timespec ts = {0, 0};
    (void)clock_gettime(id, &ts); /* fails only for an unknown clock */
    return (int64_t)ts.tv_sec * NS_PER_S + (int64_t)ts.tv_nsec;
}

static int64_t monotonic_ns(void *ctx) {
    (void)ctx;
    return read_ns(CLOCK_MONOTONIC);
}

static int64_t thread_cpu_ns(void *ctx) {
    (void)ctx;
    return read_ns(CLOCK_THREAD_CPUTIME_ID);
}

static bool sleep_until_ns(void *ctx, int64_t at_ns) {
    (void)ctx;
    const struct timespec at = {.tv_sec = (time_t)(at_ns / NS_PER_S), .tv_nsec = (long)(at_ns % NS_PER_S)};
    return clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL) != EINTR;
}

static int cpu(void *ctx) {
    (void)ctx;
    return sched_getcpu();
}

rt_clock rt_clock_system(void) {
    const rt_clock clock = {NULL, monotonic_ns, thread_cpu_ns, sleep_until_ns, cpu};
    return clock;
}

int64_t rt_clock_realtime_ns(void) {
    return read_ns(CLOCK_REALTIME);
}
