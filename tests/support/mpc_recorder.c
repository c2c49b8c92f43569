/* Between the controller and its MPC (linker option --wrap=mpc_solve): keeps what was asked, and fails on demand. */
#include <string.h>

#include "mpc.h"

enum { RECORDS_MAX = 4000 };

mpc_status_t __real_mpc_solve(mpc_t *self, const mpc_problem_t *problem, mpc_result_t *result);
mpc_status_t __wrap_mpc_solve(mpc_t *self, const mpc_problem_t *problem, mpc_result_t *result);

mpc_problem_t recorded_problem[RECORDS_MAX];
double recorded_guess[RECORDS_MAX][2][MPC_INTERVALS_MAX];
int recorded_count;
int recorder_fails;         /* so many of the next solutions fail */
double recorder_slack_jump; /* added to the next solution's slack */

mpc_status_t __wrap_mpc_solve(mpc_t *self, const mpc_problem_t *problem, mpc_result_t *result)
{
    if (recorded_count < RECORDS_MAX) {
        recorded_problem[recorded_count] = *problem;
        memcpy(recorded_guess[recorded_count][0], result->torque_nm, sizeof result->torque_nm);
        memcpy(recorded_guess[recorded_count][1], result->friction_nm, sizeof result->friction_nm);
        recorded_count++;
    }
    const mpc_status_t status = __real_mpc_solve(self, problem, result);
    if (recorder_fails > 0) {
        recorder_fails--;
        result->torque_nm[0] = 1e9;
        return MPC_FAILED;
    }
    result->slack_k += recorder_slack_jump;
    recorder_slack_jump = 0.0;
    return status;
}
