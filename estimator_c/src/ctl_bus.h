/* The controller's side of the bus: frames in, checked and decoded; frames out, clamped and protected. As est_bus
 * for the estimator: what is damaged or repeated never gets past ctl_bus_accept, trouble is a counter that only
 * grows, and positions, scalings, timeouts and data ids are those of the DBC.
 *
 * No clock, no socket, no allocation, no printing; times are int64 ns of the caller's time base. The caller owns
 * the object; one thread. */
#ifndef CTL_BUS_H
#define CTL_BUS_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "controller.h"
#include "drive_e2e.h"
#include "e2e.h"
#include "timing_frames.h"

/* The messages the controller listens to. */
typedef enum {
    CTL_RX_MOTOR_STATE = 0,
    CTL_RX_ESTIMATE = 1,
    CTL_RX_WINDING = 2,
    CTL_RX_VEHICLE = 3,
    CTL_RX_COUNT = 4
} ctl_rx_id;

extern const enum drive_index ctl_rx_index[CTL_RX_COUNT];

/* Content of an accepted frame. A value that is not available is NaN. */
typedef struct {
    ctl_rx_id id;
    uint16_t tick;
    union {
        struct {
            double torque_nm, speed_rpm;
        } motor;
        struct {
            double theta_w_degc, theta_r_degc;
            bool usable; /* the status is one of an estimate */
        } estimate;
        struct {
            double sigma_degc, upper_degc;
        } winding;
        struct {
            double v_mps, distance_m;
        } vehicle;
    };
} ctl_input;

typedef struct {
    e2e_receiver_t e2e;     /* counts by verdict */
    bool alive;             /* a usable frame has been seen */
    bool stale;             /* older than HilTimeoutMs at the last ctl_bus_stale */
    uint64_t timeouts;      /* times it became stale */
    uint16_t last_tick;
    int64_t last_ns;        /* arrival of the last usable frame whose tick had moved */
} ctl_rx;

/* A few kB. */
typedef struct {
    ctl_rx rx[CTL_RX_COUNT];
    e2e_sender_t tx[DRIVE_MESSAGE_COUNT];
    uint64_t accepted;      /* frames handed on */
    uint64_t foreign;       /* valid frames of ids we do not listen to */
    uint64_t rejected;      /* an id of ours on a frame that cannot be ours */
} ctl_bus;

typedef struct {
    uint64_t crc_errors, seq_errors; /* all messages */
} ctl_bus_faults;

/* Counters as published; each stays at its last code. */
typedef struct {
    timing_counters timing;
    uint64_t crc_errors, seq_errors, stale_inputs;
    uint64_t rx_drops, tx_drops, rejected;
    uint64_t mute;          /* jobs that commanded nothing */
    controller_counters_t core;
} ctl_counters;

typedef struct {
    uint32_t dbc_hash, weights_hash, build_hash, preview_hash; /* 24 bits each */
    uint8_t controller_id;
    uint8_t policy;
    int priority;
    int core;               /* -1: not available */
    bool mlock;
    int64_t period_us;
} ctl_identity;

enum { CTL_COMMAND_FRAMES = 3, CTL_COUNTER_FRAMES = 4 + TIMING_COUNTER_FRAMES, CTL_IDENTITY_FRAMES = 3 };

/* Empties everything. Cannot fail. */
void ctl_bus_init(ctl_bus *self);

/* Judges one frame that arrived at `at_ns`; true: `out` holds new data. Under 1 µs. */
bool ctl_bus_accept(ctl_bus *self, const struct canfd_frame *frame, int64_t at_ns, ctl_input *out);

/* True if an input that has been alive is older than its timeout at `now_ns`. Once per job, after the job's frames. */
bool ctl_bus_stale(ctl_bus *self, int64_t now_ns);

/* Whether this input has been seen and was no older than its timeout at the last ctl_bus_stale. O(1). */
static inline bool ctl_bus_is_fresh(const ctl_bus *self, ctl_rx_id id) {
    return self->rx[id].alive && !self->rx[id].stale;
}

/* From the newest news of this input until `now_ns`, never negative; TIMING_NA before the first. O(1). */
int64_t ctl_bus_in_age_ns(const ctl_bus *self, ctl_rx_id id, int64_t now_ns);

void ctl_bus_read_faults(const ctl_bus *self, ctl_bus_faults *out);

/* Frames ready to be sent: TorqueCommand, CtlState, CtlSolve. `mute`: torques are sent as not available. Under 1 µs. */
void ctl_bus_command(ctl_bus *self, const controller_out_t *in, bool mute, uint16_t tick,
                     struct canfd_frame frames[CTL_COMMAND_FRAMES]);

void ctl_bus_timing(ctl_bus *self, const timing_job *in, struct canfd_frame frames[TIMING_JOB_FRAMES]);

/* Frame `which` (below CTL_COUNTER_FRAMES): CtlInputFaults, CtlBusFaults, CtlFallbacks, CtlSolves, then those of
 * timing_frames.h. */
void ctl_bus_counter(ctl_bus *self, size_t which, const ctl_counters *in, struct canfd_frame *frame);

/* Frame `which` (below CTL_IDENTITY_FRAMES) of CtlIdentity, CtlBuild, CtlGranted. */
void ctl_bus_identity(ctl_bus *self, size_t which, const ctl_identity *in, struct canfd_frame *frame);

#endif
