/* min 1/2 d'Hd + g'd + sum_i (rho_1i s_i + rho_2i s_i^2),  s_i = max(e_i + a_i d, 0),   low <= d <= high
 *
 * Mehrotra's predictor and corrector; the slacks and their multipliers are eliminated row by row, so that an iteration costs one
 * factorisation of n x n and one product of rows. The start is inside the box and every iterate stays there. */
#ifndef OCP_QP_H
#define OCP_QP_H

#include <stdbool.h>
#include <stdint.h>

#include "ocp_kernel.h"

#define OCP_ROWS OCP_LD

typedef struct {
    int32_t n;    /* unknowns, even <= OCP_LD */
    int32_t rows;
    _Alignas(64) double h[OCP_LD][OCP_LD]; /* upper triangle; positive definite */
    _Alignas(64) double a[OCP_ROWS][OCP_LD];
    _Alignas(64) double matrix[OCP_LD][OCP_LD]; /* work */
    int32_t support[OCP_ROWS];             /* columns of a in use, never falling */
    double e[OCP_ROWS], rho_1[OCP_ROWS], rho_2[OCP_ROWS];
    double g[OCP_LD], low[OCP_LD], high[OCP_LD]; /* low < high */

    /* The solution. */
    _Alignas(64) double d[OCP_LD];
    double multiplier[OCP_ROWS];           /* of e_i + a_i d <= s_i */
    double decrease;                       /* of the objective from d = 0: > 0 unless that was the solution */
    int32_t iterations;
} ocp_qp_t;

/* Solve. False: not finite, or not positive definite; d is not to be used. Cost: `iterations` (7 to 20) times
 * n^3/6 + rows n^2/4 products. No memory of its own; any thread with its own object. */
bool ocp_qp_solve(ocp_qp_t *self);

#endif
