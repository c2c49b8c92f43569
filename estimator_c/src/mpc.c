#include "mpc.h"

#include <math.h>
#include <string.h>

static const double STANDSTILL_MPS = 0.05; /* below, the rolling resistance fades */
static const double RPM_PER_RAD_S = 30.0 / 3.14159265358979323846;
static const double ABOVE_V_MAX_MPS = 1.0;
static const double NEAR_K = 15.0;        /* a temperature this far below its limit does not count in this iteration */
static const double TORQUE_FLOOR_NM = 15.0; /* of the curvature's divisor */
static const double SETTLED_NM = 0.3;     /* after a change below that the curvature is not computed anew, */
static const double SETTLED_SHARE = 0.1;  /* unless the multipliers have changed by more than that */
static const double ARMIJO = 1e-4;
enum { HALVINGS_MAX = 8 };

static double greater(double a, double b)
{
    return a > b ? a : b;
}

static double lesser(double a, double b)
{
    return a < b ? a : b;
}

/* Limits and their slopes over v. */
static void envelope(const mpc_vehicle_t *car, double v, double limit[2], double slope[2])
{
    const double omega = greater(v, 0.0) * car->gear_per_m;
    const double nm[2] = {car->drive_nm, car->regen_nm};
    const double w[2] = {car->drive_w, car->regen_w};
    for (int k = 0; k < 2; k++) {
        const bool power = omega * nm[k] > w[k];
        limit[k] = power ? w[k] / omega : nm[k];
        slope[k] = power ? -limit[k] / v : 0.0;
    }
    const double width = car->regen_full_mps - car->regen_from_mps;
    const double fade = (v - car->regen_from_mps) / width;
    if (fade < 1.0) {
        slope[1] = fade > 0.0 ? slope[1] * fade + limit[1] / width : 0.0;
        limit[1] *= greater(fade, 0.0);
    }
}

void mpc_envelope(const mpc_vehicle_t *vehicle, double v_mps, double *drive_nm, double *regen_nm)
{
    double limit[2], slope[2];
    envelope(vehicle, v_mps, limit, slope);
    *drive_nm = limit[0];
    *regen_nm = limit[1];
}

/* v one sub-step on; derivative: over v. That over T or F is `by_force()`. */
static double vehicle_step(const mpc_vehicle_t *car, double v, double force_nm, double sine, double cosine,
                           double *derivative)
{
    const double weight = car->mass_kg * car->gravity_mps2;
    const double length = sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS);
    const double rolling = weight * car->roll_coeff * cosine;
    const double force = force_nm * car->gear_per_m - weight * sine - car->drag_kg_m * v * v - rolling * v / length;
    const double rest = STANDSTILL_MPS * STANDSTILL_MPS / (length * length * length);
    *derivative = 1.0 - MPC_DT_S / car->mass_kg * (2.0 * car->drag_kg_m * v + rolling * rest);
    return v + MPC_DT_S / car->mass_kg * force;
}

static double by_force(const mpc_vehicle_t *car)
{
    return MPC_DT_S / car->mass_kg * car->gear_per_m;
}

double mpc_vehicle_step(const mpc_vehicle_t *vehicle, double v_mps, double force_nm, double slope_rad)
{
    double derivative;
    return vehicle_step(vehicle, v_mps, force_nm, sin(slope_rad), cos(slope_rad), &derivative);
}

void mpc_init(mpc_t *self, const mpc_setting_t *setting, const mpc_vehicle_t *vehicle)
{
    memset(self, 0, sizeof *self);
    self->setting = *setting;
    self->vehicle = *vehicle;
    self->scale = setting->speed > 0.0 ? setting->speed : 1.0;
    double *const weight[] = {
        &self->setting.speed, &self->setting.friction, &self->setting.torque, &self->setting.torque_change,
            &self->setting.slack,
        &self->setting.slack_square, &self->setting.above_reference, &self->setting.above_v_max,
    };
    for (size_t k = 0; k < sizeof weight / sizeof weight[0]; k++) {
        *weight[k] /= self->scale;
    }
    for (int k = 0; k < setting->intervals; k++) {
        self->first[k] = self->substeps;
        self->substeps += setting->substeps[k];
        self->dt_s[k] = MPC_DT_S * setting->substeps[k];
    }
    self->first[setting->intervals] = self->substeps;
}

