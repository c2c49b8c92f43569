#include "sensor_monitor.h"

#include <math.h>
#include <string.h>

static const double STEP_S = 0.1;

/* No value, and values that repeat. */
static const int32_t MISSING_LIMIT = 3;        /* values in a row: one or two may be late on the bus, or spikes */
static const double EQUAL_MEMORY = 0.02;       /* 5 s */
static const double EQUAL_USUAL = 0.2;         /* a sensor that repeats itself this often has no noise to go by */
static const double STUCK_MOVE_DEGC = 1.0;     /* then: how far the prediction must have moved meanwhile */

/* Spikes and noise. */
static const int32_t SPIKE_HOLD = 10;          /* steps, 1 s */
static const double NOISE_ON = 3.0;            /* spread over what it should be */
static const double NOISE_OFF = 1.6;
static const int32_t NOISE_QUIET = 50;         /* steps without noise that end it */
static const double NOISE_WORTH = 2.0;         /* the net errs more slowly than the noise it is modelled by: measured */
static const double NOISE_MEMORY = 0.05;       /* 2 s */
static const int32_t SPREAD_MIN = 10;          /* values that a spread needs */
static const double BESIDE_SPREAD = 1.3;       /* a noisy sensor's level off by more than its spread ... */
static const double BESIDE_USUAL = 4.0;        /* ... and that much of what is usual has an offset, too */

/* Steps. */
static const int32_t REBASE = 20;              /* values that give the size of a step */
static const double REBASED_SHARE = 0.005;     /* of a value's weight afterwards: followed over ten seconds */
static const int32_t REBASE_HOLD = 1200;       /* steps, 2 min: then the net alone knows better than that measurement */

/* What creeps: lag and drift. */
static const double SLOW_MEMORY = 1.0 / 150.0; /* 15 s */
static const double SLOW_LAG_S = 1.5;          /* slope of the slow innovation over the rate */
static const double SLOW_EFFECT_DEGC = 0.5;    /* and what it must amount to */
static const double SLOW_CORRELATION2 = 0.5;
static const double DRIFT_USUAL = 1.45;        /* times what is usual */
static const int32_t USUAL_BLOCK = 100;        /* 10 s; the usual is MONITOR_PENDING blocks old: drift shows first */
static const double USUAL_KEEP = 0.998;        /* per block: 80 min */
static const int32_t WARM_UP = 600;            /* steps before drift is judged */
static const int32_t RELAPSE = 600;            /* steps: distrusted again within a minute */
static const int32_t RELAPSES_MAX = 4;

/* The way back to trust. */
static const int32_t CALM_SHORT = 20, CALM_STEP = 30, CALM_CREEP = 100; /* steps */
static const double PLAUSIBLE_DEGC = 0.3;      /* how far the level may be off, beside 3 sigma of the prediction */
static const double PLAUSIBLE_VARIANCE = 10.0; /* K^2 */
static const double GAINED_DEGC_S = 0.05, GAINED_MAX_DEGC = 10.0; /* beside: see sensor_monitor_gained_degc() */
static const double GAINED_OFFSET = 0.25;      /* of a step's size */
static const double CREEP_DEGC = 0.6;          /* how far the level may be off after a creeping fault ... */
static const double CREEP_DEGC_S = 0.015;      /* ... and how that widens: what still creeps must stay outside */
static const double CREEP_MAX_DEGC = 3.0;

void sensor_monitor_init(sensor_monitor_t *self, const est_setting_t *setting, int channel)
{
    memset(self, 0, sizeof *self);
    self->r = 1.0 / fmax(1e-9, setting->weight_measurement[channel]);
    self->spread_r = self->r;
    self->gate = setting->gate_sigma;
    self->drift = setting->drift_degc[channel];
    self->range_low = setting->range_low_degc;
    self->range_high = setting->range_high_degc;
    self->trusted = true;
    self->ordinary_r = NOISE_ON * NOISE_ON * self->r;
    self->equal_share = 1.0; /* until it has shown that it scatters */
    self->last_y = NAN;
}

bool sensor_monitor_in_range(const sensor_monitor_t *self, double raw)
{
    return raw >= self->range_low && raw <= self->range_high;
}

double sensor_monitor_distrusted_s(const sensor_monitor_t *self)
{
    return self->trusted ? 0.0 : STEP_S * self->distrusted_steps;
}

double sensor_monitor_gained_degc(const sensor_monitor_t *self)
{
    return fmin(GAINED_MAX_DEGC, GAINED_DEGC_S * sensor_monitor_distrusted_s(self));
}

/* A fault that the estimate has followed, as it came slowly. */
static bool creeps(sensor_class_t fault)
{
    return fault == SENSOR_DRIFT || fault == SENSOR_SLOW;
}

