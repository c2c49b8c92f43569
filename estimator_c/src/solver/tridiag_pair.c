#include "tridiag_pair.h"

void tridiag_pair_factor(tridiag_pair_t *self, int n, const real_pair_t diag[], const real_pair_t off[])
{
    const int middle = n / 2;
    real_pair_t down = {diag[0][0], diag[0][1]};         /* pivot from the first row on */
    real_pair_t up = {diag[n - 1][0], diag[n - 1][1]};   /* and from the last row back */
    for (int i = 0; i < middle; i++) {
        const int j = n - 1 - i;
        for (int s = 0; s < 2; s++) {
            self->inverse[i][s] = 1 / down[s];
            self->towards[i][s] = off[i][s] * self->inverse[i][s];
            down[s] = diag[i + 1][s] - self->towards[i][s] * off[i][s];
        }
        for (int s = 0; s < 2 && j > middle; s++) {
            self->inverse[j][s] = 1 / up[s];
            self->towards[j][s] = off[j - 1][s] * self->inverse[j][s];
            up[s] = diag[j - 1][s] - self->towards[j][s] * off[j - 1][s];
        }
    }
    for (int s = 0; s < 2; s++) { /* both have reached the middle row, each with its diagonal in it */
        const real_t both = n > 1 ? down[s] + up[s] - diag[middle][s] : down[s];
        self->inverse[middle][s] = 1 / both;
    }
}

void tridiag_pair_solve(const tridiag_pair_t *self, int n, const real_pair_t b[], real_pair_t x[])
{
    const int middle = n / 2;
    for (int k = 0; k < n; k++) {
        for (int s = 0; s < 2; s++) {
            x[k][s] = b[k][s];
        }
    }
    for (int i = 0; i < middle; i++) {
        const int j = n - 1 - i;
        for (int s = 0; s < 2; s++) {
            x[i + 1][s] -= self->towards[i][s] * x[i][s];
        }
        for (int s = 0; s < 2 && j > middle; s++) {
            x[j - 1][s] -= self->towards[j][s] * x[j][s];
        }
    }
    for (int s = 0; s < 2; s++) {
        x[middle][s] *= self->inverse[middle][s];
    }
    for (int i = middle - 1, j = middle + 1; i >= 0; i--, j++) {
        for (int s = 0; s < 2; s++) {
            x[i][s] = x[i][s] * self->inverse[i][s] - self->towards[i][s] * x[i + 1][s];
        }
        for (int s = 0; s < 2 && j < n; s++) {
            x[j][s] = x[j][s] * self->inverse[j][s] - self->towards[j][s] * x[j - 1][s];
        }
    }
}
