/* All that the estimator's step uses of <math.h>: no function of the mathematical library. What is not here does not
 * compile for the ECU. */
#ifndef ECU_MATH_H
#define ECU_MATH_H

#define NAN (__builtin_nanf(""))
#define INFINITY (__builtin_inff())

#endif
