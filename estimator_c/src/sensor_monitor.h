/* One sensor, watched by what is predicted for it: may its newest value be used, and if not, what is wrong with it?
 *
 *   range, gaps        → dropout          run of equal values   → stuck
 *   values beyond the gate, few           → spike
 *   a run of them that began with a jump  → offset
 *   spread of the last 2 s                → noise: still used, with the weight that this spread deserves
 *   slope of the slow innovation over the rate of change, last 15 s → slow (late or lagging)
 *   slow innovation as such, against what is usual                  → drift
 *
 * A sensor that stepped away and scatters as it should still shows changes: its values count a little, less the step.
 * A distrusted sensor is believed again after some seconds in which its values agree with the prediction, within what
 * the prediction may have lost meanwhile, and scatter as they should. Two faults at once show as the graver one.
 *
 * No allocation, no clock, no printing; one thread at a time per object; < 1 kB. */
#ifndef SENSOR_MONITOR_H
#define SENSOR_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "est_settings.h"
#include "sensor_fault.h"

enum { MONITOR_HISTORY = 30, MONITOR_SPREAD = 20, MONITOR_RUN = 5, MONITOR_PENDING = 5 };

/* What is known when a value is due, one per 0.1 s. */
typedef struct {
    double y;              /* measurement, offset removed, degC; NAN: none */
    double raw;            /* as the sensor gave it, for the range check */
    double residual;       /* y minus its prediction, degC */
    double variance;       /* of the prediction, K^2 */
    double slow;           /* innovation of the slow observer, low-passed, degC */
    double slow_raw;       /* the same, not low-passed */
    double rate;           /* predicted rate of change, degC/s */
} monitor_input_t;

/* What to do. */
typedef struct {
    double share;          /* 0..1 of the value's weight; 0: do not use it */
    double offset;         /* to be subtracted first, degC: a stepped sensor still shows changes */
    int32_t forget;        /* values before this one that turned out to be worth nothing */
    bool resume;           /* believed again: take the sensor's level */
    double level;          /* resume: how far the sensor stands above the prediction, degC */
    bool settled;          /* noise has ended: the slow observer, led astray by it, goes to the estimate's level */
    bool creep;            /* drift or lag found: the estimate has followed it, take the slow observer's level */
} monitor_verdict_t;

typedef struct {
    /* of the setting and the channel */
    double r;              /* variance of a value, K^2 */
    double gate, drift, range_low, range_high;

    sensor_class_t fault;  /* as published */
    bool trusted;
    double spread_r;       /* noise: variance as seen, K^2; else r */
    int32_t distrusted_steps, trusted_steps; /* since trust was lost, and since it came back */
    int32_t relapses;      /* creeping faults found soon after one had ended */
    int32_t quiet;         /* noise: steps without */
    int32_t elsewhere;     /* dropout, stuck: calm values far from the prediction, in a row */
    double ordinary_r;     /* scatter^2 that was ordinary before trust was lost, K^2 */

    double residual[MONITOR_HISTORY]; /* ring of the newest values' residuals */
    int32_t count, next;
    int32_t since_change;  /* values taken since trust was lost or the level was last out */
    int32_t since_step;    /* offset: values since then */
    bool rebased;          /* offset: its size is known */
    double offset;         /* that size, degC */
    int32_t missing;       /* in a row */
    int32_t equal;         /* values in a row equal to the one before */
    double equal_share;    /* how often that happens with this sensor */
    double last_y, run_prediction;
    int32_t run;           /* values beyond the gate in a row, on the same side; sign of the side */
    double last_inside;    /* residual of the last value inside the gate */
    int32_t spike_hold;    /* steps for which a spike is still shown */
    double moment[5];      /* exponentially weighted: slow, rate, slow^2, rate^2, slow rate */
    double moment_weight;
    double usual;          /* largest size of the slow innovation in this drive, slowly forgotten, degC */
    double pending[MONITOR_PENDING]; /* of the newest blocks, not yet part of it */
    int32_t steps;         /* of trusted record */
} sensor_monitor_t;

/* Watch channel `channel` as the setting says. Never fails. */
void sensor_monitor_init(sensor_monitor_t *self, const est_setting_t *setting, int channel);

/* Judge one value. < 2 us. Never fails. */
monitor_verdict_t sensor_monitor_step(sensor_monitor_t *self, const monitor_input_t *input);

/* Judge a value that came after its step: its share. Changes nothing. */
double sensor_monitor_late(const sensor_monitor_t *self, double raw, double residual, double variance);

/* Can the sensor's value be one at all? Open and shorted sensors give others; NAN is none. Never fails. */
bool sensor_monitor_in_range(const sensor_monitor_t *self, double raw);

/* For how long the sensor has not been believed, s; 0 while it is. Never fails. */
double sensor_monitor_distrusted_s(const sensor_monitor_t *self);

/* How far the machine may have moved from what the net says of it since then, degC: 0.05 a second, at most 10. As much
 * is added to the upper bound, and as far off the sensor may be when it comes back. Never fails. */
double sensor_monitor_gained_degc(const sensor_monitor_t *self);

#endif
