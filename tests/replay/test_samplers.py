"""Every sampler meets exact quotas over time and draws the same after a restart."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from support.states import through_json

from restock.errors import MixtureError
from restock.replay.sampling.rules import EPSILON, Prioritised
from restock.replay.sampling.sampler import Quotas, QuotaSampler
from restock.train.run import checkpoint

STRATA = [np.arange(0, 400, 2), np.arange(1, 101, 2)]  # 200 and 50 rows
SHARES = [0.7, 0.3]
PARTS = st.lists(st.integers(0, 1000), min_size=1, max_size=9).filter(lambda s: sum(s) > 0)
RULES = {
    "with replacement": ["uniform", "uniform"],
    "without replacement": ["without_replacement", "without_replacement"],
    "PER": ["per", "per"],
    "without replacement beside PER": ["without_replacement", "per"],
}
PER = Prioritised(per_alpha=0.7)


def make(rules: list[str], seed: int = 0, batch_size: int = 50) -> QuotaSampler:
    rng = np.random.default_rng(seed)
    return QuotaSampler(STRATA, SHARES, batch_size, rng, within=rules, prioritised=PER)


def errors() -> np.ndarray:
    """Return |TD| of each row (400,), over three orders of magnitude."""
    return 10 ** np.random.default_rng(5).uniform(-2, 1, 400)


def priority(rule: str, td_abs: np.ndarray) -> np.ndarray:
    """Return priorities as in the PER paper; 1 for other rules."""
    return (td_abs + EPSILON) ** PER.per_alpha if rule == "per" else np.ones_like(td_abs)


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_quotas_are_exact_and_rows_follow_rule(rules):
    sampler, td = make(rules, batch_size=40), errors()  # 28 and 12
    for rows in STRATA:
        sampler.update(rows, td[rows])
    counts = np.zeros(400)
    for _ in range(4000):
        drawn, stratum = sampler.draw()
        assert np.bincount(stratum).tolist() == [28, 12]
        assert ((drawn % 2 == 1) == (stratum == 1)).all()
        np.add.at(counts, drawn, 1)
    for rows, total, rule in zip(STRATA, (112_000, 48_000), rules, strict=True):
        assert counts[rows].sum() == total
        if rule == "without_replacement":
            assert np.ptp(counts[rows]) <= 1
        else:
            share = priority(rule, td[rows])
            assert stats.chisquare(counts[rows], share / share.sum() * total).pvalue > 1e-4
    assert counts.sum() == 160_000


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
@pytest.mark.parametrize("before", [0, 3, 107])  # after 107, rows drawn ahead were returned
def test_restored_sampler_continues_exactly(rules, tmp_path, before):
    def go_on(sampler: QuotaSampler, batches: int, seed: int) -> list[Any]:
        observed: list[Any] = []
        rng = np.random.default_rng(seed)
        for index in range(batches):
            if index == 100:
                sampler.set_shares([0.2, 0.8])
            if index == 105:
                sampler.set_batch_size(31)
            drawn, stratum = sampler.draw()
            weights = sampler.drawn_weights
            observed += [drawn.tolist(), stratum.tolist()]
            observed.append(None if weights is None else weights.tolist())
            sampler.update(drawn, rng.uniform(0, 9, len(drawn)))
        return observed

    first, second, third = (make(rules, seed) for seed in (1, 2, 3))
    go_on(first, before, seed=1)
    state = first.state_dict()
    checkpoint.save(tmp_path / "state", state)
    second.load_state_dict(checkpoint.load(tmp_path / "state"))
    third.load_state_dict(through_json(state))
    assert second.batch_size == first.batch_size
    expected = go_on(first, 250, seed=2)  # into blocks drawn later
    assert go_on(second, 250, seed=2) == expected
    assert go_on(third, 250, seed=2) == expected


def test_state_of_other_rule_is_refused():
    def sampler(within: str) -> QuotaSampler:
        return QuotaSampler(STRATA, SHARES, 50, np.random.default_rng(0), within=within)

    with pytest.raises(MixtureError, match="another rule"):
        sampler("per").load_state_dict(sampler("uniform").state_dict())
    with pytest.raises(MixtureError, match="another rule"):
        sampler("per").load_state_dict({})


@settings(max_examples=150)
@given(parts=PARTS, batch_size=st.integers(1, 300), draws=st.integers(1, 200))
def test_batches_are_full_and_shares_met_over_time(parts, batch_size, draws):
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


@settings(max_examples=60)
@given(
    steps=st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(1, 40)), max_size=8),
    within=st.sampled_from(["uniform", "without_replacement"]),
    seed=st.integers(0, 2**32),
)
def test_share_error_is_bounded_when_shares_change(steps, within, seed):
    rows = [np.arange(0, 30), np.arange(30, 41), np.arange(41, 60)]
    sampler = QuotaSampler(rows, [0.5, 0.3, 0.2], 16, np.random.default_rng(seed), within=within)
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
            # A stratum whose share becomes 0 forfeits its remainder: less than a row per change.
            assert np.abs(total - wanted).max() < 3.0 + len(steps)
        if within == "without_replacement":  # rows drawn ahead and returned do not count
            assert all(np.ptp(counts[members]) <= 1 for members in rows)


@pytest.mark.parametrize(
    ("shares", "message"),
    [([0.5, 0.4], "sum to 1"), ([1.5, -0.5], "not negative"), ([1.0, np.nan], "finite")],
)
def test_invalid_shares_are_refused(shares, message):
    with pytest.raises(MixtureError, match=message):
        Quotas(shares, 8)
