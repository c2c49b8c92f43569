/* One cycle of the controller process, the same in real time, lock-step and replay: read, check, control, publish,
 * account.
 *
 *     frames → ctl_bus (E2E, decode) → controller → ctl_bus (encode, E2E) → frames
 *
 * Frames leave in this order: TorqueCommand, CtlState, CtlSolve, then (response time known) CtlTimingA …
 * CtlTimingD, then housekeeping: once a second the counter frames, with the first job and every ten seconds the
 * three identity frames. At most eleven leave together. Without a fresh VehicleState, or before the first estimate
 * where one is needed, the torques are sent as not available: the plant then drives by itself, under its rule. No
 * allocation, no lock, no printing. One thread; the caller owns the object. */
#ifndef CTL_CYCLE_H
#define CTL_CYCLE_H

#include <stdbool.h>
#include <stdint.h>

#include "controller.h"
#include "ctl_bus.h"
#include "est_io.h"
#include "rt_machine.h"
#include "rt_task.h"
#include "timing_watch.h"

enum {
    CTL_CYCLE_MAX_FRAMES = 4096, /* frames one job reads at most; the rest waits for the next job */
    CTL_CYCLE_HOUSEKEEPING_FRAMES = 4,
    CTL_CYCLE_FRAMES_PER_JOB = CTL_COMMAND_FRAMES + TIMING_JOB_FRAMES + CTL_CYCLE_HOUSEKEEPING_FRAMES
};

typedef enum {
    CTL_CYCLE_OK = 0,
    CTL_CYCLE_GONE = 1,           /* the bus has ended */
    CTL_CYCLE_INTERRUPTED = 2,    /* a signal ended the wait */
    CTL_CYCLE_BAD_CONTROLLER = 3, /* controller_init refused; its error is in `error` */
    CTL_CYCLE_BAD_PERIOD = 4
} ctl_cycle_status;

/* About 1.1 MB: belongs in static storage. */
typedef struct {
    rt_task task;
    ctl_bus bus;
    controller_t controller;
    controller_error_t error;
    est_io io;
    ctl_identity identity;
    ctl_input estimate, winding; /* newest, to be fed together */
    bool estimate_new, winding_known;
    uint16_t tick;               /* of the newest VehicleState */
    int64_t next_counters_ns;    /* release time from which the counters are due */
    int64_t next_identity_ns;
    ctl_counters round;          /* counters of the housekeeping round under way */
    size_t round_next, round_end;
    timing_watch watch;          /* what the kernel says since warm-up */
    uint64_t stale_jobs, mute_jobs;
    uint64_t commands_sent, commands_lost; /* jobs = sent + lost */
    uint64_t sources[4];         /* jobs by controller_source_t */
} ctl_cycle;

/* Prepares everything and drives the controller along the beginning of its road, so that the first real job finds
 * code and data in memory. Copies all arguments; what `io.ctx` and `road` point to must outlive `self`.
 * Milliseconds. */
ctl_cycle_status ctl_cycle_init(ctl_cycle *self, const rt_task_config *config, const rt_clock *clock, const char *name,
                                const controller_road_t *road, const est_io *io, const ctl_identity *identity);

/* Run delay and steal time are read from `machine`, which outlives `self`. */
void ctl_cycle_watch(ctl_cycle *self, const rt_machine *machine);

/* Real time: the grid starts now (r_0). Once, before the first job. */
void ctl_cycle_start_grid(ctl_cycle *self);

/* Real time: waits for the next release and runs its job. Blocks up to one period. */
ctl_cycle_status ctl_cycle_wait_and_run(ctl_cycle *self);

/* Lock-step: runs the job of the next release, whose time is rt_task_next_release_ns. */
ctl_cycle_status ctl_cycle_run_released(ctl_cycle *self);

/* Replay: runs the job of release `index`, after the one before, that read its inputs at `now_ns`. */
ctl_cycle_status ctl_cycle_run_replayed(ctl_cycle *self, uint64_t index, int64_t now_ns);

/* The counters as they are published. O(1). */
void ctl_cycle_counters(const ctl_cycle *self, ctl_counters *out);

/* Sends the counter frames once more, after the last job. */
ctl_cycle_status ctl_cycle_send_final(ctl_cycle *self);

#endif
