/* The sigmoid of a vector, the same for every width. Included last by vec_avx2.h and vec_avx512.h, whose vec_... it is
 * made of. */
#ifndef VEC_GATE_H
#define VEC_GATE_H

/* 1/(1 + 2^a) for |a| < 1e15, absolute error <= 3e-16; the ends are held within 2^-63 of 0 and 1; NaN gives NaN, an
 * infinite a its end or NaN. The polynomial is that of net_gates(). The power of two is made beside the polynomial,
 * which takes longer. */
VEC_INLINE vec_t vec_gate(vec_t a)
{
    const vec_t one = vec_all(1.0);
    const vec_t shift = vec_all(6755399441055744.0); /* 1.5 2^52: adding it rounds to a whole number */
    const vec_t shifted = vec_add(a, shift);
    const vec_t r = vec_fraction(a, shifted, shift);
    const vec_t most = vec_all(6755399441055744.0 + 63.0);
    const vec_t least = vec_all(6755399441055744.0 - 64.0);
    const vec_t scale = vec_power_of_two(vec_min(most, vec_max(least, shifted)));
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
    return vec_reciprocal(below);
}

#endif
