"""Intervals against published and hand-made values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.stats import bootstrap, iqm, probability_of_improvement, wilson


def test_wilson_against_the_published_values() -> None:
    # Newcombe 1998 (Statist. Med. 17), table I, method 3, without continuity correction.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def test_wilson_without_trials_knows_nothing() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 of 2"):
        wilson(3, 2)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_share_and_stays_in_range(case: tuple[int, int]) -> None:
    successes, trials = case
    low, high = wilson(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    assert high - low > 0


def test_iqm_leaves_out_the_outer_quarters() -> None:
    assert iqm(np.array([-100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0])) == 3.5


def test_bootstrap_is_seeded_and_covers_the_mean() -> None:
    rng = np.random.default_rng(0)
    groups = [rng.normal(0, 1, 200), rng.normal(10, 1, 200)]
    low, high = bootstrap(groups, rng=np.random.default_rng(1), resamples=500)
    assert (low, high) == bootstrap(groups, rng=np.random.default_rng(1), resamples=500)
    # Stratified: the interval has the width of the noise within, not of the gap between.
    assert low < np.mean(np.concatenate(groups)) < high
    assert high - low < 0.4


def test_probability_of_improvement_counts_ties_half() -> None:
    assert probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0])) == 0.875
