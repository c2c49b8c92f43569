/* Lock-step records over a pipe: a CAN frame and its time, 24 bytes, native little endian. Same bytes as
 * rt_runner/records.py.
 *
 * A record whose id is exactly RT_RECORD_CONTROL_ID is a control record; data[0] says which. Nothing here allocates;
 * both ends may block on their pipe. The caller owns the objects; one thread each. */
#ifndef RT_RECORD_H
#define RT_RECORD_H

#include <linux/can.h>
#include <stddef.h>
#include <stdint.h>

enum {
    RT_RECORD_CONTROL_ID = 0x20000000, /* CAN_ERR_FLAG alone: no data frame can have it */
    RT_RECORD_TICK = 1,                /* time has advanced to t_ns, everything before has been delivered */
    RT_RECORD_END = 2,
    RT_RECORD_JOB = 3,                 /* replay: a job read its inputs at t_ns; data[1..4]: its release, little endian;
                                        * data[5]: what it put out (signal `output`); data[6]: est_replayed.sweep_limit */
    RT_RECORD_BUFFER = 64 * 1024
};

typedef struct {
    int64_t t_ns;
    struct can_frame frame;
} rt_record;

_Static_assert(sizeof(rt_record) == 24, "the record is the wire format");

typedef enum {
    RT_RECORD_OK = 0,
    RT_RECORD_EOF = 1,       /* the other side closed between two records */
    RT_RECORD_TRUNCATED = 2, /* … or in the middle of one */
    RT_RECORD_ERROR = 3      /* errno tells */
} rt_record_status;

typedef struct {
    int fd;
    size_t begin;
    size_t end;
    unsigned char buffer[RT_RECORD_BUFFER];
} rt_record_reader;

typedef struct {
    int fd;
    size_t used;
    unsigned char buffer[RT_RECORD_BUFFER];
} rt_record_writer;

void rt_record_reader_init(rt_record_reader *self, int fd);
void rt_record_writer_init(rt_record_writer *self, int fd);

/* The next record. Blocks when the buffer is empty; a signal does not end the wait. */
rt_record_status rt_record_read(rt_record_reader *self, rt_record *out);

/* Appends a record; writes the buffer out when it is full. Blocks as the pipe does. RT_RECORD_OK or RT_RECORD_ERROR. */
rt_record_status rt_record_write(rt_record_writer *self, const rt_record *record);

/* Writes everything out. */
rt_record_status rt_record_flush(rt_record_writer *self);

/* Appends a control record and writes everything out. */
rt_record_status rt_record_control(rt_record_writer *self, int64_t t_ns, uint8_t code);

#endif
