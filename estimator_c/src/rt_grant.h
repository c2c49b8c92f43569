/* Real-time set-up of the calling thread, and what the system granted of it.
 *
 * Every field of rt_granted is read back from the kernel, never copied from the request: a container may refuse
 * SCHED_FIFO, locked memory or a core without saying so. What was asked for and not granted becomes a warning;
 * nothing here is fatal. */
#ifndef RT_GRANT_H
#define RT_GRANT_H

#include <stdbool.h>
#include <stdint.h>

enum { RT_GRANT_WARNINGS = 8, RT_GRANT_WARNING_LENGTH = 192 };

/* The values of the bus signal `policy`. */
typedef enum { RT_POLICY_OTHER = 0, RT_POLICY_FIFO = 1, RT_POLICY_RR = 2 } rt_policy;

typedef struct {
    int core;          /* pin to this core; -1: wherever the system likes */
    int priority;      /* SCHED_FIFO priority 1..99 */
    bool real_time;    /* ask for SCHED_FIFO and locked memory */
} rt_request;

typedef struct {
    rt_policy policy;
    int priority;      /* 0 outside SCHED_FIFO and SCHED_RR */
    int core;          /* -1: not pinned to a single core */
    bool mlock;        /* mlockall succeeded and VmLck agrees */
    int64_t locked_kb; /* VmLck */
    int warnings;
    char warning[RT_GRANT_WARNINGS][RT_GRANT_WARNING_LENGTH];
} rt_granted;

/* What the kernel says about time stolen from a thread and from the whole machine. -1: not available. */
typedef struct {
    int64_t minor_faults;
    int64_t major_faults;
    int64_t vol_switches;
    int64_t invol_switches;
    int64_t run_delay_ns;  /* runnable but not running (/proc/thread-self/schedstat) */
    int64_t steal_ticks;   /* taken by the hypervisor, whole machine (/proc/stat, in USER_HZ) */
} rt_environment;

/* Pins, raises and locks the calling thread as asked, touches 256 KiB of stack, sets the shortest timer slack, makes
 * denormal numbers zero (FTZ/DAZ) and reads back what is now in force. Takes milliseconds; call once, before the
 * loop. */
void rt_grant_apply(const rt_request *request, rt_granted *granted);

/* The same for a further thread of the process: core, SCHED_FIFO, timer slack, denormals; memory is locked by
 * rt_grant_apply for all threads and the stack is left alone. `mlock` and `locked_kb` are not filled in. No file is
 * opened. */
void rt_grant_thread(const rt_request *request, rt_granted *granted);

/* Adds a warning, shortened to RT_GRANT_WARNING_LENGTH - 1 characters; dropped when there are RT_GRANT_WARNINGS
 * already. */
__attribute__((format(printf, 2, 3))) void rt_grant_warn(rt_granted *granted, const char *format, ...);

/* Denormals are zero in the calling thread from here on, so that a decaying state never slows the step. O(1). */
void rt_grant_flush_denormals(void);

/* The name of a policy: "other", "fifo", "rr". */
const char *rt_policy_name(rt_policy policy);

/* Reads all figures, `with_files` also those that need a file to be opened (tens of µs: not for the loop; without it
 * they are -1). About 1 µs without. */
void rt_environment_read(rt_environment *self, bool with_files);

#endif
