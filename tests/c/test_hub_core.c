/* The hub's core on socket pairs with a clock of the test's own: order, back-pressure, stall, ends. Exit status 0: all hold. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "can_port.h"
#include "hub.h"

#define CHECK(condition)                                                                \
  do {                                                                                  \
    if (!(condition)) {                                                                 \
      (void)fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition); \
      exit(1);                                                                          \
    }                                                                                   \
  } while (0)

enum { SECOND = 1000000000 };
static hub_t hub;
static int stalls;
static int32_t stalled_pid;

static void on_stall(const hub_client_t *c, void *context)
{
  CHECK(context == &hub);
  stalled_pid = c->pid;
  stalls++;
}

static int join(int32_t pid)
{
  int pair[2];
  CHECK(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, pair) == 0);
  CHECK(hub_add(&hub, pair[0], pid, "test"));
  return pair[1];
}

static void run(int64_t now_ns)
{
  struct pollfd fds[HUB_CLIENTS_MAX];
  for (;;) {
    const size_t count = hub_poll_set(&hub, fds);
    if (poll(fds, (nfds_t)count, 0) <= 0 && !hub.blocked) {
      return;
    }
    if (hub.blocked) {
      hub_hand_out(&hub, now_ns, on_stall, &hub);
    }
    while (hub_take(&hub, fds, count)) {
      hub_hand_out(&hub, now_ns, on_stall, &hub);
    }
    if (hub.blocked) {
      CHECK(hub_poll_timeout_ms(&hub) == HUB_RETRY_MS);
      return;
    }
  }
}

/* The hub looks every 50 ms; the last time at `to_ns`. */
static void run_through(int64_t from_ns, int64_t to_ns)
{
  for (int64_t t = from_ns; t < to_ns; t += SECOND / 20) {
    run(t);
  }
  run(to_ns);
}

static bool put(int fd, uint32_t id)
{
  const struct can_frame f = {.can_id = id, .can_dlc = 1, .data = {7}};
  return send(fd, &f, sizeof f, MSG_DONTWAIT | MSG_NOSIGNAL) == sizeof f;
}

static int64_t get(int fd) /* id, -1 nothing, -2 end */
{
  struct canfd_frame f;
  const ssize_t n = recv(fd, &f, sizeof f, MSG_DONTWAIT);
  return n == CAN_MTU ? (int64_t)f.can_id : n == 0 ? -2 : -1;
}

static void everybody_but_the_sender_gets_a_frame_in_one_order(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), b = join(2), c = join(3);
  CHECK(put(a, 0x10) && put(b, 0x20) && put(a, 0x11) && put(b, 0x21));
  run(0);
  int64_t order[4];
  for (int i = 0; i < 4; i++) {
    order[i] = get(c);
    CHECK(order[i] > 0);
  }
  CHECK(get(c) == -1);
  CHECK(get(a) == 0x20 && get(a) == 0x21 && get(a) == -1);
  CHECK(get(b) == 0x10 && get(b) == 0x11 && get(b) == -1);
  CHECK(hub.counters.frames == 4 && hub.counters.delivered == 8 && hub.counters.rejected == 0);
  hub_close(&hub);
  CHECK(get(a) == -2 && hub_clients(&hub) == 0);
  CHECK(close(a) == 0 && close(b) == 0 && close(c) == 0);
}

