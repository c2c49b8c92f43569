/* What the estimator's step uses of <math.h>, as instructions of the compiler: nothing here is a call into a library, and
 * whatever is not here does not compile for the ECU. Cost: one to three instructions each on a Cortex-M7 (FPv5). */
#ifndef ECU_MATH_H
#define ECU_MATH_H

#define NAN (__builtin_nanf(""))
#define INFINITY (__builtin_inff())
#define isfinite(x) __builtin_isfinite(x)
#define isnan(x) __builtin_isnan(x)
#define fabs(x) __builtin_fabs(x)
#define fmax(x, y) __builtin_fmax(x, y)
#define fmin(x, y) __builtin_fmin(x, y)
#define fabsf(x) __builtin_fabsf(x)
#define fmaxf(x, y) __builtin_fmaxf(x, y)
#define fminf(x, y) __builtin_fminf(x, y)

#endif
