/* Random frames into the estimator's core: for the sanitizers, and for what must hold whatever arrives.
 *
 *   test_estimator_fuzz [ROUNDS] [SEED]    exit 0: everything held, and every status was seen; 1: one line says what not */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "estimator.h"

static uint64_t state;
static uint32_t seen[ESTIMATOR_INVALID + 1]; /* outputs by status */

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

static int play(estimator_t *self, uint32_t round, uint32_t frames)
{
    const bool dead_w = below(8) == 0, dead_r = below(8) == 0; /* a sensor that never was there */
    uint32_t tick = below(200000);
    for (uint32_t k = 0; k < frames; k++) {
        tick = next_tick(tick);
        if (below(50) != 0) {
            estimator_feed_motor(self, (uint16_t)tick, value(-160, 160), value(0, 11500), below(40) != 0);
        }
        if (tick % 10 == 0 || below(200) == 0) {
            const uint32_t late = below(20) == 0 ? 10 * below(30) : 0;
            estimator_feed_temp(self, (uint16_t)(tick - late), value(-60, 220), value(-60, 220),
                                !dead_w && below(30) != 0, !dead_r && below(30) != 0);
        }
        if (below(12) != 0) {
            continue;
        }
        estimator_out_t out;
        estimator_step(self, &out);
        if (out.status > ESTIMATOR_INVALID) {
            return fail("a status that does not exist", round);
        }
        seen[out.status]++;
        const bool numbers = isfinite(out.theta_w_degc) && isfinite(out.theta_r_degc);
        const bool valid = out.status == ESTIMATOR_RUNNING || out.status == ESTIMATOR_PREDICTING ||
                           out.status == ESTIMATOR_INPUT_STALE;
        if (valid && !numbers) {
            return fail("a valid status without an estimate", round);
        }
        if ((out.status == ESTIMATOR_INIT || out.status == ESTIMATOR_STARTING) && numbers) {
            return fail("an estimate before the start", round);
        }
        if (out.intervals < 0 || out.intervals > self->setting.max_gap_steps + 1) {
            return fail("more intervals in one step than the bound", round);
        }
        if (out.sweeps > self->setting.max_sweeps || out.tick16 != (uint16_t)out.tick) {
            return fail("output out of range", round);
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
        if (estimator_init(&self, &setting) != ESTIMATOR_OK) {
            return fail("estimator_init refused a setting", round);
        }
        const int rc = play(&self, round, 500 + below(3000));
        if (rc != 0) {
            return rc;
        }
    }
    for (uint32_t status = 0; rounds >= 50 && status <= ESTIMATOR_INVALID; status++) {
        if (seen[status] == 0) {
            fprintf(stderr, "test_estimator_fuzz: status %u was never seen\n", status);
            return 1;
        }
    }
    return 0;
}
