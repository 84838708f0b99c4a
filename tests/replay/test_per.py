"""Draws are in proportion to priorities, weights undo exactly that, and both can be resumed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from support.states import through_json

from restock import native
from restock.errors import MixtureError
from restock.replay.sampling.priorities import (
    CHUNK,
    Lap,
    Per,
    Priorities,
    PrioritySampler,
    Rule,
    find_places,
)

STRATA = [np.arange(0, 400, 2), np.arange(1, 101, 2)]  # 200 and 50 rows
SHARES = [0.7, 0.3]


def sampler(
    rule: Rule, *, seed: int = 0, batch_size: int = 50, refresh_every: int | None = None
) -> PrioritySampler:
    return PrioritySampler(
        STRATA,
        SHARES,
        batch_size,
        np.random.default_rng(seed),
        rule=rule,
        refresh_every=refresh_every,
    )


def errors(seed: int = 5) -> np.ndarray:
    """|TD| of each row (400,), over three orders of magnitude."""
    return 10 ** np.random.default_rng(seed).uniform(-2, 1, 400)


def priority(rule: Rule | None, td_abs: np.ndarray) -> np.ndarray:
    """As the papers have it."""
    if isinstance(rule, Per):
        return (td_abs + rule.epsilon) ** rule.alpha
    return np.maximum(td_abs, rule.floor) ** rule.alpha if rule else np.ones_like(td_abs)


def expected(priority: np.ndarray) -> np.ndarray:
    return priority / priority.sum()


def test_priorities_are_those_of_the_papers() -> None:
    td, rows = np.array([0.0, 0.5, 4.0], np.float32), np.arange(3)
    strata = [rows, rows + 3]
    priorities = Priorities(strata, [Per(alpha=0.5, epsilon=0.25), Lap(alpha=0.5)])
    for members in strata:
        priorities.update(members, td)
    np.testing.assert_allclose(priorities.of(rows), (td + 0.25) ** 0.5)
    np.testing.assert_allclose(priorities.of(rows + 3), [1.0, 1.0, 2.0])


def test_each_stratum_may_have_its_own_rule() -> None:
    strata = [np.arange(0, 60), np.arange(60, 90), np.arange(90, 130), np.arange(130, 150)]
    rules = [Per(alpha=1.0, beta=1.0), None, Lap(alpha=1.0), None]

    def fresh(seed: int) -> PrioritySampler:
        return PrioritySampler(
            strata,
            [0.25] * 4,
            40,
            np.random.default_rng(seed),
            rule=rules,
            replacement=[True, False, True, True],
        )

    drawing, td = fresh(0), 10 ** np.random.default_rng(1).uniform(-1, 1, 150)
    drawing.update(np.arange(150), td)
    counts = np.zeros(150)
    for _ in range(3000):
        drawn, stratum = drawing.draw()
        assert np.bincount(stratum).tolist() == [10] * 4
        weights = drawing.drawn_weights
        assert weights is not None
        assert (weights[stratum > 0] == 1).all()
        assert (weights[stratum == 0] != 1).all()
        np.add.at(counts, drawn, 1)
    assert np.ptp(counts[strata[1]]) <= 1
    for stratum_index in (0, 2, 3):
        rows = strata[stratum_index]
        wanted = expected(priority(rules[stratum_index], td[rows])) * 30_000
        assert stats.chisquare(counts[rows], wanted).pvalue > 1e-4
    again = fresh(7)
    again.load_state_dict(drawing.state_dict())
    for _ in range(30):
        for one, other in zip(drawing.draw(), again.draw(), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("beta", [0.4, 0.8, 1.0])
def test_weights_are_those_of_the_distribution_drawn_from(beta: float) -> None:
    rule = Per(alpha=0.6, beta=beta, beta_batches=10**12)
    drawing, td = sampler(rule, refresh_every=4), errors()
    for rows in STRATA:
        drawing.update(rows, td[rows])
    seen = 0
    for batch in range(8):
        # Priorities change after every batch; those of batches 0 to 3 were drawn from the first.
        if batch % 4 == 0:
            now = {s: drawing.priorities.of(rows).astype(float) for s, rows in enumerate(STRATA)}
        drawn, stratum = drawing.draw()
        weights = drawing.drawn_weights
        assert weights is not None
        for s, rows in enumerate(STRATA):
            share = dict(zip(rows.tolist(), expected(now[s]), strict=True))
            p = np.array([share[row] for row in drawn[stratum == s].tolist()])
            every = expected(now[s])
            mean = (every * (len(rows) * every) ** -beta).sum()
            np.testing.assert_allclose(
                weights[stratum == s], (len(rows) * p) ** -beta / mean, rtol=1e-4
            )
            seen += len(p)
        drawing.update(drawn, np.random.default_rng(batch).uniform(0, 5, len(drawn)))
    assert seen == 400


def test_weighted_draws_have_the_mean_of_uniform_ones() -> None:
    drawing, value = sampler(Per(alpha=1.0, beta=1.0)), errors(9)
    for rows in STRATA:
        drawing.update(rows, value[rows])  # the value itself decides what is drawn
    total, plain = np.zeros(2), np.zeros(2)
    for _ in range(4000):
        drawn, stratum = drawing.draw()
        total += np.bincount(stratum, drawing.drawn_weights * value[drawn])
        plain += np.bincount(stratum, value[drawn])
    count = 4000 * np.array([35, 15])
    truth = np.array([value[rows].mean() for rows in STRATA])
    np.testing.assert_allclose(total / count, truth, rtol=0.01)
    assert (plain / count > 1.5 * truth).all()


@pytest.mark.parametrize("beta", [0.4, 1.0])
def test_weights_leave_each_stratum_its_share_of_the_gradient(beta: float) -> None:
    drawing, td = sampler(Per(beta=beta, beta_batches=10**12), refresh_every=64), errors()
    td[1::2] *= 50  # of the second stratum
    for rows in STRATA:
        drawing.update(rows, td[rows])
    total = np.zeros(2)
    for _ in range(2000):
        _, stratum = drawing.draw()
        total += np.bincount(stratum, drawing.drawn_weights)
    np.testing.assert_allclose(total / total.sum(), SHARES, rtol=0.01)


def test_beta_grows_to_one_and_lap_has_no_weights() -> None:
    rule = Per(beta=0.4, beta_batches=100)
    assert [rule.beta_after(n) for n in (0, 50, 100, 1000)] == pytest.approx([0.4, 0.7, 1.0, 1.0])
    drawing = sampler(Lap())
    drawing.draw()
    assert drawing.drawn_weights is None


def test_rows_not_drawn_yet_have_the_largest_priority_so_far() -> None:
    priorities = Priorities(STRATA, [Per(alpha=1.0, epsilon=1e-3)] * 2)
    priorities.update(np.array([0, 1]), np.array([7.0, 0.1]))
    priorities.draw(np.array([1, 1]), 0, np.random.default_rng(0))
    # Of its own stratum: the second has had no error above the one it began with.
    np.testing.assert_allclose(priorities.of(np.array([0, 1, 2, 3])), [7.001, 0.101, 7.001, 1.001])


@settings(max_examples=60)
@given(
    sizes=st.lists(st.integers(1, 70), min_size=1, max_size=4),
    batch_size=st.integers(1, 40),
    refresh_every=st.integers(1, 5),
    seed=st.integers(0, 2**32),
)
def test_every_row_drawn_is_of_its_stratum_whatever_the_priorities(
    sizes: list[int], batch_size: int, refresh_every: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows = np.split(rng.permutation(sum(sizes)), np.cumsum(sizes)[:-1])
    drawing = PrioritySampler(
        rows,
        np.full(len(sizes), 1 / len(sizes)),
        batch_size,
        rng,
        rule=Per(alpha=1.0),
        refresh_every=refresh_every,
    )
    for _ in range(12):
        drawn, stratum = drawing.draw()
        assert len(drawn) == batch_size
        assert all(row in rows[code] for row, code in zip(drawn, stratum, strict=True))
        assert np.isfinite(drawing.drawn_weights).all()
        drawing.update(drawn, 10 ** rng.uniform(-30, 30, batch_size))


@settings(max_examples=30)
@given(
    before=st.integers(0, 30),
    batch_size=st.integers(1, 60),
    refresh_every=st.integers(1, 9),
    lap=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_restored_sampler_goes_on_exactly(
    before: int, batch_size: int, refresh_every: int, lap: bool, seed: int
) -> None:
    rule = Lap() if lap else Per(beta_batches=40)

    def go_on(drawing: PrioritySampler, batches: int, rng: np.random.Generator) -> list[Any]:
        seen = []
        for index in range(batches):
            if index == 12:
                drawing.set_shares([0.2, 0.8])
            drawn, stratum = drawing.draw()
            seen += [drawn.copy(), stratum.copy(), drawing.drawn_weights]
            drawing.update(drawn, rng.uniform(0, 9, len(drawn)))
        return seen

    first = sampler(rule, seed=1, batch_size=batch_size, refresh_every=refresh_every)
    go_on(first, before, np.random.default_rng(seed))
    second = sampler(rule, seed=2, batch_size=batch_size, refresh_every=refresh_every)
    second.load_state_dict(through_json(first.state_dict()))
    mine, theirs = (go_on(s, 25, np.random.default_rng(seed + 1)) for s in (first, second))
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=80)
@given(st.integers(0, 2**32), st.integers(1, 200), st.integers(0, 300), st.booleans())
def test_compiled_places_are_those_of_numpy(
    seed: int, chunks: int, draws: int, some_empty: bool
) -> None:
    if not native.IS_THERE:
        pytest.skip(f"native code is {native.state()}")
    rng = np.random.default_rng(seed)
    priority = (10 ** rng.uniform(-4, 2, (chunks, CHUNK))).astype(np.float32)
    if some_empty:  # as a stratum's last chunk is
        priority[rng.random(priority.shape) < 0.5] = 0
        priority[-1, 0] = 1
    sums = np.einsum("ij->i", priority)
    ends = np.cumsum(sums, dtype=np.float64)
    at = np.sort(rng.random(draws)) * ends[-1]
    if draws > 2:
        at[0], at[-1] = 0.0, ends[-1]  # the range's own ends
        at[1] = ends[chunks // 2]
        at.sort()
    places = [np.full(draws, -1, np.int64) for _ in range(2)]
    for find, out in zip((native.compiled.find_places, find_places), places, strict=True):
        find(priority, sums, ends, at, out)
    np.testing.assert_array_equal(places[0], places[1])


def test_draws_are_the_same_without_compiled_code(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, list[Any]] = {}
    for switch in ("1", "0"):
        monkeypatch.setenv(native.SWITCH, switch)
        one = sampler(Per(), refresh_every=4)
        one.update(np.arange(0, 400, 2), errors()[::2])
        drawn[switch] = [(one.draw()[0].copy(), one.drawn_weights) for _ in range(9)]
    np.testing.assert_equal(drawn["0"], drawn["1"])


def test_the_mean_weight_of_many_rows_is_that_of_some() -> None:
    """Of strata with more rows than are raised to a power: 1, to within a percent."""
    rows = np.arange(200_000)
    rng = np.random.default_rng(0)
    one = PrioritySampler([rows], [1.0], 256, rng, rule=Per(), refresh_every=64)
    one.update(rows, 10 ** np.random.default_rng(1).uniform(-2, 1, len(rows)))
    weights = []
    for _ in range(64):
        one.draw()
        assert one.drawn_weights is not None
        weights.append(float(one.drawn_weights.mean()))
    assert np.mean(weights) == pytest.approx(1.0, abs=0.01)


def test_what_cannot_be_a_priority_is_refused() -> None:
    with pytest.raises(MixtureError, match="not finite"):
        sampler(Per()).update(np.array([0, 2]), np.array([1.0, np.nan]))
    for rule in (Per(), Lap()):
        # Signed, rows of a negative error were not drawn again.
        with pytest.raises(MixtureError, match=r"1 TD errors are negative, the least -0\.5"):
            sampler(rule).update(np.array([0, 2]), np.array([1.0, -0.5]))
        for wrong in (np.ones(1), np.ones(()), np.ones((2, 1))):
            with pytest.raises(MixtureError, match=r"for rows of shape \(2,\)"):
                sampler(rule).update(np.array([0, 2]), wrong)
    with pytest.raises(MixtureError, match="two strata"):
        Priorities([np.arange(3), np.arange(2, 5)], [Lap()] * 2)
    with pytest.raises(MixtureError, match="alpha"):
        Per(alpha=2.0)
