/* Runs several solvers (backend.h) over one recorded stream of MHE calls (stream.h), in turns, and notes what each step took and
 * gave:
 *
 *   bench_solver STREAM OUT [-c CPU] [-b BLOCK] [-r REPEATS] [-s SKIP] [-w EVERY] LIBRARY,VARIANT,SWEEPS,TOLERANCE,LOSS ...
 *
 * A step is everything from one solve to the next: advance, arrival, measurements, solve, and the run through the sensor's delay.
 * Backends take turns of BLOCK steps, each turn begun by another one, so that all of them see the same noise of the machine;
 * within a turn the caches are warm but for its first step. REPEATS whole passes; the shortest time of each step counts.
 * SKIP: steps at the head of each segment that are run but neither timed nor counted. Instructions: callgrind with
 * --toggle-collect='timed_*'.
 *
 * OUT, doubles: per backend and step COLUMNS values (ns of the step, of its solve, of its run forward; theta, theta ahead, kkt,
 * sweeps, status); then, for every EVERY-th step (0: none) and each backend, 1 + 32 doubles of
 * the window's temperatures (their number first), and the first backend's problem (length first, padded).
 * Prints "steps backends chosen problem-doubles", then the state's bytes per backend. */
#include <dlfcn.h>
#include <sched.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "solver_backends/backend.h"
#include "solver_backends/stream.h"

enum { MAX_BACKENDS = 24, MAX_AHEAD = 64, COLUMNS = 10, WINDOW_DOUBLES = 33, PROBLEM_DOUBLES = 512 };

typedef struct {
    int (*open)(const char *, int, double, int);
    size_t (*state_bytes)(void);
    void (*call)(const double *);
    void (*solve)(backend_result_t *);
    void (*ahead)(const double (*)[2], int, backend_result_t *);
    void (*finish)(void);
    int (*window)(double (*)[2]);
    int (*problem)(double *);
} backend_t;

typedef struct {
    const double *first; /* its first record; the last one is STREAM_SOLVE */
    int in_segment;      /* place of the step in its segment */
    int ahead;           /* steps to run forward */
    double u[MAX_AHEAD][2];
} step_t;

static backend_t backend[MAX_BACKENDS];
static step_t *step;
static int steps;

void timed_calls(const backend_t *self, const step_t *at);
void timed_solve(const backend_t *self, backend_result_t *result);
void timed_ahead(const backend_t *self, const step_t *at, backend_result_t *result);

static void calls(const backend_t *self, const step_t *at)
{
    for (const double *record = at->first; (int)record[0] != STREAM_SOLVE; record += 2 + (int)record[1]) {
        self->call(record);
    }
}

/* The three parts of a step that count: external and not inlined, callgrind finds them by their names. */
__attribute__((noinline)) void timed_calls(const backend_t *self, const step_t *at)
{
    calls(self, at);
}

__attribute__((noinline)) void timed_solve(const backend_t *self, backend_result_t *result)
{
    self->solve(result);
}

__attribute__((noinline)) void timed_ahead(const backend_t *self, const step_t *at, backend_result_t *result)
{
    self->ahead((const double (*)[2])at->u, at->ahead, result);
}

static void plain_step(const backend_t *self, const step_t *at, backend_result_t *result)
{
    calls(self, at);
    self->solve(result);
    self->ahead((const double (*)[2])at->u, at->ahead, result);
}

static void fail(const char *what, const char *why)
{
    fprintf(stderr, "bench_solver: %s: %s\n", what, why);
    exit(1);
}

