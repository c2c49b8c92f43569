/* What the kernel says about time taken from a thread and from its core, read once a second where it disturbs nobody.
 *
 * Reading /proc/stat takes tens of µs and more with every core, too much for the loop. A thread of the ordinary
 * class does it and leaves the numbers where the loop picks them up. */
#ifndef RT_MACHINE_H
#define RT_MACHINE_H

#include <pthread.h>
#include <semaphore.h>
#include <stdbool.h>
#include <stdint.h>

typedef struct {
    int64_t run_delay_ns;  /* read through rt_machine_read */
    int64_t steal_ns;
    int64_t every_ns;
    int core;
    int schedstat;         /* file descriptors; -1: not there */
    int stat;
    bool running;
    pthread_t thread;
    sem_t stop;
} rt_machine;

/* Watches the calling thread, and the steal time of `core` (-1: of all), from now on and every `every_ns`. Takes
 * about 1 ms; set-up only (allocates a stack). Where a file or the thread cannot be had, the figures are -1. `self`
 * must outlive the thread. */
void rt_machine_start(rt_machine *self, int core, int64_t every_ns);

/* The newest figures, at most `every_ns` old: nanoseconds the thread was runnable but did not run, and nanoseconds
 * the hypervisor took, both since their own beginnings; -1: not available. The steal time has the resolution of
 * USER_HZ, 10 ms. O(1), any thread. */
void rt_machine_read(const rt_machine *self, int64_t *run_delay_ns, int64_t *steal_ns);

/* Ends the thread and waits for it. After the loop, also when nothing was started. */
void rt_machine_stop(rt_machine *self);

#endif
