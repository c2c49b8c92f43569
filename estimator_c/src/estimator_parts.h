/* What estimator.c (start, steps), estimator_feed.c (frames in), estimator_publish.c (what is said) and
 * estimator_predict.c (what is said when that is too late) share; for these four alone. Nothing here fails; cost as said, threads and memory as in estimator.h. */
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

/* Move theta and the net's memory from node `from` to node `to` with the stored inputs. One net step per node. */
void estimator_run_forward(const estimator_t *self, int64_t from, int64_t to, double theta[MHE_CHANNELS],
                           double memory[NET_MEMORY]);

/* Theta at the newest motor frame, from theta and the net's memory at the newest grid node: moved by the rate for the
 * frames since. At most one net step. */
void estimator_publish_theta(const estimator_t *self, const double node[MHE_CHANNELS], const double before[NET_MEMORY],
                             estimator_out_t *out);

/* Fill in what is known now: all of *out but the ticks and what the steps' solutions said. At most one net step. */
void estimator_publish(const estimator_t *self, estimator_out_t *out);

#endif
