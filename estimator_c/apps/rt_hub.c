/* rt_hub - the user-space CAN bus as a process: `rt_hub --socket PATH`. See src/hub.h for what it promises.
 *
 * stdout: one JSON line when it is ready, one with its counters at the end. stderr: one line for each client it had
 * to disconnect, and for a set-up error. SIGTERM, SIGINT: socket removed, exit 0. Set-up error: exit 1. */
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "hub.h"

static const char usage[] =
    "usage: rt_hub --socket PATH [--stall-s S] [--mode OCTAL] [--with-parent]\n"
    "  --socket PATH  where clients connect (at most 107 bytes)\n"
    "  --stall-s S    disconnect a client that has not read for S seconds while others wait (default 2)\n"
    "  --mode OCTAL   who may connect: permissions of the socket (default 0600; 0666: any user)\n"
    "  --with-parent  end when the process that started the hub ends\n";

static int fail(const char *format, ...) __attribute__((format(printf, 1, 2)));
static int fail(const char *format, ...)
{
  va_list args;
  va_start(args, format);
  (void)fputs("rt_hub: ", stderr);
  (void)vfprintf(stderr, format, args);
  (void)fputc('\n', stderr);
  va_end(args);
  return -1;
}

/* 0, or -1 with one line when what was just written did not get out. */
static int written(const char *what)
{
  (void)fflush(stdout);
  return ferror(stdout) == 0 ? 0 : fail("stdout: cannot write the %s line (%s); give it a place to go", what, strerror(errno));
}

/* ---- command line ------------------------------------------------------------------------------------------ */

typedef struct {
  struct sockaddr_un addr;
  double stall_s;
  mode_t mode;
  bool with_parent, help;
} options_t;

static int parse(options_t *o, int argc, char **argv)
{
  static const struct option table[] = {{"socket", required_argument, NULL, 's'},
                                        {"stall-s", required_argument, NULL, 't'},
                                        {"mode", required_argument, NULL, 'm'},
                                        {"with-parent", no_argument, NULL, 'p'},
                                        {"help", no_argument, NULL, 'h'},
                                        {NULL, 0, NULL, 0}};
  *o = (options_t){.addr = {.sun_family = AF_UNIX}, .stall_s = 2.0, .mode = 0600};
  for (int c; (c = getopt_long(argc, argv, "", table, NULL)) != -1;) {
    char *end = NULL;
    switch (c) {
      case 's':
        if (strlen(optarg) >= sizeof o->addr.sun_path) {
          return fail("--socket: the path has %zu bytes, a socket's path at most %zu: choose a shorter one",
                      strlen(optarg), sizeof o->addr.sun_path - 1);
        }
        (void)strcpy(o->addr.sun_path, optarg);
        break;
      case 't':
        o->stall_s = strtod(optarg, &end);
        if (end == optarg || *end != '\0' || !(o->stall_s >= 0.01 && o->stall_s <= 3600.0)) {
          return fail("--stall-s %s: give seconds from 0.01 to 3600", optarg);
        }
        break;
      case 'm': {
        const unsigned long mode = strtoul(optarg, &end, 8);
        if (end == optarg || *end != '\0' || mode > 0777) {
          return fail("--mode %s: give octal permissions such as 0600 or 0666", optarg);
        }
        o->mode = (mode_t)mode;
        break;
      }
      case 'p': o->with_parent = true; break;
      case 'h': o->help = true; return 0;
      default: return fail("unknown option (rt_hub --help says which there are)");
    }
  }
  if (optind < argc) {
    return fail("'%s' is no option (rt_hub --help says which there are)", argv[optind]);
  }
  return o->addr.sun_path[0] != '\0' ? 0 : fail("--socket PATH is missing");
}

/* ---- the socket -------------------------------------------------------------------------------------------- */

/* Two hubs starting at once must not take each other's socket for a stale one: lock the folder meanwhile. */
static int lock_folder(const char *path)
{
  char folder[sizeof((struct sockaddr_un *)0)->sun_path];
  (void)strcpy(folder, path);
  char *slash = strrchr(folder, '/');
  if (slash == NULL) {
    (void)strcpy(folder, ".");
  } else {
    slash[slash == folder] = '\0'; /* "/hub.sock" lies in "/" */
  }
  const int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd < 0) {
    return fail("cannot open the folder %s of the socket: %s", folder, strerror(errno));
  }
  for (int tries = 0; flock(fd, LOCK_EX | LOCK_NB) != 0; tries++) {
    if (tries == 200) {
      (void)close(fd);
      return fail("the folder %s stays locked by another process: choose another folder", folder);
    }
    (void)nanosleep(&(struct timespec){.tv_nsec = 10000000}, NULL);
  }
  return fd;
}

