/* Two symmetric positive definite tridiagonal systems side by side, factored from both ends towards the middle: four
 * chains of n/2 divisions that do not wait for each other, where one system alone would be a chain of n. Both
 * functions: no allocation, no failure for positive definite matrices (others give a non-finite result), any thread, 1
 * <= n <= TRIDIAG_MAX; cost 2 n divisions (factor), about 100 flops (solve) at n = 16. */
#ifndef TRIDIAG_PAIR_H
#define TRIDIAG_PAIR_H

#include "tridiag.h"

typedef real_t real_pair_t[2]; /* an element of the first system, and of the second */

typedef struct {
    real_pair_t inverse[TRIDIAG_MAX]; /* of the pivots */
    real_pair_t towards[TRIDIAG_MAX]; /* multiplier of row k in its neighbour's, the one nearer to the middle */
} tridiag_pair_t;

/* Matrices with diagonals diag[n] and sub-diagonals off[n-1]. */
void tridiag_pair_factor(tridiag_pair_t *self, int n, const real_pair_t diag[], const real_pair_t off[]);

/* x = A^{-1} b; x may be b. */
void tridiag_pair_solve(const tridiag_pair_t *self, int n, const real_pair_t b[], real_pair_t x[]);

#endif