void mpc_forget(mpc_t *self)
{
    memset(self->multiplier, 0, sizeof self->multiplier);
    memset(self->kink, 0, sizeof self->kink);
    memset(self->qp.bound, 0, sizeof self->qp.bound);
}

/* Cost of interval k but for friction and change of torque, with its derivatives over v+ (first and second). */
static double cost_of_speed(const mpc_t *self, const mpc_problem_t *problem, int k, double v, double *slope,
                            double *curvature)
{
    const mpc_setting_t *set = &self->setting;
    const double error = v - problem->v_ref_mps[k];
    const double over = greater(error, 0.0);
    const double fast = greater(v - self->vehicle.v_max_mps - ABOVE_V_MAX_MPS, 0.0);
    const double back = greater(-v, 0.0);
    const double twice = 2.0 * self->dt_s[k];
    *slope = twice * (set->speed * error + set->above_reference * over + set->above_v_max * (fast - back));
    *curvature = twice * (set->speed + (over > 0.0 ? set->above_reference : 0.0) +
                          (fast > 0.0 || back > 0.0 ? set->above_v_max : 0.0));
    return self->dt_s[k] * (set->speed * error * error + set->above_reference * over * over +
                            set->above_v_max * (fast * fast + back * back));
}

static double penalty(const mpc_t *self, int k, double excess)
{
    const double s = greater(excess, 0.0);
    return self->dt_s[k] * (self->setting.slack * s + self->setting.slack_square * s * s);
}

/* From the unknowns (share and friction, or, wished, torque and friction clipped to the box) through the horizon. */
static void roll(const mpc_t *self, const mpc_problem_t *problem, bool wished, mpc_course_t *course)
{
    const mpc_setting_t *set = &self->setting;
    double before = problem->torque_nm;
    course->v[0] = problem->v_mps;
    memcpy(course->theta[0], problem->theta, sizeof course->theta[0]);
    memcpy(course->memory[0], problem->memory, sizeof course->memory[0]);
    course->cost = 0.0;
    course->slack = 0.0;
    for (int k = 0; k < set->intervals; k++) {
        double limit[2], slope[2], unused[2];
        double v = course->v[k];
        double theta[2] = {course->theta[k][0], course->theta[k][1]};
        envelope(&self->vehicle, v, limit, slope);
        course->span[k] = limit[0] + limit[1];
        if (wished) {
            course->share[k] = (course->torque[k] + limit[1]) / course->span[k];
            course->friction[k] = lesser(greater(course->friction[k], -self->vehicle.friction_nm), 0.0);
        }
        course->share[k] = lesser(greater(course->share[k], 0.0), 1.0);
        course->torque[k] = -limit[1] + course->share[k] * course->span[k];
        course->torque_v[k] = -slope[1] + course->share[k] * (slope[0] + slope[1]);
        const double torque = course->torque[k];
        const double friction = course->friction[k];
        const double sine = sin(problem->slope_rad[k]);
        const double cosine = cos(problem->slope_rad[k]);
        for (int s = self->first[k]; s < self->first[k + 1]; s++) {
            const double u[2] = {v * self->vehicle.gear_per_m * RPM_PER_RAD_S, torque};
            double rate[2];
            net_kernel->forward(u, theta, course->memory[s], course->memory[s + 1], rate, course->tape[s]);
            theta[0] += MPC_DT_S * rate[0];
            theta[1] += MPC_DT_S * rate[1];
            v = vehicle_step(&self->vehicle, v, torque + friction, sine, cosine, &course->slope_v[s]);
        }
        course->v[k + 1] = v;
        const double change = torque - before;
        before = torque;
        course->cost += cost_of_speed(self, problem, k, v, &unused[0], &unused[1]);
        course->cost += self->dt_s[k] * (set->friction * friction * friction + set->torque * torque * torque);
        course->cost += set->torque_change * change * change;
        for (int ch = 0; ch < 2; ch++) {
            course->theta[k + 1][ch] = theta[ch];
            course->cost += penalty(self, k, theta[ch] - problem->limit[ch]);
            course->slack = greater(course->slack, theta[ch] - problem->limit[ch]);
        }
    }
}

