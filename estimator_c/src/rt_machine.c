#include "rt_machine.h"

#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { STACK_BYTES = 128 * 1024, STAT_BYTES = 16 * 1024 };

static const int64_t NS_PER_S = 1000000000;

/* The whole number number `which` (from 0) behind `name` and spaces at the start of a line, or -1. */
static int64_t field(const char *text, const char *name, int which) {
    const size_t length = strlen(name);
    const char *line = text;
    while (strncmp(line, name, length) != 0 || (length > 0 && line[length] != ' ')) {
        line = strchr(line, '\n');
        if (line == NULL) {
            return -1;
        }
        line++;
    }
    const char *at = line + length;
    long long value = -1;
    for (int i = 0; i <= which; i++) {
        char *end = NULL;
        value = strtoll(at, &end, 10);
        if (end == at) {
            return -1;
        }
        at = end;
    }
    return (int64_t)value;
}

static bool contents(int fd, char *text, size_t size) {
    const ssize_t got = fd >= 0 ? pread(fd, text, size - 1, 0) : -1;
    if (got <= 0) {
        return false;
    }
    text[got] = '\0';
    return true;
}

static void look(rt_machine *self) {
    char text[STAT_BYTES];
    char cpu[16] = "cpu";
    if (self->core >= 0) {
        (void)snprintf(cpu, sizeof cpu, "cpu%d", self->core);
    }
    const int64_t delay_ns = contents(self->schedstat, text, sizeof text) ? field(text, "", 1) : -1;
    const int64_t ticks = contents(self->stat, text, sizeof text) ? field(text, cpu, 7) : -1;
    const long hz = sysconf(_SC_CLK_TCK);
    __atomic_store_n(&self->run_delay_ns, delay_ns, __ATOMIC_RELAXED);
    __atomic_store_n(&self->steal_ns, ticks >= 0 && hz > 0 ? ticks * (NS_PER_S / hz) : -1, __ATOMIC_RELAXED);
}

/* Ordinary class, any core: never in the loop's way. */
static void step_aside(void) {
    const struct sched_param none = {.sched_priority = 0};
    cpu_set_t all;
    memset(&all, 0xff, sizeof all);
    (void)sched_setscheduler(0, SCHED_OTHER, &none); /* giving up a priority is always allowed */
    (void)sched_setaffinity(0, sizeof all, &all);    /* where it is not, the thread stays where it is */
}

/* True when it is time to end; false at `at`. */
static bool stopped_before(rt_machine *self, const struct timespec *at) {
    while (sem_clockwait(&self->stop, CLOCK_MONOTONIC, at) != 0) {
        if (errno != EINTR) {
            return errno != ETIMEDOUT;
        }
    }
    return true;
}

static void *run(void *argument) {
    rt_machine *self = argument;
    struct timespec next = {0, 0};
    step_aside();
    (void)clock_gettime(CLOCK_MONOTONIC, &next);
    do {
        look(self);
        const int64_t ns = (int64_t)next.tv_nsec + self->every_ns;
        next.tv_sec += (time_t)(ns / NS_PER_S);
        next.tv_nsec = (long)(ns % NS_PER_S);
    } while (!stopped_before(self, &next));
    return NULL;
}

/* The thread inherits the mask: signals are for the job's thread. */
static bool create(rt_machine *self) {
    pthread_attr_t attributes;
    sigset_t all;
    sigset_t before;
    if (pthread_attr_init(&attributes) != 0) {
        return false;
    }
    (void)sigfillset(&all);
    (void)pthread_attr_setstacksize(&attributes, STACK_BYTES);
    (void)pthread_sigmask(SIG_SETMASK, &all, &before);
    const bool created = pthread_create(&self->thread, &attributes, run, self) == 0;
    (void)pthread_sigmask(SIG_SETMASK, &before, NULL);
    (void)pthread_attr_destroy(&attributes);
    return created;
}

void rt_machine_start(rt_machine *self, int core, int64_t every_ns) {
    memset(self, 0, sizeof *self);
    self->run_delay_ns = self->steal_ns = -1;
    self->every_ns = every_ns;
    self->core = core;
    /* It stays this thread's, whoever reads it. */
    self->schedstat = open("/proc/thread-self/schedstat", O_RDONLY | O_CLOEXEC);
    self->stat = open("/proc/stat", O_RDONLY | O_CLOEXEC);
    (void)sem_init(&self->stop, 0, 0);
    self->running = create(self);
}

void rt_machine_read(const rt_machine *self, int64_t *run_delay_ns, int64_t *steal_ns) {
    *run_delay_ns = __atomic_load_n(&self->run_delay_ns, __ATOMIC_RELAXED);
    *steal_ns = __atomic_load_n(&self->steal_ns, __ATOMIC_RELAXED);
}

void rt_machine_stop(rt_machine *self) {
    if (self->running) {
        (void)sem_post(&self->stop);
        (void)pthread_join(self->thread, NULL);
        self->running = false;
    }
    for (int i = 0; i < 2; i++) {
        int *fd = i == 0 ? &self->schedstat : &self->stat;
        if (*fd > STDERR_FILENO) {
            (void)close(*fd);
        }
        *fd = -1;
    }
}
