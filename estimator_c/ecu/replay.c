/* Recorded calls to the MHE, made again on the machine of port.h: the same source on the ECU and on the host.
 *
 * Reads the records of tools/solver_backends/stream.h, every number as real_t, little endian. Writes one `first_t`,
 * then an `answer_t` for each solution. Only the calls into the MHE are counted, reading and writing are not. */
#include <string.h>

#include "mhe.h"
#include "port.h"
#include "stream.h"

#define MAGIC 0x31554345u /* "ECU1" */


/* LEVEL: forget and shift. FEEDBACK and FINISH are mhe_solve() in two. */
enum { PART_ADVANCE, PART_ARRIVAL, PART_MEASURE, PART_LEVEL, PART_FEEDBACK, PART_FINISH, PARTS };

typedef struct {
    uint32_t magic, real_bytes, memory, state_bytes;
    uint32_t reading;         /* ticks of two readings of the counter with nothing between */
    uint32_t loop_1k, loop_3k; /* ticks of port_known_loop(1000), (3000) */
    uint32_t reserved;
} first_t;

typedef struct {
    int32_t status, sweeps, active, count;
    uint32_t ticks[PARTS]; /* since the last solution, readings of the counter taken out */
    uint32_t stack_bytes;  /* deepest call of the step, with the caller's arguments */
    uint32_t window_hash;  /* of every bit of the window's temperatures and memories */
    real_t theta[MHE_CHANNELS];
    real_t kkt_degc;
    real_t innovation[MHE_CHANNELS]; /* of the last measurement attached */
    real_t padding;
} answer_t;

enum { PAYLOAD = STREAM_SETTING > 4 + NET_MEMORY ? STREAM_SETTING : 4 + NET_MEMORY };

static mhe_t mhe; /* the step's state: alone in .bss, the rest of this file's data is the bench's */
static real_t payload[PAYLOAD] __attribute__((section(".bss.bench")));
static answer_t answer __attribute__((section(".bss.bench")));
static est_setting_t setting __attribute__((section(".bss.bench")));
static uint32_t reading __attribute__((section(".bss.bench")));

static uint32_t hash_of(uint32_t hash, const void *data, size_t bytes)
{
    const uint8_t *byte = data; /* FNV-1a */
    for (size_t k = 0; k < bytes; k++) {
        hash = (hash ^ byte[k]) * 16777619u;
    }
    return hash;
}

static uint32_t window_hash(void)
{
    uint32_t hash = 2166136261u;
    for (int age = 0; age < mhe.count; age++) {
        const mhe_node_t *node = mhe_node(&mhe, age);
        hash = hash_of(hash, node->theta, sizeof node->theta);
        hash = hash_of(hash, node->memory, NET_MEMORY * sizeof node->memory[0]);
    }
    return hash;
}

static void begin(void)
{
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        setting.weight_measurement[ch] = (double)payload[SETTING_MEASUREMENT + ch];
        setting.weight_noise[ch] = (double)payload[SETTING_NOISE + ch];
        setting.weight_arrival[ch] = (double)payload[SETTING_ARRIVAL + ch];
        setting.weight_prior[ch] = (double)payload[SETTING_PRIOR + ch];
    }
    setting.loss = (int32_t)payload[SETTING_LOSS];
    setting.loss_scale_degc = (double)payload[SETTING_LOSS_SCALE];
    setting.hard_bounds = (int32_t)payload[SETTING_HARD] != 0;
    setting.lower_degc = (double)payload[SETTING_LOWER];
    setting.upper_degc = (double)payload[SETTING_UPPER];
    setting.bound_weight = (double)payload[SETTING_BOUND_WEIGHT];
    setting.max_sweeps = (int32_t)payload[SETTING_MAX_SWEEPS];
    setting.tolerance_degc = (double)payload[SETTING_TOLERANCE];
    setting.newest_measurement = (int32_t)payload[SETTING_NEWEST] != 0;
    setting.delay_steps = (int32_t)payload[SETTING_DELAY_STEPS];
    mhe_init(&mhe, &setting);
    if (payload[SETTING_TOLERANCE] < 0) {
        mhe.tolerance = payload[SETTING_TOLERANCE]; /* every sweep is made: mhe_init() holds it above rounding */
    }
}

