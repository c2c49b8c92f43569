#include "est_lockstep.h"

#include <stddef.h>
#include <string.h>

#include "can_port.h"

_Static_assert(sizeof(est_lockstep) <= 240000, "est_lockstep.h says so");

static void begin(void *ctx, int64_t now_ns) {
    ((est_lockstep *)ctx)->now_ns = now_ns;
}

static est_io_status receive(void *ctx, struct canfd_frame *frame, int64_t *at_ns) {
    est_lockstep *self = ctx;
    if (self->used == 0) {
        return EST_IO_EMPTY;
    }
    const rt_record *record = &self->queue[self->head];
    memset(frame, 0, sizeof *frame);
    memcpy(frame, &record->frame, sizeof record->frame);
    frame->flags = 0; /* padding in a classic frame, whatever the other side left there */
    *at_ns = record->t_ns;
    self->head = (self->head + 1U) % EST_LOCKSTEP_QUEUE;
    self->used--;
    self->counters.received++;
    return EST_IO_OK;
}

static est_io_status transmit(void *ctx, const struct canfd_frame *frame) {
    est_lockstep *self = ctx;
    rt_record record;
    memset(&record, 0, sizeof record);
    record.t_ns = self->now_ns;
    memcpy(&record.frame, frame, sizeof record.frame);
    if (self->broken || rt_record_write(&self->writer, &record) != RT_RECORD_OK) {
        self->broken = true;
        return EST_IO_GONE;
    }
    self->counters.sent++;
    return EST_IO_OK;
}

static void counters(void *ctx, est_io_counters *out) {
    *out = ((const est_lockstep *)ctx)->counters;
}

void est_lockstep_init(est_lockstep *self, int in_fd, int out_fd) {
    memset(self, 0, sizeof *self);
    rt_record_reader_init(&self->reader, in_fd);
    rt_record_writer_init(&self->writer, out_fd);
}

est_io est_lockstep_io(est_lockstep *self) {
    const est_io io = {self, begin, receive, transmit, counters, NULL};
    return io;
}

est_lockstep_status est_lockstep_advance(est_lockstep *self, int64_t t_ns) {
    if (t_ns < self->last_ns) {
        return EST_LOCKSTEP_BACKWARDS;
    }
    if (t_ns - self->last_ns > EST_LOCKSTEP_MAX_STEP_NS) {
        return EST_LOCKSTEP_JUMP;
    }
    self->last_ns = t_ns;
    return EST_LOCKSTEP_OK;
}

void est_lockstep_push(est_lockstep *self, const rt_record *record) {
    struct canfd_frame frame;
    memset(&frame, 0, sizeof frame);
    memcpy(&frame, &record->frame, sizeof record->frame);
    if (!can_port_valid(&frame, sizeof record->frame)) {
        self->counters.rejected++;
        return;
    }
    if ((record->frame.can_id & CAN_ERR_FLAG) != 0) {
        self->counters.error_frames++;
        return;
    }
    if (self->used == EST_LOCKSTEP_QUEUE) {
        self->counters.rx_drops++;
        return;
    }
    self->queue[(self->head + self->used) % EST_LOCKSTEP_QUEUE] = *record;
    self->used++;
}
