/* can_port against a hub that this program plays itself, call by call. Exit status 0: all hold. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "can_port.h"

#define CHECK(condition)                                                                \
  do {                                                                                  \
    if (!(condition)) {                                                                 \
      (void)fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition); \
      exit(1);                                                                          \
    }                                                                                   \
  } while (0)

static struct sockaddr_un addr = {.sun_family = AF_UNIX};
static char bus[128];
static int listener;
static can_port_t port;
static struct canfd_frame frame;
static int64_t stamp_ns;

static int connect_port(void)
{
  CHECK(can_port_open(&port, bus) == CAN_PORT_OK && port.fd >= 0 && port.hub && port.error[0] == '\0');
  const int hub = accept(listener, NULL, NULL);
  CHECK(hub >= 0);
  return hub;
}

static void put(int hub, canid_t id)
{
  const struct can_frame f = {.can_id = id, .can_dlc = 2, .data = {1, 2}};
  CHECK(send(hub, &f, sizeof f, 0) == sizeof f);
}

/* A hub so quick that it has sent before connect returns to the port. */
static int quick_hub = -1;
static bool hub_is_quick;

int connect(int fd, const struct sockaddr *to, socklen_t length)
{
  const int rc = (int)syscall(SYS_connect, fd, to, length);
  if (rc == 0 && hub_is_quick) {
    quick_hub = accept(listener, NULL, NULL);
    put(quick_hub, 0x31);
  }
  return rc;
}

static int64_t wall_ns(void)
{
  struct timespec t;
  (void)clock_gettime(CLOCK_REALTIME, &t);
  return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void the_very_first_frame_is_stamped_when_it_came(void)
{
  hub_is_quick = true;
  CHECK(can_port_open(&port, bus) == CAN_PORT_OK);
  hub_is_quick = false;
  const int64_t opened_ns = wall_ns();
  CHECK(nanosleep(&(struct timespec){.tv_nsec = 50000000}, NULL) == 0);
  CHECK(can_port_recv(&port, &frame, &stamp_ns) == CAN_PORT_OK && frame.can_id == 0x31);
  CHECK(stamp_ns <= opened_ns);
  can_port_close(&port);
  CHECK(close(quick_hub) == 0);
}

static void garbage_is_skipped_but_not_without_bound(void)
{
  const int hub = connect_port();
  CHECK(can_port_recv(&port, &frame, &stamp_ns) == CAN_PORT_EMPTY);
  for (int i = 0; i < CAN_PORT_SKIP_MAX - 1; i++) {
    CHECK(send(hub, "garbage", 7, 0) == 7);
  }
  put(hub, 0x11);
  CHECK(can_port_recv(&port, &frame, &stamp_ns) == CAN_PORT_OK && frame.can_id == 0x11 && frame.flags == 0);
  CHECK(port.counters.rejected == CAN_PORT_SKIP_MAX - 1 && stamp_ns > 1600000000 * (int64_t)1000000000);
  for (int i = 0; i < CAN_PORT_SKIP_MAX; i++) {
    CHECK(send(hub, "garbage", 7, 0) == 7);
  }
  put(hub, 0x12);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_SKIPPED); /* not EMPTY: the frame behind it is still queued */
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x12);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_EMPTY);
  CHECK(port.counters.rejected == 2 * CAN_PORT_SKIP_MAX - 1 && port.counters.received == 2);
  can_port_close(&port);
  CHECK(close(hub) == 0 && can_port_recv(&port, &frame, NULL) == CAN_PORT_GONE);
}

static void error_frames_are_counted_and_skipped(void)
{
  const int hub = connect_port();
  put(hub, CAN_ERR_FLAG | 0x40);
  put(hub, 0x13);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x13 && port.counters.error_frames == 1);
  can_port_close(&port);
  CHECK(close(hub) == 0);
}

static void filters_select_by_id_mask_and_inversion(void)
{
  const struct can_filter one[] = {{.can_id = 0x100, .can_mask = 0x700}};
  const struct can_filter not_one[] = {{.can_id = 0x100 | CAN_INV_FILTER, .can_mask = 0x7ff}};
  const int hub = connect_port();
  CHECK(can_port_filter(&port, one, CAN_PORT_FILTERS_MAX + 1) == CAN_PORT_REFUSED);
  CHECK(can_port_filter(&port, one, 1) == CAN_PORT_OK);
  put(hub, 0x200);
  put(hub, 0x17f);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x17f);
  CHECK(can_port_filter(&port, not_one, 1) == CAN_PORT_OK);
  put(hub, 0x100);
  put(hub, 0x101);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x101);
  CHECK(can_port_filter(&port, NULL, 0) == CAN_PORT_OK);
  put(hub, 0x100);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x100 && port.counters.received == 3);
  can_port_close(&port);
  CHECK(close(hub) == 0);
}