/* Median of n <= MONITOR_HISTORY values; sorts them. */
static double median(double values[], int n)
{
    for (int i = 1; i < n; i++) {
        const double v = values[i];
        int j = i;
        for (; j > 0 && values[j - 1] > v; j--) {
            values[j] = values[j - 1];
        }
        values[j] = v;
    }
    return n % 2 ? values[n / 2] : 0.5 * (values[n / 2 - 1] + values[n / 2]);
}

/* Median and spread (1.4826 times the median absolute deviation) of the newest n residuals. */
static double level_of(const sensor_monitor_t *self, int n, double *spread)
{
    double values[MONITOR_HISTORY];
    n = n < self->count ? n : self->count;
    if (n == 0) {
        *spread = 0.0;
        return 0.0;
    }
    for (int k = 0; k < n; k++) {
        values[k] = self->residual[(self->next + MONITOR_HISTORY - 1 - k) % MONITOR_HISTORY];
    }
    const double middle = median(values, n);
    for (int k = 0; k < n; k++) {
        values[k] = fabs(values[k] - middle);
    }
    *spread = 1.4826 * median(values, n);
    return middle;
}

static void remember(sensor_monitor_t *self, double residual)
{
    self->residual[self->next] = residual;
    self->next = (self->next + 1) % MONITOR_HISTORY;
    self->count += self->count < MONITOR_HISTORY;
}

static void distrust(sensor_monitor_t *self, sensor_class_t fault)
{
    if (self->trusted) {
        const bool again = creeps(fault) && self->trusted_steps < RELAPSE;
        self->distrusted_steps = 0;
        self->ordinary_r = fmax(NOISE_ON * NOISE_ON * self->r, NOISE_OFF * NOISE_OFF * self->spread_r);
        self->relapses = again ? self->relapses + (self->relapses < RELAPSES_MAX) : 0;
    }
    memset(self->pending, 0, sizeof self->pending); /* what a faulty sensor does is not what is usual */
    self->run = 0;
    self->trusted = false;
    self->fault = fault;
    self->since_change = 0;
    self->since_step = 0;
    self->rebased = false;
    self->spread_r = self->r;
    memset(self->moment, 0, sizeof self->moment);
    self->moment_weight = 0.0;
}

static void trust(sensor_monitor_t *self)
{
    self->trusted = true;
    self->trusted_steps = 0;
    self->fault = SENSOR_OK;
    self->run = 0;
    self->last_inside = 0.0;
    self->count = 0; /* residuals against a prediction that has just been moved */
}

/* Slope of the slow innovation over the rate of change: how late the sensor is, in s. */
static bool is_slow(sensor_monitor_t *self, const monitor_input_t *in)
{
    const double sample[5] = {in->slow_raw, in->rate, in->slow_raw * in->slow_raw, in->rate * in->rate,
                              in->slow_raw * in->rate};
    const double keep = 1.0 - SLOW_MEMORY;
    self->moment_weight = keep * self->moment_weight + SLOW_MEMORY;
    for (int k = 0; k < 5; k++) {
        self->moment[k] = keep * self->moment[k] + SLOW_MEMORY * sample[k];
    }
    if (self->moment_weight < 0.3) {
        return false;
    }
    double mean[5];
    for (int k = 0; k < 5; k++) {
        mean[k] = self->moment[k] / self->moment_weight;
    }
    const double var_slow = mean[2] - mean[0] * mean[0];
    const double var_rate = mean[3] - mean[1] * mean[1];
    const double cov = mean[4] - mean[0] * mean[1];
    if (var_rate <= 1e-8 || var_slow <= 0.0) {
        return false;
    }
    const double lag_s = -cov / var_rate;
    return lag_s > SLOW_LAG_S && lag_s * sqrt(var_rate) > SLOW_EFFECT_DEGC &&
           cov * cov > SLOW_CORRELATION2 * var_slow * var_rate;
}

/* The slow innovation is never zero, as no model is right; what it has been up to earlier in this drive is no drift. */
static bool is_drift(sensor_monitor_t *self, const monitor_input_t *in)
{
    const double size = fabs(in->slow);
    const bool found = self->steps > WARM_UP && size > fmax(self->drift, DRIFT_USUAL * self->usual);
    double *pending = self->pending;
    if (found || self->fault != SENSOR_OK) {
        return found;
    }
    pending[0] = fmax(pending[0], size);
    if (++self->steps % USUAL_BLOCK == 0) {
        self->usual = fmax(USUAL_KEEP * self->usual, pending[MONITOR_PENDING - 1]);
        memmove(pending + 1, pending, (MONITOR_PENDING - 1) * sizeof *pending);
        pending[0] = 0.0;
    }
    return found;
}

