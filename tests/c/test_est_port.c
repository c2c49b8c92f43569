/* The estimator's cycle on a bus port whose other end is this program; run by tests/unit/test_est_port.py.
 *
 * Prints "ok", or the check that failed and exits with 1. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
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

static const int64_t MS = 1000000;
static est_cycle cycle;
static est_port state;
static can_port_t port;
static est_io io;
static e2e_sender_t motor_sender;
static int hub;

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
    const rt_task_config config = {.period_ns = 100 * MS, .deadline_ns = 100 * MS, .warmup_releases = 5, .virtual_time = true};
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

int main(void) {
    a_storm_of_error_frames_hides_nothing();
    puts("ok");
    return 0;
}
