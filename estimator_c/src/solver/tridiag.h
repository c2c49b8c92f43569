/* Symmetric positive definite tridiagonal systems, factor once, solve often.
 * Both functions: no allocation, no failure for a positive definite matrix (a matrix that is not gives a
 * non-finite result), any thread, n <= TRIDIAG_MAX; cost 16 divisions (factor), about 50 flops (solve) at n = 16. */
#ifndef TRIDIAG_H
#define TRIDIAG_H

#include "real.h"

#define TRIDIAG_MAX 16

/* L D L^T of the matrix with diagonal diag[n] and sub-diagonal off[n-1]. */
typedef struct {
    real_t lower[TRIDIAG_MAX];   /* lower[k] = L(k+1, k) */
    real_t inverse[TRIDIAG_MAX]; /* 1/D(k) */
} tridiag_t;

void tridiag_factor(tridiag_t *self, int n, const real_t diag[], const real_t off[]);

/* x = A^{-1} b; x may be b. */
void tridiag_solve(const tridiag_t *self, int n, const real_t b[], real_t x[]);

#endif
