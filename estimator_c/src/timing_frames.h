/* The timing of a real-time loop as frames: four per job, eleven once a second. The same for every process.
 *
 * The frames of two processes have the same layout and differ in their ids and data ids, so a process is a table of
 * positions in drive_messages[] (the estimator's: timing_frames_estimator). That all messages of a table have the layout of
 * the estimator's is checked where the DBC is tested, not here.
 *
 * No clock, no socket, no allocation, no printing; each function takes under 1 µs and cannot fail. Any thread, as long as
 * the senders belong to one. */
#ifndef TIMING_FRAMES_H
#define TIMING_FRAMES_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "drive_e2e.h"
#include "e2e.h"

enum {
    TIMING_JOB_FRAMES = 4,     /* TimingA … TimingD, in this order */
    TIMING_COUNTER_FRAMES = 11 /* Releases, Misses, Overload, MissRun, Outputs, Environment, Machine, Canary, WakeStat,
                                * ExecStat, RespStat, in this order */
};

/* Which messages a process sends. */
typedef struct {
    enum drive_index job[TIMING_JOB_FRAMES];
    enum drive_index counter[TIMING_COUNTER_FRAMES];
} timing_frames_table;

extern const timing_frames_table timing_frames_estimator;

/* What a job put out. The values are those of the bus signal `output`. */
typedef enum {
    TIMING_OUTPUT_COMPUTED = 0,
    TIMING_OUTPUT_HELD = 1,
    TIMING_OUTPUT_PREDICTED = 2,
    TIMING_OUTPUT_INVALID = 3
} timing_output;

enum { TIMING_NA = -1 }; /* of a duration: not available; so is every negative one */

/* One job. Durations in ns; what does not fit its signal becomes the last valid code. */
typedef struct {
    bool miss_late;
    bool warmup;
    bool stale_input;
    bool after_skip;
    bool cut;
    bool queued;
    uint8_t miss_cause;      /* rt_cause */
    timing_output output;
    uint64_t release_index;  /* sent modulo 2^24: 4.7 h at 1 ms */
    int64_t wake_lat_ns;
    int64_t exec_wall_ns;
    int64_t exec_cpu_ns;
    int64_t resp_ns;
    int64_t canary_ns;
    int64_t in_age_ns[2];    /* of the process's two inputs, in the order of its TimingC */
} timing_job;

typedef struct {
    int64_t p99_ns;
    int64_t max_ns;
} timing_stat;

/* What is counted. Counts stay at their last code. */
typedef struct {
    uint64_t releases;       /* run or skipped: releases = jobs + miss_skipped; those that wait are not in it */
    uint64_t jobs;
    uint64_t miss_late, miss_skipped, overrun;
    uint64_t waiting, queued, cut, rebased;
    uint64_t consec_miss_max, mk_worst;
    int64_t phase_ns;        /* total shift of the grid */
    uint64_t held, predicted, invalidated;
    int64_t minor_faults, major_faults, invol_switches; /* since the end of warm-up; negative: 0 is sent */
    int64_t run_delay_ns;    /* negative: not available */
    int64_t steal_ns;        /* the same */
    uint64_t migrations;
    timing_stat canary, wake, exec, resp;
} timing_counters;

/* All four frames of a job. `tx`: a sender per message of drive_messages[]. */
void timing_frames_job(const timing_frames_table *table, e2e_sender_t tx[DRIVE_MESSAGE_COUNT], const timing_job *in,
                       struct canfd_frame frames[TIMING_JOB_FRAMES]);

/* Frame `which` (below TIMING_COUNTER_FRAMES). */
void timing_frames_counter(const timing_frames_table *table, e2e_sender_t tx[DRIVE_MESSAGE_COUNT], size_t which,
                           const timing_counters *in, struct canfd_frame *frame);

/* Gives a packed frame its id, counter and CRC. `frame->data` is what the message's pack wrote, the rest is set here. */
void timing_frames_seal(e2e_sender_t tx[DRIVE_MESSAGE_COUNT], enum drive_index index, struct canfd_frame *frame);

#endif
