/* The offset of both sensors, measured at key-on: a machine that has stood long enough has the coolant's temperature
 * everywhere, so the mean of measurement minus coolant over ten seconds is the offset. Then it is frozen: while
 * driving an offset cannot be told from an error of the model.
 *
 * No allocation, no clock, no printing; one thread at a time per object; the caller owns the memory. */
#ifndef OFFSET_CALIBRATION_H
#define OFFSET_CALIBRATION_H

#include <stdbool.h>
#include <stdint.h>

enum { CALIBRATION_CHANNELS = 2 };

typedef enum {
    CALIBRATION_DATASHEET = 0, /* the setting's offset is in use */
    CALIBRATION_MEASURING = 1, /* key-on with the machine at coolant temperature: averaging */
    CALIBRATION_FROZEN = 2,    /* the measured offset is in use and stays */
    CALIBRATION_REFUSED = 3,   /* measured, but of at least one sensor not believable: the datasheet's stays in use,
                                * as uncertain as what was measured is large */
} calibration_state_t;

/* What is being subtracted. */
typedef struct {
    calibration_state_t state;
    double offset_degc[CALIBRATION_CHANNELS];
    double sigma_degc[CALIBRATION_CHANNELS]; /* its standard deviation */
} estimator_calibration_t;

typedef struct {
    bool enabled, soaked;
    double datasheet_degc, coolant_degc;
    int32_t age;               /* values since the last coolant temperature */
    int32_t wait;              /* values still to pass: they speak for the time before key-on */
    int32_t count[CALIBRATION_CHANNELS];
    double mean[CALIBRATION_CHANNELS], m2[CALIBRATION_CHANNELS];
    estimator_calibration_t result;
} offset_calibration_t;

/* Start with the datasheet's offset and its uncertainty; enabled = false keeps them for good. Sensors report
 * `delay_steps` values late. */
void offset_calibration_init(offset_calibration_t *self, double datasheet_degc, double sigma_degc, int32_t delay_steps,
                             bool enabled);

/* Coolant temperature (NAN: none, ignored), and whether the machine has soaked. The end of the soak, or 2.5 s without
 * a coolant temperature, before ten seconds of values ends the calibration without a result. */
void offset_calibration_coolant(offset_calibration_t *self, double coolant_degc, bool soaked);

/* The machine turns or gives torque: a calibration under way ends without a result. */
void offset_calibration_moving(offset_calibration_t *self);

/* Values as the sensors gave them (NAN: none). True: the offset has just changed. */
bool offset_calibration_measure(offset_calibration_t *self, const double raw[CALIBRATION_CHANNELS]);

#endif
