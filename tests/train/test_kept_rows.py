"""Compare the recorded rows of compiled code and of NumPy."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock import native
from restock.replay.sampling.ring import FreshRing
from restock.train.feed.sampled_rows import FRESH, LOGGED, BatchValues, SampledRows, keep_rows

compiled = pytest.mark.skipif(not native.IS_USED, reason=f"native code is {native.state()}")
CAPACITY = 50


def ring_of(rng: np.random.Generator) -> FreshRing:
    """Return a ring with random metadata."""
    ring = FreshRing(
        CAPACITY, 1, 4, discount=0.9, n_step=1, conditions=["a", "b"], behaviour_policies=["p"]
    )
    for name in ("episode", "episode_step", "behaviour_policy", "env_step", "gradient_step"):
        ring.meta[name][:] = rng.integers(0, 30_000, CAPACITY)
    ring.by_condition.stratum[:] = rng.integers(-1, 2, CAPACITY)
    return ring


def batch(rng: np.random.Generator, logged: int, fresh: int, weighted: bool) -> dict[str, Any]:
    rows = logged + fresh
    packed = rng.normal(size=(rows, 11)).astype(np.float32)
    packed[:, 8] = rng.integers(0, 10, rows)
    td, q, weight = rng.normal(size=(3, rows)).astype(np.float32)
    return {
        "values": BatchValues(td, q, weight if weighted else None, packed[:, -3:]),
        "log_rows": rng.integers(0, 1 << 40, logged),
        "log_stratum": rng.integers(0, 8, logged),
        "slots": rng.integers(0, CAPACITY, fresh),
        "clocks": (int(rng.integers(1 << 40)), int(rng.integers(1 << 40))),
    }


@compiled
@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32),
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.booleans()), max_size=8),
    st.integers(0, 8),
)
def test_compiled_rows_match_numpy(seed, sizes, cleared_after):
    rng = np.random.default_rng(seed)
    ring = ring_of(rng)
    both = [(SampledRows(LOGGED), SampledRows(FRESH)) for _ in range(2)]
    for place, (logged, fresh, weighted) in enumerate(sizes):
        sampled = batch(rng, logged, fresh, weighted)
        for sources, by_native in zip(both, (True, False), strict=True):
            to = {"ring": ring, "logged": sources[0], "fresh": sources[1], "by_native": by_native}
            keep_rows(**sampled, **to)
            if place == cleared_after:
                taken = [(rows, dict(rows.columns)) for rows in sources]
                before = [
                    {name: column_values.copy() for name, column_values in reported.items()}
                    for _, reported in taken
                ]
                for rows, _ in taken:
                    rows.clear()
                keep_rows(**sampled, **to)
                for (_, reported), held in zip(taken, before, strict=True):
                    for name, column_values in held.items():
                        assert np.array_equal(reported[name], column_values)
    for of_compiled, of_numpy in zip(*both, strict=True):
        assert len(of_compiled) == len(of_numpy)
        for name, column in of_compiled.columns.items():
            assert column.dtype == of_numpy.columns[name].dtype
            assert np.array_equal(column, of_numpy.columns[name]), name
            assert np.array_equal(of_compiled.last[name], of_numpy.last[name])
