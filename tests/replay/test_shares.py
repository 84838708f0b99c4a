"""Shares sum to one, keep floors and caps, and stay within the replay limits of the rows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import MixtureError
from restock.replay.mixture.mixture import StratumRule
from restock.replay.mixture.shares import wanted_shares, within_limits
from restock.replay.plan.strata import ResolvedStratum, assign

PARTS = st.integers(0, 1000).map(lambda thousandths: thousandths / 1000)


@st.composite
def rules(draw: st.DrawFn) -> list[StratumRule]:
    found = []
    for index in range(draw(st.integers(1, 7))):
        low, high = sorted((draw(PARTS), draw(PARTS)))
        share = draw(st.one_of(st.sampled_from(["natural", "equal"]), PARTS))
        floor, cap = (low / 2, high) if draw(st.booleans()) else (0.0, 1.0)
        if isinstance(share, float):
            floor, cap = min(floor, share), max(cap, share)
        found.append(StratumRule(name=f"s{index}", share=share, floor=floor, cap=cap))
    return found


@settings(max_examples=300)
@given(rules(), st.data())
def test_wanted_shares_sum_to_one_within_floors_and_caps(given_rules, data):
    rows = np.array([data.draw(st.integers(0, 10_000)) for _ in given_rules])
    fixed = sum(rule.share for rule in given_rules if isinstance(rule.share, float))
    flexible = [rule for rule in given_rules if isinstance(rule.share, str)]
    rest = 1 - fixed
    low, high = sum(rule.floor for rule in flexible), sum(rule.cap for rule in flexible)
    close = min(abs(rest - low), abs(high - rest), abs(rest)) < 1e-6
    feasible = low <= rest + 1e-9 and (high >= rest - 1e-9 if flexible else abs(rest) < 1e-6)
    if not feasible and not close:
        with pytest.raises(MixtureError, match=r"sum to"):
            wanted_shares(given_rules, rows)
        return
    try:
        wanted = wanted_shares(given_rules, rows)
    except MixtureError:
        assert close
        return
    assert wanted.sum() == pytest.approx(1)
    for rule, share in zip(given_rules, wanted, strict=True):
        if isinstance(rule.share, str):
            assert rule.floor - 1e-6 <= share <= rule.cap + 1e-6
        else:
            assert share == pytest.approx(rule.share, abs=1e-6)


@settings(max_examples=300)
@given(st.data())
def test_shares_stay_within_limits_of_rows(data):
    count = data.draw(st.integers(1, 7))
    parts = [np.array([data.draw(PARTS) for _ in range(count)]) for _ in range(3)]
    wanted, limit, caps = parts
    if wanted.sum() == 0:
        wanted = np.ones(count)
    wanted = wanted / wanted.sum()
    shortfall = data.draw(st.sampled_from(["redistribute", "shrink", "refuse"]))
    short = (wanted > limit + 1e-8).any()
    if short and (shortfall == "refuse" or np.minimum(wanted, limit).sum() <= 0):
        with pytest.raises(MixtureError, match=r"who is short|no stratum has rows"):
            within_limits(wanted, limit, caps, shortfall, lambda: "who is short")
        return
    plan = within_limits(wanted, limit, caps, shortfall, lambda: "who is short")
    assert plan.got.sum() == pytest.approx(1)
    assert 0 < plan.scale <= 1
    assert (plan.got * plan.scale <= limit + 1e-6).all()
    if (wanted <= limit + 1e-12).all():
        np.testing.assert_allclose(plan.got, wanted)
    if shortfall == "redistribute":
        # No stratum was raised above its cap, and no room was left unused.
        raised = plan.got * plan.scale > wanted + 1e-6
        assert (plan.got * plan.scale)[raised] == pytest.approx(
            np.minimum(plan.got * plan.scale, caps)[raised], abs=1e-6
        )
        room = np.maximum(np.minimum(limit, caps) - plan.got * plan.scale, 0)
        assert plan.scale == pytest.approx(1, abs=1e-6) or room.sum() < 1e-6


@settings(max_examples=200)
@given(st.data())
def test_rows_are_assigned_by_priority(data):
    count, size = data.draw(st.integers(0, 30)), data.draw(st.integers(1, 5))
    flags = data.draw(st.lists(st.booleans(), min_size=count * size, max_size=count * size))
    member = np.array(flags, np.bool_).reshape(count, size)
    priority = data.draw(st.lists(st.integers(0, 3), min_size=size, max_size=size))
    strata = [
        ResolvedStratum(StratumRule(name=f"s{i}"), "true", None, p, "pre", "none")
        for i, p in enumerate(priority)
    ]
    code = assign(member, strata)
    for row in range(count):
        holds = [(priority[i], i) for i in range(size) if member[row, i]]
        assert code[row] == (min(holds)[1] if holds else -1)
