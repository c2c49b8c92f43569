#include "tridiag.h"

void tridiag_factor(tridiag_t *self, int n, const real_t diag[], const real_t off[])
{
    real_t pivot = diag[0];
    self->inverse[0] = 1 / pivot;
    for (int k = 0; k + 1 < n; k++) {
        self->lower[k] = off[k] * self->inverse[k];
        pivot = diag[k + 1] - self->lower[k] * off[k];
        self->inverse[k + 1] = 1 / pivot;
    }
}

void tridiag_solve(const tridiag_t *self, int n, const real_t b[], real_t x[])
{
    x[0] = b[0];
    for (int k = 1; k < n; k++) {
        x[k] = b[k] - self->lower[k - 1] * x[k - 1];
    }
    x[n - 1] *= self->inverse[n - 1];
    for (int k = n - 2; k >= 0; k--) {
        x[k] = x[k] * self->inverse[k] - self->lower[k] * x[k + 1];
    }
}
