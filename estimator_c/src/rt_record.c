#include "rt_record.h"

#include <errno.h>
#include <string.h>
#include <unistd.h>

void rt_record_reader_init(rt_record_reader *self, int fd) {
    memset(self, 0, sizeof *self);
    self->fd = fd;
}

void rt_record_writer_init(rt_record_writer *self, int fd) {
    memset(self, 0, sizeof *self);
    self->fd = fd;
}

rt_record_status rt_record_read(rt_record_reader *self, rt_record *out) {
    while (self->end - self->begin < sizeof *out) {
        memmove(self->buffer, self->buffer + self->begin, self->end - self->begin);
        self->end -= self->begin;
        self->begin = 0;
        const ssize_t got = read(self->fd, self->buffer + self->end, sizeof self->buffer - self->end);
        if (got < 0) {
            if (errno == EINTR) {
                continue;
            }
            return RT_RECORD_ERROR;
        }
        if (got == 0) {
            return self->end == 0 ? RT_RECORD_EOF : RT_RECORD_TRUNCATED;
        }
        self->end += (size_t)got;
    }
    memcpy(out, self->buffer + self->begin, sizeof *out);
    self->begin += sizeof *out;
    return RT_RECORD_OK;
}

rt_record_status rt_record_flush(rt_record_writer *self) {
    size_t done = 0;
    while (done < self->used) {
        const ssize_t put = write(self->fd, self->buffer + done, self->used - done);
        if (put < 0) {
            if (errno == EINTR) {
                continue;
            }
            return RT_RECORD_ERROR;
        }
        done += (size_t)put;
    }
    self->used = 0;
    return RT_RECORD_OK;
}

rt_record_status rt_record_write(rt_record_writer *self, const rt_record *record) {
    if (sizeof self->buffer - self->used < sizeof *record) {
        const rt_record_status status = rt_record_flush(self);
        if (status != RT_RECORD_OK) {
            return status;
        }
    }
    memcpy(self->buffer + self->used, record, sizeof *record);
    self->used += sizeof *record;
    return RT_RECORD_OK;
}

rt_record_status rt_record_control(rt_record_writer *self, int64_t t_ns, uint8_t code) {
    rt_record record;
    memset(&record, 0, sizeof record);
    record.t_ns = t_ns;
    record.frame.can_id = RT_RECORD_CONTROL_ID;
    record.frame.can_dlc = 1;
    record.frame.data[0] = code;
    const rt_record_status status = rt_record_write(self, &record);
    return status == RT_RECORD_OK ? rt_record_flush(self) : status;
}