static void a_full_reader_holds_everybody_back_and_nothing_is_lost(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), slow = join(2), fast = join(3);
  uint32_t sent = 0, fast_got = 0, slow_got = 0;
  int64_t id;
  while (!hub.blocked) {
    CHECK(put(a, sent & 0x7ff));
    sent++;
    run(0);
    while ((id = get(fast)) >= 0) {
      CHECK(id == (fast_got & 0x7ff));
      fast_got++;
    }
  }
  CHECK(fast_got == sent); /* the slow one does not keep the last batch from the fast one */
  uint32_t waiting = 0;
  while (put(a, (sent + waiting) & 0x7ff)) {
    waiting++;
  }
  run(SECOND / 2);
  CHECK(hub.blocked && get(fast) == -1); /* but nothing new is taken: that is the one order */
  for (int i = 0; i < 3; i++) {          /* a reader that is slow but reads is never disconnected */
    CHECK((id = get(slow)) == (slow_got & 0x7ff));
    slow_got++;
    run((i + 1) * (int64_t)SECOND);
  }
  CHECK(stalls == 0 && hub_clients(&hub) == 3);
  do {
    while ((id = get(slow)) >= 0) {
      CHECK(id == (slow_got & 0x7ff));
      slow_got++;
    }
    run(4 * (int64_t)SECOND);
    while (get(fast) >= 0) {
      fast_got++;
    }
  } while (slow_got < sent + waiting);
  CHECK(fast_got == slow_got && hub.counters.delivered == 2u * slow_got && !hub.blocked);
  CHECK(hub.counters.blocked_ns > 0 && hub_poll_timeout_ms(&hub) == -1);
  hub_close(&hub);
  CHECK(close(a) == 0 && close(slow) == 0 && close(fast) == 0);
}

static void nobody_is_read_while_the_bus_waits_not_even_a_dead_client(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), slow = join(2), dying = join(3);
  uint32_t sent = 0, got = 0;
  int64_t id;
  for (; !hub.blocked; sent++) {
    CHECK(put(a, sent & 0x7ff));
    run(0);
  }
  CHECK(put(dying, 0x123) && close(dying) == 0); /* full, with a word left to say, and poll reports it */
  run(0);
  CHECK(hub.blocked);
  do {
    run(0);
    while ((id = get(slow)) >= 0 && got < sent) {
      CHECK(id == (got & 0x7ff));
      got++;
      run(0);
    }
  } while (id != 0x123);
  CHECK(got == sent && get(slow) == -1 && get(a) == 0x123);
  hub_close(&hub);
  CHECK(close(a) == 0 && close(slow) == 0);
}

static void who_does_not_read_is_disconnected_by_name(void)
{
  hub_init(&hub, 2 * (int64_t)SECOND);
  stalls = 0;
  const int a = join(1), stuck = join(42), reader = join(3);
  int64_t last = -1;
  uint32_t sent = 0;
  for (; !hub.blocked; sent++) {
    CHECK(put(a, sent & 0x7ff));
    run(0);
    while (get(reader) >= 0) {
    }
  }
  CHECK(put(a, 0x7ab));
  run_through(0, 2 * (int64_t)SECOND - 1);
  CHECK(stalls == 0 && hub.blocked);
  run(2 * (int64_t)SECOND);
  CHECK(stalls == 1 && stalled_pid == 42 && hub.counters.stalled == 1 && hub_clients(&hub) == 2 && !hub.blocked);
  for (int64_t id; (id = get(reader)) >= 0;) {
    last = id;
  }
  CHECK(last == 0x7ab); /* the bus goes on */
  uint32_t kept = 0;
  int64_t id;
  while ((id = get(stuck)) >= 0) {
    CHECK(id == (kept & 0x7ff));
    kept++;
  }
  CHECK(id == -2 && kept == sent - 1); /* what was queued for it stays readable, then the end */
  hub_close(&hub);
  CHECK(close(a) == 0 && close(stuck) == 0 && close(reader) == 0);
}

