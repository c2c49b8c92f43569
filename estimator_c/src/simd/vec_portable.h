/* One double beside itself, for kernels written on vec_... functions where there is no vector machine. */
#ifndef VEC_PORTABLE_H
#define VEC_PORTABLE_H

#include <stdbool.h>

static bool vec_available(void)
{
    return true;
}

typedef double vec_t;

static inline vec_t vec_all(double x)
{
    return x;
}

static inline vec_t vec_load(const double *p)
{
    return *p;
}

static inline void vec_store(double *p, vec_t x)
{
    *p = x;
}

static inline vec_t vec_add(vec_t a, vec_t b)
{
    return a + b;
}

static inline vec_t vec_sub(vec_t a, vec_t b)
{
    return a - b;
}

static inline vec_t vec_mul(vec_t a, vec_t b)
{
    return a * b;
}

/* a b + c */
static inline vec_t vec_fma(vec_t a, vec_t b, vec_t c)
{
    return a * b + c;
}

/* c - a b */
static inline vec_t vec_fnma(vec_t a, vec_t b, vec_t c)
{
    return c - a * b;
}

static inline double vec_sum(vec_t x)
{
    return x;
}

#endif