/* Derivatives of speeds and torques, and all of the cost but the temperatures: gradient and Gauss and Newton's matrix.
 */
static void linearise_motion(mpc_t *self, const mpc_problem_t *problem, const mpc_course_t *course)
{
    const mpc_setting_t *set = &self->setting;
    const int n = 2 * set->intervals;
    int32_t support[MPC_INTERVALS_MAX];
    double weight_v[MPC_INTERVALS_MAX], weight_t[MPC_INTERVALS_MAX], weight_change[MPC_INTERVALS_MAX];
    ocp_qp_t *qp = &self->qp;
    double before = problem->torque_nm;
    qp->n = n;
    for (int i = 0; i < n; i++) {
        memset(qp->h[i], 0, sizeof qp->h[i]);
        qp->g[i] = 0.0;
    }
    for (int k = 0; k < set->intervals; k++) {
        double *by_v = self->by_v[k], *by_t = self->by_t[k], *change = self->change[k];
        double keep = 1.0, force = 0.0, slope_v;
        for (int s = self->first[k]; s < self->first[k + 1]; s++) {
            force = course->slope_v[s] * force + by_force(&self->vehicle);
            keep *= course->slope_v[s];
        }
        for (int j = 0; j < 2 * k; j++) {
            const double v_j = self->by_v[k - 1][j]; /* support of row k - 1: 2 k */
            by_t[j] = course->torque_v[k] * v_j;
            by_v[j] = keep * v_j + force * by_t[j];
            change[j] = by_t[j] - self->by_t[k - 1][j];
        }
        by_t[2 * k] = 1.0;
        by_t[2 * k + 1] = 0.0;
        change[2 * k] = 1.0;
        change[2 * k + 1] = 0.0;
        by_v[2 * k] = force;
        by_v[2 * k + 1] = force;
        support[k] = 2 * (k + 1);

        (void)cost_of_speed(self, problem, k, course->v[k + 1], &slope_v, &weight_v[k]);
        weight_t[k] = 2.0 * self->dt_s[k] * set->torque;
        weight_change[k] = 2.0 * set->torque_change;
        const double slope_t = weight_t[k] * course->torque[k];
        const double slope_change = weight_change[k] * (course->torque[k] - before);
        before = course->torque[k];
        for (int j = 0; j < support[k]; j++) {
            qp->g[j] += slope_v * by_v[j] + slope_t * by_t[j] + slope_change * change[j];
        }
        const double twice = 2.0 * self->dt_s[k] * set->friction;
        qp->g[2 * k + 1] += twice * course->friction[k];
        qp->h[2 * k + 1][2 * k + 1] += twice;
        qp->low[2 * k] = -course->share[k] * course->span[k];
        qp->high[2 * k] = (1.0 - course->share[k]) * course->span[k];
        qp->low[2 * k + 1] = -self->vehicle.friction_nm - course->friction[k];
        qp->high[2 * k + 1] = -course->friction[k];
    }
    const int rows = set->intervals;
    ocp_kernel->gram(qp->h, n, (const double (*)[OCP_LD])self->by_v, support, weight_v, rows);
    ocp_kernel->gram(qp->h, n, (const double (*)[OCP_LD])self->by_t, support, weight_t, rows);
    ocp_kernel->gram(qp->h, n, (const double (*)[OCP_LD])self->change, support, weight_change, rows);
}

