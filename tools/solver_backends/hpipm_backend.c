/* Backend as in the paper: Gauss-Newton SQP by multiple shooting, at most the setting's number of iterations, QPs by HPIPM.
 *
 * Variants: "ocp" (Riccati), "pcond5" (partial condensing 15 -> 5), "full" (condensing to the 32 unknowns); each with "-free"
 * behind it: the QP without its bounds first, and with them only if the result violates one, which is what a user who looks
 * for speed would do. */
#include <math.h>
#include <string.h>

#include "backend.h"
#include "hpipm_qp.h"
#include "model.h"

enum { LOSS_QUADRATIC = 0, LOSS_HUBER = 1, LOSS_GEMAN_MCCLURE = 2 }; /* est_settings.h, held together by a test */

static const double SHRINK = 0.5; /* per iteration, or the next ones are careful; as in mhe.c */

static window_t window;
static qp_t bounded[2][WINDOW_NODES]; /* [hard, soft][stages]; made when opened */
static qp_t unbounded[WINDOW_NODES];
static bool free_first;
static bool careful; /* this step keeps to the loss's majorant */
static int sweeps_fixed;
static double tolerance_given;
static int loss_given = -1;

int backend_open(const char *variant, int sweeps, double tolerance, int loss)
{
    static const char *const NAMES[3] = {"ocp", "pcond5", "full"};
    sweeps_fixed = sweeps;
    tolerance_given = tolerance;
    loss_given = loss;
    for (int form = 0; form < 3; form++) {
        const size_t length = strlen(NAMES[form]);
        if (strncmp(variant, NAMES[form], length) != 0) {
            continue;
        }
        free_first = strcmp(variant + length, "-free") == 0;
        if (variant[length] != '\0' && !free_first) {
            return 1;
        }
        for (int stages = 1; stages < WINDOW_NODES; stages++) {
            qp_create(&bounded[0][stages], stages, (qp_form_t)form, QP_HARD);
            qp_create(&bounded[1][stages], stages, (qp_form_t)form, QP_SOFT);
            qp_create(&unbounded[stages], stages, (qp_form_t)form, QP_FREE);
        }
        return 0;
    }
    return 1;
}

size_t backend_state_bytes(void)
{
    return sizeof window + sizeof(qp_t) + bounded[1][WINDOW_NODES - 1].bytes +
           (free_first ? unbounded[WINDOW_NODES - 1].bytes : 0);
}

void backend_call(const double record[])
{
    if ((int)record[0] != STREAM_ADVANCE) {
        window_call(&window, record);
        if ((int)record[0] == STREAM_INIT && loss_given >= 0) {
            window.setting[SETTING_LOSS] = loss_given;
        }
        return;
    }
    window_node_t *newest = window_append(&window, record + 2);
    const window_node_t *before = &window.node[window.count - 2];
    double jacobian[QP_STATES * QP_STATES];
    model_step(before->u, before->theta, before->memory, newest->theta, newest->memory, jacobian);
}

/* What the loss makes of a residual: *pull times it is the gradient, the return value is the curvature; both are factors on the
 * measurement's weight. The same rule as in mhe.c, for a fair comparison: the loss's own curvature where it is not negative, or,
 * once that has not helped, the parabola that touches the loss from above. */
static double loss_terms(double residual, double *pull)
{
    const double x = fabs(residual / window.setting[SETTING_LOSS_SCALE]);
    *pull = 1.0;
    if ((int)window.setting[SETTING_LOSS] == LOSS_GEMAN_MCCLURE) {
        *pull = 1.0 / ((1.0 + x * x) * (1.0 + x * x));
        return careful ? *pull : *pull * fmax(0.0, (1.0 - 3.0 * x * x) / (1.0 + x * x));
    }
    if ((int)window.setting[SETTING_LOSS] == LOSS_HUBER) {
        *pull = 1.0 / fmax(1.0, x);
        return careful ? *pull : x > 1.0 ? 0.0 : 1.0;
    }
    return 1.0;
}

/* Put the linearisation at the present window into a QP. */
static void linearise(qp_t *qp, const double a[][QP_STATES * QP_STATES], const double gap[][QP_STATES])
{
    const double *s = window.setting;
    const double *p0 = window_arrival(&window);
    for (int k = 0; k < window.count; k++) {
        const window_node_t *node = &window.node[k];
        double weight[2];
        double gradient[2];
        double noise[2];
        double lower[2];
        double upper[2];
        for (int ch = 0; ch < 2; ch++) {
            const double residual = node->theta[ch] - node->y[ch];
            double pull = 1.0;
            weight[ch] = window_weight(&window, k, ch) * loss_terms(residual, &pull);
            gradient[ch] = window_weight(&window, k, ch) * pull * residual;
            if (k == 0) {
                weight[ch] += p0[ch];
                gradient[ch] += p0[ch] * (node->theta[ch] - window.prior[ch]);
            }
            noise[ch] = s[SETTING_NOISE + ch] * node->w[ch];
            lower[ch] = s[SETTING_LOWER] - node->theta[ch];
            upper[ch] = s[SETTING_UPPER] - node->theta[ch];
        }
        qp_set_cost(qp, k, weight, gradient);
        qp_set_bounds(qp, k, lower, upper);
        if (k + 1 < window.count) {
            qp_set_stage(qp, k, (double *)a[k], (double *)gap[k]);
            qp_set_noise(qp, k, &s[SETTING_NOISE], noise);
        }
    }
    qp_set_bound_weight(qp, s[SETTING_BOUND_WEIGHT]);
}

