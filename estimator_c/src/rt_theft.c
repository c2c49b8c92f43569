#include "rt_theft.h"

#include <string.h>

void rt_theft_init(rt_theft *self) {
    memset(self, 0, sizeof *self);
}

void rt_theft_note(rt_theft *self, int64_t due_ns, int64_t woke_ns) {
    if (woke_ns - due_ns <= RT_THEFT_MIN_NS) {
        return;
    }
    const uint32_t newest = (self->head + RT_THEFTS - 1U) % RT_THEFTS;
    const int64_t covered_ns = self->used > 0 ? self->span[newest].to_ns : due_ns;
    const int64_t from_ns = due_ns > covered_ns ? due_ns : covered_ns;
    if (from_ns >= woke_ns) {
        return;
    }
    if (self->used > 0 && from_ns == covered_ns) { /* the same theft, now known to have lasted longer */
        self->span[newest].to_ns = woke_ns;
        return;
    }
    self->span[self->head].from_ns = from_ns;
    self->span[self->head].to_ns = woke_ns;
    self->head = (self->head + 1U) % RT_THEFTS;
    self->used += self->used < RT_THEFTS ? 1U : 0U;
}

int64_t rt_theft_between(const rt_theft *self, int64_t from_ns, int64_t to_ns) {
    int64_t sum_ns = 0;
    for (uint32_t i = 0; i < self->used; i++) {
        const int64_t begin_ns = self->span[i].from_ns > from_ns ? self->span[i].from_ns : from_ns;
        const int64_t end_ns = self->span[i].to_ns < to_ns ? self->span[i].to_ns : to_ns;
        sum_ns += end_ns > begin_ns ? end_ns - begin_ns : 0;
    }
    return sum_ns;
}
