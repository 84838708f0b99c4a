"""Batch quotas: logged rows up to their replay limit, fresh rows for the rest, or a shortfall."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.errors import MixtureError
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.mixture.share_controller import PlannedDraws, SampledStratum, ShareController
from restock.replay.plan.strata import rules_of
from restock.replay.sampling.ring import FreshRing

QUOTAS = (
    "max_replays_per_row = 400\n"
    "[[strata]]\nname = 'nominal'\nshare = 0.4\n"
    "[[strata]]\nname = 'slip'\nshare = 0.3\n"
    "[[strata]]\nname = 'near'\nshare = 0.3\n"
)
NAMES = ("nominal", "slip", "near")
ROWS = (7_628, 915, 559)  # as in the sample logs
BATCH = 128
PLENTY = np.full(3, 1e6)


def controller(
    env_steps: int,
    *,
    rows: tuple[int, ...] = ROWS,
    text: str = QUOTAS,
    known: tuple[bool, ...] = (True, True, True),
    corrected: tuple[bool, ...] = (False, False, False),
) -> ShareController:
    """Return the share controller of a run of `env_steps` steps with the default schedule."""
    mixture = parse_mixture(text)
    strata = [
        SampledStratum(name, "logs", rule, count, 9, corrected=weighed)
        for name, rule, count, weighed in zip(
            NAMES, rules_of(mixture, NAMES), rows, corrected, strict=True
        )
    ]
    planned = PlannedDraws(2_000 * BATCH, 0.25 * (env_steps - 2_000) * BATCH, 2_000, env_steps)
    return ShareController(mixture, strata, planned, fresh=np.array(known))


def drive(
    shares: ShareController, env_steps: int, stock: np.ndarray, batches: int = 400
) -> np.ndarray:
    """Return rows fed by stratum and source (4, 2) over a run; `batches` stand for all of them."""
    fed = np.zeros((4, 2))
    begin = shares.planned.begin_env_steps
    each = shares.planned.online / batches
    for number in range(batches):
        shares.batches = 0  # each stands for many, so shares are always recomputed
        shares.at(begin + (env_steps - begin) * number / batches, stock)
        logged = shares.shares * shares.logs_share * each
        shares.drawn = shares.drawn + np.round(logged).astype(np.int64)
        fed[:3, 0] += logged
        fed[:, 1] += shares.fresh_shares * each
    return fed


@pytest.mark.parametrize("env_steps", [48_000, 128_000, 200_000, 288_000, 1_800_000])
def test_quotas_hold_at_every_budget(env_steps):
    """Regression: from 288,000 steps on, quotas were redistributed to nominal."""
    shares = controller(env_steps)
    np.testing.assert_allclose(shares.shares, [0.4, 0.3, 0.3])  # offline, whatever the budget
    fed = drive(shares, env_steps, PLENTY)
    np.testing.assert_allclose(fed[:3].sum(axis=1) / fed.sum(), [0.4, 0.3, 0.3], atol=0.002)
    assert fed[3].sum() < 1e-6
    assert (shares.drawn <= 400 * np.array(ROWS)).all()
    (nominal, slip, near) = shares.forecast()
    assert [row["short_share"] for row in (nominal, slip, near)] == [0, 0, 0]
    whole = shares.planned.offline + shares.planned.online
    assert near["logs_share"] * whole <= 400 * 559 * 1.001
    assert near["logs_share"] + near["fresh_share"] == pytest.approx(0.3)


def test_half_of_quota_is_logged_if_limits_allow():
    shares = controller(20_000)
    shares.at(2_000, PLENTY)
    assert shares.logs_share == pytest.approx(0.5)
    np.testing.assert_allclose(shares.fresh_shares, [0.2, 0.15, 0.15, 0], atol=1e-12)


def test_logged_rows_fill_quotas_while_ring_is_empty():
    shares = controller(20_000)
    shares.at(2_000, np.zeros(3))
    np.testing.assert_allclose(shares.shares * shares.logs_share, [0.4, 0.3, 0.3])
    shares.batches = 0
    shares.at(2_100, np.array([0.1, 0.05, 0.0]))  # stock in batches: 12 rows and 6
    np.testing.assert_allclose(shares.fresh_shares, [0.1, 0.05, 0, 0], atol=1e-12)
    np.testing.assert_allclose(shares.shares * shares.logs_share, [0.3, 0.25, 0.3], atol=0.01)


def test_shortfall_is_not_given_to_nominal():
    shares = controller(1_800_000, known=(True, True, False))
    fed = drive(shares, 1_800_000, PLENTY)
    nominal, slip, near, anything = fed.sum(axis=1) / fed.sum()
    assert (nominal, slip) == pytest.approx((0.4, 0.3), abs=0.002)
    assert near < 0.005
    assert anything == pytest.approx(0.3 - near, abs=0.002)  # rows of any stratum, reported as such
    row = shares.forecast()[2]
    assert row["short_share"] == pytest.approx(0.3 - row["logs_share"])
    assert row["reason"] == (
        "its 559 logged rows give 400 draws each, and the twin has no fresh rows of it"
    )
    with pytest.raises(MixtureError, match=r"near wants 30\.0% of the rows fed and gets 0\.4%"):
        controller(1_800_000, known=(True, True, False), text="shortfall = 'refuse'\n" + QUOTAS)
    controller(1_800_000, text="shortfall = 'refuse'\n" + QUOTAS)  # the ring fills it


def test_logged_rows_fill_quota_without_fresh_rows():
    """Regression: they gave half of the quota and left the rest short, whatever their limit."""
    for hindered in ({"known": (True, True, False)}, {"corrected": (False, False, True)}):
        shares = controller(10_000, **hindered)
        shares.at(2_000, PLENTY)
        assert (shares.shares * shares.logs_share)[2] == pytest.approx(0.3)
        assert shares.fresh_shares[3] == pytest.approx(0, abs=1e-12)
        assert shares.forecast()[2]["short_share"] == 0
    # Importance weights would undo a boost of fresh rows.
    shares = controller(1_800_000, corrected=(False, False, True))
    shares.at(2_000, PLENTY)
    assert shares.fresh_shares[2] == 0
    assert "importance weights" in str(shares.forecast()[2]["reason"])


def test_ring_is_drawn_without_strata_if_no_quotas():
    shares = controller(48_000, text="[each_condition]\nshare = 'natural'\n")
    shares.at(2_000, PLENTY)
    np.testing.assert_array_equal(shares.fresh_shares, [0, 0, 0, 0.5])
    assert shares.logs_share == 0.5
    assert [row["short_share"] for row in shares.forecast()] == [0, 0, 0]


@given(
    st.tuples(*[st.integers(0, 5_000)] * 3).filter(lambda rows: rows[0] > 3_000),
    st.lists(st.floats(0, 2), min_size=3, max_size=3),
    st.integers(10_000, 3_000_000),
    st.tuples(*[st.booleans()] * 3),
)
def test_no_stratum_gets_more_than_its_quota(rows, stock, env_steps, known):
    shares = controller(env_steps, rows=rows, known=known)
    shares.at(2_000, np.array(stock))
    logs, fresh = shares.shares * shares.logs_share, shares.fresh_shares
    assert logs.sum() + fresh.sum() == pytest.approx(1)
    assert (logs + fresh[:3] <= shares.wanted + 1e-9).all()
    assert (fresh[:3] <= np.array(stock) + 1e-9).all()
    assert (fresh[:3][~np.array(known)] == 0).all()
    left = 400.0 * np.array(rows)
    assert (logs * shares.planned.online <= left * 1.0001).all()


def test_replanning_changes_logged_share():
    shares = controller(288_000)
    shares.at(2_000, PLENTY)
    before = shares.logs_share
    planned = shares.planned
    half = PlannedDraws(planned.offline, planned.online / 2, 2_000, 145_000)
    assert shares.replan(half)
    assert shares.logs_share > before


def ring_of(strata: list[int], rows: int = 40) -> FreshRing:
    """Return a ring with one ended episode whose steps are in these strata (-1: in none)."""
    ring = FreshRing(rows, 1, 1, discount=0.9, conditions=("any",), strata=("a", "b"))
    keys = [append(ring, step, ends=step == len(strata) - 1) for step in range(len(strata))]
    ring.set_labels(keys[-1], np.zeros(len(strata), np.int64), np.array(strata))
    return ring


def append(ring: FreshRing, step: int, ends: bool = False) -> int:
    """Append a step, and return its episode's key."""
    values = dict.fromkeys(("action", "reward"), np.zeros(1))
    values |= dict.fromkeys(("observation", "next_observation"), np.zeros((1, 1)))
    ended = {"terminated": np.array([ends]), "truncated": np.array([False])}
    return int(ring.append(**values, **ended, env_step=step, gradient_step=0)[0])


