/* End-to-end protection in C, without Python: table, sequence verdicts, limits, and the generated frame table. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drive_e2e.h"
#include "e2e.h"

#define CHECK(condition)                                                        \
    do {                                                                        \
        if (!(condition)) {                                                     \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition);     \
            exit(1);                                                            \
        }                                                                       \
    } while (0)

static uint8_t crc_bit_by_bit(const uint8_t *data, size_t length, uint8_t data_id)
{
    uint8_t crc = 0xff;
    for (size_t i = 0; i <= length; i++) {
        crc ^= i < length ? data[i] : data_id;
        for (int bit = 0; bit < 8; bit++) {
            crc = (uint8_t)((crc & 0x80u) ? ((uint32_t)crc << 1) ^ 0x2fu : (uint32_t)crc << 1);
        }
    }
    return crc ^ 0xff;
}

static void test_crc(void)
{
    const uint8_t check[] = "12345678";
    CHECK(e2e_crc8h2f(check, 8, '9') == 0xdf); /* published check value of CRC-8H2F over "123456789" */
    uint8_t data[7];
    for (unsigned i = 0; i < 100000; i++) {
        for (size_t k = 0; k < sizeof data; k++) {
            data[k] = (uint8_t)rand();
        }
        const uint8_t id = (uint8_t)rand();
        CHECK(e2e_crc8h2f(data, sizeof data, id) == crc_bit_by_bit(data, sizeof data, id));
    }
    CHECK(e2e_crc8h2f(data, 0, 0x5a) == crc_bit_by_bit(data, 0, 0x5a));
}

static void test_limits(void)
{
    const uint8_t *ids = drive_messages[0].data_id_list;
    uint8_t frame[8] = {0};
    e2e_sender_t sender;
    e2e_sender_init(&sender, ids);
    CHECK(!e2e_protect(&sender, frame, 1));
    CHECK(sender.counter == 0);
    e2e_receiver_t receiver = {0};
    CHECK(!e2e_receiver_init(&receiver, ids, 1, 3));
    CHECK(!e2e_receiver_init(&receiver, ids, 8, 0));
    CHECK(!e2e_receiver_init(&receiver, ids, 8, 15));
    CHECK(e2e_receiver_init(&receiver, ids, 8, 14));
    CHECK(receiver.status == E2E_NO_DATA);
    CHECK(e2e_check(&receiver, frame, 0) == E2E_WRONG_CRC);
    CHECK(e2e_check(&receiver, frame, 7) == E2E_WRONG_CRC);
    CHECK(e2e_check(&receiver, frame, 9) == E2E_WRONG_CRC);
    CHECK(receiver.counts[E2E_WRONG_CRC] == 3);
}

/* What a receiver with max_delta 3 says to frames with these counters. */
static void test_sequence(void)
{
    static const struct {
        uint8_t counter;
        e2e_status_t verdict;
    } script[] = {
        {14, E2E_OK},       {15, E2E_OK},   {0, E2E_OK},   {0, E2E_REPEATED}, {1, E2E_OK},
        {3, E2E_LOST},      {6, E2E_LOST},  {7, E2E_OK},   {11, E2E_WRONG_SEQUENCE}, {12, E2E_OK},
        {11, E2E_WRONG_SEQUENCE}, {12, E2E_OK},
    };
    const uint8_t *ids = drive_messages[DRIVE_INDEX_TEMP_MEAS].data_id_list;
    e2e_receiver_t receiver;
    CHECK(e2e_receiver_init(&receiver, ids, 8, 3));
    uint32_t counts[5] = {0};
    for (size_t i = 0; i < sizeof script / sizeof script[0]; i++) {
        e2e_sender_t sender;
        e2e_sender_init(&sender, ids);
        sender.counter = (uint8_t)(script[i].counter - 1u) & 0x0fu;
        uint8_t frame[8] = {0, 0xa0, 1, 2, 3, 4, 5, (uint8_t)i};
        CHECK(e2e_protect(&sender, frame, sizeof frame));
        CHECK(frame[1] == (0xa0u | script[i].counter));
        CHECK(e2e_check(&receiver, frame, sizeof frame) == script[i].verdict);
        CHECK(receiver.status == script[i].verdict);
        counts[script[i].verdict]++;
        frame[7] ^= 0x40u; /* damage moves nothing */
        CHECK(e2e_check(&receiver, frame, sizeof frame) == E2E_WRONG_CRC);
        counts[E2E_WRONG_CRC]++;
    }
    CHECK(memcmp(counts, receiver.counts, sizeof counts) == 0);
    CHECK(receiver.frames_lost == 1 + 2);
    CHECK(e2e_is_usable(E2E_OK) && e2e_is_usable(E2E_LOST) && e2e_is_usable(E2E_WRONG_SEQUENCE));
    CHECK(!e2e_is_usable(E2E_REPEATED) && !e2e_is_usable(E2E_WRONG_CRC) && !e2e_is_usable(E2E_NO_DATA));
}

static void test_frame_table(void)
{
    for (int i = 0; i < DRIVE_MESSAGE_COUNT; i++) {
        const drive_message_info_t *m = &drive_messages[i];
        CHECK(drive_index_of(m->can_id) == i);
        CHECK(m->length == 8 && m->crc_byte == 0 && m->counter_bit == 8);
        CHECK(m->timeout_ms >= m->cycle_ms && m->cycle_ms > 0);
        CHECK(m->max_delta >= 1 && m->max_delta <= 14);
        CHECK(m->sender < DRIVE_NODE_COUNT);
    }
    CHECK(drive_index_of(0x7ff) == -1);
    CHECK(drive_messages[DRIVE_INDEX_ESTIMATE].per_job);
    CHECK(drive_messages[DRIVE_INDEX_TRUTH_TEMP].simulation_only);
}

static void test_conversions_are_safe(void)
{
    const double values[] = {-INFINITY, -1e300, -1e9, -0.0, 1e9, 1e300, INFINITY};
    for (size_t i = 0; i < sizeof values / sizeof values[0]; i++) {
        const uint16_t theta = drive_estimate_theta_w_est_degc_to_raw(values[i]);
        CHECK(theta <= 65534);
        const int16_t torque = drive_motor_state_torque_nm_to_raw(values[i]);
        CHECK(torque >= -32767);
    }
    CHECK(drive_estimate_theta_w_est_degc_to_raw(NAN) == DRIVE_ESTIMATE_THETA_W_EST_DEGC_NOT_AVAILABLE_CHOICE);
    CHECK(drive_motor_state_torque_nm_to_raw(NAN) == DRIVE_MOTOR_STATE_TORQUE_NM_NOT_AVAILABLE_CHOICE);
    CHECK(isnan(drive_motor_state_torque_nm_to_phys(DRIVE_MOTOR_STATE_TORQUE_NM_NOT_AVAILABLE_CHOICE)));
    CHECK(drive_est_misses_miss_late_to_raw(1e6) == 65535); /* counters stay at the last code */
    CHECK(drive_est_timing_a_release_index_to_raw(1e12) == 0xffffff);
    CHECK(drive_motor_state_tick_to_raw(NAN) == 0);
    CHECK(fabs(drive_estimate_theta_w_est_degc_to_phys(drive_estimate_theta_w_est_degc_to_raw(91.25)) - 91.25) < 1e-12);
}

int main(void)
{
    test_crc();
    test_limits();
    test_sequence();
    test_frame_table();
    test_conversions_are_safe();
    return 0;
}
