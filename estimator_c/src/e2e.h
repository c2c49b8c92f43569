/* AUTOSAR end-to-end protection, profile 2: CRC-8H2F and a 4-bit counter; twin of rt_runner/e2e.py.
 *
 * Layout of a protected frame: byte 0 the CRC over bytes 1 .. length-1 and a data id, byte 1 low nibble the
 * counter. The data id is the entry of the message's 16-entry list at the frame's counter value; it is never sent.
 * Lists, lengths and max_delta of our frames are in the generated drive_messages[].
 *
 * All functions: constant time for a given length (about 3 ns a byte), no memory, no locks, no system calls; safe
 * from any thread as long as one object is used by one thread at a time. The caller owns every object.
 */
#ifndef E2E_H
#define E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define E2E_COUNTER_STATES 16u
#define E2E_MIN_LENGTH 2u

/* Verdict on a received frame; the values are those of the log. */
typedef enum {
    E2E_OK = 0,             /* in sequence; also the first good frame (AUTOSAR's INITIAL) */
    E2E_REPEATED = 1,       /* same counter as the frame before: nothing new */
    E2E_LOST = 2,           /* good, but up to max_delta - 1 frames before it are missing */
    E2E_WRONG_SEQUENCE = 3, /* good CRC, counter jumped by more than max_delta; the sequence restarts here */
    E2E_WRONG_CRC = 4,      /* damaged, wrong length or sent as another message: believe nothing in it */
    E2E_NO_DATA = 5         /* no good frame yet; a state, never the verdict on a frame */
} e2e_status_t;

/* Sender's side of one message. 16 bytes. */
typedef struct {
    const uint8_t *data_id_list; /* 16 entries, outlives the object */
    uint8_t counter;             /* of the frame sent last */
} e2e_sender_t;

/* Receiver's side of one message. 48 bytes. Counters only grow. */
typedef struct {
    const uint8_t *data_id_list; /* 16 entries, outlives the object */
    uint8_t length;              /* bytes a frame must have */
    uint8_t max_delta;
    uint8_t last_counter;
    e2e_status_t status; /* of the frame checked last, E2E_NO_DATA before the first */
    bool started;        /* a good frame has been seen */
    uint32_t counts[5];  /* frames by verdict, E2E_OK .. E2E_WRONG_CRC */
    uint32_t frames_lost; /* missing before E2E_LOST ones; what a E2E_WRONG_SEQUENCE skipped is unknown */
} e2e_receiver_t;

/* CRC-8 with polynomial 0x2f, start value 0xff, result inverted, over data[0 .. length-1] and then data_id. */
uint8_t e2e_crc8h2f(const uint8_t *data, size_t length, uint8_t data_id);

/* Start a sender; its first frame will carry counter 1 (the profile counts up, then sends). Cannot fail. */
void e2e_sender_init(e2e_sender_t *self, const uint8_t data_id_list[E2E_COUNTER_STATES]);

/* Write the next counter and the CRC into a packed frame, leaving the high nibble of byte 1 alone.
 * Returns false, and changes nothing, if length < 2. */
bool e2e_protect(e2e_sender_t *self, uint8_t *frame, size_t length);

/* Start a receiver. Returns false, and changes nothing, unless 2 <= length and 1 <= max_delta <= 14. */
bool e2e_receiver_init(e2e_receiver_t *self, const uint8_t data_id_list[E2E_COUNTER_STATES], uint8_t length,
                       uint8_t max_delta);

/* Judge a received frame and count the verdict. A length other than the receiver's gives E2E_WRONG_CRC.
 * Whether a frame that is not E2E_WRONG_CRC is used is the caller's choice; see e2e_is_usable. */
e2e_status_t e2e_check(e2e_receiver_t *self, const uint8_t *frame, size_t length);

/* Whether the frame brings new data that can be believed: E2E_OK, E2E_LOST and E2E_WRONG_SEQUENCE (its content is
 * intact, only the neighbours are missing or out of order). */
static inline bool e2e_is_usable(e2e_status_t status)
{
    return status == E2E_OK || status == E2E_LOST || status == E2E_WRONG_SEQUENCE;
}

#endif
