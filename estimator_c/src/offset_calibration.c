#include "offset_calibration.h"

#include <math.h>
#include <string.h>

static const int32_t VALUES = 100;            /* 10 s */
static const int32_t FRESH = 25;              /* values since the last coolant temperature: it comes once a second */
static const double BELIEVABLE_DEGC = 5.0;    /* further from the datasheet the sensor is broken, not offset */
static const double SPREAD_MAX_DEGC = 1.0;    /* standard deviation: noisier, nothing can be said */
static const double SIGMA_MAX_DEGC = 50.0;
static const double ISOTHERMAL_DEGC = 0.05;   /* what soaked may still mean: part of the uncertainty */

void offset_calibration_init(offset_calibration_t *self, double datasheet_degc, double sigma_degc, int32_t delay_steps,
                             bool enabled)
{
    memset(self, 0, sizeof *self);
    self->enabled = enabled;
    self->datasheet_degc = datasheet_degc;
    self->coolant_degc = NAN;
    self->wait = delay_steps;
    for (int ch = 0; ch < CALIBRATION_CHANNELS; ch++) {
        self->result.offset_degc[ch] = datasheet_degc;
        self->result.sigma_degc[ch] = sigma_degc;
    }
}

static void end(offset_calibration_t *self, calibration_state_t state)
{
    self->enabled = false;
    self->result.state = state;
}

void offset_calibration_coolant(offset_calibration_t *self, double coolant_degc, bool soaked)
{
    if (!self->enabled || !isfinite(coolant_degc)) {
        return; /* no coolant temperature: nothing new, and before long nothing fresh */
    }
    if (soaked) {
        self->soaked = true;
        self->age = 0;
        self->coolant_degc = coolant_degc;
        self->result.state = CALIBRATION_MEASURING;
    } else if (self->soaked) {
        end(self, CALIBRATION_DATASHEET);
    }
}

void offset_calibration_moving(offset_calibration_t *self)
{
    if (self->enabled && self->soaked) {
        end(self, CALIBRATION_DATASHEET);
    }
}

/* The mean of a channel's values if that can be an offset; else the datasheet's stays, as uncertain as the mean is far
 * away. */
static bool take(offset_calibration_t *self, int ch)
{
    const double variance = self->m2[ch] / (VALUES - 1);
    const double from_datasheet = self->mean[ch] - self->datasheet_degc;
    if (fabs(from_datasheet) > BELIEVABLE_DEGC || variance > SPREAD_MAX_DEGC * SPREAD_MAX_DEGC) {
        self->result.sigma_degc[ch] = fmin(SIGMA_MAX_DEGC, fmax(self->result.sigma_degc[ch], fabs(from_datasheet)));
        return false;
    }
    self->result.offset_degc[ch] = self->mean[ch];
    self->result.sigma_degc[ch] = sqrt(variance / VALUES + ISOTHERMAL_DEGC * ISOTHERMAL_DEGC);
    return true;
}

bool offset_calibration_measure(offset_calibration_t *self, const double raw[CALIBRATION_CHANNELS])
{
    if (!self->enabled || !self->soaked) {
        return false;
    }
    if (++self->age > FRESH) {
        end(self, CALIBRATION_DATASHEET);
        return false;
    }
    if (self->wait > 0) {
        self->wait--;
        return false;
    }
    bool complete = true;
    for (int ch = 0; ch < CALIBRATION_CHANNELS; ch++) {
        const double value = raw[ch] - self->coolant_degc;
        if (isfinite(value) && self->count[ch] < VALUES) { /* Welford's mean and variance */
            const double before = value - self->mean[ch];
            self->count[ch]++;
            self->mean[ch] += before / self->count[ch];
            self->m2[ch] += before * (value - self->mean[ch]);
        }
        complete = complete && self->count[ch] == VALUES;
    }
    if (!complete) {
        return false;
    }
    const bool first = take(self, 0);
    const bool second = take(self, 1);
    end(self, first && second ? CALIBRATION_FROZEN : CALIBRATION_REFUSED);
    return first || second;
}
