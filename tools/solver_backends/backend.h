/* What every solver under test offers to the bench (bench_solver.c): one shared library each, one object each, loaded with
 * RTLD_LOCAL so that several builds of the same sources stand side by side. Nothing here allocates after backend_open(). */
#ifndef BACKEND_H
#define BACKEND_H

#include <stddef.h>

typedef struct {
    double theta[2]; /* newest node of the window, degC */
    double ahead[2]; /* the same after the sensor's delay has been run forward */
    double kkt_degc; /* largest change the last linear solve asked for */
    int sweeps;      /* linear solves */
    int status;      /* 0: converged, 1: best iterate, 2: not usable */
} backend_result_t;

/* Choose a variant ("" : the only one). sweeps > 0: exactly that many, whatever the tolerance; tolerance > 0: in place of the
 * setting's; loss >= 0: in place of the setting's. Returns 0, or 1 where this machine or build has no such variant. */
int backend_open(const char *variant, int sweeps, double tolerance, int loss);

/* Memory that must live from one step to the next, and work space where the solver wants the caller to keep it. */
size_t backend_state_bytes(void);

/* One record of the stream (stream.h) other than STREAM_SOLVE. */
void backend_call(const double record[]);

/* Solve; all of the result but `ahead`. */
void backend_solve(backend_result_t *result);

/* Run the net forward from the solution through u[0 .. steps - 1] (speed, torque): result->ahead. */
void backend_ahead(const double u[][2], int steps, backend_result_t *result);

/* After publishing: what a solver that answers early has left to do. Not timed. */
void backend_finish(void);

/* Temperatures of the window, oldest first; returns their number. */
int backend_window(double theta[][2]);

/* The problem that the next backend_solve() solves, as doubles (layout: window_problem() in window.h); returns their number, 0 where the backend
 * does not keep it. */
int backend_problem(double problem[]);

#endif
