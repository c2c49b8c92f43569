/* Sends recorded frames in real time and takes the time until each question is answered.
 *
 *   bench_loop_probe BUS SPEED ASK ANSWER CORE PRIORITY [COLLECT...] < records
 *
 * Records are those of rt_record.h; SPEED times as fast as they say. A question is a frame with the id ASK. Its answer is
 * the first frame with the id ANSWER whose last two bytes (a tick) are the question's, or up to nine later. The time counts
 * from before the question is sent to the kernel's stamp of the answer's arrival here, so that our own wake-up is no part
 * of it. Payloads of the ids COLLECT are kept. Ids in hex.
 *
 * Last line of stdout: {"asked", "unanswered", "late_ms" (the worst sending), "tx_drops", "rx_drops", "rtt_ns": […],
 * "frames": {"2A8": ["hex", …]}}. Exit status 1 with one line when something cannot be had. */
#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "can_port.h"
#include "rt_clock.h"
#include "rt_grant.h"
#include "rt_record.h"

enum { RECORDS_MAX = 400000, KEPT_MAX = 200000, COLLECT_MAX = 8, LATER_TICKS = 9, START_MS = 20, END_MS = 200 };
static const int64_t NS_PER_MS = 1000000, NS_PER_S = 1000000000;

typedef struct {
    canid_t id;
    uint8_t data[8];
} kept_frame;

typedef struct {
    can_port_t port;
    canid_t ask, answer, collect[COLLECT_MAX];
    size_t collects;
    bool waiting;
    uint16_t tick;
    int64_t asked_ns;
    uint64_t asked, unanswered;
    int64_t late_ns;
    size_t times, kept;
    int64_t rtt_ns[KEPT_MAX];
    kept_frame frames[KEPT_MAX];
} probe;

static probe self;
static rt_record records[RECORDS_MAX];

static int fail(const char *what, const char *why) {
    (void)fprintf(stderr, "bench_loop_probe: %s: %s\n", what, why);
    return EXIT_FAILURE;
}

static uint16_t tick_of(const uint8_t *data) {
    return (uint16_t)(data[6] | data[7] << 8);
}

static void take(const struct canfd_frame *frame, int64_t rx_ns) {
    for (size_t i = 0; i < self.collects; i++) {
        if (frame->can_id == self.collect[i] && self.kept < KEPT_MAX) {
            self.frames[self.kept].id = frame->can_id;
            memcpy(self.frames[self.kept++].data, frame->data, 8);
        }
    }
    const uint16_t later = (uint16_t)(tick_of(frame->data) - self.tick);
    if (self.waiting && frame->can_id == self.answer && later <= LATER_TICKS && self.times < KEPT_MAX) {
        self.rtt_ns[self.times++] = rx_ns - self.asked_ns;
        self.waiting = false;
    }
}

static bool read_all(void) {
    struct canfd_frame frame;
    int64_t rx_ns = 0;
    can_port_status_t status = CAN_PORT_OK;
    while (status == CAN_PORT_OK || status == CAN_PORT_SKIPPED) {
        status = can_port_recv(&self.port, &frame, &rx_ns);
        if (status == CAN_PORT_OK) {
            take(&frame, rx_ns);
        }
    }
    return status == CAN_PORT_EMPTY;
}

/* Reads until `at_ns` (CLOCK_MONOTONIC); false: the bus is gone. */
static bool read_until(const rt_clock *clock, int64_t at_ns) {
    for (;;) {
        const int64_t left_ns = at_ns - clock->now_ns(clock->ctx);
        if (left_ns <= 0) {
            return true;
        }
        struct pollfd wait = {.fd = self.port.fd, .events = POLLIN};
        const struct timespec left = {.tv_sec = (time_t)(left_ns / NS_PER_S), .tv_nsec = (long)(left_ns % NS_PER_S)};
        if (ppoll(&wait, 1, &left, NULL) > 0 && !read_all()) {
            return false;
        }
    }
}

