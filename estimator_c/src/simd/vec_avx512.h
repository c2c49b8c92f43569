/* Eight doubles side by side on AVX-512, for the generated thermal_net_avx512.c and nothing else. vec_..._part: the
 * first n of a vector, the rest 0; n is a constant wherever it is called. */
#ifndef VEC_AVX512_H
#define VEC_AVX512_H

#include <stdbool.h>

/* Before the instruction set is set: this runs on every processor. */
static bool vec_available(void)
{
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq");
}

#pragma GCC target("avx512f,avx512dq,avx2,fma,prefer-vector-width=512")
#include <immintrin.h>

typedef __m512d vec_t;

#define VEC_INLINE static inline __attribute__((always_inline))

VEC_INLINE vec_t vec_all(double x)
{
    return _mm512_set1_pd(x);
}

VEC_INLINE vec_t vec_load(const double *p)
{
    return _mm512_loadu_pd(p);
}

VEC_INLINE void vec_store(double *p, vec_t x)
{
    _mm512_storeu_pd(p, x);
}

VEC_INLINE vec_t vec_load_part(const double *p, int n)
{
    return n == 8 ? vec_load(p) : _mm512_maskz_loadu_pd((__mmask8)((1 << n) - 1), p);
}

VEC_INLINE void vec_store_part(double *p, vec_t x, int n)
{
    if (n == 8) {
        vec_store(p, x);
    } else {
        _mm512_mask_storeu_pd(p, (__mmask8)((1 << n) - 1), x);
    }
}

VEC_INLINE vec_t vec_add(vec_t a, vec_t b)
{
    return _mm512_add_pd(a, b);
}

VEC_INLINE vec_t vec_sub(vec_t a, vec_t b)
{
    return _mm512_sub_pd(a, b);
}

VEC_INLINE vec_t vec_mul(vec_t a, vec_t b)
{
    return _mm512_mul_pd(a, b);
}

/* a b + c */
VEC_INLINE vec_t vec_fma(vec_t a, vec_t b, vec_t c)
{
    return _mm512_fmadd_pd(a, b, c);
}

/* c - a b */
VEC_INLINE vec_t vec_fnma(vec_t a, vec_t b, vec_t c)
{
    return _mm512_fnmadd_pd(a, b, c);
}

VEC_INLINE vec_t vec_neg(vec_t a)
{
    return _mm512_xor_pd(a, vec_all(-0.0));
}

VEC_INLINE double vec_sum(vec_t x)
{
    const __m256d four = _mm256_add_pd(_mm512_castpd512_pd256(x), _mm512_extractf64x4_pd(x, 1));
    const __m128d two = _mm_add_pd(_mm256_castpd256_pd128(four), _mm256_extractf128_pd(four, 1));
    return _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)));
}

/* The second operand where one is NaN. */
VEC_INLINE vec_t vec_min(vec_t a, vec_t b)
{
    return _mm512_min_pd(a, b);
}

VEC_INLINE vec_t vec_max(vec_t a, vec_t b)
{
    return _mm512_max_pd(a, b);
}

/* a less the whole number next to it, in one instruction that needs neither the shift nor a + shift. */
VEC_INLINE vec_t vec_fraction(vec_t a, vec_t shifted, vec_t shift)
{
    (void)shifted;
    (void)shift;
    return _mm512_reduce_pd(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
}

/* 2^n for shifted = shift + n. */
VEC_INLINE vec_t vec_power_of_two(vec_t shifted)
{
    const __m512i exponent = _mm512_add_epi64(_mm512_castpd_si512(shifted), _mm512_set1_epi64(1023));
    return _mm512_castsi512_pd(_mm512_slli_epi64(exponent, 52));
}

/* An estimate to 2^-14 times the series of 1/(1 - t). A division takes the unit for 16 cycles, this for 4. */
VEC_INLINE vec_t vec_reciprocal(vec_t a)
{
    const vec_t guess = _mm512_rcp14_pd(a);
    const vec_t t = vec_fnma(a, guess, vec_all(1.0));
    const vec_t better = vec_fma(guess, t, guess);
    return vec_fma(better, vec_mul(t, t), better);
}

#include "vec_gate.h"

#endif
