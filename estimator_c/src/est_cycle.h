/* One cycle of the estimator process, the same in real time and in lock-step: read, check, estimate, publish, account.
 *
 *     frames → est_bus (E2E, decode) → estimator → est_bus (encode, E2E) → frames
 *
 * Frames leave in this order: Estimate, EstimateInnov, EstValidity, EstWinding, EstRotor, then (response time known)
 * EstTimingA … EstTimingD, then housekeeping: once a second of release time the sixteen counter frames, with the first job and
 * every ten seconds the three identity frames behind them. Housekeeping is a queue of which a job sends at most two frames,
 * so that no more than eleven leave together (EST_CYCLE_FRAMES_PER_JOB), what the send queue of a CAN interface (10) and its
 * controller (1) take. The counters of one round are all from the moment it began; the next round waits for its end, so
 * with fewer than ten jobs a second they come less often.
 * No allocation, no lock, no printing. One thread; the caller owns the object. */
#ifndef EST_CYCLE_H
#define EST_CYCLE_H

#include <stdbool.h>
#include <stdint.h>

#include "est_bus.h"
#include "est_io.h"
#include "estimator.h"
#include "injection.h"
#include "rt_machine.h"
#include "rt_task.h"
#include "timing_watch.h"

enum { EST_CYCLE_MAX_FRAMES = 4096 }; /* frames one job reads at most; the rest waits for the next job */

enum {
    EST_CYCLE_JOB_FRAMES = 5 + TIMING_JOB_FRAMES, /* that every job sends */
    EST_CYCLE_HOUSEKEEPING_FRAMES = 2,            /* at most, beside them */
    EST_CYCLE_FRAMES_PER_JOB = EST_CYCLE_JOB_FRAMES + EST_CYCLE_HOUSEKEEPING_FRAMES
};

typedef enum {
    EST_CYCLE_OK = 0,
    EST_CYCLE_GONE = 1,         /* the bus has ended */
    EST_CYCLE_INTERRUPTED = 2,  /* a signal ended the wait */
    EST_CYCLE_BAD_SETTING = 3,
    EST_CYCLE_BAD_PERIOD = 4,
    EST_CYCLE_STOPPED = 5       /* the policy's number of misses is reached */
} est_cycle_status;

/* What a job puts out whose estimate comes too late (rt_task_late_now). */
typedef enum {
    EST_ON_MISS_LATE = 0,    /* the late estimate, flagged */
    EST_ON_MISS_HOLD = 1,    /* what the last job in time put out, its tick included; its innovation is not repeated */
    EST_ON_MISS_PREDICT = 2, /* the net forward from the last estimate, status `predicting` */
    EST_ON_MISS_INVALID = 3  /* no temperatures, status `invalid` */
} est_on_miss;

/* Up to 800 kB (checked where it is compiled): belongs in static storage. */
/* What a logged job did that follows from no input: time decided it. */
typedef struct {
    timing_output output;
    uint8_t sweep_limit; /* the solver's time was up when it asked for the n-th time, after n sweeps; 0: it was not */
} est_replayed;

typedef struct {
    rt_task task;
    est_bus bus;
    estimator_t estimator;
    est_io io;
    est_identity identity;
    int64_t next_counters_ns;   /* release time from which the counters are due */
    int64_t next_identity_ns;
    est_counters round;         /* counters of the housekeeping round under way */
    size_t round_next;          /* its next frame: counters first, then identity */
    size_t round_end;           /* none left when round_next has come here */
    estimator_calibration_t calibration; /* of the newest job */
    est_on_miss on_miss;
    const est_replayed *replayed; /* while a job is replayed; otherwise NULL */
    est_output last_in_time;    /* what EST_ON_MISS_HOLD repeats */
    bool has_last;
    uint64_t output_jobs[4];    /* jobs by timing_output */
    injections faults;
    int64_t last_release_ns;    /* of the newest job */
    int64_t event_ns;           /* trigger by frames: arrival of the frame that waits for its job; -1: none */
    int64_t event_due_ns;       /* … and when a job runs without one */
    timing_watch watch;         /* what the kernel says since warm-up */
    uint64_t stale_jobs;        /* jobs made without fresh input */
    uint64_t estimates_sent;    /* jobs = estimates_sent + estimates_lost */
    uint64_t estimates_lost;
    uint64_t status_jobs[16];   /* jobs by published status */
} est_cycle;

/* Prepares everything and runs the whole estimator once through a made-up drive of its own, so that the first real job
 * finds code and data in memory. Copies all arguments; what `io.ctx` points to must outlive `self`. Milliseconds. */
est_cycle_status est_cycle_init(est_cycle *self, const rt_task_config *config, const rt_clock *clock,
                                const est_setting_t *setting, const est_io *io, const est_identity *identity);

/* What a late job puts out; EST_ON_MISS_LATE if never called. Where HOLD and PREDICT have nothing to start from, INVALID. */
void est_cycle_on_miss(est_cycle *self, est_on_miss on_miss);

/* Faults to be made on purpose. Copies. */
void est_cycle_inject(est_cycle *self, const injections *faults);

/* Run delay and steal time are read from `machine`, which outlives `self`. */
void est_cycle_watch(est_cycle *self, const rt_machine *machine);

/* Real time: the grid starts now (r_0), so that set-up time is no release. Once, before the first job. */
void est_cycle_start_grid(est_cycle *self);

/* Real time: waits for the next release and runs its job. Blocks up to one period. With rt_task_config.on_event the release is the
 * arrival of the next usable TempMeas; when none came for its HilTimeoutMs a job runs all the same, on stale input, and so on.
 * Of several that had arrived the newest has the job, the others are skipped releases (rt_task_event_passed). */
est_cycle_status est_cycle_wait_and_run(est_cycle *self);

/* Lock-step: runs the job of the next release, whose time is rt_task_next_release_ns. */
est_cycle_status est_cycle_run_released(est_cycle *self);

/* Replay (virtual time): runs the job of release `index`, after the one before, that read its inputs at `now_ns`. Releases
 * left out have no job; lateness is what `as` says. The same frames with the same arrival times give the same estimates as they did in real time. */
est_cycle_status est_cycle_run_replayed(est_cycle *self, uint64_t index, int64_t now_ns, const est_replayed *as);

/* The counters as they are published. O(1). */
void est_cycle_counters(const est_cycle *self, est_counters *out);

/* Sends the sixteen counter frames once more, after the last job; real time: in two lots, 5 ms apart. */
est_cycle_status est_cycle_send_final(est_cycle *self);

#endif
