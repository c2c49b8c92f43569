/* What the real-time runtime adds to a job: bench_rt CLOCK WORK_KB JOBS CLOCK counted: the clock costs nothing (the
 * accounting alone); system: the clocks of the real loop. WORK_KB of memory are walked through between the calls of
 * a job, as the job itself would (0: the accounting stays in the caches). The sleep takes no time, but the clock
 * leaps to the release, so that every job starts 30 µs late and is in time; the canary woke twice. Prints "jobs
 * median_ns p99_ns": the time in the four calls, less what two looks at the clock take. Instructions: callgrind with
 * --toggle-collect=timed_job. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "rt_task.h"

enum { MAX_JOBS = 100000, MAX_WORK = 16 << 20, LATE_NS = 30000 };

static rt_task task;
static rt_canary_ring ring;
static rt_clock real;
static int64_t ahead_ns; /* our clock before the real one */
static int64_t frozen_ns;
static bool counted;
static int64_t cost_ns[MAX_JOBS];
static unsigned char memory[MAX_WORK];
static volatile unsigned sink;

static int64_t now(void *ctx) {
    (void)ctx;
    return counted ? frozen_ns : real.now_ns(NULL) + ahead_ns;
}

static int64_t cpu(void *ctx) {
    (void)ctx;
    return counted ? frozen_ns : real.thread_cpu_ns(NULL);
}

static int core(void *ctx) {
    (void)ctx;
    return counted ? 0 : real.cpu(NULL);
}

static bool leap(void *ctx, int64_t at_ns) {
    (void)ctx;
    frozen_ns = at_ns + LATE_NS;
    ahead_ns += counted ? 0 : frozen_ns - now(NULL);
    return true;
}

/* Leaves the caches to the job's own data. */
static void work(size_t bytes) {
    unsigned sum = 0;
    for (size_t i = 0; i < bytes; i += 64) {
        sum += memory[i]++;
    }
    sink = sum;
}

static int64_t clock_ns(void) { return real.now_ns(NULL); }

void timed_job(size_t bytes, int64_t *sum_ns);

/* noinline and external: callgrind finds it by name */
__attribute__((noinline)) void timed_job(size_t bytes, int64_t *sum_ns) {
    rt_job job;
    int64_t at_ns[8];
    at_ns[0] = clock_ns();
    (void)rt_task_wait(&task, &job);
    at_ns[1] = clock_ns();
    work(bytes);
    at_ns[2] = clock_ns();
    rt_task_stepped(&task, &job);
    at_ns[3] = clock_ns();
    work(bytes / 4);
    at_ns[4] = clock_ns();
    rt_task_published(&task, &job, true, false);
    at_ns[5] = clock_ns();
    work(bytes / 4);
    at_ns[6] = clock_ns();
    rt_task_done(&task, &job);
    at_ns[7] = clock_ns();
    *sum_ns = at_ns[1] - at_ns[0] + at_ns[3] - at_ns[2] + at_ns[5] - at_ns[4] + at_ns[7] - at_ns[6];
}

static int ascending(const void *a, const void *b) {
    const int64_t x = *(const int64_t *)a;
    const int64_t y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static int64_t look_ns(void) {
    static int64_t looks[1001];
    for (size_t i = 0; i < 1001; i++) {
        const int64_t before_ns = clock_ns();
        looks[i] = clock_ns() - before_ns;
    }
    qsort(looks, 1001, sizeof looks[0], ascending);
    return looks[500];
}

int main(int argc, char **argv) {
    if (argc != 4) {
        return 2;
    }
    counted = strcmp(argv[1], "counted") == 0;
    const size_t bytes = (size_t)atoi(argv[2]) << 10;
    const int jobs = atoi(argv[3]);
    if (jobs < 1 || jobs > MAX_JOBS || bytes > MAX_WORK) {
        return 2;
    }
    real = rt_clock_system();
    const rt_clock clock = {NULL, now, cpu, leap, core};
    const rt_task_config config = {
        .period_ns = 1000000, .deadline_ns = 1000000, .warmup_releases = 5, .mk_m = 1, .mk_k = 100};
    if (rt_task_init(&task, &config, &clock) != RT_TASK_OK) {
        return 2;
    }
    rt_task_set_canary(&task, &ring, true);
    memset(memory, 1, sizeof memory);
    for (int i = 0; i < jobs; i++) {
        const int64_t due_ns = rt_task_next_release_ns(&task) - config.period_ns / 4;
        const int64_t before_ns = due_ns - config.period_ns / 2;
        rt_canary_ring_push(&ring, (rt_canary_record){before_ns, before_ns + LATE_NS});
        rt_canary_ring_push(&ring, (rt_canary_record){due_ns, due_ns + LATE_NS});
        timed_job(bytes, &cost_ns[i]);
    }
    const int64_t four_looks_ns = 4 * look_ns();
    qsort(cost_ns, (size_t)jobs, sizeof cost_ns[0], ascending);
    printf("%llu %lld %lld\n", (unsigned long long)task.total.jobs, (long long)(cost_ns[jobs / 2] - four_looks_ns),
           (long long)(cost_ns[jobs * 99 / 100] - four_looks_ns));
    return 0;
}
