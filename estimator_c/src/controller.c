#include "controller.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { TICKS_PER_STEP = 10, PLAN_LIFE_STEPS = 5, SPIN_UP_STEPS = 5 };

static const double TICK_S = 0.01;
static const double LOW_DEGC = -60.0, HIGH_DEGC = 250.0; /* no temperature of a machine lies beyond */
enum { FRESH_TICKS = 30 };                    /* an estimate older than that is made up by the net */
static const double DOUBT_K_PER_S = 0.05, DOUBT_MAX_K = 10.0;
static const double SLACK_JUMP_K = 2.0;
static const double CLAMP_DEGC = 157.0;
static const double IN_FORCE = 1e-3;         /* of a multiplier's largest value without slack: the limit costs torque */
static const double MOTOR_NM_MAX = 1e4, MOTOR_RPM_MAX = 1e5, V_MAX_MPS = 200.0;
static const derating_rule_t FALLBACK_RULE = {.start_degc = {150.0, 145.0}, .end_degc = {155.0, 160.0}};

static bool is_finite(double x)
{
    return x - x == 0.0;
}

static double within(double x, double low, double high)
{
    return x > high ? high : x < low ? low : x;
}

/* A table of the road at distance x: between its points by a straight line, at its ends the end value. */
static double on_road(const controller_road_t *road, const double table[], double x)
{
    const double last = road->count - 1;
    const double place = within(x / road->step_m, 0.0, last);
    const int32_t k = place < last ? (int32_t)place : road->count - 2;
    const double share = place - k;
    return table[k] * (1.0 - share) + table[k + 1] * share;
}

static bool usable_road(const controller_road_t *road)
{
    if (road->count < 2 || !(road->step_m > 0.0) || !is_finite(road->step_m) || !is_finite(road->lookahead_m)) {
        return false;
    }
    double sum = 0.0;
    for (int32_t k = 0; k < road->count; k++) {
        sum += road->v_ref_mps[k] + road->slope_rad[k];
    }
    return is_finite(sum);
}

static controller_error_t choose(controller_t *self, const char *name)
{
    int start = 0, end = 0, length = 0;
    const mpc_setting_t *setting = mpc_setting_find(name);
    if (strcmp(name, "none") == 0) {
        self->kind = CONTROLLER_NONE;
        self->name = "none";
        return CONTROLLER_OK;
    }
    if (sscanf(name, "rule-%d-%d%n", &start, &end, &length) == 2 && name[length] == '\0' && start < end) {
        self->kind = CONTROLLER_RULE;
        self->name = "rule";
        self->rule = FALLBACK_RULE;
        self->rule.start_degc[0] = start;
        self->rule.end_degc[0] = end;
        return CONTROLLER_OK;
    }
    if (setting == NULL) {
        return CONTROLLER_UNKNOWN;
    }
    if (!OCP_SUPPORTED) {
        return CONTROLLER_NO_NET;
    }
    self->kind = CONTROLLER_MPC;
    self->name = setting->name;
    mpc_init(&self->mpc, setting, &mpc_vehicle);
    return CONTROLLER_OK;
}

controller_error_t controller_init(controller_t *self, const char *name, double period_s, const controller_road_t *road)
{
    memset(self, 0, sizeof *self);
    const controller_error_t error = choose(self, name);
    if (error != CONTROLLER_OK) {
        return error;
    }
    const double ticks = period_s / TICK_S;
    self->ticks = ticks > 0.5 && ticks < TICKS_PER_STEP + 0.5 ? (int32_t)(ticks + 0.5) : 0;
    if (self->ticks == 0 || TICKS_PER_STEP % self->ticks != 0 || fabs(ticks - self->ticks) > 1e-6) {
        return CONTROLLER_BAD_PERIOD;
    }
    if (!usable_road(road)) {
        return CONTROLLER_BAD_ROAD;
    }
    self->road = *road;
    self->x_m = self->v_mps = NAN;
    self->theta[0] = self->theta[1] = NAN;
    self->estimate_age = -1;
    self->plan_age = -1;
    return CONTROLLER_OK;
}

