#include "can_port.h"

#include <errno.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define RCVBUF_BYTES (4 << 20) /* the default holds about 222 frames: 0.7 s of this project's bus */
#define CONNECT_TIMEOUT_S 2    /* a hub that was stopped accepts nobody; do not wait for it for ever */

_Static_assert(CAN_MTU == 16 && CANFD_MTU == 72, "wire sizes of the hub are the kernel's frames");

static void explain(can_port_t *port, const char *bus, const char *what, const char *remedy)
{
  (void)snprintf(port->error, sizeof port->error, "%.128s: %s: %s", bus, what, remedy);
}

bool can_port_valid(const struct canfd_frame *frame, size_t size)
{
  if (size == CAN_MTU ? frame->len > CAN_MAX_DLEN : size != CANFD_MTU || frame->len > CANFD_MAX_DLEN) {
    return false;
  }
  /* 11 bits are what a standard frame carries; an error frame uses the id field for its classes. */
  return (frame->can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)) != 0 || (frame->can_id & CAN_EFF_MASK) <= CAN_SFF_MASK;
}

/* ---- open: the only place where the two kinds of bus differ ------------------------------------------------ */

/* Before anything can arrive: a frame that was queued earlier would be stamped only when it is read. On AF_UNIX the stamp
 * is the moment the hub put the frame into our queue. */
static bool ask_for_stamps(can_port_t *port, const char *bus)
{
  const int on = 1;
  if (setsockopt(port->fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) != 0) {
    explain(port, bus, strerror(errno), "the kernel gives no receive stamps");
    return false;
  }
  return true;
}

static can_port_status_t open_socketcan(can_port_t *port, const char *bus, const char *iface)
{
  const int on = 1, size = RCVBUF_BYTES;
  const can_err_mask_t errors = CAN_ERR_MASK;
  struct sockaddr_can addr = {.can_family = AF_CAN};
  const size_t length = strlen(iface);

  if (length == 0 || length >= IFNAMSIZ) {
    explain(port, bus, "not an interface name", "give socketcan:IFACE, e.g. socketcan:vcan0");
    return CAN_PORT_REFUSED;
  }
  port->fd = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
  if (port->fd < 0) {
    explain(port, bus, errno == EAFNOSUPPORT ? "this kernel has no CAN support" : strerror(errno),
            "use the user-space hub (--bus hub), or run inside tools/vcan-lab");
    return CAN_PORT_GONE;
  }
  addr.can_ifindex = (int)if_nametoindex(iface);
  if (addr.can_ifindex == 0) {
    explain(port, bus, strerror(errno), "create it with `rt-runner vcan up`, or use --bus hub");
    return CAN_PORT_GONE;
  }
  if (!ask_for_stamps(port, bus)) {
    return CAN_PORT_GONE;
  }
  if (setsockopt(port->fd, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size) != 0) {
    (void)setsockopt(port->fd, SOL_SOCKET, SO_RCVBUF, &size, sizeof size); /* capped by net.core.rmem_max */
  }
  if (setsockopt(port->fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on) != 0 ||
      setsockopt(port->fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) != 0 ||
      setsockopt(port->fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) != 0 ||
      bind(port->fd, (const struct sockaddr *)&addr, sizeof addr) != 0) {
    explain(port, bus, strerror(errno), "is it a CAN interface?");
    return CAN_PORT_GONE;
  }
  return CAN_PORT_OK;
}

static can_port_status_t open_hub(can_port_t *port, const char *bus, const char *path)
{
  struct sockaddr_un addr = {.sun_family = AF_UNIX};
  const struct timeval limit = {.tv_sec = CONNECT_TIMEOUT_S};
  const size_t length = strlen(path);

  if (length == 0 || length >= sizeof addr.sun_path) {
    explain(port, bus, "not a socket path", "give rt_hub:PATH with 1 to 107 bytes of path");
    return CAN_PORT_REFUSED;
  }
  memcpy(addr.sun_path, path, length + 1);
  port->fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
  if (port->fd < 0) {
    explain(port, bus, strerror(errno), "cannot make a socket");
    return CAN_PORT_GONE;
  }
  if (!ask_for_stamps(port, bus)) {
    return CAN_PORT_GONE;
  }
  (void)setsockopt(port->fd, SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit);
  if (connect(port->fd, (const struct sockaddr *)&addr, sizeof addr) != 0) {
    explain(port, bus, errno == EAGAIN ? "the hub does not answer" : strerror(errno),
            "is the hub running? start it with `rt_hub --socket PATH`");
    return CAN_PORT_GONE;
  }
  return CAN_PORT_OK;
}