/* Remove what a hub that was killed has left; refuse everything else. */
static int clear_path(const struct sockaddr_un *addr)
{
  struct stat st;
  if (lstat(addr->sun_path, &st) != 0) {
    return errno == ENOENT ? 0 : fail("%s: %s", addr->sun_path, strerror(errno));
  }
  if (!S_ISSOCK(st.st_mode)) {
    return fail("%s exists and is not a socket: choose another path", addr->sun_path);
  }
  const int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  const int rc = fd < 0 ? -1 : connect(fd, (const struct sockaddr *)addr, sizeof *addr);
  const int error = errno;
  if (fd >= 0) {
    (void)close(fd);
  }
  if (rc == 0 || error == EAGAIN || error == EPROTOTYPE) { /* EAGAIN: alive, with a full queue of connections */
    return fail("another process already listens at %s: stop it or choose another path", addr->sun_path);
  }
  if (error != ECONNREFUSED) {
    return fail("%s: %s", addr->sun_path, strerror(error));
  }
  return unlink(addr->sun_path) == 0 ? 0 : fail("cannot remove the stale %s: %s", addr->sun_path, strerror(errno));
}

static int listen_at(const options_t *o, struct stat *identity)
{
  const char *path = o->addr.sun_path;
  const int lock = lock_folder(path);
  int fd = -1;
  if (lock < 0) {
    return -1;
  }
  if (clear_path(&o->addr) == 0) {
    fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    const mode_t old = umask(0777 & ~o->mode); /* nobody else gets in between bind and chmod */
    if (fd < 0 || bind(fd, (const struct sockaddr *)&o->addr, sizeof o->addr) != 0 || chmod(path, o->mode) != 0 ||
        listen(fd, HUB_CLIENTS_MAX) != 0 || stat(path, identity) != 0) {
      (void)fail("cannot listen at %s: %s", path, strerror(errno));
      if (fd >= 0) {
        (void)close(fd);
      }
      fd = -1;
    }
    (void)umask(old);
  }
  (void)close(lock);
  return fd;
}

static void remove_own_socket(const char *path, const struct stat *identity)
{
  struct stat st;
  if (lstat(path, &st) == 0 && st.st_dev == identity->st_dev && st.st_ino == identity->st_ino) {
    (void)unlink(path);
  }
}

enum { ACCEPT_PAUSE_NS = 100000000 }; /* out of descriptors: a listener that stays readable must not be a busy loop */
static bool out_of_descriptors;

static bool accept_one(hub_t *hub, int listener)
{
  const int fd = accept4(listener, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK);
  struct ucred who = {0};
  socklen_t size = sizeof who;
  char path[32], name[HUB_NAME_MAX + 1] = ""; /* with the newline */
  if (fd < 0) {
    out_of_descriptors = errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM;
    return false;
  }
  (void)getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &who, &size);
  (void)snprintf(path, sizeof path, "/proc/%d/comm", (int)who.pid);
  const int comm = open(path, O_RDONLY | O_CLOEXEC);
  if (comm >= 0) {
    const ssize_t n = read(comm, name, sizeof name - 1);
    name[n > 0 ? n : 0] = '\0';
    name[strcspn(name, "\n")] = '\0';
    (void)close(comm);
  }
  if (!hub_add(hub, fd, who.pid, name)) {
    (void)close(fd); /* the client sees a closed connection */
  }
  return true;
}

static void accept_all(hub_t *hub, int listener)
{
  out_of_descriptors = false;
  while (accept_one(hub, listener)) {
  }
}

/* ---- what it says ------------------------------------------------------------------------------------------ */

static void put_json_string(const char *s)
{
  (void)putchar('"');
  for (; *s != '\0'; s++) {
    const unsigned char c = (unsigned char)*s;
    if (c == '"' || c == '\\') {
      (void)printf("\\%c", c);
    } else if (c < 0x20 || c == 0x7f) {
      (void)printf("\\u%04x", c);
    } else {
      (void)putchar(c);
    }
  }
  (void)putchar('"');
}