/* Which temperatures count, in order of their nodes; returns how many. node[r], channel[r]. */
static int choose_rows(const mpc_t *self, const mpc_problem_t *problem, const mpc_course_t *course, int node[],
                       int channel[])
{
    int rows = 0;
    for (int k = 0; k < self->setting.intervals && rows + 2 <= OCP_ROWS; k++) {
        for (int ch = 0; ch < 2; ch++) {
            if (course->theta[k + 1][ch] > problem->limit[ch] - NEAR_K) {
                node[rows] = k;
                channel[rows] = ch;
                rows++;
            }
        }
    }
    return rows;
}

/* The temperatures' derivatives: all rows back through the horizon together, a row joining at its node. */
static void linearise_heat(mpc_t *self, const mpc_problem_t *problem, const mpc_course_t *course, int node[],
                           int channel[])
{
    ocp_qp_t *qp = &self->qp;
    double v_bar[OCP_ROWS];
    const double rpm = self->vehicle.gear_per_m * RPM_PER_RAD_S;
    const double force = by_force(&self->vehicle);
    qp->rows = choose_rows(self, problem, course, node, channel);
    int first = qp->rows; /* rows first..rows-1 are under way */
    for (int r = 0; r < qp->rows; r++) {
        memset(qp->a[r], 0, sizeof qp->a[r]);
        qp->support[r] = 2 * (node[r] + 1);
        qp->e[r] = course->theta[node[r] + 1][channel[r]] - problem->limit[channel[r]];
        qp->rho_1[r] = self->dt_s[node[r]] * self->setting.slack;
        qp->rho_2[r] = self->dt_s[node[r]] * self->setting.slack_square;
        qp->kink[r] = self->kink[channel[r]][node[r]];
    }
    for (int k = self->setting.intervals - 1; k >= 0; k--) {
        while (first > 0 && node[first - 1] >= k) {
            first--;
            memset(&self->back[first], 0, sizeof self->back[first]);
            self->back[first].theta[channel[first]] = 1.0;
            v_bar[first] = 0.0;
        }
        if (first == qp->rows) {
            continue;
        }
        double by_torque[OCP_ROWS] = {0.0}, by_both[OCP_ROWS] = {0.0};
        for (int s = self->first[k + 1] - 1; s >= self->first[k]; s--) {
            ocp_kernel->pull_back(course->tape[s], course->memory[s], &self->back[first], qp->rows - first);
            for (int r = first; r < qp->rows; r++) {
                by_torque[r] += self->back[r].u[1];
                by_both[r] += force * v_bar[r];
                v_bar[r] = course->slope_v[s] * v_bar[r] + rpm * self->back[r].u[0];
            }
        }
        for (int r = first; r < qp->rows; r++) {
            qp->a[r][2 * k] = by_torque[r] + by_both[r];
            qp->a[r][2 * k + 1] = by_both[r];
            v_bar[r] += (by_torque[r] + by_both[r]) * course->torque_v[k];
        }
    }
}

/* What the temperatures in force, each times its multiplier, ask of every step; returns the last interval that
 * matters, -1: none. */
static int weigh_back(mpc_t *self, const mpc_course_t *course)
{
    ocp_row_t all = {.theta = {0.0, 0.0}};
    int last = -1;
    for (int k = self->setting.intervals - 1; k >= 0; k--) {
        for (int ch = 0; ch < 2; ch++) {
            all.theta[ch] += self->multiplier[ch][k];
            last = self->multiplier[ch][k] > 0.0 && last < 0 ? k : last;
        }
        for (int s = self->first[k + 1] - 1; last >= 0 && s >= self->first[k]; s--) {
            ocp_kernel->pull_back_one(course->tape[s], course->memory[s], &all, &self->bar[s]);
        }
    }
    return last;
}

/* Second derivatives of these temperatures over the torques, each speed held: what the torques do to each other
 * through the net's memory included, what they do through the speed left out. (To take some sub-steps for all does not
 * do: the contributions of neighbours differ in sign.) */