static void load(backend_t *self, char *text)
{
    char *field[5];
    for (int k = 0; k < 5; k++) {
        field[k] = strsep(&text, ",");
        if (field[k] == NULL) {
            fail("backend", "give LIBRARY,VARIANT,SWEEPS,TOLERANCE,LOSS");
        }
    }
    void *library = dlopen(field[0], RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) {
        fail(field[0], dlerror());
    }
    *(void **)&self->open = dlsym(library, "backend_open");
    *(void **)&self->state_bytes = dlsym(library, "backend_state_bytes");
    *(void **)&self->call = dlsym(library, "backend_call");
    *(void **)&self->solve = dlsym(library, "backend_solve");
    *(void **)&self->ahead = dlsym(library, "backend_ahead");
    *(void **)&self->finish = dlsym(library, "backend_finish");
    *(void **)&self->window = dlsym(library, "backend_window");
    *(void **)&self->problem = dlsym(library, "backend_problem");
    if (self->open == NULL || self->open(field[1], atoi(field[2]), atof(field[3]), atoi(field[4])) != 0) {
        fail(field[0], "has no such variant on this machine");
    }
}

static double *read_stream(const char *path, size_t *length)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0) {
        fail(path, "cannot be read");
    }
    const long bytes = ftell(file);
    rewind(file);
    double *data = malloc((size_t)bytes + 1);
    *length = (size_t)bytes / sizeof *data;
    if (data == NULL || fread(data, sizeof *data, *length, file) != *length) {
        fail(path, "cannot be read");
    }
    fclose(file);
    return data;
}

/* The steps of a stream, and the inputs that follow each: those of the next advances of its segment, the last one held. */
static void index_steps(const double *data, size_t length)
{
    const double *end = data + length;
    size_t room = 0;
    for (const double *at = data; at < end; at += 2 + (int)at[1]) {
        room += (int)at[0] == STREAM_SOLVE;
    }
    step = calloc(room + 1, sizeof *step);
    const double *first = data;
    int in_segment = 0;
    int delay = 0;
    for (const double *at = data; at < end; at += 2 + (int)at[1]) {
        if ((int)at[0] == STREAM_INIT) {
            in_segment = 0;
            delay = (int)at[2 + SETTING_DELAY_STEPS];
        }
        if ((int)at[0] == STREAM_SOLVE) {
            step[steps++] = (step_t){.first = first, .in_segment = in_segment++, .ahead = delay};
            first = at + 2;
        }
    }
    for (int k = 0; k < steps; k++) {
        const double *at = step[k].first;
        const double *held = NULL;
        int found = 0;
        int seen = -1; /* the step's own advance leads to its newest node; those after it leave there */
        for (int ahead = step[k].ahead; found < ahead; at += 2 + (int)at[1]) {
            if (at >= end || ((int)at[0] == STREAM_INIT && seen >= 0)) {
                break;
            }
            seen += (int)at[0] == STREAM_SOLVE;
            if ((int)at[0] == STREAM_ADVANCE) {
                held = at + 2;
                if (seen >= 0) {
                    memcpy(step[k].u[found++], held, sizeof step[k].u[0]);
                }
            }
        }
        for (; held != NULL && found < step[k].ahead; found++) {
            memcpy(step[k].u[found], held, sizeof step[k].u[0]);
        }
        step[k].ahead = held != NULL ? step[k].ahead : 0;
    }
}

static double now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static void keep_shorter(double *kept, double took, bool first)
{
    *kept = first || took < *kept ? took : *kept;
}

/* One step; row: shortest total, solve and run forward so far, ns. problem: where the problem goes, or NULL. */
static void timed_parts(const backend_t *self, const step_t *at, backend_result_t *result, double *problem, bool first,
                        double row[3])
{
    const double begin = now_ns();
    timed_calls(self, at);
    const double called = now_ns();
    if (problem != NULL) {
        problem[0] = self->problem(problem + 1);
    }
    const double ready = now_ns();
    timed_solve(self, result);
    const double solved = now_ns();
    timed_ahead(self, at, result);
    const double end = now_ns();
    keep_shorter(&row[0], called - begin + end - ready, first);
    keep_shorter(&row[1], solved - ready, first);
    keep_shorter(&row[2], end - solved, first);
}