can_port_status_t can_port_open(can_port_t *port, const char *bus)
{
  static const char socketcan[] = "socketcan:", hub[] = "rt_hub:";
  can_port_status_t status;

  memset(port, 0, sizeof *port);
  port->fd = -1;
  if (strncmp(bus, socketcan, sizeof socketcan - 1) == 0) {
    status = open_socketcan(port, bus, bus + sizeof socketcan - 1);
  } else if (strncmp(bus, hub, sizeof hub - 1) == 0) {
    port->hub = true;
    status = open_hub(port, bus, bus + sizeof hub - 1);
  } else {
    explain(port, bus, "not a bus", "give socketcan:IFACE or rt_hub:PATH");
    return CAN_PORT_REFUSED;
  }
  if (status != CAN_PORT_OK) {
    can_port_close(port);
  }
  return status;
}

void can_port_close(can_port_t *port)
{
  if (port->fd >= 0) {
    (void)close(port->fd);
    port->fd = -1;
  }
  port->gone = true;
}

/* ---- filters ----------------------------------------------------------------------------------------------- */

can_port_status_t can_port_filter(can_port_t *port, const struct can_filter *filters, size_t count)
{
  static const struct can_filter everything = {0, 0};
  if (count > CAN_PORT_FILTERS_MAX) {
    return CAN_PORT_REFUSED;
  }
  if (port->hub) {
    if (count > 0) {
      memcpy(port->filters, filters, count * sizeof *filters);
    }
    port->filter_count = (uint32_t)count;
    return CAN_PORT_OK;
  }
  const struct can_filter *list = count > 0 ? filters : &everything;
  const socklen_t bytes = (socklen_t)((count > 0 ? count : 1) * sizeof *filters);
  if (setsockopt(port->fd, SOL_CAN_RAW, CAN_RAW_FILTER, list, bytes) != 0) {
    explain(port, "socketcan", strerror(errno), "the kernel refused the filters");
    return CAN_PORT_GONE;
  }
  return CAN_PORT_OK;
}

can_port_status_t can_port_send_only(can_port_t *port)
{
  /* SocketCAN: an empty filter list receives nothing. Hub: it learns of the shut-down and sends us nothing. */
  const int rc = port->hub ? shutdown(port->fd, SHUT_RD) : setsockopt(port->fd, SOL_CAN_RAW, CAN_RAW_FILTER, NULL, 0);
  if (rc != 0) {
    explain(port, port->hub ? "rt_hub" : "socketcan", strerror(errno), "cannot stop receiving");
    return CAN_PORT_GONE;
  }
  port->send_only = true;
  return CAN_PORT_OK;
}

static bool wanted(const can_port_t *port, canid_t id)
{
  for (uint32_t i = 0; i < port->filter_count; i++) {
    const struct can_filter *f = &port->filters[i];
    const bool inverted = (f->can_id & CAN_INV_FILTER) != 0;
    if (((id & f->can_mask) == ((f->can_id & ~CAN_INV_FILTER) & f->can_mask)) != inverted) {
      return true;
    }
  }
  return port->filter_count == 0;
}

/* ---- receive, send ----------------------------------------------------------------------------------------- */

static can_port_status_t lost(can_port_t *port, const char *what)
{
  if (!port->gone) {
    explain(port, port->hub ? "rt_hub" : "socketcan", what, "the bus has ended, restart the run");
    port->gone = true;
  }
  return CAN_PORT_GONE;
}

