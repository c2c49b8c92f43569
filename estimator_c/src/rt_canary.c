#include "rt_canary.h"

#include <errno.h>
#include <limits.h>
#include <signal.h>
#include <stddef.h>
#include <string.h>

enum { STACK_BYTES = 64 * 1024, MAX_PRIORITY = 99 };

void rt_canary_ring_init(rt_canary_ring *self) {
    memset(self, 0, sizeof *self);
}

void rt_canary_ring_push(rt_canary_ring *self, rt_canary_record record) {
    const uint64_t read = __atomic_load_n(&self->read, __ATOMIC_ACQUIRE); /* the slot is free when its reader is done */
    if (self->written - read == RT_CANARY_RING) {
        __atomic_store_n(&self->lost, self->lost + 1U, __ATOMIC_RELAXED);
        return;
    }
    self->record[self->written % RT_CANARY_RING] = record;
    __atomic_store_n(&self->written, self->written + 1U, __ATOMIC_RELEASE);
}

bool rt_canary_ring_pop(rt_canary_ring *self, rt_canary_record *out) {
    if (__atomic_load_n(&self->written, __ATOMIC_ACQUIRE) == self->read) {
        return false;
    }
    *out = self->record[self->read % RT_CANARY_RING];
    __atomic_store_n(&self->read, self->read + 1U, __ATOMIC_RELEASE);
    return true;
}

void rt_canary_ring_arm(rt_canary_ring *self, int64_t due_ns) {
    __atomic_store_n(&self->due_ns, due_ns, __ATOMIC_RELEASE);
}

int64_t rt_canary_ring_due(const rt_canary_ring *self) {
    const int64_t due_ns = __atomic_load_n(&self->due_ns, __ATOMIC_ACQUIRE);
    return due_ns != 0 ? due_ns : INT64_MAX;
}

uint64_t rt_canary_ring_lost(const rt_canary_ring *self) {
    return __atomic_load_n(&self->lost, __ATOMIC_RELAXED);
}

int64_t rt_canary_next_due_ns(int64_t t0_ns, int64_t period_ns, int64_t now_ns) {
    const int64_t period = now_ns >= t0_ns ? (now_ns - t0_ns) / period_ns : 0;
    const int64_t start_ns = t0_ns + period * period_ns;
    const int64_t quarter_ns = period_ns / 4;
    if (start_ns + quarter_ns > now_ns) {
        return start_ns + quarter_ns;
    }
    const int64_t third_ns = start_ns + period_ns - quarter_ns;
    return third_ns > now_ns ? third_ns : start_ns + period_ns + quarter_ns;
}

static bool wait_for(sem_t *semaphore) {
    while (sem_wait(semaphore) != 0) {
        if (errno != EINTR) {
            return false;
        }
    }
    return true;
}

static void *run(void *argument) {
    rt_canary *self = argument;
    rt_granted granted;
    rt_grant_thread(&self->request, &granted);
    self->policy = granted.policy;
    self->priority = granted.priority;
    self->core = granted.core;
    (void)sem_post(&self->granted);
    if (!wait_for(&self->aimed)) {
        return NULL;
    }
    int64_t due_ns = self->t0_ns;
    while (!__atomic_load_n(&self->stop, __ATOMIC_ACQUIRE)) {
        due_ns = rt_canary_next_due_ns(self->t0_ns, self->period_ns, due_ns);
        rt_canary_ring_arm(&self->ring, due_ns);
        while (!self->clock.sleep_until_ns(self->clock.ctx, due_ns)) {
        }
        const rt_canary_record record = {due_ns, self->clock.now_ns(self->clock.ctx)};
        rt_canary_ring_push(&self->ring, record);
        due_ns = record.woke_ns; /* activations that passed meanwhile are in this record's interval */
    }
    return NULL;
}

/* The thread inherits the mask: signals are for the job's thread. */
static int create(rt_canary *self) {
    pthread_attr_t attributes;
    sigset_t all;
    sigset_t before;
    (void)sigfillset(&all);
    int error = pthread_attr_init(&attributes);
    if (error != 0) {
        return error;
    }
    const size_t stack = STACK_BYTES > PTHREAD_STACK_MIN ? (size_t)STACK_BYTES : (size_t)PTHREAD_STACK_MIN;
    (void)pthread_attr_setstacksize(&attributes, stack);
    (void)pthread_sigmask(SIG_SETMASK, &all, &before);
    error = pthread_create(&self->thread, &attributes, run, self);
    (void)pthread_sigmask(SIG_SETMASK, &before, NULL);
    (void)pthread_attr_destroy(&attributes);
    return error;
}

void rt_canary_start(rt_canary *self, int64_t period_ns, rt_granted *job) {
    memset(self, 0, sizeof *self);
    self->period_ns = period_ns;
    self->clock = rt_clock_system();
    const bool real_time = job->policy == RT_POLICY_FIFO;
    const rt_request request = {job->core, job->priority < MAX_PRIORITY ? job->priority + 1 : MAX_PRIORITY, real_time};
    self->request = request;
    (void)sem_init(&self->granted, 0, 0);
    (void)sem_init(&self->aimed, 0, 0);
    const int error = create(self);
    if (error != 0) {
        rt_grant_warn(job, "no canary thread (%s): time stolen by the machine is not told apart from other causes",
                      strerror(error));
        return;
    }
    self->running = wait_for(&self->granted);
    const bool above = self->policy == RT_POLICY_FIFO && self->priority > job->priority;
    self->conclusive = real_time && above && job->core >= 0 && self->core == job->core;
    if (real_time && !self->conclusive) {
        rt_grant_warn(job, "canary is not above the job on its core (priority %d and %d, core %d and %d; -1: any): "
                      "nothing is blamed on the machine", self->priority, job->priority, self->core, job->core);
    }
}

void rt_canary_aim(rt_canary *self, int64_t t0_ns) {
    if (self->running) {
        self->t0_ns = t0_ns;
        (void)sem_post(&self->aimed);
    }
}

void rt_canary_stop(rt_canary *self) {
    if (!self->running) {
        return;
    }
    __atomic_store_n(&self->stop, true, __ATOMIC_RELEASE);
    (void)sem_post(&self->aimed); /* it may never have been aimed */
    (void)pthread_join(self->thread, NULL);
    (void)sem_destroy(&self->granted);
    (void)sem_destroy(&self->aimed);
    self->running = false;
}
