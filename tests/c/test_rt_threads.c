/* The real-time runtime where it is not one thread: snapshots taken while the task runs, the canary, the machine's
 * figures. And releases by events. Run by tests/unit/test_rt_threads.py.
 *
 * Prints what it did and "ok", or the check that failed and exits with 1. */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "rt_canary.h"
#include "rt_clock.h"
#include "rt_grant.h"
#include "rt_machine.h"
#include "rt_task.h"

#define CHECK(condition)                                                         \
    do {                                                                         \
        if (!(condition)) {                                                      \
            fprintf(stderr, "%s:%d: %s is false\n", __FILE__, __LINE__, #condition); \
            return 1;                                                            \
        }                                                                        \
    } while (0)

enum { MS = 1000000 };

/* A clock that only the test moves. */
static int64_t scripted_ns;
static int64_t scripted_now(void *ctx) { return (void)ctx, scripted_ns; }
static int64_t scripted_cpu(void *ctx) { return (void)ctx, scripted_ns; }
static bool scripted_sleep(void *ctx, int64_t at_ns) {
    (void)ctx;
    scripted_ns = scripted_ns > at_ns ? scripted_ns : at_ns;
    return true;
}
static const rt_clock scripted = {NULL, scripted_now, scripted_cpu, scripted_sleep, NULL};

static rt_task task;

/* ---- snapshots ------------------------------------------------------------------------------------------------- */

static bool finished;

static void run_some_job(uint64_t i) {
    rt_job job;
    if (rt_task_wait(&task, &job) != RT_TASK_OK) {
        return;
    }
    scripted_ns += (int64_t)(i % 7U) * MS / 3; /* in time, late, and with skipped or waiting releases */
    rt_task_stepped(&task, &job);
    rt_task_published(&task, &job, i % 11U != 0, i % 13U == 0);
    rt_task_done(&task, &job);
}

static void *write_jobs(void *argument) {
    (void)argument;
    const rt_clock clock = rt_clock_system();
    for (uint64_t i = 0; !__atomic_load_n(&finished, __ATOMIC_ACQUIRE); i++) {
        run_some_job(i);
        const int64_t until_ns = clock.now_ns(NULL) + (int64_t)(i % 16U) * 1000; /* a reader needs a few µs */
        while (clock.now_ns(NULL) < until_ns) {
        }
    }
    return NULL;
}

static uint64_t sum(const uint64_t *values, size_t count) {
    uint64_t total = 0;
    for (size_t i = 0; i < count; i++) {
        total += values[i];
    }
    return total;
}

static bool conserved(const rt_tally *t) { return t->releases == t->jobs + t->miss_skipped + t->queued_now; }

static int whole(const rt_task_counters *c, const rt_stats *s) {
    CHECK(conserved(&c->total) && conserved(&c->warmup) && conserved(&c->judged));
    CHECK(c->total.releases == c->warmup.releases + c->judged.releases);
    CHECK(c->total.miss_late == c->warmup.miss_late + c->judged.miss_late);
    CHECK(c->total.overrun == c->warmup.overrun + c->judged.overrun);
    const uint64_t blamed = sum(c->causes, RT_CAUSES);
    CHECK(blamed == c->total.jobs || blamed + 1 == c->total.jobs); /* one may be running */
    CHECK(sum(c->skipped_causes, RT_CAUSES) == c->total.miss_skipped);
    CHECK(sum(c->judged_causes, RT_CAUSES) == c->judged.miss_late + c->judged.miss_skipped);
    CHECK(s->count == c->judged.jobs || s->count + 1 == c->judged.jobs);
    CHECK(s->count == s->underflow + s->overflow + sum(s->bucket, RT_STATS_BUCKETS));
    CHECK(s->count == 0 || ((double)s->min_ns <= s->mean_ns + 1e-6 && s->mean_ns <= (double)s->max_ns + 1e-6));
    return 0;
}

static int snapshots(void) {
    static rt_task_counters counters;
    static rt_stats stats;
    pthread_t writer;
    rt_task_config config = {.period_ns = MS, .deadline_ns = MS, .warmup_releases = 50, .mk_m = 1, .mk_k = 10};
    config.reaction.overrun = RT_OVERRUN_QUEUE;
    config.reaction.queue_limit = 2;
    CHECK(rt_task_init(&task, &config, &scripted) == RT_TASK_OK);
    CHECK(pthread_create(&writer, NULL, write_jobs, NULL) == 0);
    const rt_clock clock = rt_clock_system();
    const int64_t end_ns = clock.now_ns(NULL) + 400 * (int64_t)MS;
    uint64_t taken = 0;
    uint64_t busy = 0;
    int failed = 0;
    while (clock.now_ns(NULL) < end_ns && failed == 0) {
        if (rt_task_snapshot(&task, RT_METRIC_RESP, false, 50, &counters, &stats)) {
            failed = whole(&counters, &stats);
            taken++;
        } else {
            busy++;
        }
        (void)sched_yield();
    }
    __atomic_store_n(&finished, true, __ATOMIC_RELEASE);
    CHECK(pthread_join(writer, NULL) == 0);
    CHECK(failed == 0);
    CHECK(taken >= 10);
    CHECK(rt_task_snapshot(&task, RT_METRIC_RESP, false, 1, &counters, &stats));
    CHECK(whole(&counters, &stats) == 0 && counters.total.jobs == task.total.jobs);
    CHECK(memcmp(&stats, &task.stats[RT_METRIC_RESP], sizeof stats) == 0);
    rt_seqlock_begin(&task.version); /* a writer that never ends its section */
    CHECK(!rt_task_snapshot(&task, RT_METRIC_RESP, false, 1000, &counters, &stats));
    rt_seqlock_end(&task.version);
    (void)printf("%llu snapshots of a task of %llu jobs, %llu times busy\n", (unsigned long long)taken,
                 (unsigned long long)task.total.jobs, (unsigned long long)busy);
    return 0;
}

/* ---- the canary ------------------------------------------------------------------------------------------------ */

static int ring(void) {
    static rt_canary_ring r;
    rt_canary_record record;
    rt_canary_ring_init(&r);
    CHECK(!rt_canary_ring_pop(&r, &record));
    for (int64_t i = 0; i < RT_CANARY_RING + 3; i++) {
        rt_canary_ring_push(&r, (rt_canary_record){i, i + 1});
    }
    CHECK(rt_canary_ring_lost(&r) == 3);
    for (int64_t i = 0; i < RT_CANARY_RING; i++) {
        CHECK(rt_canary_ring_pop(&r, &record) && record.due_ns == i && record.woke_ns == i + 1);
    }
    CHECK(!rt_canary_ring_pop(&r, &record));
    rt_canary_ring_push(&r, (rt_canary_record){7, 8});
    CHECK(rt_canary_ring_pop(&r, &record) && record.due_ns == 7);
    return 0;
}

static int due_times(void) {
    CHECK(rt_canary_next_due_ns(100, 40, 0) == 110);
    CHECK(rt_canary_next_due_ns(100, 40, 100) == 110);
    CHECK(rt_canary_next_due_ns(100, 40, 109) == 110);
    CHECK(rt_canary_next_due_ns(100, 40, 110) == 130);
    CHECK(rt_canary_next_due_ns(100, 40, 130) == 150);
    CHECK(rt_canary_next_due_ns(100, 40, 149) == 150);
    return 0;
}

static void spin(int64_t ns) {
    const rt_clock clock = rt_clock_system();
    const int64_t until_ns = clock.now_ns(NULL) + ns;
    while (clock.now_ns(NULL) < until_ns) {
    }
}

/* The job computes all the time; what the canary says of it. */
static int canary_beside(rt_granted *job, bool *conclusive) {
    static rt_canary canary;
    const rt_clock clock = rt_clock_system();
    const int64_t period_ns = 4 * MS;
    rt_canary_start(&canary, period_ns, job);
    CHECK(canary.running);
    *conclusive = canary.conclusive;
    CHECK(canary.conclusive == (job->policy == RT_POLICY_FIFO && canary.policy == RT_POLICY_FIFO && job->core >= 0 &&
                                canary.core == job->core && canary.priority == job->priority + 1));
    const int64_t t0_ns = clock.now_ns(NULL);
    rt_canary_aim(&canary, t0_ns);
    spin(100 * MS);
    const int64_t end_ns = clock.now_ns(NULL);
    rt_canary_stop(&canary);
    rt_canary_record record;
    int64_t before_ns = t0_ns;
    int64_t quick = 0;
    int64_t heard = 0;
    int64_t covered = 0;
    while (rt_canary_ring_pop(&canary.ring, &record)) {
        CHECK((record.due_ns - t0_ns - period_ns / 4) % (period_ns / 2) == 0);
        CHECK(record.due_ns == rt_canary_next_due_ns(t0_ns, period_ns, before_ns));
        CHECK(record.woke_ns >= record.due_ns);
        covered += 1 + (record.woke_ns - record.due_ns) / (period_ns / 2);
        quick += record.woke_ns - record.due_ns < period_ns / 8 ? 1 : 0;
        before_ns = record.woke_ns;
        heard++;
    }
    if (*conclusive) { /* otherwise our own computing may keep it from the core */
        CHECK(covered >= (end_ns - t0_ns) / (period_ns / 2) - 1); /* each is a wake-up or inside a late one */
        CHECK(heard >= 1 && quick * 2 >= heard);
    }
    rt_canary_stop(&canary); /* again: nothing to do */
    return 0;
}

static int canary_thread(void) {
    rt_granted granted;
    bool conclusive = true;
    const rt_request plain = {-1, 80, false};
    rt_grant_apply(&plain, &granted);
    CHECK(canary_beside(&granted, &conclusive) == 0);
    CHECK(!conclusive && granted.warnings == 0); /* nothing was asked for, nothing is missing */
    cpu_set_t set;
    CHECK(sched_getaffinity(0, sizeof set, &set) == 0);
    int core = 0;
    while (!CPU_ISSET((size_t)core, &set)) {
        core++;
    }
    const rt_request real_time = {core, 80, true};
    rt_grant_apply(&real_time, &granted);
    const int warnings = granted.warnings;
    CHECK(canary_beside(&granted, &conclusive) == 0);
    CHECK(conclusive == (granted.policy == RT_POLICY_FIFO && granted.core == core));
    CHECK(granted.warnings == warnings);
    (void)printf("canary above a job of class %s: %s\n", rt_policy_name(granted.policy), conclusive ? "yes" : "no");
    if (granted.policy == RT_POLICY_FIFO) {
        const rt_request top = {core, 99, true};
        rt_grant_apply(&top, &granted);
        CHECK(canary_beside(&granted, &conclusive) == 0);
        CHECK(!conclusive && granted.warnings >= 1);
        CHECK(strstr(granted.warning[granted.warnings - 1], "not above the job") != NULL);
    }
    static rt_canary never_aimed;
    rt_canary_start(&never_aimed, MS, &granted);
    rt_canary_stop(&never_aimed);
    const struct sched_param none = {0};
    (void)sched_setscheduler(0, SCHED_OTHER, &none);
    return 0;
}

/* ---- the machine's figures ------------------------------------------------------------------------------------- */

static int machine(void) {
    static rt_machine m;
    int64_t run_delay_ns = 0;
    int64_t steal_ns = 0;
    rt_machine_stop(&m); /* never started */
    rt_machine_start(&m, -1, 5 * MS);
    const rt_clock clock = rt_clock_system();
    const bool schedstat = access("/proc/thread-self/schedstat", R_OK) == 0;
    const bool stat = access("/proc/stat", R_OK) == 0;
    const int64_t give_up_ns = clock.now_ns(NULL) + 5000 * (int64_t)MS;
    do {
        (void)clock.sleep_until_ns(NULL, clock.now_ns(NULL) + MS);
        rt_machine_read(&m, &run_delay_ns, &steal_ns);
    } while (((schedstat && run_delay_ns < 0) || (stat && steal_ns < 0)) && clock.now_ns(NULL) < give_up_ns);
    CHECK((run_delay_ns >= 0) == schedstat && (steal_ns >= 0) == stat);
    rt_environment environment;
    rt_environment_read(&environment, true); /* this thread's, as it was a moment later */
    CHECK(run_delay_ns <= environment.run_delay_ns && steal_ns / 10000000 <= environment.steal_ticks);
    rt_machine_stop(&m);
    rt_machine_start(&m, 1023, MS); /* no such core */
    (void)clock.sleep_until_ns(NULL, clock.now_ns(NULL) + 20 * MS);
    rt_machine_read(&m, &run_delay_ns, &steal_ns);
    CHECK(steal_ns == -1);
    rt_machine_stop(&m);
    return 0;
}

/* ---- releases by events ---------------------------------------------------------------------------------------- */

static void work(rt_job *job, int64_t ns) {
    scripted_ns += ns;
    rt_task_stepped(&task, job);
    rt_task_published(&task, job, true, false);
    rt_task_done(&task, job);
}

static int events(void) {
    rt_job job;
    rt_task_config config = {.period_ns = 10 * MS, .deadline_ns = 10 * MS, .on_event = true};
    config.reaction.stop_total = 3;
    scripted_ns = 0;
    CHECK(rt_task_init(&task, &config, &scripted) == RT_TASK_OK);
    CHECK(rt_task_wait(&task, &job) == RT_TASK_BAD_CONFIG);
    scripted_ns = 5100000;
    CHECK(rt_task_event(&task, &job, 5 * MS) == RT_TASK_OK);
    CHECK(job.index == 1 && job.wake_lat_ns == 100000 && !job.queued);
    work(&job, 25 * MS); /* two more events come meanwhile: at 15 and 25; done at 30.1 */
    CHECK(job.resp_ns == 25100000 && job.miss_late && job.cause == RT_CAUSE_LONG_COMPUTE);
    rt_task_event_passed(&task, 15 * MS);
    CHECK(task.total.miss_skipped == 1 && task.total.overrun == 1 && task.skipped_causes[RT_CAUSE_LONG_COMPUTE] == 1);
    CHECK(rt_task_event(&task, &job, 25 * MS) == RT_TASK_OK && job.index == 3 && job.queued && job.after_skip);
    CHECK(task.total.overrun == 2 && task.total.queued == 1);
    work(&job, MS);
    CHECK(job.resp_ns == 6100000 && !job.miss_late && job.cause == RT_CAUSE_NONE);
    CHECK(task.stats[RT_METRIC_PERIOD_DEV].count == 0 && task.stats[RT_METRIC_RESP].count == 2);
    scripted_ns = 46 * MS;
    rt_task_event_passed(&task, 35 * MS); /* nothing ran at 35: skipped, but no overrun */
    CHECK(task.total.overrun == 2 && task.total.miss_skipped == 2);
    CHECK(task.total.releases == 4 && task.total.jobs == 2);
    CHECK(rt_task_event(&task, &job, 45 * MS) == RT_TASK_STOPPED && task.total.releases == 4);
    CHECK(rt_task_stopped(&task));
    config.reaction = (rt_reaction){.overrun = RT_OVERRUN_REBASE};
    CHECK(rt_task_init(&task, &config, &scripted) == RT_TASK_BAD_CONFIG);
    return 0;
}

int main(void) {
    if (snapshots() || ring() || due_times() || canary_thread() || machine() || events()) {
        return 1;
    }
    puts("ok");
    return 0;
}
