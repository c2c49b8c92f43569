/* The estimator's cycle on a bus port whose other end is this program; run by tests/unit/test_est_port.py.
 *
 * Prints "ok", or the check that failed and exits with 1. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "est_cycle.h"
#include "est_port.h"
#include "rt_clock.h"

#define CHECK(condition)                                                             \
    do {                                                                             \
        if (!(condition)) {                                                          \
            fprintf(stderr, "%s:%d: %s is false\n", __FILE__, __LINE__, #condition); \
            exit(1);                                                                 \
        }                                                                            \
    } while (0)

enum { MS = 1000000 };
static est_cycle cycle;
static est_port state;
static can_port_t port;
static est_io io;
static e2e_sender_t motor_sender;
static int hub;
static int64_t wall_shift_s; /* somebody has set the wall clock; the kernel's stamps are from before */

int clock_gettime(clockid_t id, struct timespec *ts) {
    const int rc = (int)syscall(SYS_clock_gettime, id, ts);
    ts->tv_sec += id == CLOCK_REALTIME ? (time_t)wall_shift_s : 0;
    return rc;
}

static int64_t now_ns(void) {
    const rt_clock clock = rt_clock_system();
    return clock.now_ns(clock.ctx);
}

static void sleep_ms(long ms) {
    const struct timespec t = {.tv_nsec = ms * MS};
    CHECK(nanosleep(&t, NULL) == 0);
}

static void connect_port(void) {
    int pair[2];
    const int on = 1;
    CHECK(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, pair) == 0);
    hub = pair[1];
    memset(&port, 0, sizeof port);
    port.fd = pair[0];
    port.hub = true;
    CHECK(setsockopt(port.fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) == 0);
    io = est_port_io(&state, &port);
    e2e_sender_init(&motor_sender, drive_messages[DRIVE_INDEX_MOTOR_STATE].data_id_list);
}

static void disconnect_port(void) {
    can_port_close(&port);
    CHECK(close(hub) == 0);
}

static void start_cycle(void) {
    const rt_task_config config = {.period_ns = 100 * (int64_t)MS, .deadline_ns = 100 * (int64_t)MS, .warmup_releases = 5, .virtual_time = true};
    const rt_clock clock = rt_clock_system();
    const est_identity identity = {.core = -1, .period_us = 100000};
    CHECK(est_cycle_init(&cycle, &config, &clock, est_setting_find("default"), &io, &identity) == EST_CYCLE_OK);
}

static void put_motor(uint16_t tick) {
    struct can_frame frame = {.can_id = drive_messages[DRIVE_INDEX_MOTOR_STATE].can_id, .can_dlc = 8};
    const struct drive_motor_state_t raw = {.tick = tick};
    CHECK(drive_motor_state_pack(frame.data, &raw, sizeof frame.data) > 0);
    CHECK(e2e_protect(&motor_sender, frame.data, sizeof frame.data));
    CHECK(send(hub, &frame, sizeof frame, 0) == sizeof frame);
}

static void put_error_frames(int count) {
    const struct can_frame frame = {.can_id = CAN_ERR_FLAG | 0x40, .can_dlc = 8};
    for (int i = 0; i < count; i++) {
        CHECK(send(hub, &frame, sizeof frame, 0) == sizeof frame);
    }
}

static int skips;

static est_io_status always_skipped(void *ctx, struct canfd_frame *frame, int64_t *at_ns) {
    (void)ctx;
    (void)frame;
    (void)at_ns;
    skips++;
    return EST_IO_SKIPPED;
}

/* A job reads past a storm of error frames to the frame behind it, but not without bound. */
static void a_storm_of_error_frames_hides_nothing(void) {
    connect_port();
    start_cycle();
    put_error_frames(3 * CAN_PORT_SKIP_MAX); /* 277 fit into a queue of the default size */
    put_motor(1);
    CHECK(est_cycle_run_released(&cycle) == EST_CYCLE_OK);
    CHECK(cycle.bus.accepted == 1 && port.counters.error_frames == 3 * CAN_PORT_SKIP_MAX);
    est_counters counters;
    est_cycle_counters(&cycle, &counters);
    CHECK(counters.rejected == 3 * CAN_PORT_SKIP_MAX); /* as published */

    io.recv = always_skipped;
    start_cycle();
    CHECK(est_cycle_run_released(&cycle) == EST_CYCLE_OK);
    CHECK(skips == EST_CYCLE_MAX_FRAMES / EST_IO_SKIP_COST);
    disconnect_port();
}

static int64_t arrival(void) {
    struct canfd_frame frame;
    int64_t at_ns = -1;
    CHECK(io.recv(io.ctx, &frame, &at_ns) == EST_IO_OK);
    return at_ns;
}

