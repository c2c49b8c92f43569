/* The controller under random and hostile inputs: test_controller_fuzz SECONDS-OF-DRIVE SEED [NAME]. Every command has
 * to be finite, inside the envelope and of the right sign, whatever is fed; prints what went wrong and ends with 1. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "controller.h"

enum { POINTS = 2000 };

static uint64_t state;

static double uniform(double low, double high)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return low + (high - low) * (double)(state >> 11) / 9007199254740992.0;
}

static double nasty(double value)
{
    const double kind = uniform(0.0, 1.0);
    return kind < 0.90 ? value : kind < 0.93 ? NAN : kind < 0.95 ? INFINITY : kind < 0.97 ? -1e300 : uniform(-1e3, 1e3);
}

static int wrong(const char *what, int step, const controller_out_t *out)
{
    fprintf(stderr, "step %d: %s: %g %g %g, source %d\n", step, what, out->drive_nm, out->regen_nm, out->friction_nm,
            (int)out->source);
    return 1;
}

static int drive(const char *name, double period_s, int steps)
{
    static double v_ref[POINTS], slope[POINTS];
    static controller_t controller;
    const controller_road_t road = {v_ref, slope, POINTS, 2.0, 2.0};
    double v = uniform(0.0, 36.0), x = 0.0, theta = uniform(60.0, 160.0);
    for (int k = 0; k < POINTS; k++) {
        v_ref[k] = k == 0 ? 20.0 : fmin(fmax(v_ref[k - 1] + uniform(-0.6, 0.6), 0.0), 37.0);
        slope[k] = uniform(-0.15, 0.15);
    }
    if (controller_init(&controller, name, period_s, &road) != CONTROLLER_OK) {
        fprintf(stderr, "%s: cannot be set up\n", name);
        return 1;
    }
    for (int k = 0; k < steps; k++) {
        const bool hostile = uniform(0.0, 1.0) < 0.1;
        controller_out_t out;
        double known = controller.v_mps, drive_nm, regen_nm;
        if (uniform(0.0, 1.0) < 0.9) {
            const double t = hostile ? nasty(theta) : theta;
            controller_feed_estimate(&controller, t, hostile ? nasty(0.8 * theta) : 0.8 * theta, nasty(0.1),
                                     nasty(t + 0.5), !hostile);
        }
        if (uniform(0.0, 1.0) < 0.9) {
            controller_feed_motion(&controller, hostile ? nasty(x) : x, hostile ? nasty(v) : v);
            known = controller.v_mps;
        }
        controller_feed_motor(&controller, hostile ? nasty(50.0) : 50.0, hostile ? nasty(v * 300.0) : v * 300.0);
        controller_step(&controller, &out);
        const double sum = out.drive_nm + out.regen_nm + out.friction_nm;
        if (!(sum - sum == 0.0)) {
            return wrong("not finite", k, &out);
        }
        if (out.drive_nm < 0.0 || out.regen_nm > 0.0 || out.friction_nm > 0.0 || out.drive_nm * out.regen_nm != 0.0) {
            return wrong("wrong sign", k, &out);
        }
        if (isnan(known)) {
            if (sum != 0.0) {
                return wrong("torque without a speed", k, &out);
            }
        } else if (out.solved || out.source == CONTROLLER_BY_DRIVER) {
            mpc_envelope(&mpc_vehicle, known, &drive_nm, &regen_nm);
            const bool shifted = out.source == CONTROLLER_BY_SHIFTED; /* made for another speed */
            if (!shifted && (out.drive_nm > drive_nm + 1e-6 || -out.regen_nm > regen_nm + 1e-6)) {
                return wrong("outside the envelope", k, &out);
            }
        }
        if (controller.kind != CONTROLLER_NONE && controller.theta[0] > 157.0 && out.drive_nm - out.regen_nm != 0.0) {
            return wrong("motor torque above 157 degC", k, &out);
        }
        v = fmin(fmax(mpc_vehicle_step(&mpc_vehicle, v, sum, 0.0), 0.0), 40.0);
        x += period_s * v;
        theta = fmin(fmax(theta + uniform(-0.1, 0.1), 40.0), 165.0);
    }
    return 0;
}

int main(int argc, char **argv)
{
    static const char *const names[] = {"none", "rule-150-155", "mpc-S", "mpc-M", "paper"};
    const double seconds = argc > 1 ? atof(argv[1]) : 10.0;
    state = argc > 2 ? (uint64_t)atoll(argv[2]) : 1u;
    for (size_t k = 0; k < sizeof names / sizeof names[0]; k++) {
        const double period_s = k % 2 == 0 ? 0.1 : 0.05;
        if (drive(names[k], period_s, (int)(seconds / period_s)) != 0) {
            fprintf(stderr, "%s failed\n", names[k]);
            return 1;
        }
    }
    return 0;
}
