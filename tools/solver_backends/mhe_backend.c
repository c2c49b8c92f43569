/* Backend: estimator_c's own MHE, whatever build it is compiled with (double or float, any kernel).
 *
 * Variants: a kernel's name ("portable", "avx2", "avx512"; "" is the processor's best), "feedback": the best kernel, the estimate
 * after one sweep and the rest in backend_finish(), or "reference": portable, as many sweeps as the tolerance asks for, and the
 * problem kept. */
#include <stdlib.h>
#include <string.h>

#include "backend.h"
#include "mhe.h"
#include "window.h"

enum { REFERENCE_SWEEPS = 200 };

typedef __typeof__(((mhe_t *)0)->prior[0]) value_t; /* double, or float in that build */

static mhe_t mhe;
static window_t window; /* of "reference" only */
static bool reference;
static bool feedback;
static mhe_result_t solved;
static int sweeps_fixed;
static double tolerance_given;
static int loss_given = -1;

int backend_open(const char *variant, int sweeps, double tolerance, int loss)
{
    sweeps_fixed = sweeps;
    tolerance_given = tolerance;
    loss_given = loss;
    reference = strcmp(variant, "reference") == 0;
    feedback = strcmp(variant, "feedback") == 0;
    const char *kernel = reference ? "portable" : feedback || *variant == '\0' ? NULL : variant;
    return net_select(kernel) != NULL ? 0 : 1;
}

size_t backend_state_bytes(void)
{
    return sizeof mhe;
}

static void init(const double at[])
{
    est_setting_t setting;
    memset(&setting, 0, sizeof setting);
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        setting.weight_measurement[ch] = at[SETTING_MEASUREMENT + ch];
        setting.weight_noise[ch] = at[SETTING_NOISE + ch];
        setting.weight_arrival[ch] = at[SETTING_ARRIVAL + ch];
        setting.weight_prior[ch] = at[SETTING_PRIOR + ch];
    }
    setting.loss = loss_given >= 0 ? loss_given : (int32_t)at[SETTING_LOSS];
    setting.loss_scale_degc = at[SETTING_LOSS_SCALE];
    setting.hard_bounds = at[SETTING_HARD] != 0.0;
    setting.lower_degc = at[SETTING_LOWER];
    setting.upper_degc = at[SETTING_UPPER];
    setting.bound_weight = at[SETTING_BOUND_WEIGHT];
    setting.max_sweeps = sweeps_fixed > 0 ? sweeps_fixed : reference ? REFERENCE_SWEEPS : (int32_t)at[SETTING_MAX_SWEEPS];
    setting.tolerance_degc = sweeps_fixed > 0 ? 0.0 : tolerance_given > 0.0 ? tolerance_given : at[SETTING_TOLERANCE];
    setting.newest_measurement = at[SETTING_NEWEST] != 0.0;
    mhe_init(&mhe, &setting);
}

static void convert(value_t to[], const double from[], int n)
{
    for (int k = 0; k < n; k++) {
        to[k] = (value_t)from[k];
    }
}

void backend_call(const double record[])
{
    const double *at = record + 2;
    value_t a[2];
    value_t b[2];
    value_t memory[NET_MEMORY];
    switch ((int)record[0]) {
    case STREAM_INIT:
        init(at);
        break;
    case STREAM_START:
        convert(a, at, 2);
        convert(memory, at + 2, NET_MEMORY);
        mhe_start(&mhe, a, memory);
        break;
    case STREAM_ADVANCE:
        convert(a, at, 2);
        mhe_advance(&mhe, a);
        break;
    case STREAM_ARRIVAL:
        convert(a, at, 2);
        convert(b, at + 2, 2);
        convert(memory, at + 4, record[1] > 4.0 ? NET_MEMORY : 0);
        mhe_arrival(&mhe, a, b, record[1] > 4.0 ? memory : NULL);
        break;
    case STREAM_MEASURE:
        (void)mhe_measure(&mhe, (int)at[0], (int)at[1], (value_t)at[2], (value_t)at[3]);
        break;
    case STREAM_FORGET:
        mhe_forget(&mhe, (int)at[0], (int)at[1]);
        break;
    case STREAM_SHIFT:
        mhe_shift(&mhe, (int)at[0], (value_t)at[1]);
        break;
    case STREAM_WEIGH:
        mhe_weigh(&mhe, (const value_t[2]){(value_t)at[0], (value_t)at[1]}, (value_t)at[2]);
        break;
    default:
        break;
    }
    if (reference) {
        if ((int)record[0] == STREAM_ADVANCE) {
            (void)window_append(&window, at);
        } else {
            window_call(&window, record);
        }
        if ((int)record[0] == STREAM_INIT && loss_given >= 0) {
            window.setting[SETTING_LOSS] = loss_given;
        }
    }
}

void backend_solve(backend_result_t *result)
{
    const mhe_status_t status = feedback ? mhe_feedback(&mhe, &solved) : mhe_solve(&mhe, &solved);
    *result = (backend_result_t){
        .theta = {(double)solved.theta[0], (double)solved.theta[1]},
        .kkt_degc = (double)solved.kkt_degc,
        .sweeps = solved.sweeps,
        .status = (int)status,
    };
}

void backend_ahead(const double inputs[][2], int steps, backend_result_t *result)
{
    value_t theta[2];
    _Alignas(64) value_t memory[NET_MEMORY];
    value_t rate[2];
    _Alignas(64) value_t tape[NET_TAPE];
    convert(theta, result->theta, 2);
    memcpy(memory, mhe_node(&mhe, 0)->memory, sizeof memory);
    for (int k = 0; k < steps; k++) {
        value_t u[2];
        convert(u, inputs[k], 2);
        net_forward(u, theta, memory, memory, rate, tape);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            theta[ch] += (value_t)NET_DT_S * rate[ch];
        }
    }
    result->ahead[0] = (double)theta[0];
    result->ahead[1] = (double)theta[1];
}

void backend_finish(void)
{
    if (feedback) {
        (void)mhe_finish(&mhe, &solved);
    }
    if (!reference) {
        return;
    }
    for (int age = 0; age < window.count; age++) { /* the problem's memory and prior come from the solution */
        const mhe_node_t *node = mhe_node(&mhe, age);
        window_node_t *kept = &window.node[window.count - 1 - age];
        for (int ch = 0; ch < 2; ch++) {
            kept->theta[ch] = (double)node->theta[ch];
        }
        for (int k = 0; k < NET_MEMORY; k++) {
            kept->memory[k] = (double)node->memory[k];
        }
    }
}

int backend_window(double theta[][2])
{
    int count = 0;
    while (mhe_node(&mhe, count) != NULL) {
        count++;
    }
    for (int k = 0; k < count; k++) {
        const mhe_node_t *node = mhe_node(&mhe, count - 1 - k);
        theta[k][0] = (double)node->theta[0];
        theta[k][1] = (double)node->theta[1];
    }
    return count;
}

int backend_problem(double problem[])
{
    return reference ? window_problem(&window, problem) : 0;
}
