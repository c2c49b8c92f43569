/* What the innovations can say about a sensor. The codes are the bus's (dbc: sensor_w_fault). */
#ifndef SENSOR_FAULT_H
#define SENSOR_FAULT_H

typedef enum {
    SENSOR_OK = 0,
    SENSOR_OFFSET = 1,  /* stepped away and stays there */
    SENSOR_NOISE = 2,   /* far noisier than it should be */
    SENSOR_STUCK = 3,   /* the same value again and again */
    SENSOR_DROPOUT = 4, /* no value, or one no winding can have (open or short circuit) */
    SENSOR_SPIKE = 5,   /* single values far out */
    SENSOR_DRIFT = 6,   /* creeps away */
    SENSOR_SLOW = 7,    /* late or lagging: the innovation follows the rate of change */
} sensor_class_t;

#endif