static void time_the_hub_was_stopped_is_not_held_against_a_reader(void)
{
  hub_init(&hub, SECOND);
  stalls = 0;
  const int a = join(1), slow = join(42);
  for (uint32_t sent = 0; !hub.blocked; sent++) {
    CHECK(put(a, sent & 0x7ff));
    run(0);
  }
  run(SECOND / 20);
  run(3600 * (int64_t)SECOND); /* stopped for an hour: the reader had no chance to be served */
  CHECK(stalls == 0 && hub.blocked);
  const int64_t resumed = 3600 * (int64_t)SECOND;
  run_through(resumed, resumed + SECOND * (int64_t)8 / 10);
  CHECK(stalls == 0 && hub.blocked);
  run_through(resumed + SECOND * (int64_t)8 / 10, resumed + SECOND);
  CHECK(stalls == 1 && !hub.blocked && hub_clients(&hub) == 1); /* but from then on it has its second, and no more */
  hub_close(&hub);
  CHECK(close(a) == 0 && close(slow) == 0);
}

static void who_floods_does_not_keep_a_quiet_sender_waiting(void)
{
  hub_init(&hub, SECOND);
  const int flood[] = {join(1), join(2)}, quiet = join(3), reader = join(4);
  for (uint32_t i = 0; i < 8 * HUB_BATCH; i++) {
    CHECK(put(flood[0], 0x100) && put(flood[1], 0x101));
  }
  CHECK(put(quiet, 0x7));
  run(0);
  int before = 0;
  for (int64_t id; (id = get(reader)) != 0x7; before++) {
    CHECK(id == 0x100 || id == 0x101);
  }
  CHECK(before <= 2 * HUB_BATCH); /* one batch of each, then it is his turn */
  CHECK(put(quiet, 0x8)); /* and the floods are served alike: nobody is ahead by more than a batch */
  int ahead = 0;
  for (int64_t id; (id = get(reader)) >= 0;) {
    ahead += id == 0x100 ? 1 : id == 0x101 ? -1 : 0;
    CHECK(ahead >= -HUB_BATCH && ahead <= HUB_BATCH);
  }
  run(0);
  CHECK(get(reader) == 0x8 && hub.counters.frames == 16 * HUB_BATCH + 2);
  hub_close(&hub);
  CHECK(close(flood[0]) == 0 && close(flood[1]) == 0 && close(quiet) == 0 && close(reader) == 0);
}

/* Who comes while a batch is stuck gets none of it, but everything after, and does not hold up anybody. */
static void who_connects_while_the_bus_waits_gets_what_comes_after(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), slow = join(2);
  uint32_t sent = 0, got = 0;
  for (; !hub.blocked; sent++) {
    CHECK(put(a, 0x100));
    run(0);
  }
  const int late = join(3);
  CHECK(put(a, 0x200) && put(late, 0x300));
  run(0);
  CHECK(hub.blocked && get(late) == -1 && get(a) == -1);
  int64_t id;
  do {
    while ((id = get(slow)) == 0x100) {
      got++;
    }
    run(0);
  } while (hub.blocked || id == -1);
  CHECK(got == sent);
  CHECK(get(late) == 0x200 && get(late) == -1);
  CHECK(get(a) == 0x300 && get(a) == -1);
  hub_close(&hub);
  CHECK(close(a) == 0 && close(slow) == 0 && close(late) == 0);
}

static void garbage_is_counted_and_harms_nobody(void)
{
  static const size_t sizes[] = {0, 1, 15, 17, 71, 73, 4096};
  static char zeros[4096];
  hub_init(&hub, SECOND);
  const int a = join(1), b = join(2);
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++) {
    CHECK(send(a, zeros, sizes[i], 0) == (ssize_t)sizes[i]);
  }
  struct can_frame bad = {.can_id = 1, .can_dlc = 9};
  CHECK(send(a, &bad, sizeof bad, 0) == sizeof bad);
  bad = (struct can_frame){.can_id = 0x800};
  CHECK(send(a, &bad, sizeof bad, 0) == sizeof bad);
  struct canfd_frame bad_fd = {.can_id = 1, .len = 65};
  CHECK(send(a, &bad_fd, sizeof bad_fd, 0) == sizeof bad_fd);
  CHECK(put(a, 0x55));
  run(0);
  CHECK(get(b) == 0x55 && get(b) == -1 && hub.counters.rejected == 10 && hub.counters.frames == 1);
  CHECK(hub_clients(&hub) == 2);
  hub_close(&hub);
  CHECK(close(a) == 0 && close(b) == 0);
}

