#include "offset_calibration.h"

#include <math.h>
#include <string.h>

static const int32_t VALUES = 100;            /* 10 s */
static const double BELIEVABLE_DEGC = 5.0;    /* further from the datasheet the sensor is broken, not offset */
static const double SPREAD_MAX_DEGC = 1.0;    /* standard deviation: noisier, nothing can be said */
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

static void end_without_result(offset_calibration_t *self, calibration_state_t state)
{
    self->enabled = false;
    self->result.state = state;
}

void offset_calibration_coolant(offset_calibration_t *self, double coolant_degc, bool soaked)
{
    if (!self->enabled) {
        return;
    }
    if (soaked && isfinite(coolant_degc)) {
        self->soaked = true;
        self->coolant_degc = coolant_degc;
        self->result.state = CALIBRATION_MEASURING;
    } else if (self->soaked) {
        end_without_result(self, CALIBRATION_DATASHEET);
    }
}

static bool believable(const offset_calibration_t *self, int ch)
{
    const double variance = self->m2[ch] / (VALUES - 1);
    return self->count[ch] == VALUES && fabs(self->mean[ch] - self->datasheet_degc) <= BELIEVABLE_DEGC &&
           variance <= SPREAD_MAX_DEGC * SPREAD_MAX_DEGC;
}

bool offset_calibration_measure(offset_calibration_t *self, const double raw[CALIBRATION_CHANNELS])
{
    if (!self->enabled || !self->soaked) {
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
    if (!believable(self, 0) || !believable(self, 1)) {
        end_without_result(self, CALIBRATION_REFUSED);
        return false;
    }
    for (int ch = 0; ch < CALIBRATION_CHANNELS; ch++) {
        self->result.offset_degc[ch] = self->mean[ch];
        self->result.sigma_degc[ch] = sqrt(self->m2[ch] / (VALUES - 1) / VALUES + ISOTHERMAL_DEGC * ISOTHERMAL_DEGC);
    }
    end_without_result(self, CALIBRATION_FROZEN);
    return true;
}
