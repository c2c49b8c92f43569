/* Faults made on purpose, for the tests of what a timing fault leads to: a job that computes, or sleeps, for so long.
 *
 * Pure: no clock. Any thread. */
#ifndef INJECTION_H
#define INJECTION_H

#include <stdbool.h>
#include <stdint.h>

enum { INJECTIONS_MAX = 64, INJECTION_MAX_US = 60000000 };

typedef enum {
    INJECTION_COMPUTE = 0, /* work that asks for the time budget as the solver does, so that it can be cut */
    INJECTION_SLEEP = 1    /* off the processor, as if preempted; cannot be cut */
} injection_kind;

typedef struct {
    injection_kind kind;
    int64_t duration_ns;
    uint64_t release;      /* the job it happens in; one that is skipped has none */
} injection;

/* In order of their text. */
typedef struct {
    uint32_t count;
    injection item[INJECTIONS_MAX];
} injections;

/* Reads "compute:US@RELEASE" or "sleep:US@RELEASE" (US 1..INJECTION_MAX_US, RELEASE from 1) and appends it. False: not that,
 * or no room; `self` untouched. */
bool injections_add(injections *self, const char *text);

#endif