static int64_t read_ancillary(can_port_t *port, struct msghdr *msg)
{
  int64_t stamp_ns = 0;
  for (struct cmsghdr *c = CMSG_FIRSTHDR(msg); c != NULL; c = CMSG_NXTHDR(msg, c)) {
    if (c->cmsg_level != SOL_SOCKET) {
      continue;
    }
    if (c->cmsg_type == SCM_TIMESTAMPNS) {
      struct timespec ts;
      memcpy(&ts, CMSG_DATA(c), sizeof ts);
      stamp_ns = (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
    } else if (c->cmsg_type == SO_RXQ_OVFL) {
      uint32_t total;
      memcpy(&total, CMSG_DATA(c), sizeof total);
      port->counters.rx_drops += (uint32_t)(total - port->ovfl_seen); /* the kernel's counter wraps at 2^32 */
      port->ovfl_seen = total;
    }
  }
  return stamp_ns;
}

can_port_status_t can_port_recv(can_port_t *port, struct canfd_frame *frame, int64_t *rx_ns)
{
  _Alignas(struct cmsghdr) char control[CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(uint32_t))];

  if (port->fd < 0 || port->send_only) {
    return port->fd < 0 ? CAN_PORT_GONE : CAN_PORT_EMPTY;
  }
  for (int tries = 0; tries < CAN_PORT_SKIP_MAX; tries++) {
    struct canfd_frame raw = {0};
    struct iovec iov = {.iov_base = &raw, .iov_len = sizeof raw};
    struct msghdr msg = {.msg_iov = &iov, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
    const ssize_t size = recvmsg(port->fd, &msg, MSG_DONTWAIT);

    if (size < 0) {
      switch (errno) {
        case EAGAIN: return port->gone ? CAN_PORT_GONE : CAN_PORT_EMPTY;
        case EINTR: continue;
        case ECONNRESET: continue; /* the hub died; what it had queued for us is still there, then comes 0 */
        default: return lost(port, strerror(errno));
      }
    }
    if (size == 0) {
      return lost(port, "the hub closed the connection");
    }
    const int64_t stamp_ns = read_ancillary(port, &msg);
    if ((msg.msg_flags & MSG_TRUNC) != 0 || !can_port_valid(&raw, (size_t)size)) {
      port->counters.rejected++;
      continue;
    }
    if ((raw.can_id & CAN_ERR_FLAG) != 0) {
      port->counters.error_frames++;
      continue;
    }
    if (port->hub && !wanted(port, raw.can_id)) {
      continue;
    }
    /* One meaning of `flags` for every sender: the FDF bit says FD, a classic frame has none. */
    raw.flags = (uint8_t)(size == CANFD_MTU ? raw.flags | CANFD_FDF : 0);
    *frame = raw;
    if (rx_ns != NULL) {
      *rx_ns = stamp_ns;
    }
    port->counters.received++;
    return CAN_PORT_OK;
  }
  return CAN_PORT_SKIPPED;
}

can_port_status_t can_port_send(can_port_t *port, const struct canfd_frame *frame)
{
  const size_t size = (frame->flags & CANFD_FDF) != 0 ? CANFD_MTU : CAN_MTU;
  struct canfd_frame raw = *frame;

  if (!can_port_valid(frame, size)) {
    return CAN_PORT_REFUSED;
  }
  if (port->fd < 0 || port->gone) {
    return CAN_PORT_GONE;
  }
  if (size == CAN_MTU) {
    raw.flags = raw.__res0 = raw.__res1 = 0; /* can_frame: padding, and len8_dlc, which we do not use */
  }
  for (;;) {
    if (send(port->fd, &raw, size, MSG_DONTWAIT | MSG_NOSIGNAL) == (ssize_t)size) {
      port->counters.sent++;
      return CAN_PORT_OK;
    }
    switch (errno) {
      case EINTR: continue;
      case EAGAIN:
      case ENOBUFS: port->counters.tx_drops++; return CAN_PORT_FULL;
      case EINVAL:
      case EMSGSIZE: return CAN_PORT_REFUSED; /* an FD frame on an interface that carries only classic ones */
      default: return lost(port, strerror(errno));
    }
  }
}