static void what_no_bus_carries_is_refused(void)
{
  const int hub = connect_port();
  frame = (struct canfd_frame){.can_id = 1, .len = 9};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_REFUSED);
  frame = (struct canfd_frame){.can_id = 0x800};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_REFUSED);
  frame = (struct canfd_frame){.can_id = 1, .len = 65, .flags = CANFD_FDF};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_REFUSED && port.counters.sent == 0);
  frame = (struct canfd_frame){.can_id = 0x800 | CAN_EFF_FLAG, .len = 8, .__res0 = 7, .__res1 = 7};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_OK);
  unsigned char raw[100];
  CHECK(recv(hub, raw, sizeof raw, 0) == CAN_MTU && raw[4] == 8 && raw[5] == 0 && raw[6] == 0 && raw[7] == 0);
  can_port_close(&port);
  CHECK(close(hub) == 0);
}

static void no_room_is_counted_and_never_waited_for(void)
{
  const int hub = connect_port();
  frame = (struct canfd_frame){.can_id = 1, .len = 8};
  uint64_t sent = 0;
  while (can_port_send(&port, &frame) == CAN_PORT_OK) {
    sent++;
  }
  CHECK(can_port_send(&port, &frame) == CAN_PORT_FULL);
  CHECK(port.counters.tx_drops == 2 && port.counters.sent == sent && sent > 100);
  can_port_close(&port);
  CHECK(close(hub) == 0);
}

static void the_end_comes_after_what_was_queued_and_stays(void)
{
  const int hub = connect_port();
  frame = (struct canfd_frame){.can_id = 1};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_OK); /* never read: the hub's end resets the connection */
  put(hub, 0x21);
  put(hub, 0x22);
  CHECK(close(hub) == 0);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x21);
  CHECK(can_port_send(&port, &frame) == CAN_PORT_GONE);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_OK && frame.can_id == 0x22);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_GONE && can_port_recv(&port, &frame, NULL) == CAN_PORT_GONE);
  CHECK(can_port_send(&port, &frame) == CAN_PORT_GONE && strchr(port.error, '\n') == NULL && port.error[0] != '\0');
  can_port_close(&port);
  can_port_close(&port);
}

static void who_only_sends_receives_nothing(void)
{
  const int hub = connect_port();
  CHECK(can_port_send_only(&port) == CAN_PORT_OK);
  CHECK(can_port_recv(&port, &frame, NULL) == CAN_PORT_EMPTY && !port.gone);
  frame = (struct canfd_frame){.can_id = 5};
  CHECK(can_port_send(&port, &frame) == CAN_PORT_OK);
  CHECK(send(hub, &frame, CAN_MTU, MSG_NOSIGNAL) < 0); /* the hub learns of it */
  CHECK(close(hub) == 0 && can_port_send(&port, &frame) == CAN_PORT_GONE);
  can_port_close(&port);
}

static void a_bus_that_is_none_is_one_line(void)
{
  static const char *const bad[] = {"", "hub", "rt_hub:", "socketcan:", "socketcan:a-name-too-long-", "udp:1"};
  char long_path[300] = "rt_hub:/";
  for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
    CHECK(can_port_open(&port, bad[i]) == CAN_PORT_REFUSED);
    CHECK(port.fd == -1 && port.error[0] != '\0' && strchr(port.error, '\n') == NULL);
  }
  memset(long_path + 8, 'x', 200);
  CHECK(can_port_open(&port, long_path) == CAN_PORT_REFUSED && strlen(port.error) < CAN_PORT_ERROR_MAX);
  CHECK(can_port_open(&port, "rt_hub:/nowhere/at/all") == CAN_PORT_GONE && port.fd == -1);
  CHECK(can_port_open(&port, "socketcan:nowhere0") == CAN_PORT_GONE && port.fd == -1);
}

int main(int argc, char **argv)
{
  CHECK(argc == 2 && strlen(argv[1]) < sizeof addr.sun_path);
  (void)strcpy(addr.sun_path, argv[1]);
  (void)snprintf(bus, sizeof bus, "rt_hub:%s", argv[1]);
  listener = socket(AF_UNIX, SOCK_SEQPACKET, 0);
  CHECK(bind(listener, (const struct sockaddr *)&addr, sizeof addr) == 0 && listen(listener, 4) == 0);
  the_very_first_frame_is_stamped_when_it_came();
  garbage_is_skipped_but_not_without_bound();
  error_frames_are_counted_and_skipped();
  filters_select_by_id_mask_and_inversion();
  what_no_bus_carries_is_refused();
  no_room_is_counted_and_never_waited_for();
  the_end_comes_after_what_was_queued_and_stays();
  who_only_sends_receives_nothing();
  a_bus_that_is_none_is_one_line();
  CHECK(close(listener) == 0 && unlink(argv[1]) == 0);
  (void)puts("ok");
  return 0;
}
