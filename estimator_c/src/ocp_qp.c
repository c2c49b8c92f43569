#include "ocp_qp.h"

#include <math.h>
#include <string.h>

enum { ITERATIONS_MAX = 40, SETS_MAX = 8 };

static const double GAP = 1e-11;      /* mean complementarity that is a solution */
static const double RESIDUAL = 1e-8;  /* of stationarity */
static const double GAP_POOR = 1e-6;  /* taken where rounding allows no more */
static const double GAP_SETS = 1e-5;    /* from here on the active sets are worth a try */
static const double WRONG = 1e-9;       /* a sign or a bound missed by more than that changes the set */
static const double INSIDE = 0.05;    /* of the box, the start's distance from a bound */
static const double SLACK_START = 0.1;

/* Slacks and multipliers, and their steps: of the two bounds, and of the rows' two inequalities. */
typedef struct {
    double below[OCP_LD], above[OCP_LD];      /* d - low, high - d */
    double z_below[OCP_LD], z_above[OCP_LD];
    double t[OCP_ROWS], s[OCP_ROWS];          /* s - e - a d, s */
    double lambda[OCP_ROWS], mu[OCP_ROWS];
} point_t;

static double dot(const double a[], const double b[], int n)
{
    double sum = 0.0;
    for (int k = 0; k < n; k++) {
        sum += a[k] * b[k];
    }
    return sum;
}

static double product_with_h(const ocp_qp_t *self, const double x[], double y[])
{
    const int n = self->n;
    for (int i = 0; i < n; i++) {
        y[i] = 0.0;
    }
    for (int i = 0; i < n; i++) {
        const double *row = self->h[i];
        double sum = row[i] * x[i];
        for (int j = i + 1; j < n; j++) {
            sum += row[j] * x[j];
            y[j] += row[j] * x[i];
        }
        y[i] += sum;
    }
    return dot(x, y, n);
}

static void add_rows(const ocp_qp_t *self, const double scale[], double y[])
{
    for (int k = 0; k < self->rows; k++) {
        for (int j = 0; j < self->support[k]; j++) {
            y[j] += scale[k] * self->a[k][j];
        }
    }
}

static double smallest(double a, double b)
{
    return a < b ? a : b;
}

/* Sum of all complementarity products after a step of that length; a step of 0 is where we are. */
static double gap(const ocp_qp_t *self, const point_t *at, const point_t *step, double length)
{
    double sum = 0.0;
    for (int k = 0; k < self->n; k++) {
        sum += (at->below[k] + length * step->below[k]) * (at->z_below[k] + length * step->z_below[k]);
        sum += (at->above[k] + length * step->above[k]) * (at->z_above[k] + length * step->z_above[k]);
    }
    for (int k = 0; k < self->rows; k++) {
        sum += (at->t[k] + length * step->t[k]) * (at->lambda[k] + length * step->lambda[k]);
        sum += (at->s[k] + length * step->s[k]) * (at->mu[k] + length * step->mu[k]);
    }
    return sum / (2 * (self->n + self->rows));
}

/* The longest step, at most 1, that keeps everything positive. */
static double longest(const ocp_qp_t *self, const point_t *at, const point_t *step)
{
    double length = 1.0;
    const double *const value[] = {at->below, at->above, at->z_below, at->z_above, at->t, at->s, at->lambda, at->mu};
    const double *const change[] = {step->below, step->above, step->z_below, step->z_above,
                                    step->t, step->s, step->lambda, step->mu};
    for (int part = 0; part < 8; part++) {
        const int count = part < 4 ? self->n : self->rows;
        for (int k = 0; k < count; k++) {
            if (change[part][k] < 0.0) {
                length = smallest(length, -value[part][k] / change[part][k]);
            }
        }
    }
    return length;
}

