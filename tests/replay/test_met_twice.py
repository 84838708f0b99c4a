"""Numbers that come more than once are all found, and few others."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.replay.store.same_drives import MARKED, MetTwice, occurs_again

NUMBERS = st.integers(-(2**63), 2**63 - 1)


@settings(max_examples=200)
@given(st.lists(st.lists(st.one_of(NUMBERS, st.integers(0, 9)), max_size=40), max_size=6))
def test_none_that_comes_again_is_missed(parts):
    arrays = [np.array(part, np.int64) for part in parts]
    observed = MetTwice(sum(map(len, parts)))
    for part in arrays:
        observed.add(part)
    every = np.concatenate([np.empty(0, np.int64), *arrays])
    maybe = np.concatenate([np.empty(0, np.bool_), *(observed.maybe(part) for part in arrays)])
    exact = occurs_again(every)
    assert exact.tolist() == [int((every == value).sum()) > 1 for value in every]
    assert not (exact & ~maybe).any()


def test_of_many_that_come_once_few_are_taken_for_others():
    count = 20 * MARKED + 5
    values = np.random.default_rng(0).integers(-(2**63), 2**63 - 1, count)
    copies = np.concatenate([values, values[:100], values[MARKED - 3 : MARKED + 3]])
    observed = MetTwice(len(copies))
    observed.add(copies)
    maybe = observed.maybe(copies)
    assert maybe[occurs_again(copies)].all()
    assert maybe.mean() < 0.25