/* Straight to the descriptor, and not at all if nobody takes it: a full pipe must not stop the bus. */
static void say_stalled(const hub_client_t *c, void *context)
{
  const double *stall_s = (const double *)context;
  char line[160];
  struct pollfd err = {.fd = STDERR_FILENO, .events = POLLOUT};
  const int n = snprintf(line, sizeof line,
                         "rt_hub: disconnected client %d (%s): it has not read for %g s while the bus waited\n",
                         (int)c->pid, c->name, *stall_s);
  if (n > 0 && poll(&err, 1, 0) == 1 && (err.revents & POLLOUT) != 0) {
    (void)!write(STDERR_FILENO, line, (size_t)n < sizeof line ? (size_t)n : sizeof line - 1);
  }
}

static int say_final(const hub_counters_t *c)
{
  (void)printf("{\"final\":true,\"frames\":%llu,\"delivered\":%llu,\"rejected\":%llu,\"clients\":%llu,\"refused\":%llu,"
               "\"stalled\":%llu,\"blocked_ms\":%.3f}\n",
               (unsigned long long)c->frames, (unsigned long long)c->delivered, (unsigned long long)c->rejected,
               (unsigned long long)c->clients, (unsigned long long)c->refused, (unsigned long long)c->stalled,
               (double)c->blocked_ns * 1e-6);
  return written("final");
}

static int64_t now_ns(void)
{
  struct timespec t;
  (void)clock_gettime(CLOCK_MONOTONIC, &t);
  return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

/* ---- main -------------------------------------------------------------------------------------------------- */

static void serve(hub_t *hub, int listener, int signals, double *stall_s)
{
  struct pollfd fds[2 + HUB_CLIENTS_MAX];
  fds[0] = (struct pollfd){.fd = signals, .events = POLLIN};
  fds[1] = (struct pollfd){.fd = listener, .events = POLLIN};
  int64_t listen_ns = 0; /* not before */
  while ((fds[0].revents & POLLIN) == 0) {
    const size_t count = hub_poll_set(hub, &fds[2]);
    int timeout_ms = hub_poll_timeout_ms(hub);
    const int64_t left_ns = out_of_descriptors ? listen_ns - now_ns() : 0;
    fds[1].fd = left_ns > 0 ? -1 : listener;
    timeout_ms = timeout_ms < 0 && left_ns > 0 ? (int)(left_ns / 1000000) + 1 : timeout_ms;
    if (poll(fds, (nfds_t)(2 + count), timeout_ms) < 0) {
      continue; /* EINTR */
    }
    if (hub->blocked) {
      hub_hand_out(hub, now_ns(), say_stalled, stall_s);
    }
    while (hub_take(hub, &fds[2], count)) {
      accept_all(hub, listener);
      hub_hand_out(hub, now_ns(), say_stalled, stall_s);
    }
    if ((fds[1].revents & POLLIN) != 0) {
      accept_all(hub, listener);
      listen_ns = now_ns() + ACCEPT_PAUSE_NS;
    }
  }
}

int main(int argc, char **argv)
{
  static hub_t hub;
  options_t options;
  struct stat identity;
  sigset_t stop;

  if (parse(&options, argc, argv) != 0) {
    return 1;
  }
  if (options.help) {
    (void)fputs(usage, stdout);
    return written("usage") == 0 ? 0 : 1;
  }
  (void)sigemptyset(&stop);
  (void)sigaddset(&stop, SIGTERM);
  (void)sigaddset(&stop, SIGINT);
  (void)sigprocmask(SIG_BLOCK, &stop, NULL);
  (void)signal(SIGPIPE, SIG_IGN);
  const int signals = signalfd(-1, &stop, SFD_CLOEXEC | SFD_NONBLOCK);
  const pid_t parent = getppid();
  if (signals < 0) {
    (void)fail("signalfd: %s", strerror(errno));
    return 1;
  }
  if (options.with_parent && (prctl(PR_SET_PDEATHSIG, SIGTERM) != 0 || getppid() != parent)) {
    (void)fail("the process that started the hub is gone");
    return 1;
  }
  hub_init(&hub, (int64_t)llround(options.stall_s * 1e9));
  const int listener = listen_at(&options, &identity);
  if (listener < 0) {
    return 1;
  }
  (void)fputs("{\"ready\":true,\"socket\":", stdout);
  put_json_string(options.addr.sun_path);
  (void)printf(",\"stall_s\":%g,\"clients_max\":%d,\"pid\":%d}\n", options.stall_s, (int)HUB_CLIENTS_MAX, (int)getpid());
  if (written("ready") != 0) {
    remove_own_socket(options.addr.sun_path, &identity);
    return 1;
  }

  serve(&hub, listener, signals, &options.stall_s);

  hub_close(&hub);
  remove_own_socket(options.addr.sun_path, &identity);
  (void)close(listener);
  return say_final(&hub.counters) == 0 ? 0 : 1;
}