static void start(ocp_qp_t *self, point_t *at)
{
    double size = 0.0;
    for (int k = 0; k < self->n; k++) {
        const double room = INSIDE * (self->high[k] - self->low[k]);
        const double least = self->low[k] + room;
        const double most = self->high[k] - room;
        self->d[k] = least > 0.0 ? least : most < 0.0 ? most : 0.0;
        at->below[k] = self->d[k] - self->low[k];
        at->above[k] = self->high[k] - self->d[k];
        size += fabs(self->g[k]);
    }
    const double each = 0.1 * size / self->n + 1e-6; /* a multiplier as large as that at 10 Nm from a bound */
    for (int k = 0; k < self->n; k++) {
        at->z_below[k] = 10.0 * each / at->below[k];
        at->z_above[k] = 10.0 * each / at->above[k];
    }
    for (int k = 0; k < self->rows; k++) {
        const double excess = self->e[k] + dot(self->a[k], self->d, self->support[k]);
        at->s[k] = (excess > 0.0 ? excess : 0.0) + SLACK_START;
        at->t[k] = at->s[k] - excess;
        const double both = self->rho_1[k] + 2.0 * self->rho_2[k] * at->s[k];
        at->lambda[k] = 0.5 * both;
        at->mu[k] = 0.5 * both;
    }
}

/* The step towards complementarity `target`, corrected for the products of `tried` (NULL: none). */
static void direction(const ocp_qp_t *self, const point_t *at, double target, const point_t *tried,
                      const double residual[],
                      point_t *step, double d_step[])
{
    double of_row[OCP_ROWS], c_t[OCP_ROWS], c_s[OCP_ROWS], c_below[OCP_LD], c_above[OCP_LD];
    for (int k = 0; k < self->n; k++) {
        c_below[k] = target - at->below[k] * at->z_below[k] -
                     (tried != NULL ? tried->below[k] * tried->z_below[k] : 0.0);
        c_above[k] = target - at->above[k] * at->z_above[k] -
                     (tried != NULL ? tried->above[k] * tried->z_above[k] : 0.0);
        d_step[k] = -residual[k] + c_below[k] / at->below[k] - c_above[k] / at->above[k];
    }
    for (int k = 0; k < self->rows; k++) {
        const double c_1 = tried != NULL ? tried->t[k] * tried->lambda[k] : 0.0;
        c_t[k] = (target - at->t[k] * at->lambda[k] - c_1) / at->t[k];
        c_s[k] = (target - at->s[k] * at->mu[k] - (tried != NULL ? tried->s[k] * tried->mu[k] : 0.0)) / at->s[k];
        const double d_1 = at->lambda[k] / at->t[k];
        const double d_2 = at->mu[k] / at->s[k] + 2.0 * self->rho_2[k];
        of_row[k] = -(d_2 * c_t[k] - d_1 * c_s[k]) / (d_1 + d_2);
    }
    add_rows(self, of_row, d_step);
    ocp_kernel->solve((const double (*)[OCP_LD])self->matrix, self->n, d_step);
    for (int k = 0; k < self->n; k++) {
        step->below[k] = d_step[k];
        step->above[k] = -d_step[k];
        step->z_below[k] = (c_below[k] - at->z_below[k] * d_step[k]) / at->below[k];
        step->z_above[k] = (c_above[k] + at->z_above[k] * d_step[k]) / at->above[k];
    }
    for (int k = 0; k < self->rows; k++) {
        const double along = dot(self->a[k], d_step, self->support[k]);
        const double d_1 = at->lambda[k] / at->t[k];
        const double d_2 = at->mu[k] / at->s[k] + 2.0 * self->rho_2[k];
        step->t[k] = (c_t[k] + c_s[k] - d_2 * along) / (d_1 + d_2);
        step->s[k] = step->t[k] + along;
        step->lambda[k] = c_t[k] - d_1 * step->t[k];
        step->mu[k] = c_s[k] - at->mu[k] / at->s[k] * step->s[k];
    }
}

