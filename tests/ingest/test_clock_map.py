"""Log time to stamped time: exact at its knots, monotone between them, at one pace beyond."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.ingest.steps.clocks import ClockMap, residual_ns, spread_ns

NS = 10**9
DAY = 1_700_000_000 * NS


@pytest.mark.parametrize("pace", [0.25, 0.5, 0.9, 0.97, 1.0, 1.1])
def test_a_steady_pace_is_followed_to_the_nanosecond(pace: float) -> None:
    log = DAY + np.arange(0, 60 * NS, NS // 20)
    stamp = np.rint((log - DAY) * pace).astype(np.int64)
    fitted = ClockMap.through(log, stamp)
    between = DAY + np.arange(0, 59 * NS, 7_654_321)
    assert np.abs(fitted.stamped(between) - (between - DAY) * pace).max() <= 1
    outside = DAY + np.array([-5 * NS, 70 * NS])
    np.testing.assert_allclose(fitted.stamped(outside), [-5 * NS * pace, 70 * NS * pace], atol=2)
    assert spread_ns(residual_ns(log, stamp)) <= 2


def test_a_pause_is_a_flat_piece_and_a_constant_offset_one_knot() -> None:
    log = DAY + np.array([0, 1, 2, 12, 13], np.int64) * NS  # the simulation stood for ten seconds
    stamp = np.array([0, 1, 2, 2, 3], np.int64) * NS
    fitted = ClockMap.through(log, stamp)
    assert fitted.stamped(DAY + np.array([7 * NS, 12 * NS + NS // 2])).tolist() == [
        2 * NS,
        NS * 5 // 2,
    ]
    fixed = ClockMap.constant(DAY)
    assert fixed.is_constant
    assert fixed.stamped(log).tolist() == (log - DAY).tolist()


@given(st.lists(st.tuples(st.integers(0, 10**12), st.integers(0, 10**12)), min_size=1, max_size=40))
def test_it_never_goes_back_and_meets_its_newest_stamps(pairs: list[tuple[int, int]]) -> None:
    log, stamp = (np.array(column, np.int64) + DAY for column in zip(*pairs, strict=True))
    fitted = ClockMap.through(log, stamp)
    at = np.sort(
        np.concatenate([log, log + 1, np.linspace(log.min(), log.max(), 50).astype(np.int64)])
    )
    assert (np.diff(fitted.stamped(at)) >= 0).all()
    for one in np.unique(log):
        newest = stamp[log <= one].max()
        assert fitted.stamped(np.array([one]))[0] == newest
