/* Four doubles side by side on AVX2 with FMA, for the generated thermal_net_avx2.c and nothing else. vec_..._part: the
 * first n of a vector, the rest 0; n is a constant wherever it is called. */
#ifndef VEC_AVX2_H
#define VEC_AVX2_H

#include <stdbool.h>

/* Before the instruction set is set: this runs on every processor. */
static bool vec_available(void)
{
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}

#pragma GCC target("avx2,fma")
#include <immintrin.h>

typedef __m256d vec_t;

#define VEC_INLINE static inline __attribute__((always_inline))

VEC_INLINE vec_t vec_all(double x)
{
    return _mm256_set1_pd(x);
}

VEC_INLINE vec_t vec_load(const double *p)
{
    return _mm256_loadu_pd(p);
}

VEC_INLINE void vec_store(double *p, vec_t x)
{
    _mm256_storeu_pd(p, x);
}

VEC_INLINE __m256i vec_first(int n)
{
    return _mm256_set_epi64x(0, n > 2 ? -1 : 0, n > 1 ? -1 : 0, -1);
}

VEC_INLINE vec_t vec_load_part(const double *p, int n)
{
    return n == 4 ? vec_load(p) : _mm256_maskload_pd(p, vec_first(n));
}

VEC_INLINE void vec_store_part(double *p, vec_t x, int n)
{
    if (n == 4) {
        vec_store(p, x);
    } else {
        _mm256_maskstore_pd(p, vec_first(n), x);
    }
}

VEC_INLINE vec_t vec_add(vec_t a, vec_t b)
{
    return _mm256_add_pd(a, b);
}

VEC_INLINE vec_t vec_sub(vec_t a, vec_t b)
{
    return _mm256_sub_pd(a, b);
}

VEC_INLINE vec_t vec_mul(vec_t a, vec_t b)
{
    return _mm256_mul_pd(a, b);
}

/* a b + c */
VEC_INLINE vec_t vec_fma(vec_t a, vec_t b, vec_t c)
{
    return _mm256_fmadd_pd(a, b, c);
}

/* c - a b */
VEC_INLINE vec_t vec_fnma(vec_t a, vec_t b, vec_t c)
{
    return _mm256_fnmadd_pd(a, b, c);
}

VEC_INLINE vec_t vec_neg(vec_t a)
{
    return _mm256_xor_pd(a, vec_all(-0.0));
}

VEC_INLINE double vec_sum(vec_t x)
{
    const __m128d two = _mm_add_pd(_mm256_castpd256_pd128(x), _mm256_extractf128_pd(x, 1));
    return _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)));
}

/* The second operand where one is NaN. */
VEC_INLINE vec_t vec_min(vec_t a, vec_t b)
{
    return _mm256_min_pd(a, b);
}

VEC_INLINE vec_t vec_max(vec_t a, vec_t b)
{
    return _mm256_max_pd(a, b);
}

/* a less the whole number next to it; shifted = a + shift, which ends in that number. */
VEC_INLINE vec_t vec_fraction(vec_t a, vec_t shifted, vec_t shift)
{
    return vec_sub(a, vec_sub(shifted, shift));
}

/* 2^n for shifted = shift + n. */
VEC_INLINE vec_t vec_power_of_two(vec_t shifted)
{
    const __m256i exponent = _mm256_add_epi64(_mm256_castpd_si256(shifted), _mm256_set1_epi64x(1023));
    return _mm256_castsi256_pd(_mm256_slli_epi64(exponent, 52));
}

VEC_INLINE vec_t vec_reciprocal(vec_t a)
{
    return _mm256_div_pd(vec_all(1.0), a);
}

#include "vec_gate.h"

#endif