static void move(const ocp_qp_t *self, point_t *at, const point_t *step, double length)
{
    for (int k = 0; k < self->n; k++) {
        at->below[k] += length * step->below[k];
        at->above[k] += length * step->above[k];
        at->z_below[k] += length * step->z_below[k];
        at->z_above[k] += length * step->z_above[k];
    }
    for (int k = 0; k < self->rows; k++) {
        at->t[k] += length * step->t[k];
        at->s[k] += length * step->s[k];
        at->lambda[k] += length * step->lambda[k];
        at->mu[k] += length * step->mu[k];
    }
}

/* H + bounds + rows, factored. */
static bool factor(ocp_qp_t *self, const point_t *at)
{
    double weight[OCP_ROWS];
    for (int i = 0; i < self->n; i++) {
        memcpy(&self->matrix[i][i & ~7], &self->h[i][i & ~7], sizeof(double) * (size_t)(OCP_LD - (i & ~7)));
        self->matrix[i][i] += at->z_below[i] / at->below[i] + at->z_above[i] / at->above[i];
    }
    for (int k = 0; k < self->rows; k++) {
        const double d_1 = at->lambda[k] / at->t[k];
        const double d_2 = at->mu[k] / at->s[k] + 2.0 * self->rho_2[k];
        weight[k] = d_1 * d_2 / (d_1 + d_2);
    }
    ocp_kernel->gram(self->matrix, self->n, (const double (*)[OCP_LD])self->a, self->support, weight, self->rows);
    return ocp_kernel->factor(self->matrix, self->n);
}

static double penalty(const ocp_qp_t *self, int k, double excess)
{
    const double s = excess > 0.0 ? excess : 0.0;
    return self->rho_1[k] * s + self->rho_2[k] * s * s;
}

/* The solution if the sets are right: d and the multipliers. False: not positive definite. */
static bool solve_sets(ocp_qp_t *self, double d[], double multiplier[])
{
    _Alignas(64) double x[OCP_LD] = {0.0}, nu[OCP_LD] = {0.0};
    double fixed[OCP_LD], by_h[OCP_LD], gap_row[OCP_ROWS];
    int free[OCP_LD], on[OCP_ROWS], frees = 0, ons = 0;
    for (int k = 0; k < self->n; k++) {
        fixed[k] = self->bound[k] == OCP_LOW ? self->low[k] : self->bound[k] == OCP_HIGH ? self->high[k] : 0.0;
        if (self->bound[k] == OCP_FREE) {
            free[frees++] = k;
        }
    }
    (void)product_with_h(self, fixed, by_h);
    for (int i = 0; i < self->n; i++) {
        by_h[i] += self->g[i];
    }
    for (int i = 0; i < frees; i++) {
        memset(self->matrix[i], 0, sizeof self->matrix[i]);
        for (int j = i; j < frees; j++) {
            self->matrix[i][j] = self->h[free[i]][free[j]];
        }
    }
    for (int r = 0; r < self->rows; r++) {
        const double *a = self->a[r];
        gap_row[r] = self->e[r] + dot(a, fixed, self->support[r]);
        if (self->kink[r] == OCP_OFF) {
            continue;
        }
        /* the last is free while a row is over */
        double *reach = self->reach[self->kink[r] == OCP_ON ? ons : OCP_ROWS - 1];
        memset(reach, 0, sizeof self->reach[0]);
        for (int i = 0; i < frees && free[i] < self->support[r]; i++) {
            reach[i] = a[free[i]];
        }
        if (self->kink[r] == OCP_ON) {
            on[ons++] = r;
            continue;
        }
        const double force = self->rho_1[r] + 2.0 * self->rho_2[r] * gap_row[r];
        for (int j = 0; j < self->support[r]; j++) {
            by_h[j] += force * a[j];
        }
        for (int i = 0; i < frees && free[i] < self->support[r]; i++) {
            for (int j = i; j < frees; j++) {
                self->matrix[i][j] += 2.0 * self->rho_2[r] * reach[i] * reach[j];
            }
        }
    }
    if (ons > frees || !ocp_kernel->factor(self->matrix, frees)) {
        return false;
    }
    for (int i = 0; i < frees; i++) {
        x[i] = -by_h[free[i]];
    }
    ocp_kernel->solve((const double (*)[OCP_LD])self->matrix, frees, x);
    for (int p = 0; p < ons; p++) { /* reach_p := matrix^-1 a_p */
        ocp_kernel->solve((const double (*)[OCP_LD])self->matrix, frees, self->reach[p]);
        nu[p] = gap_row[on[p]];
        memset(self->schur[p], 0, sizeof self->schur[p]);
    }
    for (int p = 0; p < ons; p++) {
        for (int i = 0; i < frees && free[i] < self->support[on[p]]; i++) {
            const double a = self->a[on[p]][free[i]];
            nu[p] += a * x[i];
            for (int q = p; q < ons; q++) {
                self->schur[p][q] += a * self->reach[q][i];
            }
        }
    }
    if (!ocp_kernel->factor(self->schur, ons)) {
        return false;
    }
    ocp_kernel->solve((const double (*)[OCP_LD])self->schur, ons, nu);
    for (int p = 0; p < ons; p++) {
        for (int i = 0; i < frees; i++) {
            x[i] -= nu[p] * self->reach[p][i];
        }
    }
    memcpy(d, fixed, sizeof(double) * (size_t)self->n);
    for (int i = 0; i < frees; i++) {
        d[free[i]] = x[i];
    }
    for (int r = 0, p = 0; r < self->rows; r++) {
        const double excess = self->e[r] + dot(self->a[r], d, self->support[r]);
        multiplier[r] = self->kink[r] == OCP_OFF ? 0.0
                        : self->kink[r] == OCP_ON ? nu[p++]
                                                  : self->rho_1[r] + 2.0 * self->rho_2[r] * excess;
    }
    return true;
}

