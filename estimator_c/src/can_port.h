/* can_port - a bus is a file descriptor that yields CAN frames.
 *
 * A port is one end of a CAN bus. SocketCAN ("socketcan:vcan0") and the user-space hub ("rt_hub:/path/hub.sock")
 * differ only in can_port_open; after that both are used in exactly the same way, and both give the same things:
 * the kernel's own frames, the kernel's receive stamps, never one's own frames back.
 *
 * A frame is always a `struct canfd_frame`. `flags & CANFD_FDF` tells a CAN FD frame (72 bytes on the wire) from a
 * classic one (16 bytes, flags 0); id, len and data lie at the same place in both.
 *
 * Memory: the caller owns the port; nothing is allocated, ever. Threads: one port belongs to one thread.
 * Blocking: only can_port_open and can_port_close may block; recv and send never do.
 */
#ifndef CAN_PORT_H
#define CAN_PORT_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum {
  CAN_PORT_FILTERS_MAX = 32,  /* more filters than this are refused */
  CAN_PORT_ERROR_MAX = 256,   /* bytes of can_port_t.error, with the terminating zero */
  CAN_PORT_SKIP_MAX = 64,     /* unusable datagrams one can_port_recv skips before it gives up for now */
};

typedef enum {
  CAN_PORT_OK = 0, /* done */
  CAN_PORT_EMPTY,  /* recv: nothing (more) to read now */
  CAN_PORT_FULL,   /* send: no room now, the frame was NOT sent; counted in tx_drops */
  CAN_PORT_GONE,   /* the bus has ended: hub closed, interface down or removed. Only close helps */
  CAN_PORT_REFUSED, /* the argument is unusable (frame that no CAN bus carries, bus string, filters) */
  CAN_PORT_SKIPPED /* recv: CAN_PORT_SKIP_MAX unusable datagrams skipped, more may wait: call again when there is time */
} can_port_status_t;

/* Counters only grow. */
typedef struct {
  uint64_t received;     /* frames handed to the caller */
  uint64_t sent;         /* frames accepted by the bus */
  uint64_t rx_drops;     /* frames the kernel lost because we read too slowly (SO_RXQ_OVFL); never on the hub */
  uint64_t tx_drops;     /* sends that found no room (ENOBUFS, EAGAIN): the caller did not try again by itself */
  uint64_t rejected;     /* datagrams that are no CAN frame (size, length field, id): skipped */
  uint64_t error_frames; /* CAN error frames (controller state, lost arbitration...): counted and skipped */
} can_port_counters_t;

typedef struct {
  int fd;    /* for poll/epoll (POLLIN); -1 when closed. The port reads and writes it, nobody else does */
  bool hub;  /* true: user-space hub, false: SocketCAN */
  bool gone; /* the bus has ended */
  bool send_only;
  uint32_t ovfl_seen; /* last value of the kernel's 32-bit drop counter */
  uint32_t filter_count;
  struct can_filter filters[CAN_PORT_FILTERS_MAX]; /* applied here for the hub, in the kernel for SocketCAN */
  can_port_counters_t counters;
  char error[CAN_PORT_ERROR_MAX]; /* after a failed open or GONE: one line, what, where, what to do; no newline */
} can_port_t;

/* Open the bus named by `bus` ("socketcan:IFACE" or "rt_hub:PATH").
 * Cost: some ten system calls, may block (connect); call it before the real-time part.
 * Failure: CAN_PORT_REFUSED (bus string) or CAN_PORT_GONE (no such interface, no hub, no permission); `port->error`
 * holds one line for the user, fd is -1, nothing is left open. */
can_port_status_t can_port_open(can_port_t *port, const char *bus);

/* Receive only frames with (id & mask) == (can_id & mask) for one of the `count` filters; can_id may carry
 * CAN_INV_FILTER and CAN_EFF_FLAG/CAN_RTR_FLAG as in SocketCAN. count 0 with filters NULL: receive everything again.
 * Frames already queued are not removed on SocketCAN. Cost: one system call or a copy.
 * Failure: REFUSED (too many), GONE (the kernel refused; port->error). */
can_port_status_t can_port_filter(can_port_t *port, const struct can_filter *filters, size_t count);

/* Never receive anything from now on. A client that only sends MUST call this or keep reading: the hub is lossless,
 * so a client that does not read would hold everybody up and be disconnected by the hub.
 * can_port_recv then always says EMPTY. Cost: one system call. Failure: GONE. */
can_port_status_t can_port_send_only(can_port_t *port);

/* Read the oldest frame.
 * `rx_ns`: the kernel's receive stamp, CLOCK_REALTIME in ns since 1970 (UTC); may be NULL.
 * Cost: one system call (about 1 us) plus one for each datagram skipped, at most CAN_PORT_SKIP_MAX of them, then SKIPPED
 * with the rest still queued: the call is bounded whatever arrives. Never blocks.
 * Failure: EMPTY (nothing is queued), SKIPPED (call again), GONE (every later call too; frames that were queued before
 * the end are delivered first). */
can_port_status_t can_port_recv(can_port_t *port, struct canfd_frame *frame, int64_t *rx_ns);

/* Send a frame: classic if flags has no CANFD_FDF. Cost: one system call. Never blocks, never retries.
 * Failure: FULL (counted, not sent), REFUSED (len > 8 classic, > 64 FD, standard id > 0x7ff), GONE. */
can_port_status_t can_port_send(can_port_t *port, const struct canfd_frame *frame);

/* Close; harmless when already closed. The counters stay readable. */
void can_port_close(can_port_t *port);

/* True if a datagram of `size` bytes at `frame` is a frame that a CAN bus can carry: 16 bytes and len <= 8, or
 * 72 bytes and len <= 64, standard ids <= 0x7ff. Pure. Error frames (CAN_ERR_FLAG) pass. */
bool can_port_valid(const struct canfd_frame *frame, size_t size);

#ifdef __cplusplus
}
#endif
#endif
