/* A drive through the MHE with every kernel this processor has; run under sanitizers. Each must give what the portable one
 * gives. Prints the names of the kernels that ran. */
#include <stdio.h>
#include <string.h>

#include "mhe.h"

enum { STEPS = 200 };

static const char *const KERNELS[] = {"portable", "avx2", "avx512"};
static mhe_t mhe;
static real_t estimate[3][STEPS][MHE_CHANNELS];

static int drive(real_t out[STEPS][MHE_CHANNELS])
{
    const real_t empty[NET_MEMORY] = {0};
    const real_t prior[MHE_CHANNELS] = {90, 70};
    unsigned seed = 1;
    mhe_init(&mhe, est_setting_find("default"));
    mhe_start(&mhe, prior, empty);
    for (int k = 0; k < STEPS; k++) {
        const real_t u[2] = {(real_t)(3000 + 500 * ((k / 20) % 10)), (real_t)(100 - 40 * ((k / 30) % 4))};
        mhe_result_t result;
        mhe_advance(&mhe, u);
        for (int ch = 0; ch < MHE_CHANNELS; ch++) {
            seed = seed * 1103515245u + 12345u;
            const real_t noise = (real_t)((seed >> 16) & 1023) / 1024 - (real_t)0.5;
            const real_t jump = k / 25 == 3 && ch == 0 ? 20 : 0;
            if (k % 11 != ch) {
                (void)mhe_measure(&mhe, 0, ch, mhe_node(&mhe, 0)->theta[ch] + noise + jump, 1);
            }
        }
        if (mhe_solve(&mhe, &result) == MHE_INVALID) {
            return 1;
        }
        memcpy(out[k], result.theta, sizeof result.theta);
    }
    return 0;
}

int main(void)
{
    for (int i = 0; i < 3; i++) {
        const char *name = net_select(KERNELS[i]);
        if (name == NULL) {
            continue;
        }
        if (drive(estimate[i]) != 0) {
            printf("%s: not finite\n", KERNELS[i]);
            return 1;
        }
        for (int k = 0; k < STEPS; k++) {
            for (int ch = 0; ch < MHE_CHANNELS; ch++) {
                if (!(real_abs(estimate[i][k][ch] - estimate[0][k][ch]) < (real_t)1e-5)) {
                    printf("%s: step %d differs\n", KERNELS[i], k);
                    return 1;
                }
            }
        }
        printf("%s\n", name);
    }
    return 0;
}
