/* Statistics of a duration in fixed memory: count, min, max, mean, std and quantiles.
 *
 * All values are integer nanoseconds. The histogram is log-linear: values below 64 have a bucket of their own, above
 * that every octave [2^k, 2^(k+1)) is cut into 64 equal buckets up to 2^40 ns (18 minutes). A quantile is the middle
 * of its bucket, so it is at most 1/128 = 0.8 % away from the exact nearest-rank quantile. Negative values are
 * counted as underflow and values from 2^40 on as overflow, never folded into the end buckets.
 *
 * Nothing here allocates, locks, prints or reads a clock. An object belongs to one thread. */
#ifndef RT_STATS_H
#define RT_STATS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    RT_STATS_SUB_BITS = 6,                     /* 64 buckets per octave */
    RT_STATS_MAX_BITS = 40,                    /* values from 2^40 ns on are overflow */
    RT_STATS_BUCKETS = (RT_STATS_MAX_BITS - RT_STATS_SUB_BITS + 1) << RT_STATS_SUB_BITS,
    RT_STATS_QUANTILES = 5,
    RT_RECENT_CAPACITY = 1024                  /* one second of releases at the shortest period, 1 ms, fits */
};

/* How a quantile was found. */
typedef enum {
    RT_QUANTILE_OK = 0,
    RT_QUANTILE_NA = 1,        /* too few samples: fewer than one is expected beyond the quantile */
    RT_QUANTILE_UNDERFLOW = 2, /* it lies among the negative values: the value given is the minimum, a lower bound */
    RT_QUANTILE_OVERFLOW = 3   /* it lies among those from 2^40 ns on: the value given is the maximum, an upper bound */
} rt_quantile_status;

typedef struct {
    uint64_t count;
    uint64_t underflow;
    uint64_t overflow;
    int64_t min_ns;            /* valid when count > 0 */
    int64_t max_ns;
    uint64_t min_index;        /* `index` given with the first smallest value: a release, or what the caller counts */
    uint64_t max_index;        /* the same of the first largest value */
    double mean_ns;            /* Welford */
    double m2_ns2;             /* sum of squared deviations */
    uint64_t bucket[RT_STATS_BUCKETS];
} rt_stats;

/* The last samples, for the "last second" window. */
typedef struct {
    uint32_t head;             /* next slot to be written */
    uint32_t used;
    struct {
        int64_t at_ns;
        int64_t value_ns;
        uint64_t index;
    } sample[RT_RECENT_CAPACITY];
} rt_recent;

/* What a reader gets. Quantiles in the order of rt_stats_quantile_per_10k. */
typedef struct {
    uint64_t count;
    uint64_t underflow;
    uint64_t overflow;
    int64_t min_ns;
    int64_t max_ns;
    uint64_t min_index;
    uint64_t max_index;
    double mean_ns;
    double std_ns;             /* of the sample (n - 1); 0 for fewer than two values */
    int64_t quantile_ns[RT_STATS_QUANTILES];
    rt_quantile_status quantile_status[RT_STATS_QUANTILES];
} rt_summary;

/* p50, p90, p99, p99.9, p99.99 in units of 1/10 000. */
extern const uint32_t rt_stats_quantile_per_10k[RT_STATS_QUANTILES];
/* "p50", "p90", "p99", "p99.9", "p99.99". */
extern const char *const rt_stats_quantile_name[RT_STATS_QUANTILES];

/* Empties `self` (about 18 kB are written). Cannot fail. */
void rt_stats_init(rt_stats *self);

/* Adds one value; `index` says which one it was (a release, a frame, ...). O(1), about 10 ns. Cannot fail. */
void rt_stats_add(rt_stats *self, int64_t value_ns, uint64_t index);

/* Nearest-rank quantile: the smallest value v such that at least p of all samples are <= v. `per_10k` is p in 1/10 000
 * (1..9999). O(buckets). `*value_ns` is untouched when the answer is RT_QUANTILE_NA. */
rt_quantile_status rt_stats_quantile(const rt_stats *self, uint32_t per_10k, int64_t *value_ns);

/* What bucket `i` (below RT_STATS_BUCKETS) holds: low <= value < high. O(1). */
void rt_stats_bucket_bounds(size_t i, int64_t *low_ns, int64_t *high_ns);

/* Adds all values of `other`, as if they had come after those of `self`: of equal extremes the index of `self`
 * stays. Mean and std to rounding (Chan). O(buckets). */
void rt_stats_merge(rt_stats *self, const rt_stats *other);

/* Everything at once. O(buckets); not meant for the loop. */
void rt_stats_summary(const rt_stats *self, rt_summary *out);

/* Empties `self`. */
void rt_recent_init(rt_recent *self);

/* Adds one value; the oldest one is forgotten when the ring is full. O(1). */
void rt_recent_add(rt_recent *self, int64_t at_ns, int64_t value_ns, uint64_t index);

/* Summary of the samples with now_ns - span_ns < at_ns <= now_ns, through `scratch` (overwritten). Not for the loop. */
void rt_recent_summary(const rt_recent *self, int64_t now_ns, int64_t span_ns, rt_stats *scratch, rt_summary *out);

#endif