void controller_feed_estimate(controller_t *self, double theta_w_degc, double theta_r_degc, double sigma_w_degc,
                              double upper_w_degc, bool usable)
{
    if (!usable) {
        return;
    }
    const bool good = theta_w_degc > LOW_DEGC && theta_w_degc < HIGH_DEGC && theta_r_degc > LOW_DEGC &&
        theta_r_degc < HIGH_DEGC;
    if (!good) { /* a NaN too */
        self->counters.bad_inputs++;
        return;
    }
    self->theta[0] = theta_w_degc;
    self->theta[1] = theta_r_degc;
    const mpc_setting_t *set = &self->mpc.setting;
    const double by_sigma = sigma_w_degc > 0.0 ? set->margin_sigma * sigma_w_degc : 0.0;
    const double by_upper = upper_w_degc > theta_w_degc && set->margin_sigma > 0.0 ? upper_w_degc - theta_w_degc : 0.0;
    self->margin_k = within(fmax(by_sigma, by_upper), set->margin_min_k, set->margin_max_k);
    self->estimate_age = 0;
    self->estimate_new = true;
}

void controller_feed_motion(controller_t *self, double x_m, double v_mps)
{
    if (!(v_mps >= 0.0 && v_mps < V_MAX_MPS)) {
        self->counters.bad_inputs++;
        return;
    }
    self->v_mps = v_mps;
    if (is_finite(x_m)) {
        self->x_m = x_m;
    } else {
        self->counters.bad_inputs++;
    }
}

void controller_feed_motor(controller_t *self, double torque_nm, double speed_rpm)
{
    if (!(fabs(torque_nm) < MOTOR_NM_MAX && fabs(speed_rpm) < MOTOR_RPM_MAX)) {
        self->counters.bad_inputs++;
        return;
    }
    self->torque_nm = torque_nm;
    self->speed_rpm = speed_rpm;
    self->torque_sum += torque_nm;
    self->speed_sum += speed_rpm;
    self->motor_frames++;
}

/* The net one step on with what the motor did; without a new estimate it makes the temperatures too. */
static void advance_net(controller_t *self)
{
    double tape[NET_TAPE], rate[2];
    const bool heard = self->motor_frames > 0;
    const double u[2] = {heard ? self->speed_sum / self->motor_frames : self->speed_rpm,
                         heard ? self->torque_sum / self->motor_frames : self->torque_nm};
    self->speed_sum = self->torque_sum = 0.0;
    self->motor_frames = 0;
    if (self->estimate_age < 0) {
        return;
    }
    if (!self->spun_up) {
        for (int k = 0; k < SPIN_UP_STEPS; k++) {
            net_kernel->forward(u, self->theta, self->memory, self->memory, rate, tape);
        }
        self->spun_up = true;
    }
    net_kernel->forward(u, self->theta, self->memory, self->memory, rate, tape);
    if (!self->estimate_new) {
        for (int ch = 0; ch < 2; ch++) {
            self->theta[ch] = within(self->theta[ch] + NET_DT_S * rate[ch], LOW_DEGC, HIGH_DEGC);
        }
    }
    self->estimate_new = false;
}

static double doubt(const controller_t *self)
{
    const int32_t age = self->ticks * (self->estimate_age < 100000 ? self->estimate_age : 100000);
    return self->estimate_age < 0 || age <= FRESH_TICKS ? 0.0 : fmin(DOUBT_MAX_K, DOUBT_K_PER_S * TICK_S * age);
}

