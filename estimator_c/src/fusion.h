/* Net and measurements become one estimate, at the node the newest measurement speaks for.
 *
 *   u ─→ MHE, EKF, slow observer one step ahead ─→ monitor per sensor: what is this value worth?
 *                                                      └→ MHE solves │ EKF updates │ slow observer compares
 *
 * The MHE's estimate is published; the EKF gives the variance, and the estimate where the MHE has none or the setting
 * says so. All see the same shares of the same values.
 *
 * No allocation, no clock, no printing; one thread at a time per object; the caller owns it (18 kB with 8 cells). */
#ifndef FUSION_H
#define FUSION_H

#include <stdbool.h>

#include "ekf.h"
#include "mhe.h"
#include "sensor_monitor.h"
#include "slow_observer.h"

/* What the filter said of a node before its measurement. */
typedef struct {
    double theta[MHE_CHANNELS];
    double variance[MHE_CHANNELS]; /* K^2 */
    double memory[NET_MEMORY];
} fusion_prediction_t;

typedef struct {
    est_setting_t setting;
    mhe_t mhe;
    ekf_t ekf;
    fusion_prediction_t predicted[MHE_NODES]; /* of the window's nodes, a ring: arrival cost of the MHE */
    int32_t newest;              /* in the ring */
    int32_t steps;               /* since the start */
    slow_observer_t slow;
    sensor_monitor_t monitor[MHE_CHANNELS];
    double share[MHE_CHANNELS];  /* of the newest value; 0: not used */
    mhe_result_t result;         /* of the last solution */
    bool unfinished;             /* mode feedback: fusion_finish() has something to do */
    bool fallback;               /* the last estimate is the EKF's in place of the MHE's */
    bool (*expired)(void *ctx);  /* NULL: no limit; see fusion_limit() */
    void *expired_ctx;
} fusion_t;

/* The estimate at the newest node. */
typedef struct {
    double theta[MHE_CHANNELS];
    double variance[MHE_CHANNELS]; /* K^2 */
    const double *memory;          /* of the net, NET_MEMORY; valid until the next call */
    mhe_status_t status;           /* of the MHE; MHE_OK if it was not asked */
    double kkt_degc;               /* see mhe.h; NAN if it was not asked */
    int sweeps;
    bool usable;                   /* false: nothing finite, begin again */
} fusion_estimate_t;

/* Take a setting; nothing known. Never fails. */
void fusion_init(fusion_t *self, const est_setting_t *setting);

/* Begin at that temperature, known to `variance` (K^2), and that memory of the net. Never fails. */
void fusion_start(fusion_t *self, const double prior[MHE_CHANNELS], const double variance[MHE_CHANNELS],
                  const double memory[]);

/* One step of the net with u = [speed rpm, torque Nm]. Never fails. */
void fusion_advance(fusion_t *self, const double u[2]);

/* The last step was outside what the net knows, `novelty` half-widths from the middle (see validity.h): the prediction
 * is worth less, so that it does not condemn a sound sensor. Up to 1: nothing happens. */
void fusion_doubt(fusion_t *self, double novelty);

/* The value of a channel for the newest node, offset removed (NAN: none), and as the sensor gave it. Once per step and
 * channel. Returns the innovation (NAN: none) and its predicted variance. */
double fusion_measure(fusion_t *self, int channel, double y, double raw, double *variance);

/* A value for a node `age` > 0 steps back, later than the next value. It enters the MHE's window if the monitor would
 * have let it, not the filter. Returns the innovation; NAN: too late, or no MHE. */
double fusion_measure_late(fusion_t *self, int age, int channel, double y, double raw);

/* From now on fusion_solve() has the MHE ask `expired` between sweeps whether to end (mhe_solve_within). NULL, as after
 * fusion_init(): no limit. Mode feedback does one sweep anyhow. */
void fusion_limit(fusion_t *self, bool (*expired)(void *ctx), void *ctx);

/* Solve and give the estimate at the newest node; in mode feedback, after one sweep. */
void fusion_solve(fusion_t *self, fusion_estimate_t *estimate);

/* Mode feedback: the rest of the solution, which the next step begins from. Returns its status; MHE_OK where nothing is
 * left. */
mhe_status_t fusion_finish(fusion_t *self);

#endif