static void the_last_frames_of_a_dying_client_arrive(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), b = join(2);
  CHECK(put(b, 0x99));
  run(0); /* a has an unread frame: its death gives the hub ECONNRESET before the rest */
  for (uint32_t i = 0; i < 40; i++) {
    CHECK(put(a, i));
  }
  CHECK(send(a, "", 0, 0) == 0); /* an empty datagram is not the end */
  CHECK(put(a, 40));
  CHECK(close(a) == 0);
  run(0);
  for (uint32_t i = 0; i <= 40; i++) {
    CHECK(get(b) == i);
  }
  CHECK(hub_clients(&hub) == 1);
  hub_close(&hub);
  CHECK(close(b) == 0);
}

static void a_client_that_only_sends_holds_nobody_up(void)
{
  hub_init(&hub, SECOND);
  const int a = join(1), mute = join(2), b = join(3);
  CHECK(shutdown(mute, SHUT_RD) == 0);
  for (uint32_t i = 0; i < 30000; i++) {
    CHECK(put(a, i & 0x7ff));
    run((int64_t)i * SECOND);
    CHECK(get(b) == (i & 0x7ff));
  }
  CHECK(put(mute, 0x77));
  run(0);
  CHECK(get(b) == 0x77 && get(a) == 0x77 && hub.counters.stalled == 0 && hub.counters.blocked_ns == 0);
  hub_close(&hub);
  CHECK(close(a) == 0 && close(mute) == 0 && close(b) == 0);
}

static void a_full_table_refuses_and_a_late_client_gets_only_what_comes(void)
{
  int fds[HUB_CLIENTS_MAX], pair[2];
  hub_init(&hub, SECOND);
  for (int i = 0; i < HUB_CLIENTS_MAX; i++) {
    fds[i] = join(i);
  }
  CHECK(socketpair(AF_UNIX, SOCK_SEQPACKET, 0, pair) == 0);
  CHECK(!hub_add(&hub, pair[0], 99, NULL) && hub.counters.refused == 1);
  CHECK(close(fds[5]) == 0);
  CHECK(put(fds[0], 0x11));
  run(0);
  CHECK(hub_add(&hub, pair[0], 99, NULL));
  CHECK(put(fds[0], 0x12));
  run(0);
  CHECK(get(pair[1]) == 0x12 && get(pair[1]) == -1 && get(fds[0]) == -1);
  for (int i = 1; i < HUB_CLIENTS_MAX; i++) {
    CHECK(i == 5 || (get(fds[i]) == 0x11 && get(fds[i]) == 0x12 && get(fds[i]) == -1));
  }
  hub_close(&hub);
  for (int i = 0; i < HUB_CLIENTS_MAX; i++) {
    CHECK(i == 5 || close(fds[i]) == 0);
  }
  CHECK(close(pair[1]) == 0);
}

int main(void)
{
  everybody_but_the_sender_gets_a_frame_in_one_order();
  a_full_reader_holds_everybody_back_and_nothing_is_lost();
  nobody_is_read_while_the_bus_waits_not_even_a_dead_client();
  who_does_not_read_is_disconnected_by_name();
  time_the_hub_was_stopped_is_not_held_against_a_reader();
  who_floods_does_not_keep_a_quiet_sender_waiting();
  who_connects_while_the_bus_waits_gets_what_comes_after();
  garbage_is_counted_and_harms_nobody();
  the_last_frames_of_a_dying_client_arrive();
  a_client_that_only_sends_holds_nobody_up();
  a_full_table_refuses_and_a_late_client_gets_only_what_comes();
  (void)puts("ok");
  return 0;
}
