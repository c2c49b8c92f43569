#include "hpipm_qp.h"

#include <stdlib.h>

#include "blasfeo_common.h"
#include "blasfeo_d_aux.h"

/* Chosen for HPIPM's benefit, on windows with and without active bounds: the default barrier takes twice the iterations and
 * gives the same temperatures. At a hard bound that hardly pushes they stay off by up to 4e-5 degC. */
static const enum hpipm_mode MODE = SPEED;
static double TOLERANCE = 1e-8; /* of all residuals */
static double FIRST_BARRIER = 1e-3;
static int NOT = 0;
static int ITERATIONS = 60;

/* HPIPM's *_create want memory of *_memsize bytes. */
static void *give(qp_t *self, size_t bytes)
{
    void *memory = aligned_alloc(64, (bytes + 127) / 64 * 64);
    if (memory == NULL) {
        abort();
    }
    memset(memory, 0, bytes);
    self->bytes += bytes;
    return memory;
}

static void set_dimensions(qp_t *self)
{
    d_ocp_qp_dim_create(self->stages, &self->dim, give(self, d_ocp_qp_dim_memsize(self->stages)));
    for (int k = 0; k <= self->stages; k++) {
        d_ocp_qp_dim_set_nx(k, k == 0 ? 2 : QP_STATES, &self->dim);
        d_ocp_qp_dim_set_nu(k, k < self->stages ? QP_INPUTS : 0, &self->dim);
        d_ocp_qp_dim_set_nbx(k, self->bounds == QP_FREE ? 0 : 2, &self->dim);
        d_ocp_qp_dim_set_ns(k, self->bounds == QP_SOFT ? 2 : 0, &self->dim);
    }
}

static void set_constants(qp_t *self)
{
    int index[2] = {0, 1};
    double zero[2] = {0.0, 0.0};
    double b[QP_STATES * QP_INPUTS] = {0};
    b[0] = 1.0;
    b[QP_STATES + 1] = 1.0;
    for (int k = 0; k <= self->stages; k++) {
        if (k < self->stages) {
            d_ocp_qp_set_B(k, b, &self->qp);
        }
        if (self->bounds != QP_FREE) {
            d_ocp_qp_set_idxbx(k, index, &self->qp);
        }
        if (self->bounds == QP_SOFT) {
            d_ocp_qp_set_idxs(k, index, &self->qp);
            d_ocp_qp_set_zl(k, zero, &self->qp);
            d_ocp_qp_set_zu(k, zero, &self->qp);
            d_ocp_qp_set_lls(k, zero, &self->qp);
            d_ocp_qp_set_lus(k, zero, &self->qp);
        }
    }
}

static void create_ocp_solver(qp_t *self, struct d_ocp_qp_dim *dim)
{
    d_ocp_qp_ipm_arg_create(dim, &self->arg, give(self, d_ocp_qp_ipm_arg_memsize(dim)));
    d_ocp_qp_ipm_arg_set_default(MODE, &self->arg);
    d_ocp_qp_ipm_arg_set_ric_alg(&NOT, &self->arg); /* the square root form wants weight on the net's memory; there is none */
    d_ocp_qp_ipm_arg_set_iter_max(&ITERATIONS, &self->arg);
    d_ocp_qp_ipm_arg_set_mu0(&FIRST_BARRIER, &self->arg);
    d_ocp_qp_ipm_arg_set_tol_stat(&TOLERANCE, &self->arg);
    d_ocp_qp_ipm_arg_set_tol_eq(&TOLERANCE, &self->arg);
    d_ocp_qp_ipm_arg_set_tol_ineq(&TOLERANCE, &self->arg);
    d_ocp_qp_ipm_arg_set_tol_comp(&TOLERANCE, &self->arg);
    d_ocp_qp_ipm_ws_create(dim, &self->arg, &self->ws, give(self, d_ocp_qp_ipm_ws_memsize(dim, &self->arg)));
}