/* No value, or none that can be. */
static monitor_verdict_t absent(sensor_monitor_t *self)
{
    self->missing++;
    self->equal = 0;
    self->last_y = NAN;
    if (self->missing >= MISSING_LIMIT) {
        distrust(self, SENSOR_DROPOUT);
    }
    return (monitor_verdict_t){0};
}

static bool is_stuck(sensor_monitor_t *self, const monitor_input_t *in)
{
    const bool same = in->y == self->last_y;
    const double prediction = in->y - in->residual;
    if (!same) {
        self->equal = 0;
        self->run_prediction = prediction;
    } else {
        self->equal++;
    }
    self->last_y = in->y;
    if (self->equal < MONITOR_RUN) {
        self->equal_share += EQUAL_MEMORY * ((same ? 1.0 : 0.0) - self->equal_share);
    }
    const bool silent = self->equal_share > EQUAL_USUAL;
    return self->equal >= MONITOR_RUN - 1 && (!silent || fabs(prediction - self->run_prediction) > STUCK_MOVE_DEGC);
}

/* Noise comes and goes by the spread of the newest values; spread_r follows it. True: it has just ended. */
static bool watch_noise(sensor_monitor_t *self, double spread, double usual)
{
    if (self->fault != SENSOR_NOISE) {
        if (self->count >= SPREAD_MIN && spread > NOISE_ON * usual) {
            self->fault = SENSOR_NOISE;
            self->spread_r = spread * spread;
        }
        return false;
    }
    self->spread_r = fmax(self->r, self->spread_r + NOISE_MEMORY * (spread * spread - self->spread_r));
    self->quiet = spread < NOISE_OFF * usual ? self->quiet + 1 : 0;
    if (self->count < MONITOR_HISTORY || self->quiet < NOISE_QUIET) {
        return false;
    }
    self->quiet = 0;
    self->fault = SENSOR_OK;
    self->spread_r = self->r;
    return true;
}

/* Among noise a step shows in the level of many values only. */
static bool noise_hides_step(const sensor_monitor_t *self, double level, double spread, double usual)
{
    return self->fault == SENSOR_NOISE && self->count >= SPREAD_MIN &&
           fabs(level) > BESIDE_SPREAD * fmax(spread, sqrt(self->spread_r)) && fabs(level) > BESIDE_USUAL * usual;
}

/* A value inside the gate ends a run of outliers; a spike is shown a little longer. */
static void take_inside(sensor_monitor_t *self, double residual)
{
    self->run = 0;
    self->last_inside = residual;
    self->spike_hold -= self->spike_hold > 0;
    if (self->fault == SENSOR_SPIKE && self->spike_hold == 0) {
        self->fault = SENSOR_OK;
    }
}

/* A value outside: a spike, unless it is one of a calm run. True: the run is a fault, and trust is lost. */
static bool take_outlier(sensor_monitor_t *self, double residual, double usual)
{
    const int32_t side = residual > 0.0 ? 1 : -1;
    self->run = self->run * side > 0 ? self->run + side : side;
    self->spike_hold = SPIKE_HOLD;
    if (self->fault == SENSOR_OK) {
        self->fault = SENSOR_SPIKE;
    }
    if (self->run * side < MONITOR_RUN || self->fault == SENSOR_NOISE) {
        return false;
    }
    double spread;
    const double level = level_of(self, MONITOR_RUN, &spread);
    const bool jumped = fabs(level - self->last_inside) > self->gate * sqrt(self->r);
    if (spread >= NOISE_ON * usual) {
        return false;
    }
    distrust(self, jumped ? SENSOR_OFFSET : SENSOR_SLOW);
    return true;
}

/* A value of a sensor that is believed so far. */
static monitor_verdict_t judge_trusted(sensor_monitor_t *self, const monitor_input_t *in)
{
    double spread;
    const double level = level_of(self, MONITOR_SPREAD, &spread);
    const double usual = sqrt(self->r + in->variance);
    const bool settled = watch_noise(self, spread, usual);
    if (noise_hides_step(self, level, spread, usual)) {
        distrust(self, SENSOR_OFFSET);
        return (monitor_verdict_t){.forget = SPREAD_MIN};
    }
    const double share = self->fault == SENSOR_NOISE ? fmin(1.0, NOISE_WORTH * self->r / self->spread_r) : 1.0;
    const bool outside = fabs(in->residual) > self->gate * sqrt(self->spread_r + in->variance);
    if (!outside) {
        take_inside(self, in->residual);
    } else if (take_outlier(self, in->residual, usual)) {
        return (monitor_verdict_t){.forget = MONITOR_RUN};
    }
    const bool slow = is_slow(self, in);
    const bool drift = is_drift(self, in);
    if (self->fault == SENSOR_OK && !settled && (slow || drift)) {
        distrust(self, slow ? SENSOR_SLOW : SENSOR_DRIFT);
        return (monitor_verdict_t){.forget = MONITOR_HISTORY, .creep = true};
    }
    return (monitor_verdict_t){.share = outside ? 0.0 : share, .settled = settled};
}

