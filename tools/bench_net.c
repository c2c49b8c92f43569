/* What a step of the net costs: bench_net < rows
 * rows: float64 [speed rpm, torque Nm, winding, rotor] at 10 Hz. Runs the net, its adjoint and the validity monitor over
 * them, each in a function of its own; callgrind with --toggle-collect=FUNCTION counts one of them. Prints the number of
 * steps and the bytes of the net's memory, of mhe_t and of estimator_t. */
#include <stdio.h>

#include "estimator.h"

#define MAX_ROWS 20000

static double row[MAX_ROWS][4];
static double memory[NET_MEMORY];
static double memory_bar[NET_MEMORY];
static double tape[NET_TAPE];
static double rate[2];
static validity_t validity;

void counted_forward(int k);
void counted_adjoint(void);
void counted_validity(int k);

/* noinline and external: callgrind finds them by name */
__attribute__((noinline)) void counted_forward(int k)
{
    net_forward(&row[k][0], &row[k][2], memory, memory, rate, tape);
}

__attribute__((noinline)) void counted_adjoint(void)
{
    double theta_bar[2];
    net_adjoint(tape, memory, rate, memory_bar, theta_bar, memory_bar);
}

__attribute__((noinline)) void counted_validity(int k)
{
    validity_step(&validity, &row[k][0], &row[k][2]);
}

int main(void)
{
    const int rows = (int)fread(row, sizeof row[0], MAX_ROWS, stdin);
    (void)net_select("portable"); /* counts that are the same on every machine */
    validity_init(&validity);
    for (int k = 0; k < rows; k++) {
        counted_forward(k);
        counted_adjoint();
        counted_validity(k);
    }
    printf("%d %zu %zu %zu\n", rows, sizeof memory, sizeof(mhe_t), sizeof(estimator_t));
    return 0;
}