static void create_partial(qp_t *self)
{
    const int blocks = self->stages < QP_BLOCKS ? self->stages : QP_BLOCKS;
    int size[QP_BLOCKS + 1];
    d_part_cond_qp_compute_block_size(self->stages, blocks, size);
    d_ocp_qp_dim_create(blocks, &self->small_dim, give(self, d_ocp_qp_dim_memsize(blocks)));
    d_part_cond_qp_compute_dim(&self->dim, size, &self->small_dim);
    d_part_cond_qp_arg_create(blocks, &self->part_arg, give(self, d_part_cond_qp_arg_memsize(blocks)));
    d_part_cond_qp_arg_set_default(&self->part_arg);
    d_part_cond_qp_arg_set_ric_alg(0, &self->part_arg); /* likewise: 1 blows up now and then */
    d_part_cond_qp_arg_set_comp_dual_sol_eq(0, &self->part_arg);
    d_part_cond_qp_arg_set_comp_dual_sol_ineq(0, &self->part_arg);
    d_part_cond_qp_ws_create(&self->dim, size, &self->small_dim, &self->part_arg, &self->part_ws,
                             give(self, d_part_cond_qp_ws_memsize(&self->dim, size, &self->small_dim, &self->part_arg)));
    d_ocp_qp_create(&self->small_dim, &self->small, give(self, d_ocp_qp_memsize(&self->small_dim)));
    d_ocp_qp_sol_create(&self->small_dim, &self->small_sol, give(self, d_ocp_qp_sol_memsize(&self->small_dim)));
    create_ocp_solver(self, &self->small_dim);
}

static void create_full(qp_t *self)
{
    d_dense_qp_dim_create(&self->dense_dim, give(self, d_dense_qp_dim_memsize()));
    d_cond_qp_compute_dim(&self->dim, &self->dense_dim);
    d_cond_qp_arg_create(&self->cond_arg, give(self, d_cond_qp_arg_memsize()));
    d_cond_qp_arg_set_default(&self->cond_arg);
    d_cond_qp_arg_set_ric_alg(0, &self->cond_arg);
    d_cond_qp_arg_set_comp_dual_sol_eq(0, &self->cond_arg);
    d_cond_qp_arg_set_comp_dual_sol_ineq(0, &self->cond_arg);
    d_cond_qp_ws_create(&self->dim, &self->cond_arg, &self->cond_ws,
                        give(self, d_cond_qp_ws_memsize(&self->dim, &self->cond_arg)));
    d_dense_qp_create(&self->dense_dim, &self->dense, give(self, d_dense_qp_memsize(&self->dense_dim)));
    d_dense_qp_sol_create(&self->dense_dim, &self->dense_sol, give(self, d_dense_qp_sol_memsize(&self->dense_dim)));
    d_dense_qp_ipm_arg_create(&self->dense_dim, &self->dense_arg,
                              give(self, d_dense_qp_ipm_arg_memsize(&self->dense_dim)));
    d_dense_qp_ipm_arg_set_default(MODE, &self->dense_arg);
    d_dense_qp_ipm_arg_set_iter_max(&ITERATIONS, &self->dense_arg);
    d_dense_qp_ipm_arg_set_mu0(&FIRST_BARRIER, &self->dense_arg);
    d_dense_qp_ipm_arg_set_tol_stat(&TOLERANCE, &self->dense_arg);
    d_dense_qp_ipm_arg_set_tol_eq(&TOLERANCE, &self->dense_arg);
    d_dense_qp_ipm_arg_set_tol_ineq(&TOLERANCE, &self->dense_arg);
    d_dense_qp_ipm_arg_set_tol_comp(&TOLERANCE, &self->dense_arg);
    d_dense_qp_ipm_ws_create(&self->dense_dim, &self->dense_arg, &self->dense_ws,
                             give(self, d_dense_qp_ipm_ws_memsize(&self->dense_dim, &self->dense_arg)));
}

