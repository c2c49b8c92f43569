"""The number type of the generated code and of the solver around it: real.h, with the gates of the net.

One header per type, written by the generator, so that no source knows which it is compiled for. Exponential and gates
are our own: no branch, no table, no library.
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
    exp2 : tuple of float
        Coefficients of 2^r, |r| <= 1/2, from r^0 up: 1 + r q(r), q interpolated in Chebyshev's points.
    """

    c_type: str
    suffix: str
    word: str
    fraction_bits: int
    exp2: tuple[float, ...]

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
    exp2=(
        1.0, 0.6931471805599462, 0.24022650695910075, 0.05550410866465167, 0.009618129107618665, 0.0013333558200794592,
        0.00015403530424776529, 1.5252672924850737e-05, 1.3215451633221434e-06, 1.0205905413765595e-07,
        7.070977866508138e-09,
    ),
)  # fmt: skip
FLOAT = Real(
    c_type="float",
    suffix="f",
    word="uint32_t",
    fraction_bits=23,
    exp2=(
        1.0, 0.6931471824645996, 0.24022650718688965, 0.055503569543361664, 0.009618083015084267, 0.0013390863314270973,
        0.00015453163359779865,
    ),
)  # fmt: skip
REALS = {real.c_type: real for real in (DOUBLE, FLOAT)}


def real_header(real: Real, banner: str) -> str:
    """real.h."""
    poly = real.literal(real.exp2[-1])
    for coefficient in reversed(real.exp2[:-1]):
        poly = f"{real.literal(coefficient)} + r * ({poly})"
    poly = poly.replace(" + r * (", " + r * (\n            ")
    shift = 1.5 * 2.0**real.fraction_bits
    hold = FLOAT_HOLD if real is FLOAT else DOUBLE_HOLD
    return f"""{banner}/* The number type of the net and its solver. All functions: pure, any thread, no library. */
#ifndef REAL_H
#define REAL_H

#include <math.h> /* fabs() and NAN: nothing of libm is called */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

typedef {real.c_type} real_t;

#define REAL_EPSILON {real.literal(float(np.finfo(real.c_type if real.suffix == "" else "float32").eps))}

static inline real_t real_abs(real_t x)
{{
    return fabs{real.suffix}(x); /* compilers have it themselves */
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

/* a[k] = 1/(1 + exp(a[k])) for n gates: a sigmoid of -a, and tanh(a/2) = 1 - 2/(1 + exp(a)). Absolute error of either
 * <= {GATE_ERROR[real.c_type]} for |a| < {DOMAIN[real.c_type]}; the ends are held within 2^-{LIMIT - 1} of 0 and 1;
 * NaN gives NaN, an infinite a its end or NaN. No branch. */
static inline void net_gates(real_t a[], int n)
{{
    const real_t shift = {real.literal(shift)}; /* adding it rounds to a whole number, which its last bits then show */
    for (int k = 0; k < n; k++) {{
        const real_t t = a[k] * {real.literal(1.4426950408889634)};
        const real_t shifted = t + shift;
        const real_t r = t - (shifted - shift); /* exact, |r| <= 1/2 */
        const real_t power = {poly};
        {real.word} bits;
        real_t scale;
{hold}
        bits <<= {real.fraction_bits}; /* into the exponent */
        memcpy(&scale, &bits, sizeof scale);
        a[k] = 1 / (1 + power * scale);
    }}
}}

#endif
"""


# The whole number, held within limits, plus the exponent's bias, into the last bits of `bits`: in integers where a
# processor's vectors or instructions know them, else in floating point. A comparison of floating point numbers would
# become a branch and keep gcc -O2 from computing two gates at once.
FLOAT_HOLD = """\
        memcpy(&bits, &shifted, sizeof bits);
        int32_t whole = (int32_t)(bits - 0x4b400000u);
        whole = whole < -64 ? -64 : whole;
        whole = whole > 63 ? 63 : whole;
        bits = (uint32_t)(whole + 127);"""
DOUBLE_HOLD = """\
        const real_t whole = shifted - shift;
        const real_t twice = fabs(whole + 64.0) - fabs(whole - 63.0); /* 2 whole + 1 within -64..63 */
        const real_t held = (0.5 * twice + 1022.5) + shift;
        memcpy(&bits, &held, sizeof bits);"""
LIMIT = 64  # of the power of two: 0 and 1 to the last bit, no denormal numbers; some processors have an instruction
DOMAIN = {"double": "1e15", "float": "1e6"}
GATE_ERROR = {"double": "6e-16", "float": "3e-7"}  # held by tests/unit/test_net_gates.py