/* Change all that the solution of the sets contradicts; returns how much that was, -1: something is not finite. */
static int revise_sets(ocp_qp_t *self, const double d[], const double multiplier[])
{
    double residual[OCP_LD], sum = 0.0;
    int wrong = 0;
    sum += product_with_h(self, d, residual);
    for (int k = 0; k < self->n; k++) {
        residual[k] += self->g[k];
    }
    add_rows(self, multiplier, residual);
    for (int k = 0; k < self->n; k++) {
        const uint8_t was = self->bound[k];
        if (was == OCP_FREE) {
            self->bound[k] = d[k] < self->low[k] - WRONG ? OCP_LOW : d[k] > self->high[k] + WRONG ? OCP_HIGH : OCP_FREE;
        } else if (was == OCP_LOW ? residual[k] < -WRONG : residual[k] > WRONG) {
            self->bound[k] = OCP_FREE;
        }
        wrong += self->bound[k] != was;
        sum += residual[k];
    }
    for (int r = 0; r < self->rows; r++) {
        const uint8_t was = self->kink[r];
        const double excess = self->e[r] + dot(self->a[r], d, self->support[r]);
        if (was == OCP_ON) {
            const bool above = multiplier[r] > self->rho_1[r] + WRONG;
            self->kink[r] = multiplier[r] < -WRONG ? OCP_OFF : above ? OCP_OVER : OCP_ON;
        } else if (was == OCP_OFF ? excess > WRONG : excess < -WRONG) {
            self->kink[r] = OCP_ON;
        }
        wrong += self->kink[r] != was;
        sum += excess;
    }
    return sum - sum == 0.0 ? wrong : -1;
}

static void conclude(ocp_qp_t *self, const double multiplier[])
{
    double by_h[OCP_LD];
    self->decrease = -0.5 * product_with_h(self, self->d, by_h) - dot(self->g, self->d, self->n);
    for (int k = 0; k < self->rows; k++) {
        const double excess = self->e[k] + dot(self->a[k], self->d, self->support[k]);
        self->decrease += penalty(self, k, self->e[k]) - penalty(self, k, excess);
        self->multiplier[k] = multiplier[k];
    }
    for (int k = self->n; k < OCP_LD; k++) {
        self->d[k] = 0.0;
    }
}

