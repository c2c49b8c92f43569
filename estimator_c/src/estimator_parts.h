/* What estimator.c (start, steps), estimator_feed.c (frames in) and estimator_publish.c (what is said) share; for
 * these three alone. Nothing here fails; cost as said, threads and memory as in estimator.h. */
#ifndef ESTIMATOR_PARTS_H
#define ESTIMATOR_PARTS_H

#include <stddef.h>

#include "estimator.h"

/* Where interval or node k stands in the rings. */
static inline size_t estimator_slot(int64_t k)
{
    return (size_t)(k & (ESTIMATOR_RING - 1));
}

/* Begin again, all but the setting, the counters and the sensors' offset unknown; the same plant: what is known of a
 * sensor that is not believed stays known, too. < 10 us. */
void estimator_restart(estimator_t *self, bool same_plant);

/* No node has a measurement. < 1 us. */
void estimator_forget_measured(estimator_t *self);

/* A measurement for the newest node, offset removed. Cost of fusion_measure(). */
void estimator_measure(estimator_t *self, int channel, double y);

/* Fill in what is known now: all of *out but the ticks and what the steps' solutions said. At most one net step. */
void estimator_publish(const estimator_t *self, estimator_out_t *out);

#endif