/* The last plan, seen from `age` steps later: means over the new intervals. */
static void shift_plan(const controller_t *self, int32_t age, double to[][2])
{
    const mpc_t *mpc = &self->mpc;
    const int32_t count = mpc->setting.intervals;
    int32_t from = 0;
    for (int32_t k = 0; k < count; k++) {
        double sum[2] = {0.0, 0.0};
        for (int32_t s = mpc->first[k]; s < mpc->first[k + 1]; s++) {
            while (from + 1 < count && mpc->first[from + 1] <= s + age) {
                from++;
            }
            sum[0] += self->plan_nm[from][0];
            sum[1] += self->plan_nm[from][1];
        }
        to[k][0] = sum[0] / mpc->setting.substeps[k];
        to[k][1] = sum[1] / mpc->setting.substeps[k];
    }
}

/* Drive the road ahead, by the plan or, without one, as a driver without patience would, and note what it asks for;
 * the torques of the latter become the plan. */
static void look_ahead(const controller_t *self, bool planned, double plan[][2], mpc_problem_t *problem)
{
    const mpc_t *mpc = &self->mpc;
    const mpc_vehicle_t *car = &mpc->vehicle;
    double x = self->x_m, v = self->v_mps;
    for (int32_t k = 0; k < mpc->setting.intervals; k++) {
        const int32_t steps = mpc->setting.substeps[k];
        double slope_sum = 0.0, sum[2] = {0.0, 0.0}, drive, regen;
        mpc_envelope(car, v, &drive, &regen);
        for (int32_t s = 0; s < steps; s++) {
            const double slope = on_road(&self->road, self->road.slope_rad, x);
            double torque[2] = {0.0, 0.0};
            if (planned) {
                torque[0] = within(plan[k][0], -regen, drive);
                torque[1] = within(plan[k][1], -car->friction_nm, 0.0);
            } else {
                const double wish = car->kp_nm_per_mps * (on_road(&self->road, self->road.v_ref_mps,
                                                                  x + v * NET_DT_S) - v);
                mpc_envelope(car, v, &drive, &regen);
                torque[0] = within(wish, -regen, drive);
                torque[1] = within(wish - torque[0], -car->friction_nm, 0.0);
            }
            sum[0] += torque[0];
            sum[1] += torque[1];
            slope_sum += slope;
            x += NET_DT_S * v;
            v = fmax(mpc_vehicle_step(car, v, torque[0] + torque[1], slope), 0.0);
        }
        if (!planned) {
            plan[k][0] = sum[0] / steps;
            plan[k][1] = sum[1] / steps;
        }
        problem->slope_rad[k] = slope_sum / steps;
        problem->v_ref_mps[k] = on_road(&self->road, self->road.v_ref_mps, x);
    }
}

static bool in_force(const controller_t *self, const mpc_result_t *result)
{
    const mpc_setting_t *set = &self->mpc.setting;
    for (int32_t k = 0; k < set->intervals; k++) {
        const double most = self->mpc.scale * self->mpc.dt_s[k] * set->slack;
        if (result->multiplier[k][0] > IN_FORCE * most || result->multiplier[k][1] > IN_FORCE * most) {
            return true;
        }
    }
    return false;
}

