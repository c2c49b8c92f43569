#include "rt_stats.h"

#include <math.h>
#include <string.h>

const uint32_t rt_stats_quantile_per_10k[RT_STATS_QUANTILES] = {5000, 9000, 9900, 9990, 9999};
const char *const rt_stats_quantile_name[RT_STATS_QUANTILES] = {"p50", "p90", "p99", "p99.9", "p99.99"};

enum { SUB = 1 << RT_STATS_SUB_BITS };

/* Octave 0 is the linear part [0, 64); octave j >= 1 holds [2^(5+j), 2^(6+j)) in steps of 2^(j-1). */
static size_t bucket_of(uint64_t value) {
    if (value < SUB) {
        return (size_t)value;
    }
    const unsigned top = 63U - (unsigned)__builtin_clzll(value);
    const unsigned shift = top - RT_STATS_SUB_BITS;
    return ((size_t)(shift + 1U) << RT_STATS_SUB_BITS) + (size_t)((value >> shift) - SUB);
}

void rt_stats_bucket_bounds(size_t i, int64_t *low_ns, int64_t *high_ns) {
    const size_t octave = i >> RT_STATS_SUB_BITS;
    const int64_t slot = (int64_t)(i & (SUB - 1U));
    const unsigned shift = octave == 0 ? 0 : (unsigned)(octave - 1U);
    *low_ns = (octave == 0 ? slot : SUB + slot) * ((int64_t)1 << shift);
    *high_ns = *low_ns + ((int64_t)1 << shift);
}

static int64_t bucket_middle(size_t bucket) {
    int64_t low_ns = 0;
    int64_t high_ns = 0;
    rt_stats_bucket_bounds(bucket, &low_ns, &high_ns);
    return low_ns + (high_ns - low_ns - 1) / 2;
}

void rt_stats_init(rt_stats *self) {
    memset(self, 0, sizeof *self);
}

void rt_stats_add(rt_stats *self, int64_t value_ns, uint64_t index) {
    if (self->count == 0 || value_ns < self->min_ns) {
        self->min_ns = value_ns;
        self->min_index = index;
    }
    if (self->count == 0 || value_ns > self->max_ns) {
        self->max_ns = value_ns;
        self->max_index = index;
    }
    self->count++;
    const double value = (double)value_ns;
    const double before = value - self->mean_ns;
    self->mean_ns += before / (double)self->count;
    self->m2_ns2 += before * (value - self->mean_ns);
    if (value_ns < 0) {
        self->underflow++;
    } else if (value_ns >= ((int64_t)1 << RT_STATS_MAX_BITS)) {
        self->overflow++;
    } else {
        self->bucket[bucket_of((uint64_t)value_ns)]++;
    }
}

rt_quantile_status rt_stats_quantile(const rt_stats *self, uint32_t per_10k, int64_t *value_ns) {
    /* n·(1 - p) >= 1, in integers; below that the "quantile" would just be the maximum under another name. */
    if (per_10k == 0 || per_10k >= 10000 || self->count * (uint64_t)(10000U - per_10k) < 10000U) {
        return RT_QUANTILE_NA;
    }
    const uint64_t rank = (self->count * per_10k + 9999U) / 10000U;
    if (rank <= self->underflow) {
        *value_ns = self->min_ns;
        return RT_QUANTILE_UNDERFLOW;
    }
    uint64_t seen = self->underflow;
    for (size_t i = 0; i < RT_STATS_BUCKETS; i++) {
        seen += self->bucket[i];
        if (seen >= rank) {
            int64_t middle = bucket_middle(i);
            middle = middle < self->min_ns ? self->min_ns : middle;
            *value_ns = middle > self->max_ns ? self->max_ns : middle;
            return RT_QUANTILE_OK;
        }
    }
    *value_ns = self->max_ns;
    return RT_QUANTILE_OVERFLOW;
}

void rt_stats_merge(rt_stats *self, const rt_stats *other) {
    if (other->count == 0) {
        return;
    }
    if (self->count == 0) {
        *self = *other;
        return;
    }
    if (other->min_ns < self->min_ns) {
        self->min_ns = other->min_ns;
        self->min_index = other->min_index;
    }
    if (other->max_ns > self->max_ns) {
        self->max_ns = other->max_ns;
        self->max_index = other->max_index;
    }
    const double here = (double)self->count;
    const double there = (double)other->count;
    const double apart = other->mean_ns - self->mean_ns;
    self->mean_ns += apart * there / (here + there);
    self->m2_ns2 += other->m2_ns2 + apart * apart * here * there / (here + there);
    self->count += other->count;
    self->underflow += other->underflow;
    self->overflow += other->overflow;
    for (size_t i = 0; i < RT_STATS_BUCKETS; i++) {
        self->bucket[i] += other->bucket[i];
    }
}

void rt_stats_summary(const rt_stats *self, rt_summary *out) {
    memset(out, 0, sizeof *out);
    out->count = self->count;
    out->underflow = self->underflow;
    out->overflow = self->overflow;
    out->min_ns = self->min_ns;
    out->max_ns = self->max_ns;
    out->min_index = self->min_index;
    out->max_index = self->max_index;
    out->mean_ns = self->mean_ns;
    out->std_ns = self->count > 1 ? sqrt(self->m2_ns2 / (double)(self->count - 1)) : 0.0;
    for (size_t i = 0; i < RT_STATS_QUANTILES; i++) {
        out->quantile_status[i] = rt_stats_quantile(self, rt_stats_quantile_per_10k[i], &out->quantile_ns[i]);
    }
}

void rt_recent_init(rt_recent *self) {
    memset(self, 0, sizeof *self);
}

void rt_recent_add(rt_recent *self, int64_t at_ns, int64_t value_ns, uint64_t index) {
    self->sample[self->head].at_ns = at_ns;
    self->sample[self->head].value_ns = value_ns;
    self->sample[self->head].index = index;
    self->head = (self->head + 1U) % RT_RECENT_CAPACITY;
    if (self->used < RT_RECENT_CAPACITY) {
        self->used++;
    }
}

void rt_recent_summary(const rt_recent *self, int64_t now_ns, int64_t span_ns, rt_stats *scratch, rt_summary *out) {
    rt_stats_init(scratch);
    const uint32_t oldest = (self->head + RT_RECENT_CAPACITY - self->used) % RT_RECENT_CAPACITY;
    for (uint32_t i = 0; i < self->used; i++) {
        const uint32_t slot = (oldest + i) % RT_RECENT_CAPACITY;
        const int64_t at_ns = self->sample[slot].at_ns;
        if (at_ns <= now_ns && now_ns - at_ns < span_ns) {
            rt_stats_add(scratch, self->sample[slot].value_ns, self->sample[slot].index);
        }
    }
    rt_stats_summary(scratch, out);
}
