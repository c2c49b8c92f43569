/* A client of a CAN bus through can_port, for the tests and the benchmark: test_hub_port BUS MODE [N] [ID]
 *
 *   recv N     print N frames as "ID FLAGS HEXDATA STAMP_NS" (stops after 10 s without one), then the counters
 *   count N    the same without printing frames
 *   send N ID  send N frames with a 32-bit number as data, waiting for room
 *   try N ID   send N frames without ever waiting: what finds no room is lost, and counted
 *   ping N     send 0x100, wait for 0x101, N times; prints the round trips' quantiles in us
 *   pong       answer 0x100 by 0x101 until the bus ends
 *   filter     receive one frame with id 0x123 out of everything
 *
 * Last line of stdout: counters as JSON. Exit status: 0 done, 3 the bus is gone (stderr says so), 4 ten seconds without a frame. */
#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "can_port.h"

enum { PINGS_MAX = 100000, SILENCE_MS = 10000 };

static int64_t now_ns(void)
{
  struct timespec t;
  (void)clock_gettime(CLOCK_MONOTONIC, &t);
  return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int finish(can_port_t *port, int status)
{
  const can_port_counters_t *c = &port->counters;
  (void)printf("{\"received\":%" PRIu64 ",\"sent\":%" PRIu64 ",\"rx_drops\":%" PRIu64 ",\"tx_drops\":%" PRIu64
               ",\"rejected\":%" PRIu64 ",\"error_frames\":%" PRIu64 "}\n",
               c->received, c->sent, c->rx_drops, c->tx_drops, c->rejected, c->error_frames);
  (void)fflush(stdout);
  if (status == 3) {
    (void)fprintf(stderr, "%s\n", port->error);
  }
  can_port_close(port);
  return status;
}

/* 0 a frame, 3 gone, 4 silence */
static int wait_frame(can_port_t *port, struct canfd_frame *frame, int64_t *stamp_ns)
{
  for (;;) {
    const can_port_status_t status = can_port_recv(port, frame, stamp_ns);
    if (status == CAN_PORT_OK) {
      return 0;
    }
    if (status == CAN_PORT_SKIPPED) {
      continue;
    }
    if (status != CAN_PORT_EMPTY) {
      return 3;
    }
    struct pollfd p = {.fd = port->fd, .events = POLLIN};
    if (poll(&p, 1, SILENCE_MS) == 0) {
      return 4;
    }
  }
}

static int wait_send(can_port_t *port, const struct canfd_frame *frame)
{
  can_port_status_t status;
  while ((status = can_port_send(port, frame)) == CAN_PORT_FULL) {
    struct pollfd p = {.fd = port->fd, .events = POLLOUT};
    (void)poll(&p, 1, 1);
  }
  return status == CAN_PORT_OK ? 0 : 3;
}

static int receive(can_port_t *port, uint64_t n, bool print)
{
  for (uint64_t i = 0; i < n; i++) {
    struct canfd_frame f;
    int64_t stamp_ns = 0;
    const int status = wait_frame(port, &f, &stamp_ns);
    if (status != 0) {
      return finish(port, status);
    }
    if (print) {
      (void)printf("%08" PRIX32 " %02X ", f.can_id, (unsigned)f.flags);
      for (uint32_t k = 0; k < f.len; k++) {
        (void)printf("%02X", (unsigned)f.data[k]);
      }
      (void)printf(" %" PRId64 "\n", stamp_ns);
      (void)fflush(stdout);
    }
  }
  return finish(port, 0);
}

static int transmit(can_port_t *port, uint64_t n, canid_t id, bool wait)
{
  struct canfd_frame f = {.can_id = id, .len = 8};
  if (can_port_send_only(port) != CAN_PORT_OK) {
    return finish(port, 3);
  }
  for (uint64_t i = 0; i < n; i++) {
    const uint32_t number = (uint32_t)i;
    memcpy(f.data, &number, sizeof number);
    const int status = wait ? wait_send(port, &f) : (can_port_send(port, &f) == CAN_PORT_GONE ? 3 : 0);
    if (status != 0) {
      return finish(port, status);
    }
  }
  return finish(port, 0);
}

static int by_value(const void *a, const void *b)
{
  const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return (x > y) - (x < y);
}

static int ping(can_port_t *port, size_t n)
{
  static int64_t rtt_ns[PINGS_MAX];
  const struct canfd_frame request = {.can_id = 0x100, .len = 8};
  if (n > PINGS_MAX || n == 0) {
    return 1;
  }
  for (size_t i = 0; i < n; i++) {
    struct canfd_frame answer;
    const int64_t t0 = now_ns();
    int status = wait_send(port, &request);
    do {
      status = status == 0 ? wait_frame(port, &answer, NULL) : status;
    } while (status == 0 && answer.can_id != 0x101);
    if (status != 0) {
      return finish(port, status);
    }
    rtt_ns[i] = now_ns() - t0;
  }
  qsort(rtt_ns, n, sizeof rtt_ns[0], by_value);
  (void)printf("{\"p50\":%.1f,\"p99\":%.1f,\"max\":%.1f}\n", (double)rtt_ns[n / 2] * 1e-3,
               (double)rtt_ns[n * 99 / 100] * 1e-3, (double)rtt_ns[n - 1] * 1e-3);
  return finish(port, 0);
}

static int pong(can_port_t *port)
{
  for (;;) {
    struct canfd_frame f;
    int status = wait_frame(port, &f, NULL);
    if (status == 0 && f.can_id == 0x100) {
      f.can_id = 0x101;
      status = wait_send(port, &f);
    }
    if (status != 0) {
      return finish(port, status);
    }
  }
}

int main(int argc, char **argv)
{
  static can_port_t port;
  const struct can_filter one = {.can_id = 0x123, .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG};
  if (argc < 3) {
    (void)fputs("usage: test_hub_port BUS recv|count|send|try|ping|pong|filter [N] [ID]\n", stderr);
    return 1;
  }
  const char *mode = argv[2];
  const uint64_t n = argc > 3 ? strtoull(argv[3], NULL, 0) : 1;
  const canid_t id = argc > 4 ? (canid_t)strtoul(argv[4], NULL, 0) : 0x200;
  if (can_port_open(&port, argv[1]) != CAN_PORT_OK) {
    (void)fprintf(stderr, "%s\n", port.error);
    return 1;
  }
  if (strcmp(mode, "filter") == 0 && can_port_filter(&port, &one, 1) != CAN_PORT_OK) {
    return finish(&port, 3);
  }
  (void)puts("{\"ready\":true}");
  (void)fflush(stdout);
  if (strcmp(mode, "recv") == 0 || strcmp(mode, "filter") == 0) {
    return receive(&port, n, true);
  }
  if (strcmp(mode, "count") == 0) {
    return receive(&port, n, false);
  }
  if (strcmp(mode, "send") == 0 || strcmp(mode, "try") == 0) {
    return transmit(&port, n, id, strcmp(mode, "send") == 0);
  }
  if (strcmp(mode, "ping") == 0) {
    return ping(&port, (size_t)n);
  }
  return strcmp(mode, "pong") == 0 ? pong(&port) : 1;
}