static int32_t calm_needed(const sensor_monitor_t *self)
{
    if (creeps(self->fault)) { /* a late sensor agrees wherever the temperature is level: more after each relapse */
        return CALM_CREEP << (self->relapses > 1 ? self->relapses - 1 : 0);
    }
    return self->fault == SENSOR_OFFSET ? CALM_STEP : CALM_SHORT;
}

/* A value of a sensor that stepped away. */
static monitor_verdict_t judge_stepped(sensor_monitor_t *self, const monitor_input_t *in)
{
    double spread;
    const double usual = sqrt(self->r + in->variance);
    self->since_step++;
    if (!self->rebased && self->since_step >= REBASE) {
        const double level = level_of(self, REBASE, &spread);
        self->rebased = spread < NOISE_OFF * usual;
        self->offset = level;
    }
    if (!self->rebased || self->distrusted_steps > REBASE_HOLD) {
        return (monitor_verdict_t){0};
    }
    const double rest = in->residual - self->offset;
    self->run = fabs(rest) > self->gate * usual ? self->run + 1 : 0;
    if (self->run >= MONITOR_RUN) { /* it stepped again */
        self->rebased = false;
        self->since_step = 0;
        self->run = 0;
        return (monitor_verdict_t){0};
    }
    return (monitor_verdict_t){.share = self->run > 0 ? 0.0 : REBASED_SHARE, .offset = self->offset};
}

/* How far a sound sensor may stand from the prediction: what the filter says of itself, and what a plant that is not
 * the net's may have gained on the net meanwhile. A step or a creep must not slip in that way: they leave less room. */
static double plausible_level(const sensor_monitor_t *self, const monitor_input_t *in)
{
    const double filter = PLAUSIBLE_DEGC + 3.0 * sqrt(fmin(in->variance, PLAUSIBLE_VARIANCE));
    const double gained = sensor_monitor_gained_degc(self);
    if (creeps(self->fault)) {
        return fmin(CREEP_MAX_DEGC, CREEP_DEGC + CREEP_DEGC_S * sensor_monitor_distrusted_s(self));
    }
    return filter + (self->fault == SENSOR_OFFSET ? fmin(gained, GAINED_OFFSET * fabs(self->offset)) : gained);
}

/* A value of a sensor that is not believed: has it come back? */
static monitor_verdict_t judge_distrusted(sensor_monitor_t *self, const monitor_input_t *in)
{
    const double usual = sqrt(self->r + in->variance);
    double spread;
    const double level = level_of(self, MONITOR_HISTORY, &spread);
    const double plausible = plausible_level(self, in);
    const double scatter2 = creeps(self->fault) ? NOISE_OFF * NOISE_OFF * self->r : self->ordinary_r;
    const bool calm = spread * spread <= scatter2 && fabs(in->residual - level) <= self->gate * fmax(usual, spread);
    if (!calm || fabs(level) > plausible) {
        self->since_change = 0;
    }
    const bool back = self->fault == SENSOR_DROPOUT || self->fault == SENSOR_STUCK;
    self->elsewhere = back && calm && fabs(level) > plausible ? self->elsewhere + 1 : 0;
    if (self->elsewhere >= CALM_STEP) { /* values again, but far away: that is an offset */
        distrust(self, SENSOR_OFFSET);
    }
    if (self->since_change < calm_needed(self)) {
        return self->fault == SENSOR_OFFSET ? judge_stepped(self, in) : (monitor_verdict_t){0};
    }
    trust(self);
    return (monitor_verdict_t){.share = 1.0, .resume = true, .level = level};
}

monitor_verdict_t sensor_monitor_step(sensor_monitor_t *self, const monitor_input_t *in)
{
    self->distrusted_steps += !self->trusted;
    self->trusted_steps += self->trusted;
    if (!isfinite(in->y) || !sensor_monitor_in_range(self, in->raw)) {
        return absent(self);
    }
    self->missing = 0;
    if (is_stuck(self, in)) {
        const bool news = self->trusted;
        distrust(self, SENSOR_STUCK);
        return (monitor_verdict_t){.forget = news ? MONITOR_RUN : 0};
    }
    remember(self, in->residual);
    self->since_change++;
    return self->trusted ? judge_trusted(self, in) : judge_distrusted(self, in);
}

double sensor_monitor_late(const sensor_monitor_t *self, double raw, double residual, double variance)
{
    const bool inside = fabs(residual) <= self->gate * sqrt(self->spread_r + variance); /* NAN is not */
    return self->trusted && inside && sensor_monitor_in_range(self, raw) ? self->r / self->spread_r : 0.0;
}
