/* min 1/2 d'Hd + g'd + sum_i (rho_1i s_i + rho_2i s_i^2),  s_i = max(e_i + a_i d, 0),   low <= d <= high
 *
 * First by active sets: the guess in `bound` and `kink`, all that it gets wrong changed at once, a few times; with the
 * sets of a neighbouring problem that is one or two small factorisations, and the answer is exact. Where it does not
 * settle, Mehrotra's predictor and corrector, slacks and their multipliers eliminated row by row, from inside the box;
 * its last word is the active sets' again, if they agree. */
#ifndef OCP_QP_H
#define OCP_QP_H

#include <stdbool.h>
#include <stdint.h>

#include "ocp_kernel.h"

#define OCP_ROWS OCP_LD

typedef enum { OCP_FREE = 0, OCP_LOW = 1, OCP_HIGH = 2 } ocp_bound_t;
typedef enum { OCP_OFF = 0, OCP_ON = 1, OCP_OVER = 2 } ocp_kink_t; /* e + a d below 0, at 0 with a multiplier, above */

typedef struct {
    int32_t n;    /* unknowns, even <= OCP_LD */
    int32_t rows;
    _Alignas(64) double h[OCP_LD][OCP_LD]; /* upper triangle; positive definite */
    _Alignas(64) double a[OCP_ROWS][OCP_LD];
    _Alignas(64) double matrix[OCP_LD][OCP_LD], schur[OCP_LD][OCP_LD], reach[OCP_ROWS][OCP_LD]; /* work */
    int32_t support[OCP_ROWS];             /* columns of a in use, never falling */
    double e[OCP_ROWS], rho_1[OCP_ROWS], rho_2[OCP_ROWS];
    double g[OCP_LD], low[OCP_LD], high[OCP_LD]; /* low < high */

    uint8_t bound[OCP_LD], kink[OCP_ROWS]; /* ocp_bound_t, ocp_kink_t: a guess, then the solution's */

    /* The solution. */
    _Alignas(64) double d[OCP_LD];
    double multiplier[OCP_ROWS];           /* of e_i + a_i d <= s_i */
    double decrease;                       /* of the objective from d = 0: > 0 unless that was the solution */
    int32_t iterations;                    /* interior points, each n^3/6 + rows n^2/4 products */
    /* active sets tried, each (free n)^3/6 products and one n^2 per row that is on */
    int32_t sets;
} ocp_qp_t;

/* Solve. False: not finite, or not positive definite; d is not to be used. At most 40 iterations and 16 sets.
 * No memory of its own; any thread with its own object. */
bool ocp_qp_solve(ocp_qp_t *self);

#endif
