/* Does the net know this? Compares what the net is fed with the envelope of its training data.
 *
 * The envelope (generated, train_envelope.h) comes from the weights file: a range for each of the four inputs, one for
 * the mechanical power, and a polytope for the thermal history: the temperatures, how far each stands above its own
 * low-passed past, and the low-passed squares and product of speed and torque, which the losses follow. Novelty is how
 * far out the worst of them is: 1 on the envelope's face, 2 one half-width beyond it. It takes no measurement and costs
 * no memory of the past beyond five numbers.
 *
 * No allocation, no clock, no printing; one thread at a time per object; the caller owns the memory. */
#ifndef VALIDITY_H
#define VALIDITY_H

#include <stdbool.h>
#include <stdint.h>

#include "train_envelope.h"

typedef enum {
    VALIDITY_NOT_AVAILABLE = 0, /* the weights file carries no envelope, or nothing has been estimated yet */
    VALIDITY_SETTLING = 1,      /* ranges and power are judged, the thermal history is still too short */
    VALIDITY_JUDGED = 2,        /* everything is judged */
} validity_scope_t;

typedef struct {
    validity_scope_t scope;
    bool outside_speed, outside_torque, outside_theta_w, outside_theta_r;
    bool outside_joint;         /* power or thermal history: each input may look normal alone */
    double novelty;             /* >= 0, > 1 if and only if one of the flags is set; NAN: not available */
} validity_result_t;

typedef struct {
    int32_t steps;              /* of history */
    double slow[ENVELOPE_SLOW];
    validity_result_t result;   /* of the last step */
} validity_t;

/* Forget the history: result not available. Never fails. */
void validity_init(validity_t *self);

/* One step of the net's rate with its input u = [speed rpm, torque Nm] and temperatures in degC. Updates self->result.
 * About 700 instructions, the same whatever the data. A value that is not finite makes everything outside and the
 * history start again. Never fails. */
void validity_step(validity_t *self, const double u[2], const double theta[2]);

#endif