static void dynamics(double a[][QP_STATES * QP_STATES], double gap[][QP_STATES])
{
    for (int k = 0; k + 1 < window.count; k++) {
        const window_node_t *node = &window.node[k];
        const window_node_t *next = &window.node[k + 1];
        double theta[2];
        double memory[NET_MEMORY];
        model_step(node->u, node->theta, node->memory, theta, memory, a[k]);
        for (int ch = 0; ch < 2; ch++) {
            gap[k][ch] = theta[ch] + node->w[ch] - next->theta[ch];
        }
        for (int j = 0; j < NET_MEMORY; j++) {
            gap[k][2 + j] = memory[j] - next->memory[j];
        }
    }
}

static bool inside(qp_t *qp)
{
    double x[QP_STATES];
    for (int k = 0; k < window.count; k++) {
        qp_x(qp, k, x);
        for (int ch = 0; ch < 2; ch++) {
            const double theta = window.node[k].theta[ch] + x[ch];
            if (theta < window.setting[SETTING_LOWER] || theta > window.setting[SETTING_UPPER]) {
                return false;
            }
        }
    }
    return true;
}

/* Full step; returns the largest change of a temperature. */
static double take(qp_t *qp)
{
    double largest = 0.0;
    double sum = 0.0;
    double x[QP_STATES];
    double w[QP_INPUTS];
    for (int k = 0; k < window.count; k++) {
        window_node_t *node = &window.node[k];
        qp_x(qp, k, x);
        for (int ch = 0; ch < 2; ch++) {
            node->theta[ch] += x[ch];
            largest = fmax(largest, fabs(x[ch]));
            sum += x[ch];
        }
        for (int j = 0; k > 0 && j < NET_MEMORY; j++) {
            node->memory[j] += x[2 + j];
        }
        if (k + 1 < window.count) {
            qp_u(qp, k, w);
            node->w[0] += w[0];
            node->w[1] += w[1];
        }
    }
    return isfinite(sum) ? largest : NAN;
}

/* A window of one node has no dynamics and no QP: the minimum of two parabolas and a bound, per channel. */
static double lone_node(void)
{
    const double *s = window.setting;
    double largest = 0.0;
    for (int ch = 0; ch < 2; ch++) {
        window_node_t *node = &window.node[0];
        const double p0 = window_arrival(&window)[ch];
        double pull = 1.0;
        (void)loss_terms(node->theta[ch] - node->y[ch], &pull);
        const double weight = window_weight(&window, 0, ch) * pull;
        double best = (p0 * window.prior[ch] + weight * node->y[ch]) / (p0 + weight);
        const double bound = fmin(fmax(best, s[SETTING_LOWER]), s[SETTING_UPPER]);
        if (s[SETTING_HARD] != 0.0) {
            best = bound;
        } else if (bound != best) {
            const double rho = s[SETTING_BOUND_WEIGHT];
            best = ((p0 + weight) * best + rho * bound) / (p0 + weight + rho);
        }
        largest = fmax(largest, fabs(best - node->theta[ch]));
        node->theta[ch] = best;
    }
    return largest;
}

static double iterate(bool *solved)
{
    static double a[WINDOW_NODES][QP_STATES * QP_STATES];
    static double gap[WINDOW_NODES][QP_STATES];
    const int stages = window.count - 1;
    if (stages == 0) {
        *solved = true;
        return lone_node();
    }
    dynamics(a, gap);
    if (free_first) {
        linearise(&unbounded[stages], a, gap);
        *solved = qp_solve(&unbounded[stages]) == 0;
        if (*solved && inside(&unbounded[stages])) {
            return take(&unbounded[stages]);
        }
    }
    qp_t *qp = &bounded[window.setting[SETTING_HARD] != 0.0 ? 0 : 1][stages];
    linearise(qp, a, gap);
    *solved = qp_solve(qp) == 0;
    return take(qp);
}

void backend_solve(backend_result_t *result)
{
    const int most = sweeps_fixed > 0 ? sweeps_fixed : (int)window.setting[SETTING_MAX_SWEEPS];
    const double tolerance =
        sweeps_fixed > 0 ? 0.0 : tolerance_given > 0.0 ? tolerance_given : window.setting[SETTING_TOLERANCE];
    *result = (backend_result_t){.status = 1, .kkt_degc = NAN};
    bool all_solved = true;
    careful = false;
    while (result->sweeps < most && result->status == 1) {
        bool solved = false;
        const double before = result->kkt_degc;
        result->kkt_degc = iterate(&solved);
        result->sweeps++;
        careful = careful || (result->sweeps > 1 && !(result->kkt_degc < SHRINK * before));
        all_solved = all_solved && solved;
        if (result->kkt_degc <= tolerance) {
            result->status = all_solved ? 0 : 1;
            break;
        }
    }
    const window_node_t *newest = &window.node[window.count - 1];
    result->theta[0] = newest->theta[0];
    result->theta[1] = newest->theta[1];
    if (!isfinite(newest->theta[0] + newest->theta[1])) {
        result->status = 2;
    }
}

void backend_ahead(const double u[][2], int steps, backend_result_t *result)
{
    double memory[NET_MEMORY];
    memcpy(result->ahead, result->theta, sizeof result->ahead);
    memcpy(memory, window.node[window.count - 1].memory, sizeof memory);
    for (int k = 0; k < steps; k++) {
        model_ahead(u[k], result->ahead, memory);
    }
}

void backend_finish(void)
{
}

int backend_window(double theta[][2])
{
    for (int k = 0; k < window.count; k++) {
        theta[k][0] = window.node[k].theta[0];
        theta[k][1] = window.node[k].theta[1];
    }
    return window.count;
}

int backend_problem(double problem[])
{
    return window_problem(&window, problem);
}
