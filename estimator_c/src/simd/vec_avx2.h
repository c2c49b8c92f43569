/* Four doubles side by side on AVX2 with FMA, for the generated thermal_net_avx2.c and nothing else. vec_..._part: the first n
 * of a vector, the rest 0; n is a constant wherever it is called. */
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

/* 1/(1 + 2^a) for |a| < 1e15, absolute error <= 3e-16; the ends are held within 2^-63 of 0 and 1; NaN gives NaN, an
 * infinite a its end or NaN. The polynomial is that of net_gates(). The power of two is made beside the polynomial, which
 * takes longer. */
VEC_INLINE vec_t vec_gate(vec_t a)
{
    const vec_t one = vec_all(1.0);
    const vec_t shift = vec_all(6755399441055744.0); /* 1.5 2^52: adding it rounds to a whole number */
    const vec_t shifted = vec_add(a, shift);
    const vec_t r = vec_sub(a, vec_sub(shifted, shift));
    const vec_t most = vec_all(6755399441055744.0 + 63.0);
    const vec_t least = vec_all(6755399441055744.0 - 64.0);
    const vec_t held = _mm256_min_pd(most, _mm256_max_pd(least, shifted)); /* the second operand where it is NaN */
    const __m256i bits = _mm256_slli_epi64(_mm256_add_epi64(_mm256_castpd_si256(held), _mm256_set1_epi64x(1023)), 52);
    const vec_t scale = _mm256_castsi256_pd(bits);
    const vec_t r2 = vec_mul(r, r);
    const vec_t r4 = vec_mul(r2, r2);
    const vec_t r8 = vec_mul(r4, r4);
    const vec_t p0 = vec_fma(r, vec_all(0.6931471805599462), one);
    const vec_t p2 = vec_fma(r, vec_all(0.05550410866465167), vec_all(0.24022650695910075));
    const vec_t p4 = vec_fma(r, vec_all(0.0013333558200794592), vec_all(0.009618129107618665));
    const vec_t p6 = vec_fma(r, vec_all(1.5252672924850737e-05), vec_all(0.00015403530424776529));
    const vec_t p8 = vec_fma(r, vec_all(1.0205905413765595e-07), vec_all(1.3215451633221434e-06));
    const vec_t low = vec_fma(vec_fma(r2, p6, p4), r4, vec_fma(r2, p2, p0));
    const vec_t below = vec_fma(vec_fma(vec_fma(r2, vec_all(7.070977866508138e-09), p8), r8, low), scale, one);
    return _mm256_div_pd(one, below);
}

#endif
