/* The releases that wait while a job overruns (policy queue:N), oldest first, each with the releases skipped right
 * behind it.
 *
 * Pure bookkeeping in fixed memory; all functions are O(1) and cannot fail unless they say so. One thread. */
#ifndef RT_BACKLOG_H
#define RT_BACKLOG_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_reaction.h"

typedef struct {
    uint64_t index;         /* the release */
    uint64_t skipped_after; /* releases index + 1 … index + skipped_after were skipped */
} rt_waiting;

typedef struct {
    uint32_t limit;         /* 0..RT_QUEUE_MAX */
    uint32_t head;
    uint32_t used;
    rt_waiting slot[RT_QUEUE_MAX];
} rt_backlog;

/* Empty, with room for `limit`. */
void rt_backlog_init(rt_backlog *self, uint32_t limit);

/* False when it is full. Releases come in order. */
bool rt_backlog_push(rt_backlog *self, uint64_t index);

/* The releases that followed the newest one waiting were skipped. There must be one waiting. */
void rt_backlog_skip(rt_backlog *self, uint64_t count);

/* The oldest one, which no longer waits. There must be one. */
rt_waiting rt_backlog_pop(rt_backlog *self);

/* The oldest one, or NULL. */
const rt_waiting *rt_backlog_first(const rt_backlog *self);

#endif
