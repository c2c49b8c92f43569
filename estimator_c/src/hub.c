#include "hub.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include "can_port.h"

#define QUEUE_BYTES (4 << 20) /* one client's queue; a queued frame costs the kernel some 800 bytes */

void hub_init(hub_t *self, int64_t stall_ns)
{
  memset(self, 0, sizeof *self);
  self->stall_ns = stall_ns;
  for (size_t i = 0; i < HUB_CLIENTS_MAX; i++) {
    self->clients[i].fd = -1;
  }
  for (size_t i = 0; i < HUB_BATCH; i++) {
    self->in_iov[i] = (struct iovec){.iov_base = &self->frames[i], .iov_len = sizeof self->frames[i]};
    self->in[i].msg_hdr = (struct msghdr){.msg_iov = &self->in_iov[i], .msg_iovlen = 1};
    self->out[i].msg_hdr = (struct msghdr){.msg_iov = &self->out_iov[i], .msg_iovlen = 1};
  }
}

bool hub_add(hub_t *self, int fd, int32_t pid, const char *name)
{
  const int bytes = QUEUE_BYTES;
  for (uint32_t i = 0; i < HUB_CLIENTS_MAX; i++) {
    hub_client_t *c = &self->clients[i];
    if (c->fd >= 0) {
      continue;
    }
    /* In AF_UNIX the sender's buffer is the receiver's queue. */
    if (setsockopt(fd, SOL_SOCKET, SO_SNDBUFFORCE, &bytes, sizeof bytes) != 0) {
      (void)setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes); /* capped by net.core.wmem_max */
    }
    *c = (hub_client_t){.fd = fd, .pid = pid, .sent = self->fresh ? 0 : self->batch_len, .blocked_since_ns = -1};
    (void)snprintf(c->name, sizeof c->name, "%s", name != NULL ? name : "");
    if (i >= self->top) {
      self->top = i + 1;
    }
    self->counters.clients++;
    return true;
  }
  self->counters.refused++;
  return false;
}

static void remove_client(hub_t *self, hub_client_t *c)
{
  (void)close(c->fd);
  c->fd = -1;
  while (self->top > 0 && self->clients[self->top - 1].fd < 0) {
    self->top--;
  }
}

uint32_t hub_clients(const hub_t *self)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < self->top; i++) {
    n += self->clients[i].fd >= 0;
  }
  return n;
}

static bool waited_for(const hub_t *self, const hub_client_t *c)
{
  return c->fd >= 0 && !c->deaf && c->sent < self->batch_len;
}

size_t hub_poll_set(const hub_t *self, struct pollfd *fds)
{
  for (uint32_t i = 0; i < self->top; i++) {
    const hub_client_t *c = &self->clients[i];
    /* While blocked nobody is read, so nobody else may wake us: that would be a busy loop. */
    const bool watch = !self->blocked || waited_for(self, c);
    fds[i] = (struct pollfd){.fd = watch ? c->fd : -1, .events = self->blocked ? POLLOUT : POLLIN};
  }
  return self->top;
}

int hub_poll_timeout_ms(const hub_t *self)
{
  return self->blocked ? HUB_RETRY_MS : -1;
}

void hub_hand_out(hub_t *self, int64_t now_ns, hub_on_stall_t on_stall, void *context)
{
  bool blocked = false;
  const int64_t pause_ns = now_ns - self->blocked_since_ns - (int64_t)HUB_PAUSE_MS * 1000000;
  const int64_t own_ns = self->blocked && pause_ns > 0 ? pause_ns : 0; /* we were stopped: nobody could have been served */
  self->fresh = false;
  for (uint32_t i = 0; i < self->top; i++) {
    hub_client_t *c = &self->clients[i];
    while (waited_for(self, c)) {
      const int n = sendmmsg(c->fd, &self->out[c->sent], self->batch_len - c->sent, MSG_DONTWAIT | MSG_NOSIGNAL);
      if (n > 0) {
        c->sent += (uint32_t)n;
        c->blocked_since_ns = -1;
        self->counters.delivered += (uint64_t)n;
      } else if (errno == EAGAIN || errno == ENOBUFS || errno == ENOMEM) {
        c->blocked_since_ns = c->blocked_since_ns < 0 ? now_ns : c->blocked_since_ns + own_ns;
        if (now_ns - c->blocked_since_ns < self->stall_ns) {
          blocked = true;
        } else {
          self->counters.stalled++;
          if (on_stall != NULL) {
            on_stall(c, context);
          }
          remove_client(self, c);
        }
        break;
      } else if (errno != EINTR) {
        c->deaf = true; /* it hears no more, but what it has sent still counts: its own end comes by reading */
      }
    }
  }
  if (self->blocked) {
    self->counters.blocked_ns += (uint64_t)(now_ns - self->blocked_since_ns);
  }
  self->blocked = blocked;
  self->blocked_since_ns = now_ns;
}

/* recv gives 0 for an empty datagram and for the end; only the end is both hung up and has nothing left. */
static bool ended(int fd)
{
  struct pollfd p = {.fd = fd, .events = POLLRDHUP};
  int left = 0;
  return poll(&p, 1, 0) == 1 && (p.revents & (POLLRDHUP | POLLHUP)) != 0 && ioctl(fd, FIONREAD, &left) == 0 &&
         left == 0;
}

/* Take the next batch from one client; false when it had no frame. */
static bool take_batch(hub_t *self, hub_client_t *c)
{
  uint64_t empty = 0;
  const int n = recvmmsg(c->fd, self->in, HUB_BATCH, MSG_DONTWAIT, NULL);
  if (n < 0) {
    /* ECONNRESET: the client died with unread frames; what it had sent is still there, look again next time. */
    if (errno != EAGAIN && errno != EINTR && errno != ECONNRESET) {
      remove_client(self, c);
    }
    return false;
  }
  self->batch_len = 0;
  for (int i = 0; i < n; i++) {
    const size_t size = self->in[i].msg_len;
    empty += size == 0;
    if ((self->in[i].msg_hdr.msg_flags & MSG_TRUNC) != 0 || !can_port_valid(&self->frames[i], size)) {
      self->counters.rejected += size > 0;
      continue;
    }
    self->out_iov[self->batch_len++] = (struct iovec){.iov_base = &self->frames[i], .iov_len = size};
  }
  self->counters.frames += self->batch_len;
  if (empty > 0 && ended(c->fd)) {
    remove_client(self, c);
  } else {
    self->counters.rejected += empty;
  }
  return self->batch_len > 0;
}

bool hub_take(hub_t *self, struct pollfd *fds, size_t count)
{
  if (self->blocked) {
    return false; /* who was polled while blocked says nothing about who can be read */
  }
  for (size_t k = 0; k < count; k++) {
    const size_t i = (self->turn + k) % count;
    hub_client_t *c = &self->clients[i];
    const bool readable = fds[i].revents != 0 && c->fd >= 0 && c->fd == fds[i].fd;
    fds[i].revents = 0;
    if (readable && take_batch(self, c)) {
      for (uint32_t j = 0; j < self->top; j++) {
        self->clients[j].sent = 0;
      }
      c->sent = self->batch_len; /* nobody hears himself */
      self->turn = (uint32_t)(i + 1);
      self->fresh = true;
      return true;
    }
  }
  return false;
}

void hub_close(hub_t *self)
{
  hub_hand_out(self, self->blocked_since_ns, NULL, NULL);
  for (uint32_t i = HUB_CLIENTS_MAX; i-- > 0;) {
    if (self->clients[i].fd >= 0) {
      remove_client(self, &self->clients[i]);
    }
  }
}
