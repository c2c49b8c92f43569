/* The net held to the measurements by a very weak pull: what the temperatures would be if the sensors were trusted
 * over minutes only. Its innovation shows what creeps, which an estimator that follows within seconds cannot show.
 *
 * A proportional-integral observer: innovation e, d theta/dt = F + bias + e/T, d bias/dt = e/(T Ti), T and Ti growing
 * from the start as the record grows (as the gains of a Kalman filter shrink). bias is then what the net's rate lacks
 * with this plant: coolant colder than it was trained with, say.
 *
 * No allocation, no clock, no printing; one thread at a time per object; < 300 bytes with 8 cells. */
#ifndef SLOW_OBSERVER_H
#define SLOW_OBSERVER_H

#include <stdbool.h>

#include "thermal_net.h"

enum { SLOW_CHANNELS = 2 };

typedef struct {
    double theta[SLOW_CHANNELS];
    double memory[NET_MEMORY];
    double bias[SLOW_CHANNELS];     /* degC/s */
    double rate[SLOW_CHANNELS];     /* of the last step, bias included, degC/s */
    double age_s[SLOW_CHANNELS];    /* of trusted record */
    double innovation[SLOW_CHANNELS]; /* low-passed over 2 s, degC */
    double raw[SLOW_CHANNELS];      /* the last one itself */
} slow_observer_t;

/* Begin at that temperature and memory; bias 0. Never fails. */
void slow_observer_start(slow_observer_t *self, const double theta[SLOW_CHANNELS], const double memory[]);

/* One step of the net with u = [speed rpm, torque Nm]. Never fails. */
void slow_observer_predict(slow_observer_t *self, const double u[2]);

/* Compare with measurement y (offset removed): the innovation. Not finite: nothing happens. */
void slow_observer_measure(slow_observer_t *self, int channel, double y);

/* Follow the last innovation. */
void slow_observer_follow(slow_observer_t *self, int channel);

/* The sensor is believed again, `shift` above this observer: go there, keeping the bias. Never fails. */
void slow_observer_shift(slow_observer_t *self, int channel, double shift);

#endif
