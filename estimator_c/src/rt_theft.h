/* When the machine took the core from us: the newest late wake-ups of the canary, and how much of a job they cover.
 *
 * Pure bookkeeping in fixed memory. One thread. */
#ifndef RT_THEFT_H
#define RT_THEFT_H

#include <stdint.h>

enum { RT_THEFTS = 64 }; /* remembered: for the jobs that waited behind the one that met them */

/* A canary wake-up later than this is theft; up to it it is ordinary wake-up latency (p99 here: 0.08 ms). */
#define RT_THEFT_MIN_NS INT64_C(100000)

typedef struct {
    uint32_t head;
    uint32_t used;
    struct {
        int64_t from_ns;
        int64_t to_ns;
    } span[RT_THEFTS];
} rt_theft;

/* Empties it. */
void rt_theft_init(rt_theft *self);

/* The canary was due at `due_ns` and woke at `woke_ns`, or has not run until then. In order of time; what an earlier
 * call covers counts once. O(1). */
void rt_theft_note(rt_theft *self, int64_t due_ns, int64_t woke_ns);

/* Time taken between `from_ns` and `to_ns`. A lower bound: the canary cannot tell what was taken before it was due.
 * O(RT_THEFTS). */
int64_t rt_theft_between(const rt_theft *self, int64_t from_ns, int64_t to_ns);

#endif
