/* One figure per step of the estimator: bench_mhe MODE MAX_SWEEPS [KERNEL] < rows
 * rows: float64 [speed rpm, torque Nm, winding, rotor (offset removed)] at 10 Hz. MODE mhe: advance + measure + solve;
 * core: an interval's ten motor frames, its temperature frame and estimator_step(). MAX_SWEEPS 0: the setting's. KERNEL: of
 * the net, the best there is if none is named.
 * Prints "steps median_us p99_us sweeps_mean". Instructions: callgrind with --toggle-collect=timed_step. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "estimator.h"

#define MAX_ROWS 20000

static double row[MAX_ROWS][4];
static double micros[MAX_ROWS];
static mhe_t mhe;
static estimator_t core;

void timed_step(int mode, int k, double *sweeps);

/* noinline and external: callgrind finds it by name */
__attribute__((noinline)) void timed_step(int mode, int k, double *sweeps)
{
    if (mode == 0) {
        mhe_result_t result;
        mhe_advance(&mhe, row[k - 1]);
        (void)mhe_measure(&mhe, 0, 0, row[k][2], 1);
        (void)mhe_measure(&mhe, 0, 1, row[k][3], 1);
        (void)mhe_solve(&mhe, &result);
        *sweeps += result.sweeps;
        return;
    }
    estimator_out_t out;
    for (int i = 1; i <= 10; i++) {
        estimator_feed_motor(&core, (uint16_t)(10 * (k - 1) + i), row[k - 1][1], row[k - 1][0], true);
    }
    estimator_feed_temp(&core, (uint16_t)(10 * k), row[k][2] + core.setting.offset_degc,
                        row[k][3] + core.setting.offset_degc, true, true);
    estimator_step(&core, &out);
    *sweeps += out.sweeps;
}

static int ascending(const void *a, const void *b)
{
    const double x = *(const double *)a;
    const double y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
    if (argc < 3 || (argc > 3 && net_select(argv[3]) == NULL)) {
        return 2;
    }
    const int mode = strcmp(argv[1], "core") == 0;
    est_setting_t setting = *est_setting_find("default");
    if (atoi(argv[2]) > 0) {
        setting.max_sweeps = atoi(argv[2]);
        setting.tolerance_degc = 0.0;
    }
    const int rows = (int)fread(row, sizeof row[0], MAX_ROWS, stdin);
    const double empty[NET_MEMORY] = {0};
    double sweeps = 0.0;
    mhe_init(&mhe, &setting);
    mhe_start(&mhe, &row[0][2], empty);
    (void)estimator_init(&core, &setting);
    estimator_feed_temp(&core, 0, row[0][2], row[0][3], true, true);
    int steps = 0;
    for (int k = 1; k < rows; k++) {
        struct timespec a;
        struct timespec b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        timed_step(mode, k, &sweeps);
        clock_gettime(CLOCK_MONOTONIC, &b);
        if (k > 40) { /* the window is full */
            micros[steps++] = 1e6 * (double)(b.tv_sec - a.tv_sec) + 1e-3 * (double)(b.tv_nsec - a.tv_nsec);
        }
    }
    qsort(micros, (size_t)steps, sizeof micros[0], ascending);
    printf("%d %.3f %.3f %.3f\n", rows - 1, micros[steps / 2], micros[steps * 99 / 100], sweeps / (rows - 1));
    return 0;
}
