/* The QP of one SQP iteration, as HPIPM takes it: an optimal control problem with states [theta, memory of the net] (node 0:
 * theta only, its memory is given), inputs w, bounds on theta. Three ways to solve it. */
#ifndef HPIPM_QP_H
#define HPIPM_QP_H

#include <stdbool.h>
#include <stddef.h>

#include "hpipm_d_cond.h"
#include "hpipm_d_dense_qp_ipm.h"
#include "hpipm_d_ocp_qp_ipm.h"
#include "hpipm_d_part_cond.h"
#include "window.h"

enum { QP_STATES = 2 + NET_MEMORY, QP_INPUTS = 2, QP_BLOCKS = 5 };

typedef enum { QP_OCP, QP_PARTIAL, QP_FULL } qp_form_t;
typedef enum { QP_FREE, QP_HARD, QP_SOFT } qp_bounds_t;

typedef struct {
    qp_form_t form;
    qp_bounds_t bounds;
    int stages;
    struct d_ocp_qp_dim dim;
    struct d_ocp_qp qp;
    struct d_ocp_qp_sol sol;
    /* QP_OCP: of dim; QP_PARTIAL: of the condensed problem */
    struct d_ocp_qp_dim small_dim;
    struct d_ocp_qp small;
    struct d_ocp_qp_sol small_sol;
    struct d_part_cond_qp_arg part_arg;
    struct d_part_cond_qp_ws part_ws;
    struct d_ocp_qp_ipm_arg arg;
    struct d_ocp_qp_ipm_ws ws;
    /* QP_FULL */
    struct d_dense_qp_dim dense_dim;
    struct d_dense_qp dense;
    struct d_dense_qp_sol dense_sol;
    struct d_cond_qp_arg cond_arg;
    struct d_cond_qp_ws cond_ws;
    struct d_dense_qp_ipm_arg dense_arg;
    struct d_dense_qp_ipm_ws dense_ws;
    size_t bytes; /* of everything HPIPM was given */
} qp_t;

/* Allocate and set what never changes. stages: 1..15. Aborts without memory: this is a bench. */
void qp_create(qp_t *self, int stages, qp_form_t form, qp_bounds_t bounds);

/* Linear dynamics of a stage: jacobian (QP_STATES x QP_STATES, by columns) and gap. */
void qp_set_stage(qp_t *self, int k, double jacobian[], double gap[]);

/* Weights and gradients of a node; w terms only where a stage leaves it. */
void qp_set_cost(qp_t *self, int k, const double weight[2], const double gradient[2]);
void qp_set_noise(qp_t *self, int k, const double weight[2], const double gradient[2]);

/* Room of theta below and above (degC), and the weight of soft bounds (all nodes alike). */
void qp_set_bounds(qp_t *self, int k, double lower[2], double upper[2]);
void qp_set_bound_weight(qp_t *self, double weight);

/* Solve; returns HPIPM's status (0: solved). qp_x, qp_u: the solution. */
int qp_solve(qp_t *self);
void qp_x(qp_t *self, int k, double x[]);
void qp_u(qp_t *self, int k, double u[]);

#endif
