/* Model predictive control of the torque under a temperature limit, with the trained net as the thermal model.
 *
 *   v+ = v + dt/m ((T + F) i/r - m g sin(slope) - drag v^2 - m g c_r v/sqrt(v^2 + 0.05^2)),   n = 30 v i/(pi r)
 *   theta+ = theta + dt rate(n, T, theta, memory),   memory+ = net(n, T, theta, memory)          per sub-step of 0.1 s
 *
 *   min sum over intervals of  Dt (q_v (v+ - v_ref)^2 + r_F F^2 + r_u T^2) + r_d (T - T before)^2
 *                              + Dt (q_a max(v+ - v_ref, 0)^2 + q_b (max(v+ - v_max - 1, 0)^2 + max(-v+, 0)^2))
 *                              + Dt sum over both temperatures of rho_1 s + rho_2 s^2,  s = max(theta+ - limit, 0)
 *   -regen(v) <= T <= drive(v),   -friction <= F <= 0,   T and F held over each interval, the envelope at its beginning
 *
 * One motor torque T stands for accelerating and braking torque: with a weight on both, one of them is zero in every
 * solution. The unknowns are tau in T = -regen(v) + tau (drive(v) + regen(v)), 0 <= tau <= 1, and F: a box, so that
 * every iterate keeps to the envelope. v_ref and the slopes are data; who calls makes them from where the car is going
 * to be.
 *
 * Each iteration: the horizon forward, exact derivatives of every temperature near its limit by the net's adjoint, a
 * quadratic programme with the slacks eliminated (Mehrotra's predictor and corrector on a dense matrix), a step that
 * the true cost agrees to. The matrix is Gauss and Newton's plus the curvature of the temperatures in force, copper
 * loss being square in T. Its fixed point is the exact KKT point of the problem.
 *
 * Everything: no allocation, no clock, no printing; one thread at a time per object; the caller owns it (550 kB). Stack: 64 kB. */
#ifndef MPC_H
#define MPC_H

#include <stdbool.h>
#include <stdint.h>

#include "mpc_settings.h"
#include "ocp_kernel.h"
#include "ocp_qp.h"
#include "thermal_net.h"

#define MPC_DT_S NET_DT_S

typedef enum {
    MPC_OK = 0,
    MPC_MAX_ITERATIONS = 1, /* best iterate returned; the tolerance was not met. RTI: always, unless it was */
    MPC_FAILED = 2,         /* no solution: data that are not finite, or the quadratic programme failed */
} mpc_status_t;

/* Now, and the road ahead. Interval k goes from node k to node k + 1. */
typedef struct {
    double v_mps;
    double torque_nm;                          /* motor torque of the interval before */
    double theta[2];                           /* winding, rotor */
    NET_ALIGNED double memory[NET_MEMORY];     /* of the net */
    double limit[2];                           /* degC */
    double v_ref_mps[MPC_INTERVALS_MAX];       /* at node k + 1 */
    double slope_rad[MPC_INTERVALS_MAX];       /* of interval k */
} mpc_problem_t;

typedef struct {
    double torque_nm[MPC_INTERVALS_MAX];       /* T */
    double friction_nm[MPC_INTERVALS_MAX];     /* F */
    double v_mps[MPC_INTERVALS_MAX + 1];       /* at the nodes */
    double theta[MPC_INTERVALS_MAX + 1][2];
    double multiplier[MPC_INTERVALS_MAX][2];   /* of the temperatures at node k + 1; > 0: in force */
    double cost;
    double kkt_nm;                             /* largest change of torque of the last quadratic programme */
    double slack_k;                            /* largest excess of a temperature over its limit */
    /* of the quadratic programmes: interior points, active sets; rolls: passes forward through the horizon */
    int32_t iterations, qp_iterations, sets, rolls;
} mpc_result_t;

/* A course through the horizon: unknowns, states, and what their derivatives need. */
typedef struct {
    _Alignas(64) double tape[MPC_SUBSTEPS_MAX][NET_TAPE];
    _Alignas(64) double memory[MPC_SUBSTEPS_MAX + 1][NET_MEMORY];
    double slope_v[MPC_SUBSTEPS_MAX];          /* d v+ / d v of each sub-step */
    double share[MPC_INTERVALS_MAX];           /* tau */
    double torque[MPC_INTERVALS_MAX], friction[MPC_INTERVALS_MAX];
    double span[MPC_INTERVALS_MAX];            /* drive(v) + regen(v) */
    double torque_v[MPC_INTERVALS_MAX];        /* d T / d v at this tau */
    double v[MPC_INTERVALS_MAX + 1];
    double theta[MPC_INTERVALS_MAX + 1][2];
    double cost, slack;
} mpc_course_t;

typedef struct {
    mpc_setting_t setting;                     /* weights divided by q_v */
    mpc_vehicle_t vehicle;
    int32_t substeps;
    double scale;                              /* q_v */
    double dt_s[MPC_INTERVALS_MAX];
    int32_t first[MPC_INTERVALS_MAX + 1];      /* sub-step at which the interval begins */
    double multiplier[2][MPC_INTERVALS_MAX];
    double curve_multiplier[2][MPC_INTERVALS_MAX]; /* that the last curvature was weighed with */
    uint8_t kink[2][MPC_INTERVALS_MAX];        /* ocp_kink_t of each temperature in the last quadratic programme */
    mpc_course_t course[2];                    /* present and tried */
    int32_t present;

    /* The linearisation, unknowns in order (tau_0 in Nm at span, F_0, tau_1, ...). */
    _Alignas(64) double by_v[MPC_INTERVALS_MAX][OCP_LD];  /* of v at node k + 1 */
    _Alignas(64) double by_t[MPC_INTERVALS_MAX][OCP_LD];  /* of T in interval k */
    _Alignas(64) double change[MPC_INTERVALS_MAX][OCP_LD];/* of T - T before */
    ocp_row_t back[2 * MPC_INTERVALS_MAX];
    ocp_bar_t bar[MPC_SUBSTEPS_MAX];           /* of the temperatures in force together */
    ocp_tangent_t tangent;
    bool curved;                               /* a temperature is in force: there is a curvature */
    _Alignas(64) double curve[MPC_INTERVALS_MAX][OCP_DIRECTIONS]; /* of them, over the torques */
    ocp_qp_t qp;
} mpc_t;

/* Take a setting and the car; no solution known. 1 us. */
void mpc_init(mpc_t *self, const mpc_setting_t *setting, const mpc_vehicle_t *vehicle);

/* Solve from the guess in result->torque_nm and friction_nm (clipped to the box). Cost: per iteration about one pass
 * through the horizon forward, one back per temperature near its limit, one quadratic programme; see
 * docs/decisions/mpc.md. MPC_FAILED: the result is not to be used. Forgets nothing but the multipliers of the problem
 * before. */
mpc_status_t mpc_solve(mpc_t *self, const mpc_problem_t *problem, mpc_result_t *result);

/* The next problem has nothing to do with the last. */
void mpc_forget(mpc_t *self);

/* The envelope at a speed: largest driving and largest regenerating torque (both >= 0), Nm. Pure. */
void mpc_envelope(const mpc_vehicle_t *vehicle, double v_mps, double *drive_nm, double *regen_nm);

/* v one sub-step on under T + F. Pure. */
double mpc_vehicle_step(const mpc_vehicle_t *vehicle, double v_mps, double force_nm, double slope_rad);

#endif
