"""Bounds and verdicts: closed forms, monotony, and the duality of the two bounds."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rt_runner.judge import Finding, judge_misses, miss_rate_bounds, overall, percentile, releases_to_pass


def test_no_miss_has_the_closed_form_upper_bound():
    lower, upper = miss_rate_bounds(0, 600)
    assert lower == 0.0
    assert upper == pytest.approx(1 - 0.05 ** (1 / 600), rel=1e-9)


def test_all_missed_has_the_closed_form_lower_bound():
    lower, upper = miss_rate_bounds(50, 50)
    assert upper == 1.0
    assert lower == pytest.approx(0.05 ** (1 / 50), rel=1e-9)


def test_published_value():
    # 1 event in 100: one-sided 95 % upper bound 4.656 % (tables of exact binomial limits)
    assert miss_rate_bounds(1, 100)[1] == pytest.approx(0.04656, abs=1e-5)


@given(st.integers(1, 400), st.data())
def test_bounds_enclose_the_rate_and_mirror_each_other(n, data):
    k = data.draw(st.integers(0, n))
    lower, upper = miss_rate_bounds(k, n)
    assert 0 <= lower <= k / n <= upper <= 1
    mirrored = miss_rate_bounds(n - k, n)
    assert lower == pytest.approx(1 - mirrored[1], abs=1e-9)


def test_impossible_counts_are_refused():
    with pytest.raises(ValueError, match="5 misses in 4 releases"):
        miss_rate_bounds(5, 4)


@pytest.mark.parametrize(
    ("misses", "by_machine", "releases", "expected"),
    [
        (0, 0, 600, "pass"),
        (3, 0, 600, "pass"),
        (0, 0, 50, "inconclusive"),  # no miss, but too few releases to prove the limit
        (200, 0, 600, "fail"),
        (200, 195, 600, "inconclusive"),  # the machine was taken from us
        (200, 100, 600, "fail"),  # our own half is too many on its own
        (0, 0, 0, "inconclusive"),
    ],
)
def test_verdicts(misses, by_machine, releases, expected):
    finding = judge_misses(misses, by_machine, releases, 0.05)
    assert finding.verdict == expected
    assert f"{misses} misses in {releases} releases" in finding.evidence


def test_overall_is_the_worst():
    made = {v: Finding("x", v, "") for v in ("pass", "inconclusive", "fail")}
    assert overall([made["pass"]]) == "pass"
    assert overall([made["pass"], made["inconclusive"]]) == "inconclusive"
    assert overall(list(made.values())) == "fail"


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=300), st.sampled_from([50.0, 90.0, 99.0, 100.0]))
def test_percentile_is_a_sample_that_enough_samples_do_not_exceed(samples, p):
    value = percentile(sorted(samples), p)
    if value is None:
        assert len(samples) * (100 - p) / 100 < 1
        return
    assert value in samples
    assert sum(s <= value for s in samples) >= p / 100 * len(samples) - 1e-9
    assert sum(s < value for s in samples) < math.ceil(p / 100 * len(samples))


def test_a_percentile_of_too_few_samples_is_not_named():
    assert percentile(sorted(range(99)), 99) is None
    assert percentile(sorted(range(100)), 99) == 98


@pytest.mark.parametrize(("misses", "limit"), [(0, 0.05), (0, 0.5), (1, 0.05), (4, 0.05), (20, 0.01)])
def test_the_hint_names_the_fewest_releases_that_pass(misses, limit):
    enough = releases_to_pass(misses, limit)
    assert judge_misses(misses, 0, enough, limit).verdict == "pass"
    assert judge_misses(misses, 0, enough - 1, limit).verdict == "inconclusive"


def test_four_misses_need_more_releases_than_none():
    assert releases_to_pass(0, 0.05) == 59
    assert "181 releases without another miss" in judge_misses(4, 0, 74, 0.05).evidence
