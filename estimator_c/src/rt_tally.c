#include "rt_tally.h"

#include <string.h>

/* Takes the oldest release out of a window of `k` and puts a new one in. Call before the new one is written. */
static uint32_t slid(const rt_tally *self, uint32_t misses, uint32_t k, bool miss) {
    const uint32_t oldest = (self->window_head + RT_MK_WINDOW - k) % RT_MK_WINDOW;
    return misses - self->window[oldest] + (miss ? 1U : 0U);
}

static void push(rt_tally *self, bool miss) {
    self->window_misses = slid(self, self->window_misses, RT_MK_WINDOW, miss);
    if (self->mk_k > 0) {
        self->mk_misses = slid(self, self->mk_misses, self->mk_k, miss);
        self->mk_misses_max = self->mk_misses > self->mk_misses_max ? self->mk_misses : self->mk_misses_max;
        self->mk_violations += self->mk_misses > self->mk_m ? 1U : 0U;
    }
    self->window[self->window_head] = miss ? 1U : 0U;
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

void rt_tally_init_mk(rt_tally *self, uint32_t m, uint32_t k) {
    memset(self, 0, sizeof *self);
    self->mk_m = m;
    self->mk_k = k;
}

void rt_tally_start(rt_tally *self) {
    self->releases++;
    self->jobs++;
}

void rt_tally_queue(rt_tally *self) {
    self->releases++;
    self->queued_now++;
}

void rt_tally_start_queued(rt_tally *self) {
    self->queued_now--;
    self->queued++;
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

void rt_tally_skip_counted(rt_tally *self, uint64_t count) {
    self->releases += count;
    self->miss_skipped += count;
}

void rt_tally_skip_settled(rt_tally *self, uint64_t count) {
    extend_run(self, count);
    /* More skips than the window holds leave it full of misses, however many they are. */
    const uint64_t pushes = count < RT_MK_WINDOW ? count : RT_MK_WINDOW;
    for (uint64_t i = 0; i < pushes; i++) {
        push(self, true);
    }
    self->mk_violations += self->mk_k > 0 ? count - pushes : 0; /* K misses in K, and m < K */
}

void rt_tally_skip(rt_tally *self, uint64_t count) {
    rt_tally_skip_counted(self, count);
    rt_tally_skip_settled(self, count);
}

void rt_tally_overrun(rt_tally *self, uint64_t count) {
    self->overrun += count;
}
