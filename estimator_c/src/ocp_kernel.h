/* What the MPC's solver computes in bulk, once per family of processors: the net's exact derivatives for many outputs
 * at once, and dense linear algebra of up to OCP_LD unknowns. Chosen when the program is loaded, as the net's own
 * kernels are.
 *
 * Matrices are square, row by row with OCP_LD columns, their upper triangle alone counts; all memory is aligned to 64
 * bytes and zero behind the last column in use. All functions: pure, any thread, no failure but the one named. */
#ifndef OCP_KERNEL_H
#define OCP_KERNEL_H

#include <stdbool.h>
#include <stdint.h>

#include "ocp_net.h"

#define OCP_LD 80 /* two unknowns in each of 40 intervals; a multiple of the widest vector */
#define OCP_DIRECTIONS 40

/* The way back of one output through the horizon: its derivatives on what the net carries, here and now. */
typedef struct {
    _Alignas(64) double c[OCP_PAD], h[OCP_PAD]; /* on the memory */
    double theta[2];
    double u[2]; /* on speed (rpm) and torque (Nm) of the last step pulled through */
} ocp_row_t;

/* The way forward of directions in the torques of the intervals: derivatives of what the net carries, a column per
 * direction. */
typedef struct {
    _Alignas(64) double c[OCP_PAD][OCP_DIRECTIONS], h[OCP_PAD][OCP_DIRECTIONS];
    double theta[2][OCP_DIRECTIONS];
} ocp_tangent_t;

/* What an outcome asks of a step of the net: its derivatives on the step's new memory, the share by way of the rates
 * in h. */
typedef struct {
    _Alignas(64) double c[OCP_PAD], h[OCP_PAD];
} ocp_bar_t;

typedef struct ocp_kernel {
    const char *name;
    bool (*available)(void); /* on this processor */

    /* theta+ = theta + dt rate(u, theta, memory), memory+ = net(u, theta, memory), pulled back at the recorded step;
     * 60 ns a row on a vector machine. */
    void (*pull_back)(const double tape[], const double memory[], ocp_row_t row[], int rows);

    /* One row alone, noting in `bar` what it asks of this step. */
    void (*pull_back_one)(const double tape[], const double memory[], ocp_row_t *row, ocp_bar_t *bar);

    /* The same step forward for the first `directions` directions (columns behind them up to a multiple of 8 are
     * computed too); of_torque: the torque's share in each. curve += the second derivative of what bar asks for, upper
     * triangle. 30 ns a direction. */
    void (*push)(const double tape[], const double memory[], const ocp_bar_t *bar, const double of_torque[],
                 ocp_tangent_t *tangent, int directions, double curve[][OCP_DIRECTIONS]);

    /* h += sum of weight[k] row_k' row_k; support[k]: columns in use of row k, never falling with k. n^2/2 products a
     * row. */
    void (*gram)(double h[][OCP_LD], int n, const double row[][OCP_LD], const int32_t support[], const double weight[],
                 int rows);

    /* a = U'U in place, the inverses on U's diagonal. False, and a destroyed: not positive definite. n^3/6 products. */
    bool (*factor)(double a[][OCP_LD], int n);

    /* x := (U'U)^-1 x. n^2 products. */
    void (*solve)(const double a[][OCP_LD], int n, double x[]);
} ocp_kernel_t;

/* The kernel in use. */
extern const ocp_kernel_t *ocp_kernel;

/* Choose one by name, as net_select() does; NULL: the best. Not while another thread solves. */
const char *ocp_select(const char *name);

#endif
