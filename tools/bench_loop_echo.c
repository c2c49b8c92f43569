/* The yardstick of a round trip: one frame in, one frame out, nothing between.
 *
 *   bench_loop_echo BUS LISTEN ANSWER CORE PRIORITY
 *
 * Set up as the estimator is: core, SCHED_FIFO, locked memory. Ids in hex; the filter passes LISTEN alone. First line of
 * stdout: what the system granted; last line, after SIGTERM: how many frames were answered. Exit status 1 with one line
 * when the bus is gone. */
#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "can_port.h"
#include "rt_grant.h"

static volatile sig_atomic_t stop_requested;

static void on_stop(int signal_number) {
    (void)signal_number;
    stop_requested = 1;
}

/* Answers what has come; the bus's state. */
static can_port_status_t answer(can_port_t *port, canid_t listen, canid_t id, uint64_t *answered) {
    struct canfd_frame frame;
    can_port_status_t status = CAN_PORT_OK;
    while (status == CAN_PORT_OK || status == CAN_PORT_SKIPPED) {
        status = can_port_recv(port, &frame, NULL);
        if (status == CAN_PORT_OK && frame.can_id == listen) {
            frame.can_id = id;
            *answered += can_port_send(port, &frame) == CAN_PORT_OK ? 1U : 0U;
        }
    }
    return status;
}

int main(int argc, char **argv) {
    static can_port_t port;
    rt_granted granted;
    uint64_t answered = 0;
    if (argc != 6) {
        (void)fputs("usage: bench_loop_echo BUS LISTEN ANSWER CORE PRIORITY\n", stderr);
        return EXIT_FAILURE;
    }
    const canid_t listen = (canid_t)strtoul(argv[2], NULL, 16), id = (canid_t)strtoul(argv[3], NULL, 16);
    const rt_request request = {.core = atoi(argv[4]), .priority = atoi(argv[5]), .real_time = true};
    const struct can_filter filter = {.can_id = listen, .can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_SFF_MASK};
    struct sigaction stop;
    memset(&stop, 0, sizeof stop);
    stop.sa_handler = on_stop;
    (void)sigaction(SIGTERM, &stop, NULL);
    (void)sigaction(SIGINT, &stop, NULL);
    if (can_port_open(&port, argv[1]) != CAN_PORT_OK || can_port_filter(&port, &filter, 1) != CAN_PORT_OK) {
        (void)fprintf(stderr, "bench_loop_echo: %s\n", port.error);
        return EXIT_FAILURE;
    }
    rt_grant_apply(&request, &granted);
    (void)printf("{\"ready\":true,\"policy\":\"%s\",\"core\":%d}\n", rt_policy_name(granted.policy), granted.core);
    (void)fflush(stdout);
    struct pollfd wait = {.fd = port.fd, .events = POLLIN};
    can_port_status_t status = CAN_PORT_EMPTY;
    while (stop_requested == 0 && status == CAN_PORT_EMPTY) {
        if (poll(&wait, 1, -1) > 0) {
            status = answer(&port, listen, id, &answered);
        }
    }
    (void)printf("{\"final\":true,\"answered\":%" PRIu64 ",\"tx_drops\":%" PRIu64 "}\n", answered,
                 port.counters.tx_drops);
    if (status != CAN_PORT_EMPTY) {
        (void)fprintf(stderr, "bench_loop_echo: %s\n", port.error);
    }
    can_port_close(&port);
    return status == CAN_PORT_EMPTY ? EXIT_SUCCESS : EXIT_FAILURE;
}