static bool send_record(const rt_record *record) {
    const bool question = record->frame.can_id == self.ask;
    struct canfd_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.can_id = record->frame.can_id;
    frame.len = record->frame.len;
    memcpy(frame.data, record->frame.data, 8);
    if (question) {
        self.unanswered += self.waiting ? 1U : 0U;
        self.tick = tick_of(frame.data);
        self.asked_ns = rt_clock_realtime_ns();
    }
    const can_port_status_t status = can_port_send(&self.port, &frame);
    if (question) {
        self.waiting = status == CAN_PORT_OK;
        self.asked += self.waiting ? 1U : 0U;
    }
    return status != CAN_PORT_GONE;
}

/* False: the bus is gone. */
static bool run(size_t count, double speed) {
    const rt_clock clock = rt_clock_system();
    const int64_t t0_ns = clock.now_ns(clock.ctx) + START_MS * NS_PER_MS;
    int64_t due_ns = t0_ns;
    for (size_t i = 0; i < count; i++) {
        due_ns = t0_ns + (int64_t)((double)(records[i].t_ns - records[0].t_ns) / speed);
        if (!read_until(&clock, due_ns)) {
            return false;
        }
        const int64_t late_ns = clock.now_ns(clock.ctx) - due_ns;
        self.late_ns = late_ns > self.late_ns ? late_ns : self.late_ns;
        if (!send_record(&records[i])) {
            return false;
        }
    }
    return read_until(&clock, due_ns + END_MS * NS_PER_MS);
}

static void print_figures(void) {
    (void)printf("{\"asked\":%" PRIu64 ",\"unanswered\":%" PRIu64 ",\"late_ms\":%.3f,\"tx_drops\":%" PRIu64
                 ",\"rx_drops\":%" PRIu64 ",\"rtt_ns\":[",
                 self.asked, self.unanswered + (self.waiting ? 1U : 0U), (double)self.late_ns * 1e-6,
                 self.port.counters.tx_drops, self.port.counters.rx_drops);
    for (size_t i = 0; i < self.times; i++) {
        (void)printf("%s%" PRId64, i > 0 ? "," : "", self.rtt_ns[i]);
    }
    (void)printf("],\"frames\":{");
    for (size_t k = 0; k < self.collects; k++) {
        const char *comma = "";
        (void)printf("%s\"%" PRIX32 "\":[", k > 0 ? "," : "", self.collect[k]);
        for (size_t i = 0; i < self.kept; i++) {
            if (self.frames[i].id == self.collect[k]) {
                const uint8_t *d = self.frames[i].data;
                (void)printf("%s\"%02x%02x%02x%02x%02x%02x%02x%02x\"", comma, d[0], d[1], d[2], d[3], d[4], d[5], d[6],
                             d[7]);
                comma = ",";
            }
        }
        (void)printf("]");
    }
    (void)printf("}}\n");
}

int main(int argc, char **argv) {
    static rt_record_reader reader;
    rt_granted granted;
    size_t count = 0;
    if (argc < 7 || argc > 7 + COLLECT_MAX) {
        return fail("usage", "bench_loop_probe BUS SPEED ASK ANSWER CORE PRIORITY [COLLECT...] < records");
    }
    const double speed = strtod(argv[2], NULL);
    const rt_request request = {.core = atoi(argv[5]), .priority = atoi(argv[6]), .real_time = true};
    self.ask = (canid_t)strtoul(argv[3], NULL, 16);
    self.answer = (canid_t)strtoul(argv[4], NULL, 16);
    for (int i = 7; i < argc; i++) {
        self.collect[self.collects++] = (canid_t)strtoul(argv[i], NULL, 16);
    }
    rt_record_reader_init(&reader, STDIN_FILENO);
    while (count < RECORDS_MAX && rt_record_read(&reader, &records[count]) == RT_RECORD_OK) {
        count++;
    }
    if (count == 0 || count == RECORDS_MAX || !(speed > 0.0)) {
        return fail("stdin", "no records, or too many, or a speed that is not above 0");
    }
    if (can_port_open(&self.port, argv[1]) != CAN_PORT_OK) {
        return fail("bus", self.port.error);
    }
    rt_grant_apply(&request, &granted);
    const bool done = run(count, speed);
    print_figures();
    can_port_close(&self.port);
    return done ? EXIT_SUCCESS : fail("bus", self.port.error);
}
