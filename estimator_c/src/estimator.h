/* The estimator's core: frames in, estimate out. It knows no clock, no bus and no file; time is the plant's tick.
 *
 * Ticks are steps of 10 ms, 16 bits on the bus, unwrapped here. The first temperature frame fixes the grid of 0.1 s
 * intervals (temperature frames carry ticks on it). Interval k gathers the motor frames of its 10 ticks; their mean is
 * the net's input. When an interval is complete the MHE takes one step at the node `delay_steps` back, for which the
 * newest measurement speaks, and the net runs forward from there to now with the stored inputs. Between two intervals
 * the estimate follows the rate that the net gives for the motor frames received so far.
 *
 * Everything: no allocation, no printing; one thread at a time per object; state sizeof(estimator_t) (27 kB with 8
 * cells), owned by the caller. */
#ifndef ESTIMATOR_H
#define ESTIMATOR_H

#include <stdbool.h>
#include <stdint.h>

#include "fusion.h"
#include "offset_calibration.h"
#include "validity.h"

#define ESTIMATOR_RING 128          /* intervals remembered; a power of two */
#define ESTIMATOR_TICKS 10          /* motor ticks per interval */
#define ESTIMATOR_TICK_S 0.01

typedef enum {
    ESTIMATOR_INIT = 0,        /* nothing to work on yet */
    ESTIMATOR_STARTING = 1,    /* frames arrive, but no measurement speaks for a known interval yet */
    ESTIMATOR_RUNNING = 2,
    ESTIMATOR_PREDICTING = 3,  /* a channel has no measurement for longer than the setting's timeout, or a sensor that
                                * is not believed: the net alone. A channel that never had one started at the other's
                                * temperature */
    ESTIMATOR_INPUT_STALE = 4, /* the newest interval had no motor frame: its input was held */
    ESTIMATOR_INVALID = 5,     /* a result was not finite; the estimator has started again */
    ESTIMATOR_OPEN_LOOP = 6,   /* a channel without a trusted sensor for longer than the setting's limit */
    ESTIMATOR_FALLBACK = 7,    /* no usable solution of the MHE: the estimate is the Kalman filter's. Before 3 and 6 */
} estimator_status_t;

/* One temperature, beside its estimate. */
typedef struct {
    sensor_class_t fault;    /* of its sensor */
    bool trusted;            /* the newest measurement counts in the estimate */
    double sigma_degc;       /* standard deviation, the filter's at the newest measurement; NAN before the first */
    double upper_degc;       /* conservative upper bound of the temperature; NAN before the first */
    double innov_sigma_degc; /* predicted standard deviation of the innovation; NAN if none came since */
} estimator_channel_t;

typedef enum {
    ESTIMATOR_OK = 0,
    ESTIMATOR_BAD_SETTING = 1, /* a field outside what this build can hold */
} estimator_error_t;

/* Only grow; never cleared by a restart. */
typedef struct {
    uint32_t restarts;         /* tick went backwards or jumped too far twice in a row, or a result was not finite */
    uint32_t held_intervals;   /* intervals without a motor frame */
    uint32_t repeated_ticks;   /* motor frames with the tick of the frame before */
    uint32_t invalid_inputs;   /* motor frames without usable torque and speed */
    uint32_t off_grid;         /* temperature frames whose tick is not on the interval grid */
    uint32_t late_measurements;/* temperature frames that came after their node had left the window */
    uint32_t unconverged;      /* MHE steps that ended at the sweep limit */
    uint32_t stray_ticks;      /* motor frames not used: tick backwards or too far ahead, the frame before was none */
} estimator_counters_t;

typedef struct {
    double theta_w_degc, theta_r_degc; /* NAN before the first estimate */
    double innov_w_degc, innov_r_degc; /* newest measurement - what was predicted for it; NAN if none came since */
    int64_t tick;                      /* unwrapped tick the estimate is valid for: the newest motor frame's */
    uint16_t tick16;                   /* the same as on the bus */
    estimator_status_t status;
    bool stale_input;                  /* an interval consumed in this step had no motor frame */
    int32_t intervals;                 /* intervals consumed in this step */
    int32_t sweeps;                    /* most sweeps of any MHE solution in this step, 0: none was computed */
    double kkt_degc;                   /* of the last MHE solution in this step, see mhe.h; NAN: none */
    validity_result_t validity;        /* of the newest interval's input to the net */
    estimator_channel_t channel[MHE_CHANNELS];
    estimator_calibration_t calibration;
} estimator_out_t;

typedef struct {
    double speed_sum, torque_sum;      /* rpm, Nm over the frames received */
    int32_t frames;
} estimator_bin_t;

