/* The estimator's side of the bus: frames in, checked and decoded; frames out, clamped and protected.
 *
 * A frame with a bad CRC or length never gets past est_bus_accept, nor does a repeated one (nothing new in it). Everything
 * that is not right is a counter that only grows. Positions, scalings, timeouts and data ids come from the generated
 * drive_* files, that is, from the DBC.
 *
 * No clock, no socket, no allocation, no printing; times are int64 ns of whatever time base the caller lives in, the same
 * for every call. The caller owns the object; one thread. */
#ifndef EST_BUS_H
#define EST_BUS_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "drive_e2e.h"
#include "e2e.h"
#include "estimator.h"
#include "rt_stats.h"
#include "timing_frames.h"

/* The messages the estimator listens to. */
typedef enum { EST_RX_MOTOR_STATE = 0, EST_RX_TEMP_MEAS = 1, EST_RX_COOLANT = 2, EST_RX_COUNT = 3 } est_rx_id;

/* Content of an accepted frame. A value that is not valid is NaN. */
typedef struct {
    est_rx_id id;
    uint16_t tick;
    union {
        struct {
            double torque_nm;
            double speed_rpm;
            bool valid; /* both available */
        } motor;
        struct {
            double theta_w_degc;
            double theta_r_degc;
            bool valid_w;
            bool valid_r;
        } temp;
        struct {
            double coolant_degc;
            bool soaked; /* the machine has stood and all of it has the coolant's temperature */
            bool valid;
        } coolant;
    };
} est_input;

typedef enum {
    EST_BUS_INPUT = 0,  /* `out` holds new data */
    EST_BUS_IGNORED = 1 /* not for us, damaged or repeated; counted where it is a fault */
} est_bus_verdict;

/* Reception of one message. */
typedef struct {
    e2e_receiver_t e2e;     /* counts by verdict */
    bool alive;             /* a usable frame has been seen */
    bool stale;             /* older than HilTimeoutMs at the last est_bus_stale */
    uint64_t timeouts;      /* times it became stale */
    uint64_t unavailable;   /* usable frames with a value not available that we use */
    uint16_t last_tick;     /* of the last usable frame */
    int64_t last_ns;        /* arrival of the last usable frame that brought news; MotorState: its tick had moved */
    int64_t used_ns;        /* arrival of the last usable frame */
    rt_stats gap_ns;        /* between such frames */
    rt_stats age_ns;        /* of the newest such frame when a job looked */
} est_rx;

/* Up to 112 kB (checked where it is compiled): belongs in static storage. */
typedef struct {
    est_rx rx[EST_RX_COUNT];
    e2e_sender_t tx[DRIVE_MESSAGE_COUNT];
    uint64_t accepted;      /* frames handed on */
    uint64_t foreign;       /* valid frames of ids we do not listen to */
    uint64_t rejected;      /* an id of ours on a frame that cannot be ours: extended, remote, error, FD */
} est_bus;

typedef struct {
    uint64_t crc_errors;    /* bad CRC or length, all messages */
    uint64_t seq_errors;    /* lost, repeated or out of sequence, all messages */
    uint64_t rejected;
} est_bus_faults;

/* What is published per job. NaN becomes the not-available code, a value out of range the nearest valid one. */
typedef struct {
    uint8_t status;         /* value table of Estimate.status */
    uint8_t sweeps;
    uint16_t tick;
    double theta_w_degc;
    double theta_r_degc;
    double innov_w_degc;
    double innov_r_degc;
    validity_result_t validity;
    estimator_channel_t channel[MHE_CHANNELS];
} est_output;

/* Counters as published, and the calibration that goes with them; each saturates at its last valid code. */
typedef struct {
    timing_counters timing;
    uint64_t crc_errors, seq_errors, stale_inputs;
    uint64_t rx_drops, tx_drops, rejected;
    uint64_t restarts, held_intervals, late_measurements, stray_ticks;
    uint64_t off_grid, invalid_inputs, unconverged, repeated_ticks;
    estimator_calibration_t calibration;
} est_counters;

typedef struct {
    uint32_t dbc_hash;      /* 24 bits each */
    uint32_t weights_hash;
    uint32_t build_hash;
    uint8_t setting_id;
    uint8_t policy;
    int priority;
    int core;               /* -1: not available */
    bool mlock;
    int64_t period_us;
} est_identity;

/* Empties everything. Cannot fail (the generated tables are valid by their own tests). */
void est_bus_init(est_bus *self);

/* Judges one frame that arrived at `at_ns`. `out` is written only for EST_BUS_INPUT. A MotorState with the tick of the one
 * before is handed on, but does not keep the input alive: a sender whose model stands still grows stale. Under 1 µs. */
est_bus_verdict est_bus_accept(est_bus *self, const struct canfd_frame *frame, int64_t at_ns, est_input *out);

/* True if an input that has been alive is older than its timeout at `now_ns`; records the ages under release `index`. Call
 * once per job, after the job's frames. An input never seen yet is not stale: there is nothing to be late. Coolant frames are
 * of use at key-on alone: one that is late counts as a timeout of that message, but does not make the input stale. */
bool est_bus_stale(est_bus *self, int64_t now_ns, uint64_t index);

/* Whether this input was stale at the last est_bus_stale. O(1). */
static inline bool est_bus_is_stale(const est_bus *self, est_rx_id id) {
    return self->rx[id].stale;
}

/* From the arrival of the newest usable frame of this message until `now_ns`, never negative; TIMING_NA before the first. Also
 * a frame that brought no news counts: it is what the estimator was fed last. O(1). */
int64_t est_bus_in_age_ns(const est_bus *self, est_rx_id id, int64_t now_ns);

/* Sum of the fault counters. O(1). */
void est_bus_read_faults(const est_bus *self, est_bus_faults *out);

/* Frames ready to be sent, with the next counter and the CRC: a frame made and not sent shows as lost at the receiver.
 * Each takes well under 1 µs and cannot fail. */
void est_bus_estimate(est_bus *self, const est_output *in, struct canfd_frame *frame);
void est_bus_innov(est_bus *self, const est_output *in, struct canfd_frame *frame);
void est_bus_validity(est_bus *self, const est_output *in, struct canfd_frame *frame);
void est_bus_winding(est_bus *self, const est_output *in, struct canfd_frame *frame);
void est_bus_rotor(est_bus *self, const est_output *in, struct canfd_frame *frame);
void est_bus_timing(est_bus *self, const timing_job *in, struct canfd_frame frames[TIMING_JOB_FRAMES]);

enum { EST_OWN_COUNTER_FRAMES = 5, EST_COUNTER_FRAMES = EST_OWN_COUNTER_FRAMES + TIMING_COUNTER_FRAMES, EST_IDENTITY_FRAMES = 3 };
/* Frame `which` (below EST_COUNTER_FRAMES) in the order of their ids: EstReleases, EstMisses, EstInputFaults, EstBusFaults,
 * EstCoreFaults, EstCoreFaults2, EstCalibration, EstOverload, … EstRespStat (timing_frames.h). */
void est_bus_counter(est_bus *self, size_t which, const est_counters *in, struct canfd_frame *frame);
/* Frame `which` (below EST_IDENTITY_FRAMES) of EstIdentity, EstBuild, EstGranted. */
void est_bus_identity(est_bus *self, size_t which, const est_identity *in, struct canfd_frame *frame);

#endif