static bool curvature(mpc_t *self, const mpc_course_t *course)
{
    const int last = weigh_back(self, course);
    double of_torque[OCP_DIRECTIONS] = {0.0};
    memset(&self->tangent, 0, sizeof self->tangent);
    memset(self->curve, 0, sizeof self->curve);
    for (int k = 0; k <= last; k++) {
        of_torque[k] = 1.0;
        for (int s = self->first[k]; s < self->first[k + 1]; s++) {
            ocp_kernel->push(course->tape[s], course->memory[s], &self->bar[s], of_torque, &self->tangent, k + 1,
                             self->curve);
        }
        of_torque[k] = 0.0;
    }
    return last >= 0;
}

/* Whether the multipliers are about those of the last curvature. */
static bool same_forces(const mpc_t *self)
{
    double sum = 0.0, change = 0.0;
    for (int ch = 0; ch < 2; ch++) {
        for (int k = 0; k < self->setting.intervals; k++) {
            sum += self->multiplier[ch][k];
            change += fabs(self->multiplier[ch][k] - self->curve_multiplier[ch][k]);
        }
    }
    return change <= SETTLED_SHARE * sum;
}

/* Into the matrix; where that is not positive definite any more, the part that is sure to keep it so: copper loss
 * being square in T, a temperature whose slope over T is a has about the curvature a / T. anew: else that of the
 * iteration before. */
static void add_curvature(mpc_t *self, const mpc_course_t *course, const int node[], const int channel[], bool anew)
{
    ocp_qp_t *qp = &self->qp;
    if (anew || !same_forces(self)) {
        self->curved = curvature(self, course);
        memcpy(self->curve_multiplier, self->multiplier, sizeof self->multiplier);
    }
    if (!self->curved) {
        return;
    }
    for (int i = 0; i < qp->n; i++) {
        memcpy(qp->matrix[i], qp->h[i], sizeof qp->h[i]);
    }
    for (int i = 0; i < self->setting.intervals; i++) {
        for (int j = i; j < self->setting.intervals; j++) {
            qp->matrix[2 * i][2 * j] += self->curve[i][j];
        }
    }
    memcpy(qp->schur, qp->matrix, sizeof qp->schur);
    if (ocp_kernel->factor(qp->schur, qp->n)) {
        memcpy(qp->h, qp->matrix, sizeof qp->h);
        return;
    }
    for (int r = 0; r < qp->rows; r++) {
        const double multiplier = self->multiplier[channel[r]][node[r]];
        for (int k = 0; k <= node[r] && multiplier > 0.0; k++) {
            const double torque = course->torque[k];
            const double slope = torque > 0.0 ? qp->a[r][2 * k] : -qp->a[r][2 * k];
            qp->h[2 * k][2 * k] += multiplier * greater(slope, 0.0) / greater(fabs(torque), TORQUE_FLOOR_NM);
        }
    }
}

/* The course at present plus `length` times the step, tried. */
static void try_step(mpc_t *self, const mpc_problem_t *problem, double length, mpc_result_t *result)
{
    const mpc_course_t *now = &self->course[self->present];
    mpc_course_t *next = &self->course[1 - self->present];
    for (int k = 0; k < self->setting.intervals; k++) {
        const double low = -self->vehicle.friction_nm;
        next->share[k] = now->share[k] + length * self->qp.d[2 * k] / now->span[k];
        next->friction[k] = lesser(greater(now->friction[k] + length * self->qp.d[2 * k + 1], low), 0.0);
    }
    roll(self, problem, false, next);
    result->rolls++;
}

static double largest_change(const ocp_qp_t *qp)
{
    double largest = 0.0;
    for (int k = 0; k < qp->n; k++) {
        largest = greater(largest, fabs(qp->d[k]));
    }
    return largest;
}

static bool finite_problem(const mpc_t *self, const mpc_problem_t *problem)
{
    double sum = problem->v_mps + problem->torque_nm;
    for (int ch = 0; ch < 2; ch++) {
        sum += problem->theta[ch] + problem->limit[ch];
    }
    for (int k = 0; k < self->setting.intervals; k++) {
        sum += problem->v_ref_mps[k] + problem->slope_rad[k];
    }
    for (int k = 0; k < NET_MEMORY; k++) {
        sum += problem->memory[k];
    }
    return sum - sum == 0.0;
}

