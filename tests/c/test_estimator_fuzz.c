/* Random frames into the estimator's core: for the sanitizers, and for what must hold whatever arrives.
 *
 *   test_estimator_fuzz [ROUNDS] [SEED]    exit 0: everything held, and (with enough rounds) every status, class
 *                                          of a sensor and state of the calibration was seen; 1: one line says what not */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "estimator.h"

static uint64_t state;
static uint32_t seen[ESTIMATOR_FALLBACK + 1]; /* outputs by status */
static uint32_t classes[SENSOR_SLOW + 1];     /* and by class of a sensor */
static uint32_t calibrations[CALIBRATION_REFUSED + 1];

/* xorshift64*: reproducible everywhere */
static uint64_t draw(void)
{
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return state * UINT64_C(2685821657736338717);
}

static uint32_t below(uint32_t n)
{
    return (uint32_t)((draw() >> 33) % n);
}

static double value(double low, double high)
{
    switch (below(400)) {
    case 0: return NAN;
    case 1: return INFINITY;
    case 2: return -1e308;
    case 3: return 4.9e-324;
    default: return low + (high - low) * (double)below(1000000) / 1e6;
    }
}

static int fail(const char *what, uint32_t round)
{
    fprintf(stderr, "test_estimator_fuzz: round %u: %s\n", round, what);
    return 1;
}

/* Advance the plant's tick: mostly by one, sometimes a gap, a step back or a jump. */
static uint32_t next_tick(uint32_t tick)
{
    const uint32_t kind = below(1000);
    if (kind < 960) {
        return tick + 1;
    }
    if (kind < 990) {
        return tick + below(60);
    }
    return kind < 995 ? tick + below(70000) : tick - below(200);
}

/* A sensor: mostly as good as it should be about some temperature, now and then with a fault for a while. */
typedef struct {
    double level, held;
    uint32_t fault, left, since; /* of FAULTS; values until the next one, since this one */
    double size;
} sensor_t;

enum { FAULT_NONE, FAULT_STEP, FAULT_NOISE, FAULT_STUCK, FAULT_MISSING, FAULT_SPIKES, FAULT_DRIFT, FAULT_WILD, FAULTS };

static double uniform(double low, double high)
{
    return low + (high - low) * (double)below(1000000) / 1e6;
}

static double sense(sensor_t *sensor)
{
    if (sensor->left-- == 0) {
        sensor->fault = below(3) == 0 ? FAULT_NONE : below(FAULTS);
        sensor->left = 20 + below(sensor->fault == FAULT_NONE ? 300 : 500);
        sensor->size = uniform(-30.0, 30.0);
        sensor->since = 0;
    }
    const double sound = sensor->level + uniform(-0.5, 0.5);
    switch (sensor->fault) {
    case FAULT_STEP: return sound + sensor->size;
    case FAULT_NOISE: return sound + sensor->size * uniform(-1.0, 1.0);
    case FAULT_STUCK: return sensor->held;
    case FAULT_MISSING: return NAN;
    case FAULT_SPIKES: return sound + (below(8) == 0 ? sensor->size : 0.0);
    case FAULT_DRIFT: return sound + sensor->size * (sensor->size > 0.0 ? 5e-4 : 5e-3) * (double)sensor->since++;
    case FAULT_WILD: return value(-60, 220);
    default: sensor->held = sound; return sound;
    }
}

/* What must hold of whatever is published. */
static int check(const estimator_t *self, const estimator_out_t *out, uint32_t round)
{
    if (out->status > ESTIMATOR_FALLBACK || out->calibration.state > CALIBRATION_REFUSED) {
        return fail("a status that does not exist", round);
    }
    seen[out->status]++;
    calibrations[out->calibration.state]++;
    const bool numbers = isfinite(out->theta_w_degc) && isfinite(out->theta_r_degc);
    const bool valid = out->status == ESTIMATOR_RUNNING || out->status == ESTIMATOR_PREDICTING ||
                       out->status == ESTIMATOR_INPUT_STALE || out->status == ESTIMATOR_OPEN_LOOP ||
                       out->status == ESTIMATOR_FALLBACK;
    if (valid && !numbers) {
        return fail("a valid status without an estimate", round);
    }
    if ((out->status == ESTIMATOR_INIT || out->status == ESTIMATOR_STARTING) && numbers) {
        return fail("an estimate before the start", round);
    }
    if (out->intervals < 0 || out->intervals > self->setting.max_gap_steps + 1) {
        return fail("more intervals in one step than the bound", round);
    }
    if (out->sweeps > self->setting.max_sweeps || out->tick16 != (uint16_t)out->tick) {
        return fail("output out of range", round);
    }
    const double theta[MHE_CHANNELS] = {out->theta_w_degc, out->theta_r_degc};
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        const estimator_channel_t *channel = &out->channel[ch];
        if (channel->fault > SENSOR_SLOW || (!self->setting.supervise && channel->fault != SENSOR_OK)) {
            return fail("a class that cannot be", round);
        }
        classes[channel->fault]++;
        if (valid && (!(channel->sigma_degc > 0.0) || !isfinite(channel->sigma_degc))) {
            return fail("an estimate without its uncertainty", round);
        }
        if (valid && (!(channel->upper_degc > theta[ch]) || !isfinite(channel->upper_degc))) {
            return fail("an upper bound that is none", round);
        }
        const bool lost = channel->fault != SENSOR_OK && channel->fault != SENSOR_NOISE && channel->fault != SENSOR_SPIKE;
        if (lost && out->status == ESTIMATOR_RUNNING) {
            return fail("a sensor that is not believed, and a status that does not say so", round);
        }
        if (!isfinite(out->calibration.offset_degc[ch]) || !isfinite(out->calibration.sigma_degc[ch])) {
            return fail("an offset that is no number", round);
        }
    }
    return 0;
}

