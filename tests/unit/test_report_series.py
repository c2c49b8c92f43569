"""The report's arithmetic: nothing invented between samples, no peak lost, every job counted once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tools.report.charts import encode
from tools.report.data import Trace
from tools.report.series import (
    decimate,
    error_against_truth,
    log_histogram,
    time_of_tick,
    unwrap_ticks,
    with_gaps,
)

FINITE = st.floats(-1e3, 1e3)
GAPPY = st.lists(st.one_of(FINITE, st.just(float("nan"))), min_size=1, max_size=400)


def test_unwrap_continues_across_the_wrap_and_survives_a_wild_tick():
    true = np.arange(65500, 65600)
    assert unwrap_ticks(true % 65536).tolist() == true.tolist()
    wild = (true % 65536).copy()
    wild[20] = 12345
    out = unwrap_ticks(wild)
    assert np.delete(out, 20).tolist() == np.delete(true, 20).tolist()


def test_unwrap_takes_an_older_tick_as_a_step_back():
    assert unwrap_ticks(np.array([65530, 4, 65535, 14])).tolist() == [65530, 65540, 65535, 65550]


def test_time_of_tick_is_the_first_reception_and_ten_ms_a_tick_outside():
    seen, t_s = np.array([100.0, 110.0, 110.0, 120.0]), np.array([1.0, 1.1, 1.16, 1.2])
    got = time_of_tick(np.array([90.0, 100.0, 105.0, 110.0, 125.0]), seen, t_s)
    assert got == pytest.approx([0.9, 1.0, 1.05, 1.1, 1.25])
    assert np.isnan(time_of_tick(np.array([1.0]), np.empty(0), np.empty(0))).all()


def test_one_missing_frame_is_a_gap_and_estimator_jitter_is_none():
    at = np.array([0.0, 10, 20, 40, 50, 59, 70])
    out = with_gaps(at, Trace(at / 100, at))
    assert np.flatnonzero(np.isnan(out.value)).tolist() == [3]
    assert out.t_s[3] == pytest.approx(0.3)


def test_error_needs_truth_on_both_sides():
    truth_at, truth = np.array([0.0, 10, 20, 400]), np.array([0.0, 1, 2, 40])
    error = error_against_truth(np.array([-1.0, 0, 5, 20, 30, 401]), np.full(6, 5.0), truth_at, truth)
    assert error[1:4] == pytest.approx([5.0, 4.5, 3.0])
    assert np.isnan(error[[0, 4, 5]]).all()


@given(GAPPY, st.integers(2, 60))
def test_decimation_keeps_extremes_gaps_and_order(values, max_points):
    trace = Trace(np.arange(len(values)) * 0.01, np.array(values))
    out = decimate(trace, max_points)
    finite, kept = np.isfinite(trace.value), np.isfinite(out.value)
    assert (np.diff(out.t_s) > 0).all()
    assert np.isin(out.t_s, trace.t_s).all()
    assert finite.any() == kept.any()
    if finite.any():
        assert np.nanmin(out.value) == np.nanmin(trace.value)
        assert np.nanmax(out.value) == np.nanmax(trace.value)
    if len(values) > max_points:
        runs = np.count_nonzero(np.diff(finite.astype(int), prepend=0) == 1)
        assert np.count_nonzero(kept) <= max_points + 2 * runs + 2


def test_a_gap_longer_than_a_bucket_survives_decimation():
    values = np.sin(np.arange(10000) / 50)
    values[4000:5000] = np.nan
    out = decimate(Trace(np.arange(10000) * 0.01, values), 200)
    gap = np.isnan(out.value)
    assert gap.any()
    assert ((out.t_s[gap] >= 40) & (out.t_s[gap] < 50)).all()
    assert not ((out.t_s >= 40) & (out.t_s < 50) & ~gap).any()


@given(st.lists(st.floats(0.01, 1e7), max_size=200), st.lists(st.floats(0.01, 1e7), max_size=200))
def test_histogram_counts_every_sample_in_its_bin(first, second):
    samples = [np.array(first), np.array(second)]
    histogram = log_histogram([np.append(samples[0], np.nan), samples[1]])
    for sample, counts in zip(samples, histogram.counts, strict=True):
        assert counts.sum() == sample.size
        if sample.size:
            edges = histogram.edges_us
            # Against numpy's own binning; samples on an edge may fall to either side by rounding.
            inner = np.maximum(sample, 0.1)
            near = np.isclose(inner[:, None], edges[None, :], rtol=1e-9).any(axis=1)
            expected, _ = np.histogram(inner, edges)
            assert np.abs(expected - counts).sum() <= 2 * np.count_nonzero(near)


@given(GAPPY, st.floats(0, 1e4))
def test_encoding_decodes_to_the_same_samples(values, start_s):
    trace = Trace(start_s + np.arange(len(values)) * 0.01, np.array(values))
    coded = encode(trace, 3)
    t_s = np.cumsum(coded["dt"]) * 1e-4
    assert t_s == pytest.approx(trace.t_s, abs=1.01e-4)
    assert [v is None for v in coded["y"]] == np.isnan(trace.value).tolist()
    assert [v for v in coded["y"] if v is not None] == pytest.approx(trace.value[np.isfinite(trace.value)], abs=6e-4)


def test_samples_in_the_same_tenth_of_a_millisecond_stay_apart_and_in_order():
    coded = encode(Trace(np.array([1.0, 1.00001, 1.00002, 1.1]), np.arange(4.0)), 0)
    assert min(coded["dt"][1:]) >= 1
    assert coded["y"] == [0, 1, 2, 3]


def test_traces_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="equal vectors"):
        Trace(np.zeros(3), np.zeros(2))