static void report(const mpc_t *self, mpc_result_t *result)
{
    const mpc_course_t *course = &self->course[self->present];
    const int count = self->setting.intervals;
    for (int k = 0; k < count; k++) {
        result->torque_nm[k] = course->torque[k];
        result->friction_nm[k] = course->friction[k];
        for (int ch = 0; ch < 2; ch++) {
            result->multiplier[k][ch] = self->scale * self->multiplier[ch][k];
        }
    }
    memcpy(result->v_mps, course->v, sizeof(double) * (size_t)(count + 1));
    memcpy(result->theta, course->theta, sizeof(double) * 2 * (size_t)(count + 1));
    result->cost = self->scale * course->cost;
    result->slack_k = course->slack;
}

mpc_status_t mpc_solve(mpc_t *self, const mpc_problem_t *problem, mpc_result_t *result)
{
    const mpc_setting_t *set = &self->setting;
    int node[OCP_ROWS], channel[OCP_ROWS];
    bool converged = false;
    result->iterations = result->qp_iterations = result->sets = result->rolls = 0;
    result->kkt_nm = NAN;
    if (!finite_problem(self, problem)) {
        return MPC_FAILED;
    }
    mpc_course_t *start = &self->course[self->present];
    for (int k = 0; k < set->intervals; k++) {
        const bool usable = result->torque_nm[k] - result->torque_nm[k] == 0.0 &&
                            result->friction_nm[k] - result->friction_nm[k] == 0.0;
        start->torque[k] = usable ? result->torque_nm[k] : 0.0;
        start->friction[k] = usable ? result->friction_nm[k] : 0.0;
    }
    roll(self, problem, true, start);
    result->rolls++;
    const int most = set->mode == MPC_MODE_RTI ? 1 : set->max_iterations;
    while (!converged && result->iterations < most) {
        const mpc_course_t *now = &self->course[self->present];
        linearise_motion(self, problem, now);
        linearise_heat(self, problem, now, node, channel);
        add_curvature(self, now, node, channel, !(result->kkt_nm < SETTLED_NM));
        const bool solved = ocp_qp_solve(&self->qp);
        result->iterations++;
        result->qp_iterations += self->qp.iterations;
        result->sets += self->qp.sets;
        if (!solved) {
            return MPC_FAILED;
        }
        const double before = result->kkt_nm;
        result->kkt_nm = largest_change(&self->qp);
        memset(self->multiplier, 0, sizeof self->multiplier);
        memset(self->kink, 0, sizeof self->kink);
        for (int r = 0; r < self->qp.rows; r++) {
            self->kink[channel[r]][node[r]] = self->qp.kink[r];
            self->multiplier[channel[r]][node[r]] = self->qp.multiplier[r];
        }
        /* With this iteration's step taken, what the next one would change, if it shrinks as this one did. */
        const double next_nm = result->iterations > 1 ? result->kkt_nm * (result->kkt_nm / before) : result->kkt_nm;
        converged = lesser(next_nm, result->kkt_nm) <= set->tolerance_nm;
        double length = 1.0;
        for (int halvings = 0;; halvings++) {
            const mpc_course_t *next = &self->course[1 - self->present];
            try_step(self, problem, length, result);
            const double allowed = now->cost - ARMIJO * length * self->qp.decrease + 1e-12 * (1.0 + fabs(now->cost));
            if (converged || set->mode == MPC_MODE_RTI || next->cost <= allowed) {
                break;
            }
            if (halvings == HALVINGS_MAX) {
                break;
            }
            length *= 0.5;
        }
        self->present = 1 - self->present;
    }
    report(self, result);
    const double sum = result->cost + result->kkt_nm + result->v_mps[set->intervals];
    return !(sum - sum == 0.0) ? MPC_FAILED : converged ? MPC_OK : MPC_MAX_ITERATIONS;
}
