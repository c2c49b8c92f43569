#include "rt_tally.h"

#include <string.h>

static void push(rt_tally *self, bool miss) {
    self->window_misses -= self->window[self->window_head];
    self->window[self->window_head] = miss ? 1U : 0U;
    self->window_misses += miss ? 1U : 0U;
    self->window_head = (self->window_head + 1U) % RT_MK_WINDOW;
    if (self->window_misses > self->mk_worst) {
        self->mk_worst = self->window_misses;
    }
}

static void extend_run(rt_tally *self, uint64_t misses) {
    self->consec_miss += misses;
    if (self->consec_miss > self->consec_miss_max) {
        self->consec_miss_max = self->consec_miss;
    }
}

void rt_tally_init(rt_tally *self) {
    memset(self, 0, sizeof *self);
}

void rt_tally_start(rt_tally *self) {
    self->releases++;
    self->jobs++;
}

void rt_tally_finish(rt_tally *self, bool late) {
    push(self, late);
    if (late) {
        self->miss_late++;
        extend_run(self, 1);
    } else {
        self->consec_miss = 0;
    }
}

void rt_tally_skip(rt_tally *self, uint64_t count) {
    self->releases += count;
    self->miss_skipped += count;
    extend_run(self, count);
    /* More skips than the window holds leave it full of misses, however many they are. */
    const uint64_t pushes = count < RT_MK_WINDOW ? count : RT_MK_WINDOW;
    for (uint64_t i = 0; i < pushes; i++) {
        push(self, true);
    }
}

void rt_tally_overrun(rt_tally *self, uint64_t count) {
    self->overrun += count;
}
