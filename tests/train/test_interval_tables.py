"""Compare the sums of an interval with counts row by row."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from restock.train.feed import sampled_rows
from restock.train.feed.sampled_rows import GreedyRows, SourceRows, first_places

STRATA, CONDITIONS, ACTIONS = (
    ("easy", "rare", "unmet"),
    ("nominal", "slip"),
    ("left", "right", "stop"),
)


@settings(max_examples=60)
@given(
    st.lists(st.integers(-5, 40) | st.integers(7 << 40, (7 << 40) + 9), max_size=60),
    st.integers(0, 1 << 50),
)
def test_first_places_cover_each_value_once(values: list[int], first: int) -> None:
    key = np.array(values, np.int64) + first
    places = first_places(key)
    assert key[places].tolist() == sorted(set(key.tolist()))


@settings(max_examples=40)
@given(arrays(np.float64, st.integers(1, 40), elements=st.floats(0, 2**40)))
def test_ages_are_bucketed_by_powers_of_two(age: np.ndarray) -> None:
    columns = sampled_rows.ages("days", age)
    assert sum(columns["count"]) == len(age)
    counted = zip(columns["bucket"].tolist(), columns["count"].tolist(), strict=True)
    for bucket, count in counted:
        low, high = (0, 1) if bucket == -1 else (2.0**bucket, 2.0 ** (bucket + 1))
        assert ((low <= age) & (age < high)).sum() == count > 0


def source(rows: int, seed: int, *, greedy: bool) -> SourceRows:
    """Return draws from 20 rows, each with its own stratum, condition and action."""
    rng = np.random.default_rng(seed)
    row = rng.integers(20, size=rows)
    stratum, condition, action = row % 2, row // 2 % 2, row // 4 % 2  # never "unmet" or "stop"
    requested = slice(rows // 2)
    return SourceRows(
        name="logs",
        rows={
            "td": rng.normal(size=rows).astype(np.float32),
            "q": rng.normal(size=rows).astype(np.float32),
            "weight": rng.uniform(0.5, 1, rows).astype(np.float32),
            "action": action.astype(np.int16),
            "reward": rng.normal(size=rows).astype(np.float32),
            "discount": rng.choice([0, 0.99], rows).astype(np.float32),
        },
        stratum=stratum,
        strata=STRATA,
        row=row,
        available=np.array([10, 10, 0]),
        timings=[None] * 3,
        quota=[None] * 3,
        condition=condition,
        conditions=CONDITIONS,
        episode=row // 5,
        episodes=None,
        policy=np.zeros(rows, np.int64),
        policies=["operator"],
        ages={},
        greedy=GreedyRows(stratum[requested], condition[requested], np.full(rows, 2)[requested])
        if greedy
        else None,
    )


@settings(max_examples=20)
@given(st.integers(1, 80), st.integers(0, 99), st.booleans())
def test_sums_by_stratum_and_condition(rows: int, seed: int, greedy: bool) -> None:
    draws = source(rows, seed, greedy=greedy)
    strata = sampled_rows.strata(draws, np.array([rows, 0, 0]))
    weight = draws.rows["weight"].astype(np.float64)
    for code in range(len(STRATA)):
        mine = draws.stratum == code
        assert strata["drawn_rows"][code] == mine.sum()
        assert strata["unique_rows"][code] == len(set(draws.row[mine].tolist()))
        share = strata["effective_share"][code]
        assert share == pytest.approx(weight[mine].sum() / weight.sum())
        if not mine.any():
            assert strata["td_abs_mean"][code] is None
            continue
        for name, values in (
            ("td_abs_mean", np.abs(draws.rows["td"])),
            ("q_mean", draws.rows["q"]),
            ("reward_mean", draws.rows["reward"]),
            ("terminal_share", draws.rows["discount"] == 0),
        ):
            assert strata[name][code] == pytest.approx(values[mine].mean(), abs=1e-6)
    conditions = sampled_rows.conditions(draws)
    observed = Counter(CONDITIONS[code] for code in draws.condition.tolist())
    assert dict(zip(conditions["condition"], conditions["drawn_rows"], strict=True)) == observed


@settings(max_examples=20)
@given(st.integers(1, 80), st.integers(0, 99))
def test_episode_draws_by_stratum_and_condition(rows: int, seed: int) -> None:
    draws = source(rows, seed, greedy=False)
    columns = sampled_rows.sampled_episodes(draws)
    cells = zip(columns["episode"], columns["stratum"], columns["condition"], strict=True)
    found = dict(zip(cells, columns["drawn_rows"].tolist(), strict=True))
    counted: Counter[tuple[str, str, str]] = Counter(
        (str(episode), STRATA[stratum], CONDITIONS[condition])
        for episode, stratum, condition in zip(
            draws.episode, draws.stratum, draws.condition, strict=True
        )
    )
    assert found == counted
    assert columns["weight"].sum() == pytest.approx(draws.rows["weight"].sum(), rel=1e-5)


@settings(max_examples=20)
@given(st.integers(1, 80), st.integers(0, 99), st.booleans())
def test_undrawn_actions_have_rows(rows: int, seed: int, greedy: bool) -> None:
    draws = source(rows, seed, greedy=greedy)
    columns = sampled_rows.actions(draws, ACTIONS)
    cells = list(zip(columns["stratum"], columns["condition"], columns["name"], strict=True))
    observed = {(int(s), int(c)) for s, c in zip(draws.stratum, draws.condition, strict=True)}
    assert cells == [
        (STRATA[s], CONDITIONS[c], action) for s, c in sorted(observed) for action in ACTIONS
    ]
    for place, (stratum, condition, action) in enumerate(cells):
        pair = draws.stratum == STRATA.index(stratum)
        pair &= draws.condition == CONDITIONS.index(condition)
        mine = pair & (draws.rows["action"] == ACTIONS.index(action))
        assert columns["drawn_rows"][place] == mine.sum()
        assert columns["drawn_share"][place] == mine.sum() / pair.sum()
        assert columns["unique_rows"][place] == len(set(draws.row[mine].tolist()))
        if greedy:
            requested = pair[: rows // 2].sum()
            assert columns["audited_rows"][place] == requested
            assert columns["greedy_rows"][place] == (requested if action == "stop" else 0)
            assert columns["greedy_share"][place] == ((action == "stop") if requested else None)
    if not greedy:
        assert columns["greedy_rows"] is None
