/* Bookkeeping of releases: what became of every single activation of a periodic task.
 *
 * A release is executed (a job; late or in time), skipped, or waits in the queue; both a late job and a skipped
 * release are a miss. At every instant releases = jobs + miss_skipped + queued_now. Runs and windows of misses are
 * in order of release: a release skipped while an earlier one still waits enters them when that one has run.
 *
 * Nothing here reads a clock, allocates or fails. One thread. */
#ifndef RT_TALLY_H
#define RT_TALLY_H

#include <stdbool.h>
#include <stdint.h>

#include "rt_reaction.h"

typedef struct {
    uint64_t releases;        /* activations accounted for */
    uint64_t jobs;            /* executed (or executing now) */
    uint64_t miss_late;       /* jobs whose response time exceeded the deadline */
    uint64_t miss_skipped;    /* activations that never ran */
    uint64_t overrun;         /* activations hit while a job was running */
    uint64_t consec_miss_max; /* longest run of misses */
    uint64_t mk_worst;        /* most misses among any RT_MK_WINDOW consecutive releases */
    uint64_t queued;          /* jobs that had waited in the queue */
    uint64_t queued_now;      /* waiting */
    uint64_t mk_misses_max;   /* (m, K): most misses among any K consecutive releases; 0 without a monitor */
    uint64_t mk_violations;   /* (m, K): releases at which the last K held more than m misses */
    uint64_t consec_miss;     /* the run of misses under way */
    /* private */
    uint32_t mk_m;
    uint32_t mk_k;            /* 0: no monitor */
    uint32_t mk_misses;
    uint32_t window_misses;
    uint32_t window_head;
    uint8_t window[RT_MK_WINDOW];
} rt_tally;

/* All zero, no (m, K) monitor. */
void rt_tally_init(rt_tally *self);

/* The same, and watches that at most m of any k consecutive releases are misses. 0 <= m < k <= RT_MK_WINDOW. */
void rt_tally_init_mk(rt_tally *self, uint32_t m, uint32_t k);

/* A job starts: one release and one job more. O(1). */
void rt_tally_start(rt_tally *self);

/* A release begins to wait. O(1). */
void rt_tally_queue(rt_tally *self);

/* A release that waited starts. O(1). */
void rt_tally_start_queued(rt_tally *self);

/* The fate of the job started last is known. O(1). Call once per start, before any rt_tally_skip. */
void rt_tally_finish(rt_tally *self, bool late);

/* `count` releases were skipped. O(min(count, RT_MK_WINDOW)): a machine that was suspended for a day costs no more. */
void rt_tally_skip(rt_tally *self, uint64_t count);

/* The two halves of rt_tally_skip, for releases skipped while an earlier one waits: count them now … O(1). */
void rt_tally_skip_counted(rt_tally *self, uint64_t count);
/* … and enter them into runs and windows when their turn has come. */
void rt_tally_skip_settled(rt_tally *self, uint64_t count);

/* `count` activations were hit while a job was running. O(1). */
void rt_tally_overrun(rt_tally *self, uint64_t count);

#endif
