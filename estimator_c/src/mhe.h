/* Moving horizon estimation of winding and rotor temperature with the trained net as its model.
 *
 *   theta_{k+1} = theta_k + dt F(u_k, theta_k, c_k, h_k) + w_k,   (c, h)_{k+1} = LSTM(u_k, theta_k, c_k, h_k)
 *   min 1/2 |theta_0 - prior|^2_P0 + sum Wy rho(y_k - theta_k) + 1/2 sum |w_k|^2_Ww   over up to 16 nodes
 *
 * with c_0, h_0 given and rho the loss of a measurement: quadratic, Huber's or Geman and McClure's. w is eliminated,
 * so the unknowns are theta_0..theta_15 alone; c and h follow by recursion. Each sweep: the net forward over the
 * window, its exact adjoint backward (hence the exact gradient), one tridiagonal solve per channel with the
 * Gauss-Newton matrix that keeps each stage's direct slope but leaves out what passes through the net's memory. Its
 * fixed point is the exact KKT point of the problem above.
 *
 * Everything: no allocation, no clock, no printing; one thread at a time per object; state sizeof(mhe_t) (8 cells: 11
 * kB in double, 5 kB in single precision), owned by the caller. Without an active bound no branch depends on data
 * other than the number of sweeps. real_t is the generator's choice; the setting is double either way, and a tolerance
 * below what single precision can resolve is raised to 15 uK. */
#ifndef MHE_H
#define MHE_H

#include <stdbool.h>
#include <stdint.h>

#include "box_qp.h"
#include "est_settings.h"
#include "real.h"
#include "thermal_net.h"
#include "tridiag_pair.h"

#define MHE_NODES 16 /* N = 15 stages; a power of two, the window is a ring */
#define MHE_CHANNELS 2 /* 0 winding, 1 rotor */

typedef enum {
    MHE_OK = 0,
    MHE_MAX_SWEEPS = 1, /* best iterate returned; the tolerance was not met */
    MHE_INVALID = 2,    /* not started, or a result that is not finite: start again */
} mhe_status_t;

typedef struct {
    NET_ALIGNED real_t theta[MHE_CHANNELS];  /* the estimate at this node */
    real_t u[2];                 /* [speed rpm, torque Nm] of the stage that leaves this node */
    real_t y[MHE_CHANNELS];      /* measurement, offset removed */
    real_t weight[MHE_CHANNELS]; /* Wy, or 0 where there is none */
    NET_ALIGNED real_t memory[NET_MEMORY]; /* of the net on arrival at this node */
    NET_ALIGNED real_t tape[NET_TAPE];
    real_t rate[MHE_CHANNELS];   /* F of the stage that leaves this node */
    real_t slope[MHE_CHANNELS];  /* 1 + dt dF/dtheta of that stage, direct part */
} mhe_node_t;

typedef struct {
    real_t weight_measurement[MHE_CHANNELS];
    real_t weight_noise[MHE_CHANNELS];
    real_t weight_arrival[MHE_CHANNELS];
    real_t weight_prior[MHE_CHANNELS];
    real_t lower, upper, tolerance;
    bool hard_bounds;
    real_t bound_weight;         /* of soft ones */
    real_t loss_scale;           /* degC, of Huber's and Geman and McClure's loss */
    int loss;                    /* EST_LOSS_... of est_settings.h */
    int max_sweeps;
    bool newest_measurement;

    mhe_node_t node[MHE_NODES];
    int head;                    /* ring index of the oldest node */
    int count;                   /* nodes in the window, 0 before mhe_start() */
    bool full;                   /* the window has shifted at least once: arrival weight instead of prior weight */
    bool stale;                  /* temperatures have moved since the stages were computed */
    bool careful;                /* this solve keeps to the loss's majorant */
    bool converged;              /* so far */
    real_t prior[MHE_CHANNELS];  /* theta bar of the oldest node */
    real_pair_t gradient[MHE_NODES]; /* of the cost, bounds left out, at the last sweep */
    real_pair_t diag[MHE_NODES];     /* the matrix of each channel, and its factors */
    real_pair_t off[MHE_NODES];
    tridiag_pair_t factor;
} mhe_t;

