"""The net's own sigmoid and tanh, portable in both number types and on vectors: error everywhere, ends, NaN."""

from __future__ import annotations

import ctypes as ct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from estimator_c.formulation.generate import generate
from estimator_c.formulation.real import GATE_ERROR, REALS
from tools.libest import ROOT, SETTINGS, WEIGHTS

LN2 = np.log(np.longdouble(2))
PORTABLE = """#include "real.h"
void gates(real_t a[], int n);
void gates(real_t a[], int n)
{
    net_gates(a, n);
}
"""
VECTOR = """#include "simd/vec_{0}.h"
int usable(void);
void gates(double a[], int n);
int usable(void)
{{
    return vec_available();
}}
void gates(double a[], int n)
{{
    for (int k = 0; k < n; k += {1}) {{ /* as a sigmoid of -a: the exponential is one of two here */
        vec_store(&a[k], vec_gate(vec_mul(vec_load(&a[k]), vec_all(1.4426950408889634))));
    }}
}}
"""
BLOCK = 64


@pytest.fixture(scope="module", params=["double", "float", "avx2", "avx512"])
def kind(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("gates")
    library = build(request.param, folder)
    if request.param.startswith("avx") and not library.usable():
        pytest.skip(f"this processor has no {request.param}: its gates are NOT checked")
    LIBRARIES[request.param] = library
    return request.param


LIBRARIES: dict[str, ct.CDLL] = {}


def build(kind: str, folder: Path) -> ct.CDLL:
    source = folder / "gates.c"
    if kind in REALS:
        generate(WEIGHTS, SETTINGS, folder, REALS[kind])
        source.write_text(PORTABLE)
    else:
        source.write_text(VECTOR.format(kind, 4 if kind == "avx2" else 8))
    strict = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-shared", "-fPIC"]
    includes = [f"-I{folder}", f"-I{ROOT / 'estimator_c' / 'src'}"]
    subprocess.run(["gcc", *strict, *includes, "-o", str(folder / "gates.so"), str(source)], check=True)
    listed = ["nm", "-uD", str(folder / "gates.so")]
    undefined = subprocess.run(listed, capture_output=True, text=True, check=True).stdout
    assert "exp" not in undefined
    assert "GLIBC" not in undefined.replace("__cxa_finalize@GLIBC_2.2.5", "")  # nothing of libm or libc
    return ct.CDLL(str(folder / "gates.so"))


def gates(kind: str, a: np.ndarray) -> np.ndarray:
    kept = np.zeros(-(-len(a) // BLOCK) * BLOCK, np.float32 if kind == "float" else np.float64)
    kept[: len(a)] = a
    LIBRARIES[kind].gates(kept.ctypes.data_as(ct.c_void_p), ct.c_int(len(kept)))
    return kept[: len(a)]


def bound(kind: str) -> float:
    return float(GATE_ERROR["float" if kind == "float" else "double"])


def rounded(kind: str, a: np.ndarray) -> np.ndarray:
    return (a.astype(np.float32) if kind == "float" else a).astype(np.longdouble)


def check(kind: str, a: np.ndarray) -> None:
    with np.errstate(over="ignore"):
        exact = 1 / (1 + np.exp(rounded(kind, a)))
    found = gates(kind, a).astype(np.longdouble)
    assert np.abs(found - exact).max() <= bound(kind) / 2  # sigmoid; tanh is 1 - 2 gates, twice the error
    tanh = np.tanh(rounded(kind, a) / 2)
    own = gates(kind, a)
    assert np.abs((1 - 2 * own).astype(np.longdouble) - tanh).max() <= bound(kind)


def test_error_over_the_whole_range(kind: str) -> None:
    check(kind, np.linspace(-60, 60, 1_200_001))
    whole = np.arange(-70, 70) * float(LN2)  # where the rounding to whole powers of two changes
    check(kind, np.concatenate([whole * (1 + s) + half * float(LN2) for s in (-1e-7, 0, 1e-7) for half in (0, 0.5)]))
    check(kind, np.concatenate([np.geomspace(1e-300, 1, 2000), -np.geomspace(1e-300, 1, 2000)]))


@hypothesis_settings(max_examples=200, deadline=None)
@given(values=st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=64))
def test_error_anywhere(kind: str, values: list[float]) -> None:
    check(kind, np.array(values))


def test_ends_and_what_is_not_finite(kind: str) -> None:
    far = 1e5 if kind == "float" else 1e14
    np.testing.assert_allclose(gates(kind, np.array([far, -far])), [0.0, 1.0], rtol=0, atol=2.0**-60)
    assert gates(kind, np.array([0.0]))[0] == 0.5
    assert np.isnan(gates(kind, np.array([np.nan]))[0])
    for infinite, end in ((np.inf, 0.0), (-np.inf, 1.0)):
        found = gates(kind, np.array([infinite]))[0]
        assert np.isnan(found) or abs(found - end) <= 2.0**-60