void qp_create(qp_t *self, int stages, qp_form_t form, qp_bounds_t bounds)
{
    memset(self, 0, sizeof *self);
    self->stages = stages;
    self->form = form;
    self->bounds = bounds;
    set_dimensions(self);
    d_ocp_qp_create(&self->dim, &self->qp, give(self, d_ocp_qp_memsize(&self->dim)));
    d_ocp_qp_sol_create(&self->dim, &self->sol, give(self, d_ocp_qp_sol_memsize(&self->dim)));
    d_ocp_qp_set_all_zero(&self->qp);
    set_constants(self);
    if (form == QP_OCP) {
        create_ocp_solver(self, &self->dim);
    } else if (form == QP_PARTIAL) {
        create_partial(self);
    } else {
        create_full(self);
    }
}

void qp_set_stage(qp_t *self, int k, double jacobian[], double gap[])
{
    d_ocp_qp_set_A(k, jacobian, &self->qp); /* stage 0 reads the columns of theta only: they come first */
    d_ocp_qp_set_b(k, gap, &self->qp);
}

void qp_set_cost(qp_t *self, int k, const double weight[2], const double gradient[2])
{
    const int inputs = k < self->stages ? QP_INPUTS : 0;
    double q[QP_STATES] = {gradient[0], gradient[1]};
    for (int ch = 0; ch < 2; ch++) { /* two entries of the matrix change; the rest stays zero */
        BLASFEO_DMATEL(&self->qp.RSQrq[k], inputs + ch, inputs + ch) = weight[ch];
    }
    d_ocp_qp_set_q(k, q, &self->qp);
}

void qp_set_noise(qp_t *self, int k, const double weight[2], const double gradient[2])
{
    double r[QP_INPUTS] = {gradient[0], gradient[1]};
    for (int ch = 0; ch < QP_INPUTS; ch++) {
        BLASFEO_DMATEL(&self->qp.RSQrq[k], ch, ch) = weight[ch];
    }
    d_ocp_qp_set_r(k, r, &self->qp);
}

void qp_set_bounds(qp_t *self, int k, double lower[2], double upper[2])
{
    if (self->bounds != QP_FREE) {
        d_ocp_qp_set_lbx(k, lower, &self->qp);
        d_ocp_qp_set_ubx(k, upper, &self->qp);
    }
}

void qp_set_bound_weight(qp_t *self, double weight)
{
    double both[2] = {weight, weight};
    for (int k = 0; self->bounds == QP_SOFT && k <= self->stages; k++) {
        d_ocp_qp_set_Zl(k, both, &self->qp);
        d_ocp_qp_set_Zu(k, both, &self->qp);
    }
}

int qp_solve(qp_t *self)
{
    int status = 0;
    if (self->form == QP_OCP) {
        d_ocp_qp_ipm_solve(&self->qp, &self->sol, &self->arg, &self->ws);
        d_ocp_qp_ipm_get_status(&self->ws, &status);
    } else if (self->form == QP_PARTIAL) {
        d_part_cond_qp_cond(&self->qp, &self->small, &self->part_arg, &self->part_ws);
        d_ocp_qp_ipm_solve(&self->small, &self->small_sol, &self->arg, &self->ws);
        d_ocp_qp_ipm_get_status(&self->ws, &status);
        d_part_cond_qp_expand_sol(&self->qp, &self->small_sol, &self->sol, &self->part_arg, &self->part_ws);
    } else {
        d_cond_qp_cond(&self->qp, &self->dense, &self->cond_arg, &self->cond_ws);
        d_dense_qp_ipm_solve(&self->dense, &self->dense_sol, &self->dense_arg, &self->dense_ws);
        d_dense_qp_ipm_get_status(&self->dense_ws, &status);
        d_cond_qp_expand_sol(&self->qp, &self->dense_sol, &self->sol, &self->cond_arg, &self->cond_ws);
    }
    return status;
}

void qp_x(qp_t *self, int k, double x[])
{
    d_ocp_qp_sol_get_x(k, &self->sol, x);
}

void qp_u(qp_t *self, int k, double u[])
{
    d_ocp_qp_sol_get_u(k, &self->sol, u);
}
