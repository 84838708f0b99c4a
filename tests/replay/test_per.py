"""Prioritised draws are proportional to priorities, and importance weights undo exactly that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock import native
from restock.errors import MixtureError
from restock.replay.sampling.rules import (
    BETA_BATCHES,
    CHUNK,
    Per,
    Prioritised,
    StratumRows,
    find_places,
)
from restock.replay.sampling.sampler import QuotaSampler

STRATA = [np.arange(0, 400, 2), np.arange(1, 101, 2)]  # 200 and 50 rows
SHARES = [0.7, 0.3]


def sampler(*, block: int | None = None, **numbers: float) -> QuotaSampler:
    rng, given_numbers = np.random.default_rng(0), Prioritised(**numbers)  # type: ignore[arg-type]
    return QuotaSampler(
        STRATA, SHARES, 50, rng, within="per", prioritised=given_numbers, block=block
    )


def errors(seed: int = 5) -> np.ndarray:
    """Return |TD| of each row (400,), over three orders of magnitude."""
    return 10 ** np.random.default_rng(seed).uniform(-2, 1, 400)


def expected(priority: np.ndarray) -> np.ndarray:
    return priority / priority.sum()


def priorities(count: int, **numbers: float) -> Per:
    rows = StratumRows(
        np.arange(count),
        np.random.default_rng(0),
        Prioritised(**numbers),  # type: ignore[arg-type]
        lambda name: np.empty(0),
    )
    return Per(rows)


def current_priorities(drawing: QuotaSampler) -> list[np.ndarray]:
    """Return the priorities of each stratum as the next block will see them."""
    drawing.state_dict()  # applies the updates since the last block
    return [draws.priority.astype(float) for draws in drawing.draws if isinstance(draws, Per)]


@pytest.mark.parametrize("beta", [0.4, 0.8, 1.0])
def test_weights_match_drawn_distribution(beta):
    drawing = sampler(block=4, per_alpha=0.6, per_beta=beta)
    td = errors()
    for rows in STRATA:
        drawing.update(rows, td[rows])
    drawn_rows = 0
    for batch in range(8):
        # Priorities change after every batch; those of batches 0 to 3 were drawn from the first.
        if batch % 4 == 0:
            before = current_priorities(drawing)
        drawn, stratum = drawing.draw()
        weights = drawing.drawn_weights
        assert weights is not None
        for s, rows in enumerate(STRATA):
            share = dict(zip(rows.tolist(), expected(before[s]), strict=True))
            p = np.array([share[row] for row in drawn[stratum == s].tolist()])
            every = expected(before[s])
            mean = (every * (len(rows) * every) ** -beta).sum()
            np.testing.assert_allclose(
                weights[stratum == s], (len(rows) * p) ** -beta / mean, rtol=1e-4
            )
            drawn_rows += len(p)
        drawing.update(drawn, np.random.default_rng(batch).uniform(0, 5, len(drawn)))
    assert drawn_rows == 400


def test_beta_grows_to_one():
    numbers = Prioritised(per_beta=0.4)
    grown = [numbers.beta_after(part * BETA_BATCHES // 2) for part in (0, 1, 2, 9)]
    assert grown == pytest.approx([0.4, 0.7, 1.0, 1.0])


def test_undrawn_rows_have_largest_priority():
    draws = priorities(4, per_alpha=1.0)
    draws.update(np.array([0, 1]), np.array([7.0, 0.1], np.float32))
    draws.draw(1, np.random.default_rng(0), 0)
    np.testing.assert_allclose(draws.priority, [7.001, 0.101, 7.001, 7.001], rtol=1e-6)


@settings(max_examples=60)
@given(size=st.integers(1, 70), count=st.integers(1, 40), seed=st.integers(0, 2**32))
def test_drawn_places_are_valid_for_any_priorities(size, count, seed):
    rng, draws = np.random.default_rng(seed), priorities(size, per_alpha=1.0)
    for _ in range(12):
        places, weights = draws.draw(count, rng, 0)
        assert len(places) == count
        assert 0 <= places.min() <= places.max() < size
        assert weights is not None
        assert np.isfinite(weights).all()
        draws.update(places, (10 ** rng.uniform(-30, 30, count)).astype(np.float32))


@settings(max_examples=80)
@given(st.integers(0, 2**32), st.integers(1, 200), st.integers(0, 300), st.booleans())
def test_compiled_places_match_numpy(seed, chunks, draws, some_empty):
    if not native.IS_USED:
        pytest.skip(f"native code is {native.state()}")
    rng = np.random.default_rng(seed)
    priority = (10 ** rng.uniform(-4, 2, (chunks, CHUNK))).astype(np.float32)
    if some_empty:  # as in a stratum's last chunk
        priority[rng.random(priority.shape) < 0.5] = 0
        priority[-1, 0] = 1
    sums = np.einsum("ij->i", priority)
    ends = np.cumsum(sums, dtype=np.float64)
    at = np.sort(rng.random(draws)) * ends[-1]
    if draws > 2:
        at[0], at[-1] = 0.0, ends[-1]  # the ends of the range
        at[1] = ends[chunks // 2]
        at.sort()
    places = [np.full(draws, -1, np.int64) for _ in range(2)]
    for find, out in zip((native.compiled.find_places, find_places), places, strict=True):
        find(priority, sums, ends, at, out)
    np.testing.assert_array_equal(places[0], places[1])


def test_draws_match_without_compiled_code(monkeypatch):
    drawn = []
    for used in (native.IS_USED, False):
        monkeypatch.setattr(native, "IS_USED", used)
        drawing = sampler(block=4)
        drawing.update(np.arange(0, 400, 2), errors()[::2])
        drawn.append([(drawing.draw()[0].copy(), drawing.drawn_weights) for _ in range(9)])
    np.testing.assert_equal(*drawn)


def test_mean_weight_of_large_stratum_is_one():
    """Large strata estimate the mean weight from some of their rows: within a percent of 1."""
    rows = np.arange(200_000)
    rng = np.random.default_rng(0)
    drawing = QuotaSampler([rows], [1.0], 256, rng, within="per", block=64)
    drawing.update(rows, 10 ** np.random.default_rng(1).uniform(-2, 1, len(rows)))
    weights = []
    for _ in range(64):
        drawing.draw()
        assert drawing.drawn_weights is not None
        weights.append(float(drawing.drawn_weights.mean()))
    assert np.mean(weights) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("td_abs", "message"),
    [
        (np.array([1.0, np.nan]), "not finite"),
        (np.array([1.0, -0.5]), r"1 TD errors are negative, the least -0\.5"),  # never drawn again
        (np.ones(1), r"for rows of shape \(2,\)"),
        (np.ones((2, 1)), r"for rows of shape \(2,\)"),
    ],
)
def test_invalid_td_errors_are_refused(td_abs, message):
    with pytest.raises(MixtureError, match=message):
        sampler().update(np.array([0, 2]), td_abs)
