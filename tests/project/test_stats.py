"""Intervals against published and hand-made values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.stats import (
    ConfidenceInterval,
    bootstrap,
    cluster_counts,
    clustered_quantiles,
    clustered_ratio,
    difference_of_arms,
    for_few_clusters,
    holm,
    improvement_of_arms,
    paired_t,
    percentiles,
    wilson,
)


def test_wilson_equals_published_values() -> None:
    # Newcombe 1998 (Statist. Med. 17), table I, method 3, without continuity correction.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_contains_share_and_stays_in_range(case: tuple[int, int]) -> None:
    successes, trials = case
    low, high = wilson(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    assert high - low > 0


def test_bootstrap_is_seeded_and_covers_the_mean() -> None:
    rng = np.random.default_rng(0)
    groups = [rng.normal(0, 1, 200), rng.normal(10, 1, 200)]
    low, high = bootstrap(groups, rng=np.random.default_rng(1), resamples=500)
    assert (low, high) == bootstrap(groups, rng=np.random.default_rng(1), resamples=500)
    # Stratified: the interval has the width of the noise within, not of the gap between.
    assert low < np.mean(np.concatenate(groups)) < high
    assert high - low < 0.4


def test_improvement_interval_covers_seeds_and_episodes() -> None:
    """Arms that are alike: the interval holds one half about as often as it says."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(60):
        episodes = rng.normal(size=20)
        one, other = (
            episodes + rng.normal(size=(5, 1)) + rng.normal(size=(5, 20)) for _ in range(2)
        )
        found = improvement_of_arms(one, other, rng=rng, resamples=200)
        assert found.low <= found.value <= found.high
        held += found.low <= 0.5 <= found.high
    assert held >= 51
    alone = improvement_of_arms(np.ones((1, 9)), np.zeros((3, 9)), rng=rng)
    assert alone.value == 1.0
    assert np.isnan(alone.low)


def test_quantiles_count_clusters_not_rows() -> None:
    rng = np.random.default_rng(0)
    values = np.repeat(rng.normal(size=12), 50)  # 12 episodes of equal segments
    cluster = np.repeat(np.arange(12), 50)
    (together,) = clustered_quantiles(values, cluster, [0.5], rng=np.random.default_rng(1))
    (apart,) = clustered_quantiles(values, np.arange(600), [0.5], rng=np.random.default_rng(1))
    assert together.value == apart.value == np.quantile(values, 0.5, method="inverted_cdf")
    assert together.high - together.low > 2 * (apart.high - apart.low)


def test_intervals_have_nominal_coverage() -> None:
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        effect = rng.normal(size=30)
        values = (effect[:, None] + 0.1 * rng.normal(size=(30, 5))).reshape(-1)
        mean = clustered_ratio(
            values, np.ones(150), np.repeat(np.arange(30), 5), rng=rng, resamples=400
        )
        hits += mean.low <= 0 <= mean.high
    assert 0.88 <= hits / 200 <= 0.99


def test_paired_t_equals_published_value() -> None:
    # Student 1908 (Biometrika 6), hours of sleep gained by ten patients under two drugs.
    gained = np.array([1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4])
    interval, p = paired_t(gained)
    assert (interval.value, p) == pytest.approx((1.58, 0.00283), abs=1e-5)
    assert (interval.low, interval.high) == pytest.approx((0.7001, 2.4599), abs=1e-4)


@pytest.mark.parametrize(
    "ahead", [[0.3], [0.3, 0.3], [-0.1, 0.7], [0.0, 0.0, 0.0], [0.1 + 0.2, 0.3, 0.6 - 0.3]]
)
def test_two_or_equal_pairs_have_no_interval(ahead: list[float]) -> None:
    """Two seeds that came to the same difference were significant, with p < .001."""
    found, p = paired_t(np.array(ahead))
    assert found.value == pytest.approx(np.mean(ahead))
    assert np.isnan([found.low, found.high, p]).all()


def test_interval_is_clipped_to_range() -> None:
    assert ConfidenceInterval(0.5, -5.85, 6.85).within(0, 1) == ConfidenceInterval(0.5, 0.0, 1.0)
    assert ConfidenceInterval(2.0, 1.0, 3.0).within(0) == ConfidenceInterval(2.0, 1.0, 3.0)
    unknown = ConfidenceInterval(0.5, float("nan"), float("nan")).within(0, 1)
    assert np.isnan([unknown.low, unknown.high]).all()


@pytest.mark.parametrize(("runs", "episodes"), [(3, 40), (5, 60)])
def test_arm_difference_covers_seeds_and_episodes(runs: int, episodes: int) -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(250):
        hard = rng.normal(0, 1, episodes)  # to both arms alike
        arms = [
            hard
            + rng.normal(0, 0.5, episodes)  # to this method
            + rng.normal(0, 0.3, (runs, 1))  # a seed's luck
            + rng.normal(0, 1, (runs, episodes))
            > 0
            for _ in range(2)
        ]
        found = difference_of_arms(*arms)
        hits += found.low <= 0 <= found.high
    assert hits / 250 == pytest.approx(0.95, abs=0.04)


@pytest.mark.parametrize("clusters", [5, 8])
def test_few_clusters_have_nominal_coverage(clusters: int) -> None:
    rng, covered = np.random.default_rng(clusters), {"percentile": 0, "widened": 0}
    repeats = 1000
    for values in rng.normal(0.0, 1.0, (repeats, clusters)):
        counts = cluster_counts(clusters, 400, rng)
        found = ConfidenceInterval(
            float(values.mean()), *percentiles(counts @ values / counts.sum(axis=1))
        )
        for name, one in (("percentile", found), ("widened", for_few_clusters(found, clusters))):
            covered[name] += one.low <= 0.0 <= one.high
    assert covered["percentile"] < 0.91 * repeats
    assert 0.93 * repeats < covered["widened"] < 0.97 * repeats


def test_holm_equals_worked_example() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_keeps_order_and_never_lowers(p_values: list[float]) -> None:
    adjusted = holm(p_values)
    assert all(p <= q <= 1 for p, q in zip(p_values, adjusted, strict=True))
    ranked = [adjusted[place] for place in np.argsort(p_values)]
    assert ranked == sorted(ranked)
