/* What the set-up of a real-time thread does to the thread itself; run by tests/unit/test_rt_grant.py.
 *
 * Prints "ok", or the check that failed and exits with 1. */
#include <sched.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "rt_clock.h"
#include "rt_grant.h"

#define CHECK(condition)                                                         \
    do {                                                                         \
        if (!(condition)) {                                                      \
            fprintf(stderr, "%s:%d: %s is false\n", __FILE__, __LINE__, #condition); \
            return 1;                                                            \
        }                                                                        \
    } while (0)

/* A container that says yes to everything and does nothing. */
static bool all_talk;

int sched_setscheduler(pid_t pid, int policy, const struct sched_param *param) {
    return all_talk ? 0 : (int)syscall(SYS_sched_setscheduler, pid, policy, param);
}

int sched_setaffinity(pid_t pid, size_t size, const cpu_set_t *set) {
    return all_talk ? 0 : (int)syscall(SYS_sched_setaffinity, pid, size, set);
}

int mlockall(int flags) {
    return all_talk ? 0 : (int)syscall(SYS_mlockall, flags);
}

static int denormals(void) {
    volatile double tiny = 2.2250738585072014e-308; /* the smallest normal number */
    const double before = tiny / 4.0;
    CHECK(before > 0.0);
    rt_grant_flush_denormals();
    const double after = tiny / 4.0;
    CHECK(after == 0.0);
    volatile double denormal = 4.9e-324;
    CHECK(denormal * 1e300 == 0.0); /* denormals are zero as operands, too */
    return 0;
}

static int nothing_asked(void) {
    const rt_request request = {-1, 80, false};
    cpu_set_t before;
    cpu_set_t after;
    rt_granted granted;
    CHECK(sched_getaffinity(0, sizeof before, &before) == 0);
    const int policy = sched_getscheduler(0);
    rt_grant_apply(&request, &granted);
    CHECK(sched_getaffinity(0, sizeof after, &after) == 0);
    CHECK(CPU_EQUAL(&before, &after));
    CHECK(sched_getscheduler(0) == policy);
    CHECK(granted.warnings == 0);
    CHECK(!granted.mlock);
    CHECK((granted.core >= 0) == (CPU_COUNT(&after) == 1));
    CHECK(prctl(PR_GET_TIMERSLACK) == 1);
    return 0;
}

static int impossible_core(void) {
    const rt_request request = {1023, 80, false};
    rt_granted granted;
    rt_grant_apply(&request, &granted);
    CHECK(granted.warnings == 1);
    CHECK(strstr(granted.warning[0], "core 1023 is not available") != NULL);
    return 0;
}

static bool warned(const rt_granted *granted, const char *text) {
    for (int i = 0; i < granted->warnings; i++) {
        if (strstr(granted->warning[i], text) != NULL) {
            return true;
        }
    }
    return false;
}

/* A yes without effect is no grant: one warning for each. */
static int granted_without_effect(void) {
    cpu_set_t set;
    CHECK(sched_getaffinity(0, sizeof set, &set) == 0);
    int ours = 0;
    while (!CPU_ISSET((size_t)ours, &set)) {
        ours++;
    }
    CPU_ZERO(&set);
    CPU_SET((size_t)ours, &set);
    CHECK(sched_setaffinity(0, sizeof set, &set) == 0);
    const rt_request request = {ours + 1, 80, true};
    rt_granted granted;
    all_talk = true;
    rt_grant_apply(&request, &granted);
    all_talk = false;
    CHECK(warned(&granted, "SCHED_FIFO priority 80 was granted, but the system reports policy other, priority 0"));
    char core[64];
    (void)snprintf(core, sizeof core, "core %d was granted, but the system reports %d", ours + 1, ours);
    CHECK(warned(&granted, core));
    CHECK(warned(&granted, "mlockall succeeded but VmLck is 0 kB"));
    CHECK(granted.warnings == 3);
    CHECK(granted.policy == RT_POLICY_OTHER && granted.core == ours && !granted.mlock);
    return 0;
}

static int environment(void) {
    rt_environment before;
    rt_environment after;
    rt_environment_read(&before, true);
    struct rusage usage;
    CHECK(getrusage(RUSAGE_THREAD, &usage) == 0);
    CHECK(before.minor_faults > 0 && before.minor_faults <= usage.ru_minflt);
    CHECK(before.vol_switches <= usage.ru_nvcsw && usage.ru_nvcsw - before.vol_switches <= 2);
    CHECK((before.run_delay_ns >= 0) == (access("/proc/thread-self/schedstat", R_OK) == 0));
    CHECK((before.steal_ticks >= 0) == (access("/proc/stat", R_OK) == 0));
    static volatile char pages[64 * 4096]; /* never touched so far */
    for (size_t i = 0; i < sizeof pages; i += 4096) {
        pages[i] = 1;
    }
    rt_environment_read(&after, false);
    CHECK(after.minor_faults - before.minor_faults >= 32);
    CHECK(after.run_delay_ns == -1 && after.steal_ticks == -1);
    return 0;
}

static int clocks(void) {
    const rt_clock clock = rt_clock_system();
    const int64_t start = clock.now_ns(clock.ctx);
    const int64_t cpu = clock.thread_cpu_ns(clock.ctx);
    CHECK(clock.sleep_until_ns(clock.ctx, start + 20000000));
    const int64_t end = clock.now_ns(clock.ctx);
    CHECK(end >= start + 20000000);
    CHECK(clock.thread_cpu_ns(clock.ctx) - cpu < end - start); /* sleeping costs no processor time */
    CHECK(clock.sleep_until_ns(clock.ctx, start)); /* a time that has passed is no wait and no error */
    CHECK(rt_clock_realtime_ns() > INT64_C(1600000000000000000));
    return 0;
}

int main(void) {
    if (denormals() || nothing_asked() || impossible_core() || granted_without_effect() || environment() || clocks()) {
        return 1;
    }
    puts("ok");
    return 0;
}
