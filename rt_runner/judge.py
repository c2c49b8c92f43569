"""Bounds on a miss rate, and the verdict drawn from them. Pure: numbers in, words out."""

import math
from dataclasses import dataclass

CONFIDENCE = 0.95


def percentile(sorted_values: list[float], p: float) -> float | None:
    """Nearest-rank percentile: the smallest sample that at least ``p`` per cent of the samples do not exceed.

    Parameters
    ----------
    sorted_values : ascending samples, any unit
    p : per cent, 0 < p <= 100

    Returns
    -------
    The sample, or None if there is none, or too few of them to name that percentile (fewer than
    100 / (100 - p): a p99 of 50 samples would only be their maximum under another name).
    """
    n = len(sorted_values)
    if n == 0 or (p < 100 and n < 100 / (100 - p) - 1e-9):
        return None
    return sorted_values[max(0, math.ceil(p / 100 * n) - 1)]


def _binomial_cdf(k: int, n: int, p: float) -> float:
    """P(X <= k) for X ~ Binomial(n, p), summed in logarithms."""
    if p <= 0.0:
        return 1.0
    if p >= 1.0:
        return 1.0 if k >= n else 0.0
    log_p, log_q = math.log(p), math.log1p(-p)
    total = 0.0
    for i in range(k + 1):
        log_choose = math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1)
        total += math.exp(log_choose + i * log_p + (n - i) * log_q)
    return min(1.0, total)


def miss_rate_bounds(misses: int, releases: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """One-sided Clopper-Pearson bounds (lower, upper) of a miss rate, each at ``confidence``.

    Parameters
    ----------
    misses, releases : 0 <= misses <= releases

    Returns
    -------
    (lower, upper), dimensionless; (0, 1) where nothing was released.

    References
    ----------
    C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413.
    """
    if not 0 <= misses <= releases:
        raise ValueError(f"{misses} misses in {releases} releases cannot be")
    if releases == 0:
        return 0.0, 1.0
    alpha = 1.0 - confidence

    def solve(below) -> float:
        low, high = 0.0, 1.0
        for _ in range(60):
            mid = (low + high) / 2
            low, high = (mid, high) if below(mid) else (low, mid)
        return (low + high) / 2

    # Both tail probabilities are monotonic in p, so bisection finds the p at which they cross alpha.
    upper = 1.0 if misses == releases else solve(lambda p: _binomial_cdf(misses, releases, p) > alpha)
    lower = 0.0 if misses == 0 else solve(lambda p: 1.0 - _binomial_cdf(misses - 1, releases, p) < alpha)
    return lower, upper


def releases_to_pass(misses: int, limit: float) -> int:
    """Fewest releases with so many misses whose rate is proven to be at most ``limit``, 0 < limit < 1."""
    low, high = misses, misses + 1
    while miss_rate_bounds(misses, high)[1] > limit:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if miss_rate_bounds(misses, middle)[1] > limit else (low, middle)
    return high


@dataclass(frozen=True)
class Finding:
    """One thing that was judged: its name, how it came out (pass | fail | inconclusive), and the evidence."""

    what: str
    verdict: str
    evidence: str


def judge_misses(misses: int, by_machine: int, releases: int, limit: float, machine: str = "") -> Finding:
    """Judge a miss rate against ``limit`` by its bounds, never by the bare count.

    Parameters
    ----------
    misses : late plus skipped activations
    by_machine : those of them whose cause is the machine (woken late, preempted, stolen), not our code
    releases : activations released, executed or not
    limit : allowed miss rate, 0 < limit < 1
    machine : what was measured of the machine meanwhile; printed where it decides
    """
    lower, upper = miss_rate_bounds(misses, releases)
    says = f"{misses} misses in {releases} releases: rate < {upper:.2%} at {CONFIDENCE:.0%} (limit {limit:.2%})"
    if upper <= limit:
        return Finding("miss rate", "pass", says)
    if lower <= limit:
        few = releases < 4 * releases_to_pass(0, limit)
        longer = f"too few to decide, run longer ({releases_to_pass(misses, limit)} releases without another miss pass)"
        hint = f"; {longer}" if few else "; undecided"
        return Finding("miss rate", "inconclusive", says + hint)
    own_lower, _ = miss_rate_bounds(misses - by_machine, releases)
    if own_lower <= limit:
        return Finding(
            "miss rate",
            "inconclusive",
            f"{says}; {by_machine} of them were woken late, preempted or stolen: the machine was taken from us"
            + (f" ({machine})" if machine else ""),
        )
    return Finding("miss rate", "fail", f"{says}; proven above it, rate > {lower:.2%}")


def overall(findings: list[Finding]) -> str:
    """Fail if anything failed, inconclusive if anything could not be decided, else pass."""
    verdicts = {f.verdict for f in findings}
    return next((v for v in ("fail", "inconclusive") if v in verdicts), "pass")
