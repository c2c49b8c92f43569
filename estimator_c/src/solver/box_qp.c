#include "box_qp.h"

#include <stdint.h>

typedef enum { FREE = 0, AT_LOWER = -1, AT_UPPER = 1 } side_t;

void box_qp_factor(box_qp_t *self)
{
    tridiag_factor(&self->factor, self->n, self->diag, self->off);
}

static side_t side_of(real_t x, real_t lower, real_t upper)
{
    return x > upper ? AT_UPPER : x < lower ? AT_LOWER : FREE;
}

/* Solve with the nodes of `side` held at (hard) or pulled to (soft) their bounds. */
static void solve_with_sides(const box_qp_t *self, const side_t side[], real_t x[])
{
    real_t diag[TRIDIAG_MAX];
    real_t off[TRIDIAG_MAX];
    real_t rhs[TRIDIAG_MAX];
    const int n = self->n;

    for (int k = 0; k < n; k++) {
        diag[k] = self->diag[k];
        off[k] = self->off[k];
        rhs[k] = -self->gradient[k];
    }
    for (int k = 0; k < n; k++) {
        if (side[k] == FREE) {
            continue;
        }
        const real_t bound = side[k] == AT_UPPER ? self->upper[k] : self->lower[k];
        if (!self->hard) {
            diag[k] += self->rho;
            rhs[k] += self->rho * bound;
            continue;
        }
        /* Row k becomes x_k = bound; its neighbours keep symmetry by moving the known term to the right. */
        diag[k] = 1;
        rhs[k] = bound;
        if (k > 0) {
            if (side[k - 1] == FREE) {
                rhs[k - 1] -= off[k - 1] * bound;
            }
            off[k - 1] = 0;
        }
        if (k + 1 < n) {
            if (side[k + 1] == FREE) {
                rhs[k + 1] -= off[k] * bound;
            }
            off[k] = 0;
        }
    }
    tridiag_t factor;
    tridiag_factor(&factor, n, diag, off);
    tridiag_solve(&factor, n, rhs, x);
}

/* Multiplier of node k: minus the gradient of the objective, positive when the objective pushes upwards. */
static real_t push_of(const box_qp_t *self, const real_t x[], int k)
{
    real_t push = -self->gradient[k] - self->diag[k] * x[k];
    if (k > 0) {
        push -= self->off[k - 1] * x[k - 1];
    }
    if (k + 1 < self->n) {
        push -= self->off[k] * x[k + 1];
    }
    return push;
}

int box_qp_solve(const box_qp_t *self, real_t x[])
{
    const int n = self->n;
    side_t side[TRIDIAG_MAX];
    bool violated = false;

    for (int k = 0; k < n; k++) {
        x[k] = -self->gradient[k];
    }
    tridiag_solve(&self->factor, n, x, x);
    for (int k = 0; k < n; k++) {
        side[k] = side_of(x[k], self->lower[k], self->upper[k]);
        violated |= side[k] != FREE;
    }
    if (!violated) {
        return 0;
    }
    for (int change = 1; change <= BOX_QP_MAX_CHANGES; change++) {
        solve_with_sides(self, side, x);
        bool settled = true;
        for (int k = 0; k < n; k++) {
            side_t next = side_of(x[k], self->lower[k], self->upper[k]);
            if (self->hard && side[k] != FREE) {
                next = push_of(self, x, k) * (real_t)side[k] > 0 ? side[k] : FREE;
            }
            settled &= next == side[k];
            side[k] = next;
        }
        if (settled) {
            return change;
        }
    }
    for (int k = 0; self->hard && k < n; k++) {
        x[k] = x[k] > self->upper[k] ? self->upper[k] : x[k] < self->lower[k] ? self->lower[k] : x[k];
    }
    return -1;
}
