/* Writes every call that the estimator makes to its MHE as a stream (stream.h). Linked into the estimator's library with
 * -Wl,--wrap=mhe_init,... so that the calls pass through here on their way; the estimator does not notice.
 * Buffer: grows, recorder_take() hands it out. One thread. */
#include <stdlib.h>
#include <string.h>

#include "mhe.h"
#include "stream.h"

static double *buffer;
static size_t used;
static size_t room;

typedef __typeof__(((mhe_t *)0)->prior[0]) value_t; /* the MHE's own type */

void __real_mhe_init(mhe_t *self, const est_setting_t *setting);
void __real_mhe_start(mhe_t *self, const value_t prior[], const value_t memory[]);
void __real_mhe_advance(mhe_t *self, const value_t u[]);
void __real_mhe_arrival(mhe_t *self, const value_t prior[], const value_t weight[], const value_t memory[]);
value_t __real_mhe_measure(mhe_t *self, int age, int channel, value_t y, value_t share);
void __real_mhe_forget(mhe_t *self, int channel, int nodes);
void __real_mhe_shift(mhe_t *self, int channel, value_t shift);
void __real_mhe_weigh(mhe_t *self, const value_t noise[], value_t loss_scale);
mhe_status_t __real_mhe_solve(mhe_t *self, mhe_result_t *result);

/* Begin a record; returns where its payload goes. */
static double *record(int op, size_t length)
{
    if (used + length + 2 > room) {
        room = 2 * (used + length + 2) + 4096;
        double *larger = realloc(buffer, room * sizeof *buffer);
        if (larger == NULL) {
            abort();
        }
        buffer = larger;
    }
    double *at = buffer + used;
    at[0] = op;
    at[1] = (double)length;
    used += length + 2;
    return at + 2;
}

static void copy(double to[], const value_t from[], size_t n)
{
    for (size_t k = 0; k < n; k++) {
        to[k] = (double)from[k];
    }
}

/* What was recorded since the last call: its length; *at is valid until the next call to the estimator. */
size_t recorder_take(const double **at)
{
    const size_t length = used;
    *at = buffer;
    used = 0;
    return length;
}

void __wrap_mhe_init(mhe_t *self, const est_setting_t *s)
{
    double *at = record(STREAM_INIT, STREAM_SETTING);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        at[SETTING_MEASUREMENT + ch] = s->weight_measurement[ch];
        at[SETTING_NOISE + ch] = s->weight_noise[ch];
        at[SETTING_ARRIVAL + ch] = s->weight_arrival[ch];
        at[SETTING_PRIOR + ch] = s->weight_prior[ch];
    }
    at[SETTING_LOSS] = s->loss;
    at[SETTING_LOSS_SCALE] = s->loss_scale_degc;
    at[SETTING_HARD] = s->hard_bounds;
    at[SETTING_LOWER] = s->lower_degc;
    at[SETTING_UPPER] = s->upper_degc;
    at[SETTING_BOUND_WEIGHT] = s->bound_weight;
    at[SETTING_MAX_SWEEPS] = s->max_sweeps;
    at[SETTING_TOLERANCE] = s->tolerance_degc;
    at[SETTING_NEWEST] = s->newest_measurement;
    at[SETTING_DELAY_STEPS] = s->delay_steps;
    __real_mhe_init(self, s);
}

void __wrap_mhe_start(mhe_t *self, const value_t prior[], const value_t memory[])
{
    double *at = record(STREAM_START, 2 + NET_MEMORY);
    copy(at, prior, 2);
    copy(at + 2, memory, NET_MEMORY);
    __real_mhe_start(self, prior, memory);
}

void __wrap_mhe_advance(mhe_t *self, const value_t u[])
{
    copy(record(STREAM_ADVANCE, 2), u, 2);
    __real_mhe_advance(self, u);
}

void __wrap_mhe_arrival(mhe_t *self, const value_t prior[], const value_t weight[], const value_t memory[])
{
    double *at = record(STREAM_ARRIVAL, 4 + (memory != NULL ? NET_MEMORY : 0));
    copy(at, prior, 2);
    copy(at + 2, weight, 2);
    if (memory != NULL) {
        copy(at + 4, memory, NET_MEMORY);
    }
    __real_mhe_arrival(self, prior, weight, memory);
}

value_t __wrap_mhe_measure(mhe_t *self, int age, int channel, value_t y, value_t share)
{
    double *at = record(STREAM_MEASURE, 4);
    at[0] = age;
    at[1] = channel;
    at[2] = (double)y;
    at[3] = (double)share;
    return __real_mhe_measure(self, age, channel, y, share);
}

void __wrap_mhe_forget(mhe_t *self, int channel, int nodes)
{
    double *at = record(STREAM_FORGET, 2);
    at[0] = channel;
    at[1] = nodes;
    __real_mhe_forget(self, channel, nodes);
}

void __wrap_mhe_shift(mhe_t *self, int channel, value_t shift)
{
    double *at = record(STREAM_SHIFT, 2);
    at[0] = channel;
    at[1] = (double)shift;
    __real_mhe_shift(self, channel, shift);
}

void __wrap_mhe_weigh(mhe_t *self, const value_t noise[], value_t loss_scale)
{
    double *at = record(STREAM_WEIGH, 3);
    copy(at, noise, 2);
    at[2] = (double)loss_scale;
    __real_mhe_weigh(self, noise, loss_scale);
}

mhe_status_t __wrap_mhe_solve(mhe_t *self, mhe_result_t *result)
{
    (void)record(STREAM_SOLVE, 0);
    return __real_mhe_solve(self, result);
}
