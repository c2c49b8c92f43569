"""The number type of the generated code and of the solver around it: real.h, with the exponential its gates need.

One header per type, written by the generator, so that no source knows which it is compiled for. The exponential is our
own: the same bits on every machine, no branch, no table, no library.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Real:
    """A C floating point type.

    Attributes
    ----------
    c_type, suffix : str
        "double", "" or "float", "f".
    fraction_bits : int
        Of its representation; `word` is the unsigned integer of its size.
    limit : int
        Exponents of two are held within +-limit: far enough for 0 and 1 to the last bit, without denormal numbers.
    exp2 : tuple of float
        Coefficients of 2^r, |r| <= 1/2, from r^0 up: 1 + r q(r), q interpolated in Chebyshev's points.
    exp_error : str
        Bound of net_exp's relative error, as the header states it.
    """

    c_type: str
    suffix: str
    word: str
    fraction_bits: int
    limit: int
    exp2: tuple[float, ...]
    exp_error: str

    def literal(self, number: float) -> str:
        """The number as a C literal of this type, in parentheses where it is negative."""
        text = repr(float(number)) if self.c_type == "double" else str(np.float32(number))
        text = text if any(mark in text for mark in ".en") else text + ".0"
        text += self.suffix
        return f"({text})" if text.startswith("-") else text


DOUBLE = Real(
    c_type="double",
    suffix="",
    word="uint64_t",
    fraction_bits=52,
    limit=100,
    exp2=(
        1.0, 0.6931471805599462, 0.24022650695910075, 0.05550410866465167, 0.009618129107618665, 0.0013333558200794592,
        0.00015403530424776529, 1.5252672924850737e-05, 1.3215451633221434e-06, 1.0205905413765595e-07,
        7.070977866508138e-09,
    ),
    exp_error="(8 + |x|) 2^-53",
)  # fmt: skip
FLOAT = Real(
    c_type="float",
    suffix="f",
    word="uint32_t",
    fraction_bits=23,
    limit=60,
    exp2=(
        1.0, 0.6931471824645996, 0.24022650718688965, 0.055503569543361664, 0.009618083015084267, 0.0013390863314270973,
        0.00015453163359779865,
    ),
    exp_error="(4 + |x|) 2^-24",
)  # fmt: skip
REALS = {real.c_type: real for real in (DOUBLE, FLOAT)}


def real_header(real: Real, banner: str) -> str:
    """real.h."""
    poly = real.literal(real.exp2[-1])
    for coefficient in reversed(real.exp2[:-1]):
        poly = f"{real.literal(coefficient)} + r * ({poly})"
    poly = poly.replace(" + r * (", " + r * (\n        ")
    return f"""{banner}/* The number type of the net and its solver. All functions: pure, any thread, no branch, no library. */
#ifndef REAL_H
#define REAL_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

typedef {real.c_type} real_t;

#define REAL_EPSILON {real.literal(float(np.finfo(real.c_type if real.suffix == "" else "float32").eps))}

static inline real_t real_abs(real_t x)
{{
    return x > -x ? x : -x;
}}

/* The larger; b where a is not a number. */
static inline real_t real_max(real_t a, real_t b)
{{
    return a > b ? a : b;
}}

static inline bool real_finite(real_t x)
{{
    return x - x == 0;
}}

/* exp(x), relative error <= {real.exp_error}, held at 2^+-{real.limit} beyond; NaN gives NaN. In the gates built from it,
 * 1/(1 + exp(-x)) and 1 - 2/(1 + exp(2x)), the error in x cancels: theirs is <= {GATE_ERROR[real.c_type]}, absolute, for every x. */
static inline real_t net_exp(real_t x)
{{
    const real_t shift = {real.literal(1.5 * 2.0**real.fraction_bits)}; /* adding it rounds to a whole number */
    real_t t = x * {real.literal(1.4426950408889634)};
    t = t < {real.literal(-real.limit)} ? {real.literal(-real.limit)} : t;
    t = t > {real.literal(real.limit)} ? {real.literal(real.limit)} : t;
    const real_t shifted = t + shift;
    const real_t r = t - (shifted - shift); /* exact, |r| <= 1/2 */
    const real_t power = {poly};
    {real.word} whole;
    {real.word} bits;
    real_t result;
    memcpy(&whole, &shifted, sizeof whole);
    memcpy(&bits, &power, sizeof bits);
    bits += whole << {real.fraction_bits}; /* the whole number into the exponent */
    memcpy(&result, &bits, sizeof result);
    return result;
}}

#endif
"""


GATE_ERROR = {"double": "6e-16", "float": "3e-7"}  # held by tests/unit/test_net_exp.py