typedef struct {
    real_t theta[MHE_CHANNELS]; /* at the newest node */
    real_t kkt_degc;            /* largest change the last tridiagonal solve asked for: the KKT residual in degC */
    int sweeps;                 /* gradient sweeps done */
    int active;                 /* active-set changes, both channels, all sweeps; 0: no bound was met */
} mhe_result_t;

/* Take the weights, bounds and tolerances of `setting`; the window is empty. Copies; never fails. < 1 us. */
void mhe_init(mhe_t *self, const est_setting_t *setting);

/* Begin a window of one node with that prior and that memory of the net (NET_MEMORY). Never fails. */
void mhe_start(mhe_t *self, const real_t prior[MHE_CHANNELS], const real_t memory[]);

/* Append a node: the newest one plus one step of the net with u = [speed rpm, torque Nm]. A full window drops its
 * oldest node; the prior becomes the last solution at the new oldest node, whose memory is kept. One net step. */
void mhe_advance(mhe_t *self, const real_t u[2]);

/* Another prior of the oldest node, and its weights (1/K^2), in place of the last solution there and the setting's;
 * memory: of the net there, NULL to keep it (else one forward pass). For a full window, after mhe_advance(). */
void mhe_arrival(mhe_t *self, const real_t prior[MHE_CHANNELS], const real_t weight[MHE_CHANNELS],
                 const real_t memory[]);

/* Attach measurement y (offset removed) to the node `age` steps before the newest, with `share` (0..1) of the setting's
 * weight. Returns the innovation: y minus what the window said before; attaches nothing and returns NAN for a node
 * outside the window or a value that is not finite. */
real_t mhe_measure(mhe_t *self, int age, int channel, real_t y, real_t share);

/* Other weights of the noise (Ww, 1/K^2) and another scale of the loss (degC) than the setting's, from the next
 * solution on. */
void mhe_weigh(mhe_t *self, const real_t noise[MHE_CHANNELS], real_t loss_scale);

/* Take back the measurements of the newest `nodes` nodes: they turned out to be worth nothing. */
void mhe_forget(mhe_t *self, int channel, int nodes);

/* Move the whole window of one channel by `shift` degC: the level was wrong, the course was not. */
void mhe_shift(mhe_t *self, int channel, real_t shift);

/* Solve from the present window: to the tolerance, or as many sweeps as allowed (a tolerance of 0 makes that a
 * fixed number). Cost: `sweeps` adjoint passes and one forward pass less. The same as mhe_feedback() and
 * mhe_finish(). */
mhe_status_t mhe_solve(mhe_t *self, mhe_result_t *result);

/* mhe_solve() that asks `expired` before each sweep but the first: once it says true, the iterate so far is the result
 * (MHE_MAX_SWEEPS; its kkt_degc tells how good it is). */
mhe_status_t mhe_solve_within(mhe_t *self, mhe_result_t *result, bool (*expired)(void *ctx), void *ctx);

/* The estimate after the first sweep alone: one adjoint pass and one solve, no forward pass. MHE_MAX_SWEEPS: there is
 * more to do, and mhe_finish() with the same result, after publishing, does it and returns what mhe_solve() would
 * have. Until then the memory in the window's nodes is that of before the sweep. Without mhe_finish() the next
 * mhe_advance() brings the stages up to date: one sweep per step. */
mhe_status_t mhe_feedback(mhe_t *self, mhe_result_t *result);
mhe_status_t mhe_finish(mhe_t *self, mhe_result_t *result);

/* The node `age` steps before the newest, NULL outside the window. The newest node's memory belongs to the solution. */
const mhe_node_t *mhe_node(const mhe_t *self, int age);

/* The cost at the present temperatures and its gradient (count rows of [winding, rotor], oldest first), bounds left
 * out; runs a forward and an adjoint pass. For tests. */
real_t mhe_cost(mhe_t *self, real_t gradient[][MHE_CHANNELS]);

#endif