/* Solve for now; whether the solution may drive. Then it is the plan. */
static bool solve(controller_t *self, controller_out_t *out)
{
    mpc_problem_t problem = {.v_mps = self->v_mps, .torque_nm = self->command_nm[0]};
    mpc_result_t result;
    double plan[MPC_INTERVALS_MAX][2];
    const mpc_setting_t *set = &self->mpc.setting;
    const bool planned = self->plan_age >= 0 && self->plan_age <= PLAN_LIFE_STEPS;
    memcpy(problem.theta, self->theta, sizeof problem.theta);
    memcpy(problem.memory, self->memory, sizeof problem.memory);
    problem.limit[0] = set->theta_w_degc - out->margin_k;
    problem.limit[1] = set->theta_r_degc;
    if (planned) {
        shift_plan(self, self->plan_age, plan);
    }
    look_ahead(self, planned, plan, &problem);
    for (int32_t k = 0; k < set->intervals; k++) {
        result.torque_nm[k] = plan[k][0];
        result.friction_nm[k] = plan[k][1];
    }
    out->solved = true;
    out->limit_degc = problem.limit[0];
    out->status = mpc_solve(&self->mpc, &problem, &result);
    self->counters.solves++;
    out->iterations = result.iterations;
    out->qp_iterations = result.qp_iterations;
    out->kkt_nm = result.kkt_nm;
    if (out->status == MPC_FAILED) {
        return false;
    }
    out->slack_k = result.slack_k;
    out->predicted_end_degc = result.theta[set->intervals][0];
    out->predicted_peak_degc = self->theta[0];
    double excess = fmax(fmax(self->theta[0] - problem.limit[0], self->theta[1] - problem.limit[1]),
                         self->last_slack_k);
    for (int32_t k = 1; k <= set->intervals; k++) {
        out->predicted_peak_degc = fmax(out->predicted_peak_degc, result.theta[k][0]);
    }
    self->last_slack_k = result.slack_k;
    if (result.slack_k - excess > SLACK_JUMP_K) {
        self->counters.slack_jumps++;
        return false;
    }
    self->counters.unconverged += out->status == MPC_MAX_ITERATIONS && set->mode == MPC_MODE_CONVERGED;
    for (int32_t k = 0; k < set->intervals; k++) {
        self->plan_nm[k][0] = result.torque_nm[k];
        self->plan_nm[k][1] = result.friction_nm[k];
    }
    self->plan_age = 0;
    out->derating = in_force(self, &result);
    return true;
}

static void take(controller_out_t *out, double torque_nm, double friction_nm)
{
    out->drive_nm = fmax(torque_nm, 0.0);
    out->regen_nm = fmin(torque_nm, 0.0);
    out->friction_nm = friction_nm;
}

static void drive_by_law(controller_t *self, double share, controller_out_t *out)
{
    double drive, regen;
    mpc_envelope(&mpc_vehicle, self->v_mps, &drive, &regen);
    const double dt_s = TICK_S * self->ticks;
    const pi_command_t command = pi_driver_step(&self->driver, &mpc_vehicle, self->v_mps, out->v_ref_mps, drive,
                                                regen, share, dt_s);
    take(out, command.drive_nm + command.regen_nm, command.friction_nm);
    out->derating = command.cut;
}

/* The MPC's part of a step: its solution, else the last one, else the rule. */
static void drive_by_plan(controller_t *self, bool on_grid, controller_out_t *out)
{
    if (on_grid && self->plan_age >= 0) {
        self->plan_age++;
    }
    if (on_grid) {
        if (solve(self, out)) {
            take(out, self->plan_nm[0][0], self->plan_nm[0][1]);
            out->source = CONTROLLER_BY_MPC;
            return;
        }
        self->counters.failed++;
        mpc_forget(&self->mpc);
        if (self->plan_age >= 0 && self->plan_age <= PLAN_LIFE_STEPS) {
            int32_t at = 0;
            while (at + 1 < self->mpc.setting.intervals && self->mpc.first[at + 1] <= self->plan_age) {
                at++;
            }
            take(out, self->plan_nm[at][0], self->plan_nm[at][1]);
            out->source = CONTROLLER_BY_SHIFTED;
            out->derating = self->last.derating;
            return;
        }
        self->plan_age = -1;
        out->source = CONTROLLER_BY_RULE;
    } else {
        out->source = self->last.source;
        out->derating = self->last.derating;
        take(out, self->command_nm[0], self->command_nm[1]);
    }
    if (out->source == CONTROLLER_BY_RULE) {
        drive_by_law(self, derating_rule_share(&FALLBACK_RULE, out->theta_w_degc + doubt(self), out->theta_r_degc),
                     out);
    }
}

