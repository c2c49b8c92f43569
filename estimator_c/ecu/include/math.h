/* All that the estimator's step uses of <math.h>: operations of the processor, no function of the mathematical library.
 * What is not here does not compile for the ECU. */
#ifndef ECU_MATH_H
#define ECU_MATH_H

#define NAN (__builtin_nanf(""))
#define INFINITY (__builtin_inff())
#define fabs(x) __builtin_fabs(x)
#define fabsf(x) __builtin_fabsf(x)

#endif