/* By active sets, from the guess; whether it settled. */
static bool settle(ocp_qp_t *self)
{
    double d[OCP_LD], multiplier[OCP_ROWS];
    for (int k = 0; k < SETS_MAX; k++) {
        self->sets++;
        if (!solve_sets(self, d, multiplier)) {
            return false;
        }
        const int wrong = revise_sets(self, d, multiplier);
        if (wrong < 0) {
            return false;
        }
        if (wrong == 0) {
            for (int j = 0; j < self->n; j++) { /* rounding may have left the box */
                self->d[j] = d[j] < self->low[j] ? self->low[j] : d[j] > self->high[j] ? self->high[j] : d[j];
            }
            conclude(self, multiplier);
            return true;
        }
    }
    return false;
}

/* The sets that an interior point is heading for. */
static void guess_sets(ocp_qp_t *self, const point_t *at)
{
    for (int k = 0; k < self->n; k++) {
        self->bound[k] = at->z_below[k] > at->below[k] ? OCP_LOW : at->z_above[k] > at->above[k] ? OCP_HIGH : OCP_FREE;
    }
    for (int k = 0; k < self->rows; k++) {
        self->kink[k] = at->lambda[k] < at->t[k] ? OCP_OFF : at->mu[k] < at->s[k] ? OCP_OVER : OCP_ON;
    }
}

bool ocp_qp_solve(ocp_qp_t *self)
{
    _Alignas(64) double residual[OCP_LD], d_step[OCP_LD] = {0.0}, inside[OCP_LD];
    point_t at, tried, step;
    const int n = self->n;
    const point_t *const nowhere = &at; /* times a length of 0 */
    bool tried_sets = false;
    self->iterations = self->sets = 0;
    if (settle(self)) {
        return true;
    }
    start(self, &at);
    for (; self->iterations < ITERATIONS_MAX; self->iterations++) {
        double worst = 0.0;
        (void)product_with_h(self, self->d, residual);
        for (int k = 0; k < n; k++) {
            residual[k] += self->g[k] - at.z_below[k] + at.z_above[k];
        }
        add_rows(self, at.lambda, residual);
        for (int k = 0; k < n; k++) {
            worst = fabs(residual[k]) > worst ? fabs(residual[k]) : worst;
        }
        const double now = gap(self, &at, nowhere, 0.0);
        if (!(now - now == 0.0) || !(worst - worst == 0.0)) {
            return false;
        }
        if (!tried_sets && now < GAP_SETS) {
            memcpy(inside, self->d, sizeof inside);
            guess_sets(self, &at);
            if (settle(self)) {
                return true;
            }
            memcpy(self->d, inside, sizeof inside);
            tried_sets = true;
        }
        if (now < GAP && worst < RESIDUAL) {
            guess_sets(self, &at);
            conclude(self, at.lambda);
            return true;
        }
        if (!factor(self, &at)) {
            break;
        }
        direction(self, &at, 0.0, NULL, residual, &tried, d_step);
        const double far = longest(self, &at, &tried);
        const double ahead = gap(self, &at, &tried, far) / now;
        direction(self, &at, ahead * ahead * ahead * now, &tried, residual, &step, d_step);
        double length = longest(self, &at, &step);
        if (length < 1.0) {
            length *= 0.995;
        }
        move(self, &at, &step, length);
        for (int k = 0; k < n; k++) {
            self->d[k] += length * d_step[k];
        }
    }
    if (!(gap(self, &at, nowhere, 0.0) < GAP_POOR)) {
        return false;
    }
    guess_sets(self, &at);
    conclude(self, at.lambda);
    return true;
}
