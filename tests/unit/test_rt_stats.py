"""The fixed-memory statistics against exact ones."""

from __future__ import annotations

import ctypes as ct
import math
import random
import statistics

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit import rt_shim

OK, NA, UNDERFLOW, OVERFLOW = range(4)
LIMIT = 2**40


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return rt_shim.build(tmp_path_factory.mktemp("rt_stats"))


def exact(values: list[int], per_10k: int) -> int:
    """Nearest-rank quantile."""
    return sorted(values)[math.ceil(len(values) * per_10k / 10_000) - 1]


def check(library, values: list[int]) -> None:
    out = rt_shim.summarise(library, values)
    assert out.count == len(values)
    assert out.underflow == sum(v < 0 for v in values)
    assert out.overflow == sum(v >= LIMIT for v in values)
    if values:
        assert (out.min_ns, out.max_ns) == (min(values), max(values))
        assert (out.min_index, out.max_index) == (values.index(min(values)), values.index(max(values)))
        scale = max(1, max(abs(v) for v in values))
        assert out.mean_ns == pytest.approx(statistics.fmean(values), rel=1e-9, abs=1e-9 * scale)
        if len(values) > 1:
            assert out.std_ns == pytest.approx(statistics.stdev(values), rel=1e-6, abs=1e-6 * scale)
    for i, per_10k in enumerate(rt_shim.QUANTILE_PER_10K):
        status, found = out.quantile_status[i], out.quantile_ns[i]
        if len(values) * (10_000 - per_10k) < 10_000:
            assert status == NA
            continue
        truth = exact(values, per_10k)
        if truth < 0:
            assert (status, found) == (UNDERFLOW, min(values))
        elif truth >= LIMIT:
            assert (status, found) == (OVERFLOW, max(values))
        else:
            assert status == OK
            assert abs(found - truth) <= 0.01 * truth
            assert min(values) <= found <= max(values)


magnitude = st.integers(0, 45).flatmap(lambda bits: st.integers(0, 2**bits))


@settings(max_examples=300, deadline=None)
@given(st.lists(st.one_of(magnitude, magnitude, st.integers(-(2**41), 2**42)), max_size=400))
def test_quantiles_of_any_values(library, values):
    check(library, values)


@settings(max_examples=30, deadline=None)
@given(st.lists(magnitude, min_size=1, max_size=20), st.integers(9_900, 21_000), st.integers(0, 2**32))
def test_far_quantiles_need_and_get_many_samples(library, palette, count, seed):
    check(library, random.Random(seed).choices(palette, k=count))


@pytest.mark.parametrize("bits", range(41))
def test_bucket_edges(library, bits):
    for value in {max(0, 2**bits - 1), 2**bits, 2**bits + 1}:
        check(library, [value] * 3)


@pytest.mark.parametrize(
    ("count", "available"),
    [(1, 0), (2, 1), (9, 1), (10, 2), (99, 2), (100, 3), (999, 3), (1000, 4), (9999, 4), (10_000, 5)],
)
def test_a_percentile_with_too_few_samples_is_not_available(library, count, available):
    out = rt_shim.summarise(library, list(range(count)))
    assert [status == OK for status in out.quantile_status] == [True] * available + [False] * (5 - available)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 50_000), st.integers(0, 10**9)), max_size=1500),
    st.integers(0, 3_000_000),
    st.integers(1, 1_000_000),
)
def test_last_second_window(library, samples, offset, span):
    at, values, t = [], [], 0
    for gap, value in samples:
        t += gap
        at.append(t)
        values.append(value)
    now = t + 1_000_000 - offset
    n = len(at)
    out = rt_shim.Summary()
    array = rt_shim.I64 * max(1, n)
    library.shim_recent(
        array(*at), array(*values), ct.c_size_t(n), rt_shim.I64(now), rt_shim.I64(span), ct.byref(out)
    )
    kept = [v for a, v in list(zip(at, values, strict=True))[-1024:] if now - span < a <= now]
    assert out.count == len(kept)
    if kept:
        assert (out.min_ns, out.max_ns) == (min(kept), max(kept))