static int play(estimator_t *self, uint32_t round, uint32_t frames)
{
    const bool dead_w = below(8) == 0, dead_r = below(8) == 0; /* a sensor that never was there */
    const bool wild = below(3) == 0;                           /* nothing but random values, and many bad ticks */
    const bool soak = below(2) == 0;                           /* key-on: the coolant's temperature, and standstill */
    const double level = uniform(40.0, 120.0), coolant = level - uniform(-2.0, below(3) == 0 ? 8.0 : 3.0);
    sensor_t sensors[MHE_CHANNELS] = {{.level = level, .left = 200}, {.level = level, .left = 200}};
    uint32_t tick = below(200000);
    for (uint32_t k = 0; k < frames; k++) {
        tick = wild || below(300) == 0 ? next_tick(tick) : tick + 1;
        if (below(50) != 0) {
            const bool stands = soak && k < 3000; /* or no offset is measured */
            const double torque = wild ? value(-160, 160) : 0.0, speed = wild ? value(0, 11500) : stands ? 0.0 : 1000.0;
            estimator_feed_motor(self, (uint16_t)tick, torque, speed, below(40) != 0);
        }
        if (tick % 10 == 0 || below(200) == 0) {
            const uint32_t late = below(20) == 0 ? 10 * below(30) : 0;
            const double w = wild ? value(-60, 220) : sense(&sensors[0]), r = wild ? value(-60, 220) : sense(&sensors[1]);
            estimator_feed_temp(self, (uint16_t)(tick - late), w, r, !dead_w && (!wild || below(30) != 0),
                                !dead_r && (!wild || below(30) != 0));
        }
        if (tick % 100 == 0 || below(500) == 0) {
            const bool soaked = soak && (k < 3000 || below(20) == 0);
            estimator_feed_coolant(self, wild ? value(-60, 160) : coolant, soaked, below(60) != 0);
        }
        if (below(12) != 0) {
            continue;
        }
        estimator_out_t out;
        estimator_step(self, &out);
        const int rc = check(self, &out, round);
        if (rc != 0) {
            return rc;
        }
    }
    return 0;
}

static int all_seen(const char *what, const uint32_t counts[], uint32_t last)
{
    for (uint32_t k = 0; k <= last; k++) {
        if (counts[k] == 0) {
            fprintf(stderr, "test_estimator_fuzz: %s %u was never seen\n", what, k);
            return 1;
        }
    }
    return 0;
}

int main(int argc, char **argv)
{
    const uint32_t rounds = argc > 1 ? (uint32_t)strtoul(argv[1], NULL, 10) : 200;
    state = argc > 2 ? strtoull(argv[2], NULL, 10) | 1 : 88172645463325252u;
    static estimator_t self;
    for (uint32_t round = 0; round < rounds; round++) {
        est_setting_t setting = est_settings[below(EST_SETTINGS_COUNT)];
        if (below(2) == 0) { /* close bounds, so that the active sets have work */
            setting.hard_bounds = below(2) == 0;
            setting.lower_degc = 60.0;
            setting.upper_degc = 100.0;
            setting.delay_steps = (int32_t)below(40);
            setting.spin_up_steps = (int32_t)below(20);
        }
        if (below(10) == 0) {
            setting.weight_noise[below(2)] = (double)NAN; /* no solution is finite: the way to status invalid */
        }
        if (below(3) == 0) {
            setting.supervise = !setting.supervise;
        }
        if (below(10) == 0) {
            setting.loss_scale_degc = (double)NAN; /* the MHE has no solution, the filter has one */
        }
        if (estimator_init(&self, &setting) != ESTIMATOR_OK) {
            return fail("estimator_init refused a setting", round);
        }
        const int rc = play(&self, round, 500 + below(below(3) == 0 ? 24000 : 3000));
        if (rc != 0) {
            return rc;
        }
    }
    if (rounds < 50) {
        return 0;
    }
    const uint32_t rarest = rounds < 500 ? SENSOR_SPIKE : SENSOR_SLOW; /* creeping takes minutes */
    return all_seen("status", seen, ESTIMATOR_FALLBACK) + all_seen("class", classes, rarest) +
                   all_seen("calibration state", calibrations, CALIBRATION_REFUSED) != 0;
}