typedef struct {
    est_setting_t setting;
    estimator_counters_t counters;
    fusion_t fusion;
    offset_calibration_t calibration;

    /* Time. Node k lies at tick grid_tick + 10 k; interval k follows it. */
    bool anchored, motor_seen;
    bool tick_jumped;                  /* the last motor frame was such a stray */
    int64_t newest_tick;               /* newest motor tick, unwrapped */
    int64_t newest_temp_tick;
    int64_t last_measured_tick[MHE_CHANNELS]; /* newest valid measurement; far below any tick: none yet */
    int64_t grid_tick;
    int64_t next_interval;             /* the first not consumed yet */
    int32_t off_grid_run;              /* temperature frames off the grid in a row */

    /* Interval memory, index k modulo ring. */
    estimator_bin_t bin[ESTIMATOR_RING];
    double input[ESTIMATOR_RING][2];   /* [speed rpm, torque Nm] of consumed intervals */
    double novelty[ESTIMATOR_RING];    /* of consumed intervals, see validity.h */
    double measured[ESTIMATOR_RING][MHE_CHANNELS]; /* by node, offset removed; NAN: none */
    double held_input[2];              /* of the newest interval that had frames */

    /* Start. */
    double early_sum[MHE_CHANNELS];    /* measurements that speak for nodes before the first one */
    int32_t early_count[MHE_CHANNELS];
    int32_t fallback_left[MHE_CHANNELS]; /* a channel that started without a measurement: so many to come until it is
                                          * as good as others */
    bool started;

    /* Solution at the newest grid node. */
    double theta[MHE_CHANNELS];
    double memory[NET_MEMORY];
    validity_t validity;
    double innovation[MHE_CHANNELS];   /* not yet published */
    bool awaited[MHE_CHANNELS];        /* the newest node's measurement may still come */
    double resume_degc[MHE_CHANNELS];  /* after a restart: last estimate where the sensor is not believed */
    double innovation_variance[MHE_CHANNELS];
    double variance[MHE_CHANNELS];     /* of theta, K^2 */
    bool measurement_pending;          /* a late measurement entered the window after its step */
    bool invalid_pending;              /* the next output says ESTIMATOR_INVALID */
    bool newest_held;                  /* the newest consumed interval had no frame */
} estimator_t;

/* Where a prediction starts: the solution at the newest grid node before a step. */
typedef struct {
    bool known;                        /* false: there is none */
    uint32_t restarts;
    int64_t next_interval;
    double theta[MHE_CHANNELS];
    double memory[NET_MEMORY];
} estimator_base_t;

/* Start empty with a copy of `setting`. < 5 us. ESTIMATOR_BAD_SETTING leaves the object unusable. */
estimator_error_t estimator_init(estimator_t *self, const est_setting_t *setting);

/* Take one MotorState. valid = false (or a value not finite or beyond 1e6): the tick counts, the values do not. A
 * frame whose tick went backwards or more than max_gap_steps intervals ahead is not used; the second in a row restarts
 * the estimator. Never fails. < 0.1 us. */
void estimator_feed_motor(estimator_t *self, uint16_t tick16, double torque_nm, double speed_rpm, bool valid);

/* Take one TempMeas as it came from the sensor, offset included. Never fails. < 0.1 us. */
void estimator_feed_temp(estimator_t *self, uint16_t tick16, double theta_w_degc, double theta_r_degc, bool w_valid,
                         bool r_valid);

/* Take the coolant temperature, and whether the machine has stood long enough for all of it to have that temperature
 * (soaked). Only the offset calibration at key-on looks at it. Never fails. < 0.1 us. */
void estimator_feed_coolant(estimator_t *self, double coolant_degc, bool soaked, bool valid);

/* Consume every completed interval (one MHE step each, at most max_gap_steps + 1) and publish. Cost: per interval one
 * mhe_solve() and delay_steps net steps; without a completed interval at most one net step, or one re-solve when a
 * measurement arrived after its interval had been consumed. Never fails: trouble is in out->status. */
void estimator_step(estimator_t *self, estimator_out_t *out);

/* The same, with the MHE asking `expired` between sweeps whether its time is up: then it ends with the iterate it has,
 * after at least one sweep for each interval; where that is not good enough the Kalman filter stands in (status
 * ESTIMATOR_FALLBACK). NULL: no limit. */
void estimator_step_within(estimator_t *self, estimator_out_t *out, bool (*expired)(void *ctx), void *ctx);

/* Where estimator_predict() would start from now. < 0.1 us. */
void estimator_base(const estimator_t *self, estimator_base_t *base);

/* After a step: what the net alone gives for out->tick from `base`, taken before that step, without what the step made
 * of the measurements. Moves the temperatures and upper bounds of `out` there, with status ESTIMATOR_PREDICTING. False,
 * `out` untouched: there was nothing to start from, or the estimator began anew in that step. Cost: one net step for
 * each interval since, and one. */
bool estimator_predict(const estimator_t *self, const estimator_base_t *base, estimator_out_t *out);

/* After publishing: in mode feedback the rest of the last solution, as long as mhe_solve() takes; else nothing. Never
 * fails. */
void estimator_finish(estimator_t *self);

#endif
