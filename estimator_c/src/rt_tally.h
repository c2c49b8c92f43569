/* Bookkeeping of releases: what became of every single activation of a periodic task.
 *
 * A release is either executed (a job; late or in time) or skipped; both a late job and a skipped release are a miss.
 * At every instant releases = jobs + miss_skipped. Nothing here reads a clock, allocates or fails. One thread. */
#ifndef RT_TALLY_H
#define RT_TALLY_H

#include <stdbool.h>
#include <stdint.h>

enum { RT_MK_WINDOW = 100 }; /* the K of the weakly-hard (m, K) figure */

typedef struct {
    uint64_t releases;        /* activations accounted for */
    uint64_t jobs;            /* executed (or executing now) */
    uint64_t miss_late;       /* jobs whose response time exceeded the deadline */
    uint64_t miss_skipped;    /* activations that never ran */
    uint64_t overrun;         /* activations hit while a job was running */
    uint64_t consec_miss_max; /* longest run of misses */
    uint64_t mk_worst;        /* most misses among any RT_MK_WINDOW consecutive releases */
    /* private */
    uint64_t consec_miss;
    uint32_t window_misses;
    uint32_t window_head;
    uint8_t window[RT_MK_WINDOW];
} rt_tally;

/* All zero. */
void rt_tally_init(rt_tally *self);

/* A job starts: one release and one job more. O(1). */
void rt_tally_start(rt_tally *self);

/* The fate of the job started last is known. O(1). Call once per rt_tally_start, before any rt_tally_skip. */
void rt_tally_finish(rt_tally *self, bool late);

/* `count` releases were skipped. O(min(count, RT_MK_WINDOW)): a machine that was suspended for a day costs no more. */
void rt_tally_skip(rt_tally *self, uint64_t count);

/* `count` activations were hit while a job was running. O(1). */
void rt_tally_overrun(rt_tally *self, uint64_t count);

#endif