int main(int argc, char **argv)
{
    int block = 64;
    int repeats = 1;
    int skip = 0;
    int every = 0;
    int option = 3;
    for (; option + 1 < argc && argv[option][0] == '-'; option += 2) {
        const int value = atoi(argv[option + 1]);
        switch (argv[option][1]) {
        case 'b': block = value; break;
        case 'r': repeats = value; break;
        case 's': skip = value; break;
        case 'w': every = value; break;
        case 'c': {
            cpu_set_t set;
            CPU_ZERO(&set);
            CPU_SET((size_t)value, &set);
            if (sched_setaffinity(0, sizeof set, &set) != 0) {
                fail("-c", "no such core for this process");
            }
            break;
        }
        default: fail(argv[option], "no such option");
        }
    }
    const int backends = argc - option;
    if (argc < 4 || backends < 1 || backends > MAX_BACKENDS || block < 1) {
        fail("usage", "bench_solver STREAM OUT [options] LIBRARY,VARIANT,SWEEPS,TOLERANCE,LOSS ...");
    }
    size_t length = 0;
    double *data = read_stream(argv[1], &length);
    index_steps(data, length);
    for (int b = 0; b < backends; b++) {
        load(&backend[b], argv[option + b]);
    }
    double *out = calloc((size_t)backends * (size_t)steps * COLUMNS + 1, sizeof *out);
    const int chosen = every > 0 ? (steps + every - 1) / every : 0;
    double *window = calloc((size_t)chosen * (size_t)backends * WINDOW_DOUBLES + 1, sizeof *window);
    double *problem = calloc((size_t)chosen * PROBLEM_DOUBLES + 1, sizeof *problem);
    if (out == NULL || window == NULL || problem == NULL) {
        fail("memory", "not enough");
    }
    for (int pass = 0; pass < repeats; pass++) {
        for (int first = 0; first < steps; first += block) {
            const int last = first + block < steps ? first + block : steps;
            for (int turn = 0; turn < backends; turn++) {
                const int b = (turn + first / block + pass) % backends;
                for (int k = first; k < last; k++) {
                    backend_result_t result;
                    double *row = out + ((size_t)b * (size_t)steps + (size_t)k) * COLUMNS;
                    const bool asked = pass == 0 && every > 0 && k % every == 0;
                    if (step[k].in_segment < skip) {
                        plain_step(&backend[b], &step[k], &result);
                        row[0] = row[1] = row[2] = -1.0;
                    } else {
                        double *kept = b == 0 && asked ? problem + (size_t)(k / every) * PROBLEM_DOUBLES : NULL;
                        timed_parts(&backend[b], &step[k], &result, kept, pass == 0, row);
                    }
                    backend[b].finish();
                    const double rest[COLUMNS - 3] = {result.theta[0], result.theta[1], result.ahead[0], result.ahead[1],
                                                      result.kkt_degc, result.sweeps,   result.status};
                    memcpy(row + 3, rest, sizeof rest);
                    if (asked) {
                        double *at = window + ((size_t)(k / every) * (size_t)backends + (size_t)b) * WINDOW_DOUBLES;
                        at[0] = backend[b].window((double (*)[2])(at + 1));
                    }
                }
            }
        }
    }
    FILE *file = fopen(argv[2], "wb");
    if (file == NULL) {
        fail(argv[2], "cannot be written");
    }
    const size_t sizes[3] = {(size_t)backends * (size_t)steps * COLUMNS,
                             (size_t)chosen * (size_t)backends * WINDOW_DOUBLES, (size_t)chosen * PROBLEM_DOUBLES};
    bool whole = fwrite(out, sizeof *out, sizes[0], file) == sizes[0];
    whole = fwrite(window, sizeof *window, sizes[1], file) == sizes[1] && whole;
    whole = fwrite(problem, sizeof *problem, sizes[2], file) == sizes[2] && whole;
    if (fclose(file) != 0 || !whole) {
        fail(argv[2], "cannot be written");
    }
    printf("%d %d %d %d\n", steps, backends, chosen, PROBLEM_DOUBLES);
    for (int b = 0; b < backends; b++) {
        printf("%zu\n", backend[b].state_bytes());
    }
    return 0;
}
