/* What a task does when a job overruns or misses: the policies of a scenario's [timing] table, as text and as numbers.
 *
 * No state, no clock. Any thread. */
#ifndef RT_REACTION_H
#define RT_REACTION_H

#include <stdbool.h>
#include <stdint.h>

enum {
    RT_QUEUE_MAX = 64,       /* longest queue of waiting releases */
    RT_MK_WINDOW = 100       /* longest window of the (m, K) monitor, and the K of mk_worst */
};

/* What becomes of the releases that pass while a job runs. */
typedef enum {
    RT_OVERRUN_SKIP = 0,   /* whole periods are left out, the phase is kept */
    RT_OVERRUN_QUEUE = 1,  /* they wait and run late one after another; what finds the queue full is skipped */
    RT_OVERRUN_REBASE = 2  /* the grid moves: the next release is the end of the overrun */
} rt_overrun;

/* All zero: skip, no budget, never stop. */
typedef struct {
    rt_overrun overrun;
    uint32_t queue_limit;  /* RT_OVERRUN_QUEUE: releases that may wait, 1..RT_QUEUE_MAX */
    int64_t budget_ns;     /* > 0: time from the release, after which rt_task_expired ends the solver; 0: no cut */
    uint64_t stop_total;   /* > 0: stop after so many judged misses */
    uint64_t stop_row;     /* > 0: stop after so many judged misses in a row */
} rt_reaction;

/* Reads "skip", "queue:N", "rebase", "cut:BUDGET_US", "stop:total:M" or "stop:row:M" (whole numbers, N 1..RT_QUEUE_MAX,
 * budget 1..10^9 µs, M 1..10^9). cut and stop skip what overruns all the same. False: no such policy, `out`
 * untouched. */
bool rt_reaction_parse(const char *text, rt_reaction *out);

/* Reads "m,K" or "m:K": at most m misses in any K consecutive releases, 0 <= m < K <= RT_MK_WINDOW. False: not that,
 * outputs untouched. */
bool rt_mk_parse(const char *text, uint32_t *m, uint32_t *k);

/* True for a reaction that rt_task takes with this deadline: known overrun policy, queue within its limits, budget
 * <= deadline. */
bool rt_reaction_valid(const rt_reaction *self, int64_t deadline_ns);

#endif