def test_ring_draws_by_stratum_within_limit():
    ring, rng = ring_of([0, 0, 1, -1, 1]), np.random.default_rng(0)
    assert ring.stratum_rows.tolist() == [2, 2]
    drawn = np.concatenate([ring.draw(np.array([1, 0]), rng, limit=3) for _ in range(20)])
    assert set(drawn.tolist()) == {0, 1}
    assert np.bincount(drawn).max() == 3  # then the stratum is exhausted
    assert ring.by_stratum.counts.tolist() == [0, 2]
    assert ring.stratum_rows.tolist() == [2, 2]  # exhausted rows still count
    assert set(ring.draw(np.array([0, 9]), rng).tolist()) == {2, 4}
    assert set(ring.draw(np.array([0, 9]), rng, since=3).tolist()) == {4}


def test_overwritten_row_leaves_its_stratum():
    ring = ring_of([0, 0, 1, 1], rows=4)
    ring.draw(np.array([5, 5]), np.random.default_rng(0))
    state = ring.state_dict()
    restored = FreshRing(4, 1, 1, discount=0.9, conditions=("any",), strata=("a", "b"))
    restored.load_state_dict(state)
    np.testing.assert_array_equal(restored.draws, ring.draws)
    for _ in range(2):
        append(ring, 9)
    assert ring.by_stratum.counts.tolist() == [0, 2]
    assert ring.stratum.tolist() == [-1, -1, 1, 1]
    assert ring.draws[:2].tolist() == [0, 0]
    assert restored.by_stratum.counts.tolist() == [2, 2]
