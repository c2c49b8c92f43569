/* min 1/2 x'Ax + g'x  with bounds on x, A tridiagonal, positive definite, off-diagonals <= 0 (an M-matrix).
 *
 * Bounds are either hard (lower <= x <= upper) or soft (quadratic penalty rho/2 per unit of violation squared).
 * Primal-dual active set: for an M-matrix the active sets settle monotonically, in at most a few changes.
 * Memory: on the stack, < 1 kB. Any thread. Without a violated bound: one tridiagonal solve, no refactoring. */
#ifndef BOX_QP_H
#define BOX_QP_H

#include <stdbool.h>

#include "tridiag.h"

#define BOX_QP_MAX_CHANGES 40

typedef struct {
    int n;                    /* 1..TRIDIAG_MAX */
    real_t diag[TRIDIAG_MAX];
    real_t off[TRIDIAG_MAX];  /* off[k] = A(k, k+1) <= 0 */
    real_t gradient[TRIDIAG_MAX];
    real_t lower[TRIDIAG_MAX];
    real_t upper[TRIDIAG_MAX];
    bool hard;
    real_t rho;               /* soft: weight of the penalty */
    tridiag_t factor;         /* of diag, off: box_qp_factor() */
} box_qp_t;

/* Factor A; call after diag, off or n changed. */
void box_qp_factor(box_qp_t *self);

/* Solve for x. Returns the number of active-set changes (0: no bound met), or -1 when the sets did not settle within
 * BOX_QP_MAX_CHANGES; x is then clipped (hard) or the last iterate (soft). */
int box_qp_solve(const box_qp_t *self, real_t x[]);

#endif