/* One call into the MHE has ended. */
static void count(int part, uint32_t begun)
{
    const uint32_t ticks = port_ticks() - begun;
    const uint32_t depth = port_stack_depth();
    answer.ticks[part] += ticks > reading ? ticks - reading : 0u;
    answer.stack_bytes = depth > answer.stack_bytes ? depth : answer.stack_bytes;
}

static void solve(void)
{
    mhe_result_t result;
    port_stack_paint();
    uint32_t begun = port_ticks();
    mhe_status_t status = mhe_feedback(&mhe, &result);
    count(PART_FEEDBACK, begun);
    if (status != MHE_INVALID) {
        port_stack_paint();
        begun = port_ticks();
        status = mhe_finish(&mhe, &result);
        count(PART_FINISH, begun);
    }
    answer.status = (int32_t)status;
    answer.sweeps = result.sweeps;
    answer.active = result.active;
    answer.count = mhe.count;
    answer.kkt_degc = result.kkt_degc;
    for (int ch = 0; ch < MHE_CHANNELS; ch++) {
        answer.theta[ch] = result.theta[ch];
    }
    answer.window_hash = window_hash();
    port_write(&answer, sizeof answer);
    memset(&answer, 0, sizeof answer);
}

/* Carry out one record; false: it is none that this build knows. */
static bool call(int op, int length)
{
    const real_t *p = payload;
    const int channel = op == STREAM_MEASURE ? (int)p[1] : (int)p[0];
    if ((op == STREAM_MEASURE || op == STREAM_FORGET || op == STREAM_SHIFT) &&
        (channel < 0 || channel >= MHE_CHANNELS)) {
        return false;
    }
    port_stack_paint();
    const uint32_t begun = port_ticks();
    switch (op) {
    case STREAM_ADVANCE:
        mhe_advance(&mhe, p);
        count(PART_ADVANCE, begun);
        return length == 2;
    case STREAM_ARRIVAL:
        mhe_arrival(&mhe, p, p + 2, length > 4 ? p + 4 : NULL);
        count(PART_ARRIVAL, begun);
        return length == 4 || length == 4 + NET_MEMORY;
    case STREAM_MEASURE: {
        const real_t innovation = mhe_measure(&mhe, (int)p[0], channel, p[2], p[3]);
        count(PART_MEASURE, begun);
        answer.innovation[channel] = innovation;
        return length == 4;
    }
    case STREAM_FORGET:
        mhe_forget(&mhe, channel, (int)p[1]);
        count(PART_LEVEL, begun);
        return length == 2;
    case STREAM_SHIFT:
        mhe_shift(&mhe, channel, p[1]);
        count(PART_LEVEL, begun);
        return length == 2;
    case STREAM_WEIGH:
        mhe_weigh(&mhe, p, p[2]);
        count(PART_LEVEL, begun);
        return length == 3;
    case STREAM_INIT:
        begin();
        return length == STREAM_SETTING;
    case STREAM_START:
        mhe_start(&mhe, p, p + 2);
        return length == 2 + NET_MEMORY;
    case STREAM_SOLVE:
        solve();
        return length == 0;
    default:
        return false;
    }
}

int main(void)
{
    port_open();
    const uint32_t begun = port_ticks();
    reading = port_ticks() - begun;
    const first_t first = {
        .magic = MAGIC,
        .real_bytes = sizeof(real_t),
        .memory = NET_MEMORY,
        .state_bytes = sizeof(mhe_t),
        .reading = reading,
        .loop_1k = port_known_loop(1000),
        .loop_3k = port_known_loop(3000),
    };
    port_write(&first, sizeof first);
    memset(&answer, 0, sizeof answer);
    real_t head[2];
    while (port_read(head, sizeof head)) {
        const int length = (int)head[1];
        if (length < 0 || length > PAYLOAD || !port_read(payload, (size_t)length * sizeof payload[0]) ||
            !call((int)head[0], length)) {
            port_exit(PORT_BAD_STREAM);
        }
    }
    port_exit(PORT_DONE);
}
