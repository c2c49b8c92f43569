#include "rt_grant.h"

#include <errno.h>
#include <sched.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>

#if defined(__SSE2__)
#include <pmmintrin.h>
#include <xmmintrin.h>
#endif

enum { STACK_BYTES = 256 * 1024, PAGE_BYTES = 4096 };

void rt_grant_warn(rt_granted *granted, const char *format, ...) {
    if (granted->warnings >= RT_GRANT_WARNINGS) {
        return;
    }
    va_list args;
    va_start(args, format);
    (void)vsnprintf(granted->warning[granted->warnings], RT_GRANT_WARNING_LENGTH, format, args);
    va_end(args);
    granted->warnings++;
}

__attribute__((noinline)) static void prefault_stack(void) {
    volatile char page[STACK_BYTES];
    for (size_t i = 0; i < STACK_BYTES; i += PAGE_BYTES) {
        page[i] = 1;
    }
    (void)page[0];
}

void rt_grant_flush_denormals(void) {
#if defined(__SSE2__)
    _mm_setcsr(_mm_getcsr() | (unsigned)_MM_FLUSH_ZERO_ON | (unsigned)_MM_DENORMALS_ZERO_ON);
#elif defined(__aarch64__)
    uint64_t fpcr;
    __asm__ volatile("mrs %0, fpcr" : "=r"(fpcr));
    __asm__ volatile("msr fpcr, %0" : : "r"(fpcr | (UINT64_C(1) << 24)));
#endif
}

const char *rt_policy_name(rt_policy policy) {
    return policy == RT_POLICY_FIFO ? "fifo" : policy == RT_POLICY_RR ? "rr" : "other";
}

/* The number after `key` at the start of a line of a /proc file, or -1. */
static int64_t proc_number(const char *path, const char *key) {
    FILE *file = fopen(path, "re");
    if (file == NULL) {
        return -1;
    }
    char line[512];
    const size_t length = strlen(key);
    long long value = -1;
    while (fgets(line, sizeof line, file) != NULL) {
        if (strncmp(line, key, length) == 0) {
            if (sscanf(line + length, "%lld", &value) != 1) {
                value = -1;
            }
            break;
        }
    }
    (void)fclose(file);
    return (int64_t)value;
}

static int pinned_core(void) {
    cpu_set_t set;
    CPU_ZERO(&set);
    if (sched_getaffinity(0, sizeof set, &set) != 0 || CPU_COUNT(&set) != 1) {
        return -1;
    }
    for (int core = 0; core < CPU_SETSIZE; core++) {
        if (CPU_ISSET((size_t)core, &set)) {
            return core;
        }
    }
    return -1;
}

/* True unless refused, which has its warning. */
static bool pin(int core, rt_granted *granted) {
    cpu_set_t set;
    CPU_ZERO(&set);
    if (core >= CPU_SETSIZE) {
        rt_grant_warn(granted, "core %d does not exist; the loop runs on any core", core);
        return false;
    }
    CPU_SET((size_t)core, &set);
    if (sched_setaffinity(0, sizeof set, &set) != 0) {
        rt_grant_warn(granted, "core %d is not available (%s); the loop runs on any core", core, strerror(errno));
        return false;
    }
    return true;
}

/* What the system said yes to. */
typedef struct {
    bool core;
    bool policy;
    bool lock;
} answers;

static void read_back_thread(rt_granted *granted) {
    const int policy = sched_getscheduler(0);
    granted->policy = policy == SCHED_FIFO ? RT_POLICY_FIFO : policy == SCHED_RR ? RT_POLICY_RR : RT_POLICY_OTHER;
    struct sched_param param = {0};
    granted->priority = sched_getparam(0, &param) == 0 ? param.sched_priority : 0;
    granted->core = pinned_core();
}

/* Each thing that was granted is looked at by itself: a container may say yes and do nothing. */
static void read_back(const rt_request *request, const answers *yes, rt_granted *granted) {
    read_back_thread(granted);
    granted->locked_kb = proc_number("/proc/self/status", "VmLck:");
    granted->mlock = yes->lock && granted->locked_kb > 0;
    if (yes->lock && !granted->mlock) {
        rt_grant_warn(granted, "mlockall succeeded but VmLck is %lld kB: memory is not locked",
                      (long long)granted->locked_kb);
    }
    if (yes->policy && (granted->policy != RT_POLICY_FIFO || granted->priority != request->priority)) {
        rt_grant_warn(granted, "SCHED_FIFO priority %d was granted, but the system reports policy %s, priority %d",
                      request->priority, rt_policy_name(granted->policy), granted->priority);
    }
    if (yes->core && granted->core != request->core) {
        rt_grant_warn(granted, "core %d was granted, but the system reports %d (-1: no single one)", request->core,
                      granted->core);
    }
}

/* What belongs to the calling thread alone. */
static answers raise_thread(const rt_request *request, rt_granted *granted) {
    answers yes = {false, false, false};
    if (request->core >= 0) {
        yes.core = pin(request->core, granted);
    }
    if (request->real_time) {
        const struct sched_param param = {.sched_priority = request->priority};
        yes.policy = sched_setscheduler(0, SCHED_FIFO, &param) == 0;
        if (!yes.policy) {
            rt_grant_warn(granted, "SCHED_FIFO priority %d refused (%s): needs CAP_SYS_NICE or an rtprio limit; "
                          "wake-ups will be later", request->priority, strerror(errno));
        }
    }
    (void)prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* 50 µs by default outside SCHED_FIFO */
    rt_grant_flush_denormals();
    return yes;
}

void rt_grant_thread(const rt_request *request, rt_granted *granted) {
    memset(granted, 0, sizeof *granted);
    (void)raise_thread(request, granted);
    read_back_thread(granted);
}

void rt_grant_apply(const rt_request *request, rt_granted *granted) {
    memset(granted, 0, sizeof *granted);
    answers yes = raise_thread(request, granted);
    if (request->real_time) {
        yes.lock = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
        if (!yes.lock) {
            rt_grant_warn(granted, "mlockall refused (%s): needs CAP_IPC_LOCK or a larger memlock limit; "
                          "page faults are possible", strerror(errno));
        }
    }
    prefault_stack();
    read_back(request, &yes, granted);
}

/* The second number of schedstat: nanoseconds waited on a run queue. */
static int64_t run_delay_ns(void) {
    FILE *file = fopen("/proc/thread-self/schedstat", "re");
    if (file == NULL) {
        return -1;
    }
    long long delay = -1;
    if (fscanf(file, "%*s %lld", &delay) != 1) {
        delay = -1;
    }
    (void)fclose(file);
    return (int64_t)delay;
}

/* The eighth number of the line "cpu". */
static int64_t steal_ticks(void) {
    FILE *file = fopen("/proc/stat", "re");
    if (file == NULL) {
        return -1;
    }
    long long steal = -1;
    if (fscanf(file, "cpu %*s %*s %*s %*s %*s %*s %*s %lld", &steal) != 1) {
        steal = -1;
    }
    (void)fclose(file);
    return (int64_t)steal;
}

void rt_environment_read(rt_environment *self, bool with_files) {
    struct rusage usage;
    memset(&usage, 0, sizeof usage);
    (void)getrusage(RUSAGE_THREAD, &usage); /* fails only for bad arguments */
    self->minor_faults = usage.ru_minflt;
    self->major_faults = usage.ru_majflt;
    self->vol_switches = usage.ru_nvcsw;
    self->invol_switches = usage.ru_nivcsw;
    self->run_delay_ns = with_files ? run_delay_ns() : -1;
    self->steal_ticks = with_files ? steal_ticks() : -1;
}
