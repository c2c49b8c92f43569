#include "rt_backlog.h"

#include <stddef.h>

void rt_backlog_init(rt_backlog *self, uint32_t limit) {
    self->limit = limit;
    self->head = 0;
    self->used = 0;
}

bool rt_backlog_push(rt_backlog *self, uint64_t index) {
    if (self->used == self->limit) {
        return false;
    }
    rt_waiting *slot = &self->slot[(self->head + self->used) % RT_QUEUE_MAX];
    slot->index = index;
    slot->skipped_after = 0;
    self->used++;
    return true;
}

void rt_backlog_skip(rt_backlog *self, uint64_t count) {
    self->slot[(self->head + self->used - 1U) % RT_QUEUE_MAX].skipped_after += count;
}

rt_waiting rt_backlog_pop(rt_backlog *self) {
    const rt_waiting first = self->slot[self->head];
    self->head = (self->head + 1U) % RT_QUEUE_MAX;
    self->used--;
    return first;
}

const rt_waiting *rt_backlog_first(const rt_backlog *self) {
    return self->used > 0 ? &self->slot[self->head] : NULL;
}
