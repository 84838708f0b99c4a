"""Quotas are exact in every batch and met over time; draws are uniform, and can be resumed."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from restock.errors import MixtureError
from restock.replay.sampling.sampler import Quotas, QuotaSampler, uniform_sampler

SHARES = st.lists(st.integers(0, 1000), min_size=1, max_size=9).filter(lambda s: sum(s) > 0)


@settings(max_examples=150, deadline=None)
@given(parts=SHARES, batch_size=st.integers(1, 300), draws=st.integers(1, 200))
def test_every_batch_is_full_and_every_share_is_met_over_time(
    parts: list[int], batch_size: int, draws: int
) -> None:
    shares = np.array(parts) / sum(parts)
    quotas = Quotas(shares, batch_size)
    total = np.zeros(len(shares))
    for index in range(1, draws + 1):
        quota = quotas.next()
        assert quota.sum() == batch_size
        assert (quota >= 0).all()
        assert (quota[shares == 0] == 0).all()
        total += quota
        # However long it runs, no stratum is ever two rows away from its share.
        assert np.abs(total - index * batch_size * shares).max() < 2.0


def test_a_share_too_small_for_one_batch_is_met_exactly_over_time() -> None:
    quotas = Quotas([0.997, 0.003], 128)
    assert sum(int(quotas.next()[1]) for _ in range(1000)) == 384  # 0.003 * 128 * 1000


def test_a_quota_of_twelve_is_twelve_in_every_batch() -> None:
    rows = [np.arange(1000), np.arange(1000, 1050)]
    sampler = QuotaSampler(rows, [116 / 128, 12 / 128], 128, np.random.default_rng(0))
    for _ in range(200):
        drawn, stratum = sampler.draw()
        assert (drawn >= 1000).sum() == 12
        assert ((drawn >= 1000) == (stratum == 1)).all()


@pytest.mark.parametrize("replacement", [True, False])
def test_rows_within_a_stratum_are_drawn_uniformly(replacement: bool) -> None:
    rows = [np.arange(0, 400, 2), np.arange(1, 101, 2)]
    sampler = QuotaSampler(rows, [0.7, 0.3], 50, np.random.default_rng(3), replacement=replacement)
    counts = np.zeros(400)
    for _ in range(2000):
        drawn, _ = sampler.draw()
        np.add.at(counts, drawn, 1)
    for stratum, total in zip(rows, (70_000, 30_000), strict=True):
        assert counts[stratum].sum() == total
        if replacement:
            assert stats.chisquare(counts[stratum]).pvalue > 1e-4
        else:
            assert np.ptp(counts[stratum]) <= 1
    assert counts.sum() == 100_000


@settings(max_examples=60, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 30), min_size=1, max_size=5),
    batch_size=st.integers(1, 90),
    seed=st.integers(0, 2**32),
)
def test_without_replacement_no_row_is_drawn_twice_more_than_another(
    sizes: list[int], batch_size: int, seed: int
) -> None:
    starts = np.cumsum([0, *sizes])
    rows = [np.arange(a, b) for a, b in pairwise(starts)]
    shares = np.full(len(sizes), 1 / len(sizes))
    sampler = QuotaSampler(rows, shares, batch_size, np.random.default_rng(seed), replacement=False)
    counts = np.zeros(int(starts[-1]))
    for _ in range(12):
        drawn, stratum = sampler.draw()
        assert len(drawn) == batch_size
        assert all(row in rows[code] for row, code in zip(drawn, stratum, strict=True))
        np.add.at(counts, drawn, 1)
        assert all(np.ptp(counts[members]) <= 1 for members in rows)


@pytest.mark.parametrize("replacement", [True, False])
def test_a_restored_sampler_goes_on_exactly(replacement: bool) -> None:
    def fresh(seed: int) -> QuotaSampler:
        rows = [np.arange(37), np.arange(40, 51)]
        return QuotaSampler(
            rows, [0.83, 0.17], 16, np.random.default_rng(seed), replacement=replacement
        )

    first = fresh(1)
    for _ in range(7):
        first.draw()
    state = first.state_dict()
    arrays = {name: value for name, value in state.items() if isinstance(value, np.ndarray)}
    plain = json.loads(json.dumps({k: v for k, v in state.items() if k not in arrays}))
    expected = [first.draw() for _ in range(200)]  # into blocks drawn later
    second = fresh(2)
    second.load_state_dict({**arrays, **plain})
    for (rows, strata), (again, strata_again) in zip(
        expected, (second.draw() for _ in range(200)), strict=True
    ):
        np.testing.assert_array_equal(rows, again)
        np.testing.assert_array_equal(strata, strata_again)


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(1, 40)), max_size=8),
    replacement=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_shares_and_batch_size_may_change_between_batches(
    steps: list[tuple[int, int, int]], replacement: bool, seed: int
) -> None:
    rows = [np.arange(0, 30), np.arange(30, 41), np.arange(41, 60)]
    sampler = QuotaSampler(
        rows, [0.5, 0.3, 0.2], 16, np.random.default_rng(seed), replacement=replacement
    )
    counts, wanted, total = np.zeros(60), np.zeros(3), np.zeros(3)
    for first, second, batch_size in steps:
        shares = np.array([first, second, 1.0]) / (first + second + 1)
        sampler.set_shares(shares)
        sampler.set_batch_size(batch_size)
        for _ in range(3):
            drawn, stratum = sampler.draw()
            quota = np.bincount(stratum, minlength=3)
            assert quota.sum() == batch_size
            assert (quota[shares == 0] == 0).all()
            np.add.at(counts, drawn, 1)
            total += quota
            wanted += shares * batch_size
            # A stratum whose share goes to 0 forfeits what it is owed: less than a row a change.
            assert np.abs(total - wanted).max() < 3.0 + len(steps)
        if not replacement:  # what was drawn ahead and given back is no turn
            assert all(np.ptp(counts[members]) <= 1 for members in rows)


@pytest.mark.parametrize("replacement", [True, False])
def test_a_sampler_restored_after_a_change_of_shares_goes_on_exactly(replacement: bool) -> None:
    def fresh(seed: int) -> QuotaSampler:
        rows = [np.arange(37), np.arange(40, 51)]
        return QuotaSampler(
            rows, [0.83, 0.17], 16, np.random.default_rng(seed), replacement=replacement
        )

    first = fresh(1)
    first.draw()
    first.set_shares([1 / 3, 2 / 3])
    first.set_batch_size(7)
    second = fresh(2)
    second.load_state_dict(first.state_dict())
    assert second.batch_size == 7
    for index in range(100):
        if index == 50:
            for sampler in (first, second):
                sampler.set_shares([0.9, 0.1])
        for one, other in zip(first.draw(), second.draw(), strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_state_of_other_strata_is_refused() -> None:
    state = uniform_sampler(10, 4, np.random.default_rng(0)).state_dict()
    with pytest.raises(MixtureError, match="other strata"):
        uniform_sampler(11, 4, np.random.default_rng(0)).load_state_dict(state)


@pytest.mark.parametrize(
    ("shares", "message"),
    [([0.5, 0.4], "sum to 1"), ([1.5, -0.5], "not negative"), ([1.0, np.nan], "finite")],
)
def test_shares_that_are_no_distribution_are_refused(shares: list[float], message: str) -> None:
    with pytest.raises(MixtureError, match=message):
        Quotas(shares, 8)


def test_a_share_on_an_empty_stratum_is_refused() -> None:
    with pytest.raises(MixtureError, match="no rows"):
        QuotaSampler([np.arange(3), np.arange(0)], [0.5, 0.5], 8, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    sampler = QuotaSampler([np.arange(3), np.arange(0)], [1.0, 0.0], 8, rng)
    assert set(sampler.draw()[0]) <= {0, 1, 2}
