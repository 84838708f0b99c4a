"""Log time to stamped time: exact at its knots, monotone between them, at one pace beyond."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from restock.ingest.steps.clocks import ClockMap

NS = 10**9
DAY = 1_700_000_000 * NS


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