static void drain(void) {
    struct canfd_frame frame;
    int64_t at_ns;
    CHECK(io.recv(io.ctx, &frame, &at_ns) == EST_IO_EMPTY);
}

/* The offset between the clocks is not spoilt by the time between the start of the job and the reading of the clock. */
static void arrival_is_right_even_if_the_job_was_held_up(void) {
    connect_port();
    io.begin(io.ctx, now_ns());
    drain();
    sleep_ms(100);
    const int64_t before = now_ns();
    put_motor(1);
    const int64_t start = now_ns();
    sleep_ms(50);
    io.begin(io.ctx, start);
    const int64_t at = arrival();
    CHECK(at >= before - MS && at <= start && start - at < 40 * (int64_t)MS);
    disconnect_port();
}

static void no_arrival_is_of_the_future_or_before_the_last_empty_look(void) {
    connect_port();
    const int64_t first = now_ns();
    io.begin(io.ctx, first);
    drain();
    put_motor(1);
    put_motor(2);
    sleep_ms(2);
    wall_shift_s = -3600; /* set back: the stamps lie an hour ahead */
    const int64_t second = now_ns();
    io.begin(io.ctx, second);
    CHECK(arrival() == second);
    wall_shift_s = 3600; /* set forward; the second frame was left in the queue, so the last empty look is the first */
    io.begin(io.ctx, now_ns());
    CHECK(arrival() == first);
    drain();
    wall_shift_s = 0;
    put_motor(3);
    const int64_t put = now_ns();
    sleep_ms(2);
    io.begin(io.ctx, now_ns());
    const int64_t at = arrival();
    CHECK(at > second && at <= put + MS); /* right again */
    disconnect_port();
}

static void a_frame_the_port_refuses_is_counted_as_lost(void) {
    connect_port();
    const struct canfd_frame nonsense = {.can_id = 1, .len = 9};
    est_io_counters counters;
    CHECK(io.send(io.ctx, &nonsense) == EST_IO_FULL);
    io.counters(io.ctx, &counters);
    CHECK(counters.tx_drops == 1 && counters.sent == 0);
    disconnect_port();
}

/* Claimed for the buffer the kernel gives: as many frames as est_port_short_of counts on do fit. */
static void a_second_of_frames_fits_where_it_is_said_to(void) {
    static const int64_t periods_us[] = {1000000, 100000, 10000, 2000, 1000};
    connect_port();
    const struct canfd_frame frame = {.can_id = 1, .len = 8};
    int64_t fit = 0;
    while (io.send(io.ctx, &frame) == EST_IO_OK) {
        fit++;
    }
    CHECK(state.send_buffer_bytes > 0);
    for (size_t i = 0; i < sizeof periods_us / sizeof periods_us[0]; i++) {
        const int64_t needed = EST_CYCLE_FRAMES_PER_JOB + EST_CYCLE_JOB_FRAMES * 1000000 / periods_us[i];
        CHECK(est_port_short_of(&state, periods_us[i]) > 0 || fit >= needed);
    }
    state.send_buffer_bytes = 212992; /* the kernel's default */
    CHECK(est_port_short_of(&state, 100000) == 0 && est_port_short_of(&state, 1000) > 2000000);
    disconnect_port();
}

/* What the other side has not read yet is waited for, but not for ever. */
static void a_flush_ends_when_all_is_read_or_at_its_limit(void) {
    connect_port();
    const struct canfd_frame frame = {.can_id = 1, .len = 8};
    struct can_frame read_here;
    CHECK(est_port_flush(&state, 0));
    for (int i = 0; i < 3; i++) {
        CHECK(io.send(io.ctx, &frame) == EST_IO_OK);
    }
    const int64_t before = now_ns();
    CHECK(!est_port_flush(&state, 20 * (int64_t)MS));
    CHECK(now_ns() - before >= 20 * (int64_t)MS);
    while (recv(hub, &read_here, sizeof read_here, 0) == sizeof read_here) {
    }
    CHECK(est_port_flush(&state, 0));
    CHECK(io.send(io.ctx, &frame) == EST_IO_OK);
    port.hub = false; /* a CAN interface keeps its own queue */
    CHECK(est_port_flush(&state, 0));
    disconnect_port();
}

int main(void) {
    a_flush_ends_when_all_is_read_or_at_its_limit();
    a_frame_the_port_refuses_is_counted_as_lost();
    a_second_of_frames_fits_where_it_is_said_to();
    arrival_is_right_even_if_the_job_was_held_up();
    no_arrival_is_of_the_future_or_before_the_last_empty_look();

    a_storm_of_error_frames_hides_nothing();
    puts("ok");
    return 0;
}
