/* hub - a CAN bus between processes, for kernels without CAN.
 *
 * Every client is one end of an AF_UNIX SEQPACKET socket; one datagram is one kernel frame (struct can_frame or
 * canfd_frame). Each frame goes to every client but its sender.
 *
 * One total order, nothing lost: the hub takes a batch of frames from ONE client and takes nothing from anybody until
 * all others have that batch. So all see the same order, and a slow reader holds the senders back instead of losing
 * frames. A reader that takes nothing for `stall_ns` while the bus waits for it is disconnected: one stopped process
 * must not freeze the bus for ever. Time in which the hub itself did not run is not held against a reader.
 *
 * Half-closed connections: a client that has shut down its reading side is a sender, gets nothing and holds nobody up. One
 * that has shut down its writing side is taken for gone once what it had sent is read: it is disconnected, after the frames
 * queued for it it reads the end. There is no client that only listens by half-closing; it simply does not send.
 *
 * The core knows no listening socket, no signals and no clock: the caller polls, and says what time it is.
 * Memory: the caller owns the hub; nothing is allocated. Threads: one. Blocking: never.
 */
#ifndef HUB_H
#define HUB_H

#include <linux/can.h>
#include <poll.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/socket.h>
#include <sys/uio.h>

enum {
  HUB_CLIENTS_MAX = 32,
  HUB_BATCH = 16,    /* frames taken from one client before the next has its turn */
  HUB_NAME_MAX = 16, /* a process name, as in /proc/PID/comm */
  HUB_PAUSE_MS = 100, /* a longer pause between two looks at a full reader was the hub's own: it counts as this */
  HUB_RETRY_MS = 1,  /* while a reader is full: AF_UNIX reports POLLOUT only once 3/4 of its queue are free */
};

/* Counters only grow. */
typedef struct {
  uint64_t frames;     /* frames taken from clients */
  uint64_t delivered;  /* frames put into clients' queues */
  uint64_t rejected;   /* datagrams that are no CAN frame: dropped */
  uint64_t clients;    /* clients accepted */
  uint64_t refused;    /* connections turned away: table full */
  uint64_t stalled;    /* clients disconnected because they did not read */
  uint64_t blocked_ns; /* time the bus waited for slow readers */
} hub_counters_t;

typedef struct {
  int fd; /* -1: free slot */
  int32_t pid;
  char name[HUB_NAME_MAX];
  bool deaf;                /* has shut down its reading side: sends only, gets nothing */
  uint32_t sent;            /* how much of the batch it has; sent < batch_len: the bus waits for it */
  int64_t blocked_since_ns; /* since when it has taken nothing although its queue is full; -1: not full */
} hub_client_t;

typedef struct {
  hub_client_t clients[HUB_CLIENTS_MAX];
  uint32_t top;       /* slots at and above are free */
  uint32_t turn;      /* whose turn it is to be read first */
  uint32_t batch_len; /* frames of the batch now being handed out */
  bool fresh;         /* the batch has been taken, handing out has not begun */
  bool blocked;       /* some client has not got the whole batch */
  int64_t blocked_since_ns;
  int64_t stall_ns;
  struct canfd_frame frames[HUB_BATCH];
  struct iovec in_iov[HUB_BATCH], out_iov[HUB_BATCH];
  struct mmsghdr in[HUB_BATCH], out[HUB_BATCH];
  hub_counters_t counters;
} hub_t;

/* Called for every client that is disconnected for not reading, before its slot is freed. */
typedef void (*hub_on_stall_t)(const hub_client_t *client, void *context);

/* Prepare an empty hub. Cost: microseconds, no system call. Cannot fail. The hub points into itself: do not copy it. */
void hub_init(hub_t *self, int64_t stall_ns);

/* Take over a connected socket; `name` may be NULL. The client gets every frame not yet handed out.
 * Cost: two system calls. Failure: false when the table is full (counted; the caller keeps and closes fd). */
bool hub_add(hub_t *self, int fd, int32_t pid, const char *name);

/* What to poll for: fills fds[0 .. returned - 1] (room for HUB_CLIENTS_MAX); unused entries have fd -1. */
size_t hub_poll_set(const hub_t *self, struct pollfd *fds);

/* How long poll may wait, in ms: -1 for ever, HUB_RETRY_MS while a reader is full. */
int hub_poll_timeout_ms(const hub_t *self);

/* Take a batch from the next client, in turn, that poll found readable; clears its revents.
 * `fds`, `count`: from hub_poll_set, after poll. True: there is a batch; now accept everybody who waits to connect
 * and call hub_hand_out. (Whoever had connected before a frame was sent must see that frame, and connect returns
 * before accept: so accepting belongs between the two.) False: nobody is readable, or the hub is blocked.
 * Cost: one system call per client visited. Never blocks. */
bool hub_take(hub_t *self, struct pollfd *fds, size_t count);

/* Give the batch to everybody who has not got all of it; sets `blocked` if that was not possible. Call it after
 * hub_take, and after every poll while blocked. `now_ns`: monotonic. Cost: one system call per receiver. */
void hub_hand_out(hub_t *self, int64_t now_ns, hub_on_stall_t on_stall, void *context);

/* Number of clients. */
uint32_t hub_clients(const hub_t *self);

/* Hand out what is left as far as it goes, then disconnect everybody. What is queued stays readable for them. */
void hub_close(hub_t *self);

#endif
