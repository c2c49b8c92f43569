/* A recorded stream of calls to the MHE: records of doubles, [op, payload length, payload ...], one after another.
 *
 * The payload is what the call was given; what it returned is not kept, so any build can be driven by the stream and is free to
 * be right or wrong on its own. NET_MEMORY is the recording net's. */
#ifndef STREAM_H
#define STREAM_H

enum {
    STREAM_INIT = 1,    /* STREAM_SETTING doubles: begin a segment */
    STREAM_START = 2,   /* prior[2] memory[NET_MEMORY] */
    STREAM_ADVANCE = 3, /* u[2] */
    STREAM_ARRIVAL = 4, /* prior[2] weight[2], then memory[NET_MEMORY] or nothing */
    STREAM_MEASURE = 5, /* age channel y share */
    STREAM_FORGET = 6,  /* channel nodes */
    STREAM_SHIFT = 7,   /* channel shift */
    STREAM_WEIGH = 8,   /* noise weight[2] loss scale */
    STREAM_SOLVE = 9,   /* nothing: end of a step */
};

/* Places in the payload of STREAM_INIT: the fields of est_setting_t that the MHE reads, and the sensor's delay. */
enum {
    SETTING_MEASUREMENT = 0,
    SETTING_NOISE = 2,
    SETTING_ARRIVAL = 4,
    SETTING_PRIOR = 6,
    SETTING_LOSS = 8,
    SETTING_LOSS_SCALE,
    SETTING_HARD,
    SETTING_LOWER,
    SETTING_UPPER,
    SETTING_BOUND_WEIGHT,
    SETTING_MAX_SWEEPS,
    SETTING_TOLERANCE,
    SETTING_NEWEST,
    SETTING_DELAY_STEPS,
    STREAM_SETTING,
};

#endif