/* Above 157 degC the rule holds, whoever drives; what it takes from regenerating the friction brakes do. */
static void clamp(controller_t *self, controller_out_t *out)
{
    const double theta = out->theta_w_degc + doubt(self);
    if (self->kind == CONTROLLER_NONE || !(theta > CLAMP_DEGC)) {
        return;
    }
    double drive, regen;
    const double share = derating_rule_share(&FALLBACK_RULE, theta, out->theta_r_degc);
    mpc_envelope(&mpc_vehicle, self->v_mps, &drive, &regen);
    const double torque = out->drive_nm + out->regen_nm;
    const double held = within(torque, -share * regen, share * drive);
    if (held != torque) {
        take(out, held, fmax(out->friction_nm + fmin(torque - held, 0.0), -mpc_vehicle.friction_nm));
        out->clamped = out->derating = true;
        self->counters.clamped++;
    }
}

void controller_step(controller_t *self, controller_out_t *out)
{
    const bool on_grid = self->phase == 0;
    *out = (controller_out_t){
        .theta_w_degc = NAN, .theta_r_degc = NAN, .limit_degc = NAN, .kkt_nm = NAN, .slack_k = NAN, .v_ref_mps = NAN,
        .predicted_end_degc = NAN, .predicted_peak_degc = NAN,
    };
    if (self->kind == CONTROLLER_MPC && !on_grid) { /* what was said of the last solution still holds */
        out->limit_degc = self->last.limit_degc;
        out->slack_k = self->last.slack_k;
        out->predicted_end_degc = self->last.predicted_end_degc;
        out->predicted_peak_degc = self->last.predicted_peak_degc;
        out->status = self->last.status;
        out->kkt_nm = self->last.kkt_nm;
    }
    if (on_grid) {
        advance_net(self);
    }
    out->estimate_fresh = self->estimate_age >= 0 && self->estimate_age <= FRESH_TICKS / self->ticks;
    self->counters.no_estimate += !out->estimate_fresh;
    out->theta_w_degc = self->theta[0];
    out->theta_r_degc = self->theta[1];
    out->margin_k = self->margin_k + doubt(self);
    if (is_finite(self->v_mps) && is_finite(self->x_m)) {
        out->v_ref_mps = on_road(&self->road, self->road.v_ref_mps, self->x_m + self->road.lookahead_m);
        const bool known = self->estimate_age >= 0;
        if (self->kind == CONTROLLER_MPC && known) {
            drive_by_plan(self, on_grid, out);
        } else {
            const double theta_w = out->theta_w_degc + doubt(self);
            const double share = self->kind == CONTROLLER_NONE ? 1.0
                                 : self->kind == CONTROLLER_RULE
                                     ? derating_rule_share(&self->rule, theta_w, out->theta_r_degc)
                                     : 0.0;
            out->source = self->kind == CONTROLLER_MPC ? CONTROLLER_BY_RULE : CONTROLLER_BY_DRIVER;
            drive_by_law(self, share, out);
        }
        clamp(self, out);
        if (out->source == CONTROLLER_BY_MPC || out->source == CONTROLLER_BY_SHIFTED) {
            const double total = out->drive_nm + out->regen_nm + out->friction_nm;
            pi_driver_follow(&self->driver, &mpc_vehicle, self->v_mps, out->v_ref_mps, total);
        }
        self->x_m += TICK_S * self->ticks * self->v_mps; /* until the next motion says better */
    }
    self->counters.shifted += out->source == CONTROLLER_BY_SHIFTED;
    self->counters.rule_steps += out->source == CONTROLLER_BY_RULE;
    self->command_nm[0] = out->drive_nm + out->regen_nm;
    self->command_nm[1] = out->friction_nm;
    self->phase = (self->phase + self->ticks) % TICKS_PER_STEP;
    if (self->estimate_age >= 0 && self->estimate_age < INT32_MAX) {
        self->estimate_age++;
    }
    self->last = *out;
}
