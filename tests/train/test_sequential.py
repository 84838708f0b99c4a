"""Check the error rates of sequential bounds of a mean difference in simulations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.arrays import F64
from restock.stats import wilson
from restock.train.judge.sequential import ConfidenceSequence, bets, pairs_needed

MARGIN, VARIANCE = 0.05, 0.25


def paired_differences(
    success: float, baseline: float, correlation: float, shape: tuple[int, int]
) -> F64:
    """Draw differences in success between two policies on the same missions."""
    spread = np.sqrt(success * (1 - success) * baseline * (1 - baseline))
    both = success * baseline + correlation * spread
    uniform = np.random.default_rng(0).random(shape)
    better, worse = success - both, baseline - both
    return np.where(uniform < better, 1.0, np.where(uniform < better + worse, -1.0, 0.0))


def passing_share(differences: F64, error: float = 0.05) -> float:
    """Return the share of rows (n, pairs) that ever show a mean above the margin."""
    wealth, most = np.zeros(len(differences)), np.zeros(len(differences))
    for pair in range(differences.shape[1]):
        seen = differences[:, :pair]
        bet, _ = bets(
            np.full(len(differences), -MARGIN),
            pair,
            seen.sum(axis=1),
            (seen**2).sum(axis=1),
            bound=1.0,
            variance=VARIANCE,
        )
        wealth += np.log1p(bet * (differences[:, pair] + MARGIN))
        most = np.maximum(most, wealth)
    return float((most >= np.log(1 / error)).mean())


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_policy_at_margin_rarely_passes(correlation: float) -> None:
    runs = 600
    share = passing_share(paired_differences(0.85, 0.9, correlation, (runs, 300)))
    assert wilson(round(share * runs), runs)[0] <= 0.05
    assert passing_share(paired_differences(0.8, 0.9, correlation, (runs, 300))) == 0.0


def test_confidence_sequence_matches_its_bets() -> None:
    for row in paired_differences(0.9, 0.9, 0.5, (5, 400)):
        sequence = ConfidenceSequence(1.0, -MARGIN, variance=VARIANCE)
        for difference in row:
            sequence.add(float(difference))
        assert (sequence.above_at is not None) == (passing_share(row[None]) == 1.0)
        assert sequence.below_at is None


@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=60))
def test_bounds_only_tighten(differences: list[float]) -> None:
    sequence = ConfidenceSequence(2.0, -0.1, variance=0.1)
    for difference in differences:
        sequence.add(difference)
    assert sequence.pairs == len(sequence.low) == len(sequence.high)
    assert sequence.low == sorted(sequence.low)
    assert sequence.high == sorted(sequence.high, reverse=True)
    assert sequence.low[-1] >= -2.0
    assert sequence.high[-1] <= 2.0


def test_pairs_needed_is_smallest_deciding_budget() -> None:
    needed = pairs_needed(1.0, -MARGIN, variance=VARIANCE)
    sequence = ConfidenceSequence(1.0, -MARGIN, variance=VARIANCE)
    for _ in range(needed - 1):
        sequence.add(0.0)
    assert sequence.above_at is None
    assert pairs_needed(1.0, -0.2, variance=VARIANCE) < needed
