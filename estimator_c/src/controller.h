/* The controller's core: estimate, motion and the road ahead in, torque commands out. It knows no clock, no bus and no
 * file; a step is a step of the period that it was set up with.
 *
 *   feed_estimate, feed_motion, feed_motor ─→ temperatures, and how much doubt ─→ MPC │ PI driver (+ linear rule)
 *                                                                             └─→ clamp, fall-backs ─→ command
 *
 * Fall-backs of the MPC, in this order: a solution that failed, is not finite or whose slack jumped by more than 2 K
 * is replaced by the last one, shifted, for at most 0.5 s; after that the PI driver under the linear rule 150 to 155
 * degC drives. Above 157 degC that rule clamps the driving and the regenerating torque in any case. Without a fresh
 * estimate the net runs on from the last one, and the doubt grows by 0.05 K/s up to 10 K; a controller that never had
 * one commands no motor torque.
 *
 * Everything: no allocation, no printing; one thread at a time per object; state sizeof(controller_t), owned by the
 * caller (550 kB, most of it the MPC's work space). Torques are at the motor's shaft. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdbool.h>
#include <stdint.h>

#include "derating_rule.h"
#include "mpc.h"
#include "pi_driver.h"

typedef enum {
    CONTROLLER_NONE = 0, /* the PI driver, no derating */
    CONTROLLER_RULE = 1, /* the PI driver under a linear rule */
    CONTROLLER_MPC = 2,
} controller_kind_t;

typedef enum {
    CONTROLLER_OK = 0,
    CONTROLLER_UNKNOWN = 1,     /* no controller of that name */
    CONTROLLER_BAD_PERIOD = 2,  /* not 10 ms times a divisor of 10 */
    CONTROLLER_BAD_ROAD = 3,    /* fewer than two points, a step that is not positive, or a value that is not finite */
    /* the net compiled in is none that the MPC can differentiate (one layer of LSTM cells) */
    CONTROLLER_NO_NET = 4,
} controller_error_t;

/* Who made the command. */
typedef enum {
    CONTROLLER_BY_DRIVER = 0,  /* the PI driver, under the rule where the controller has one */
    CONTROLLER_BY_MPC = 1,     /* this step's solution, or the one of the last 0.1 s grid point */
    CONTROLLER_BY_SHIFTED = 2, /* the last good solution, shifted: the newest failed */
    CONTROLLER_BY_RULE = 3,    /* the PI driver under the fall-back rule: no good solution for longer than 0.5 s */
} controller_source_t;

/* Reference speed and slope at every step_m metres from where the road begins; memory is the caller's and outlives the
 * controller. Beyond the ends the end value holds. */
typedef struct {
    const double *v_ref_mps;
    const double *slope_rad;
    int32_t count;
    double step_m;
    double lookahead_m; /* the PI driver reads the reference this far ahead */
} controller_road_t;

/* Only grow. */
typedef struct {
    uint32_t solves;
    uint32_t failed;      /* solutions not taken: solver failure, not finite, slack jump */
    uint32_t slack_jumps; /* of these */
    uint32_t unconverged; /* solutions taken that ended at the limit of iterations, converged mode */
    uint32_t shifted;     /* steps driven by an old solution */
    uint32_t rule_steps;  /* steps driven by the fall-back rule */
    uint32_t clamped;     /* steps in which the clamp took torque away */
    uint32_t no_estimate; /* steps without a fresh estimate */
    uint32_t bad_inputs;  /* values not used: not finite or out of reason */
} controller_counters_t;

typedef struct {
    double drive_nm;           /* >= 0 */
    double regen_nm;           /* <= 0 */
    double friction_nm;        /* <= 0 */
    controller_source_t source;
    bool derating;             /* less driving torque than without the temperature limit */
    bool clamped;              /* the clamp above 157 degC took torque away */
    bool estimate_fresh;
    double theta_w_degc, theta_r_degc; /* what this step worked with; NAN: nothing known */
    double limit_degc;         /* temperature limit less the margin; NAN without MPC */
    double margin_k;
    double v_ref_mps;          /* reference here, with the driver's look-ahead */
    /* Of the last solution; NAN or 0 without MPC. */
    bool solved;               /* in this step */
    mpc_status_t status;
    int32_t iterations;        /* linearisations */
    int32_t qp_iterations;
    double kkt_nm;             /* largest change of torque that the next iteration would make */
    double slack_k;            /* largest predicted excess over limit_degc */
    double predicted_end_degc; /* winding at the horizon's end */
    double predicted_peak_degc;
} controller_out_t;

typedef struct controller {
    const char *name;
    controller_kind_t kind;
    int32_t ticks;             /* 10 ms each per step */
    int32_t phase;             /* ticks since the last 0.1 s grid point */
    controller_road_t road;
    controller_counters_t counters;
    derating_rule_t rule;      /* of CONTROLLER_RULE */
    pi_driver_t driver;
    mpc_t mpc;

    /* What is known. */
    double x_m, v_mps;         /* NAN before the first motion */
    double torque_nm, speed_rpm; /* newest, held */
    double torque_sum, speed_sum;
    int32_t motor_frames;      /* in the sums, of this interval */
    double theta[2];           /* NAN before the first estimate */
    double memory[NET_MEMORY]; /* of the net, run on the measured torque and speed */
    bool spun_up;
    double margin_k;           /* from the newest estimate */
    int32_t estimate_age;      /* steps since the newest estimate; -1 before the first */
    bool estimate_new;

    /* What is planned. */
    double plan_nm[MPC_INTERVALS_MAX][2]; /* of the last good solution: motor, friction; one row per interval */
    int32_t plan_age;          /* 0.1 s steps since it was made; -1: none */
    double last_slack_k;
    double command_nm[2];      /* of the last step: motor, friction */
    controller_out_t last;
} controller_t;

/* Set up by name: "none", "rule-150-155", "rule-145-160", or an MPC setting ("mpc-S", "mpc-M", "paper"). period_s: of
 * controller_step(), 0.01, 0.02, 0.05 or 0.1; the MPC solves on every 0.1 s. The road is copied, its tables are not.
 * An error leaves the object unusable. < 50 us plus one look at each point of the road. */
controller_error_t controller_init(controller_t *self, const char *name, double period_s,
                                   const controller_road_t *road);

/* The estimate of now. sigma_w: its standard deviation, upper_w: conservative upper bound (NAN: not known). usable:
 * false for a status that is no estimate (init, starting, invalid). Values that are not finite or outside -60..250
 * degC count as none. Never fails. < 0.1 us. */
void controller_feed_estimate(controller_t *self, double theta_w_degc, double theta_r_degc, double sigma_w_degc,
                              double upper_w_degc, bool usable);

/* Where the car is on the road and how fast. A distance that is not finite is made from the speed. Never fails. < 0.1
 * us. */
void controller_feed_motion(controller_t *self, double x_m, double v_mps);

/* Torque and speed as measured, any number between two steps: their mean goes to the net. Never fails. < 0.1 us. */
void controller_feed_motor(controller_t *self, double torque_nm, double speed_rpm);

/* One step. Never fails: trouble is in `out`. Cost: one MPC solution on the 0.1 s grid, else < 1 us. */
void controller_step(controller_t *self, controller_out_t *out);

#endif
