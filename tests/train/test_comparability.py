"""Check feed comparison: equal feeds pass, planted differences are found."""

import dataclasses

import numpy as np
import pytest

from restock.train.judge.comparability import Check, Feed, check_feeds, worst

pytestmark = pytest.mark.usefixtures("few_resamples")
CELLS = ["logs/nominal", "logs/wheel_slip", "logs/rare", "fresh/nominal", "fresh/wheel_slip"]


def feed(
    seed: int,
    *,
    logs: tuple[float, ...] = (0.7, 0.298, 0.002),
    slip: float = 0.3,
    fresh_episodes: int = 4000,
    log_episodes: int = 200,
    runs: int = 1,
    weight: tuple[float, ...] = (1, 1, 1, 1, 1),
) -> Feed:
    """Return a feed of half logged rows in exact quotas and half fresh rows."""
    rng = np.random.default_rng(seed)
    parts = []  # cell, tenth, episode, run, drawn
    for number, part in np.ndindex(runs, 10):
        for index, share in enumerate(logs):
            keys = np.arange(log_episodes)
            parts.append((np.full(log_episodes, index), part, keys, number, share / log_episodes))
        count = fresh_episodes // 10
        keys = 1_000_000 * (number + 1) + part * 100_000 + np.arange(count)
        parts.append((3 + (rng.random(count) < slip), part, keys, number, 1 / count))
    cell, tenth, episode, run, drawn = (
        np.concatenate([np.broadcast_to(part[column], part[0].shape) for part in parts])
        for column in range(5)
    )
    amounts = drawn * 5000
    return Feed(CELLS, cell, tenth, episode, run, amounts, amounts * np.array(weight)[cell])


def verdict(first: Feed, second: Feed) -> str:
    return worst([c.verdict for c in check_feeds(first, second, np.random.default_rng(0))])


def failing(first: Feed, second: Feed) -> list[Check]:
    checks = check_feeds(first, second, np.random.default_rng(0))
    return [check for check in checks if check.verdict == "incomparable"]


def test_feeds_of_one_process_are_comparable() -> None:
    assert verdict(feed(1, runs=5), feed(2, runs=5)) == "comparable"


def test_feed_is_not_incomparable_with_itself() -> None:
    few = feed(1, fresh_episodes=100)
    assert verdict(few, few) != "incomparable"


def test_few_episodes_of_one_process_are_inconclusive() -> None:
    # Many rows of few episodes: a test that counts rows would reject nearly all pairs.
    verdicts = [
        verdict(feed(seed, fresh_episodes=150), feed(seed + 100, fresh_episodes=150))
        for seed in range(12)
    ]
    assert verdicts.count("inconclusive") >= 10
    assert "comparable" not in verdicts


def test_halved_rare_stratum_is_found() -> None:
    found = failing(feed(1, runs=5), feed(2, logs=(0.7, 0.299, 0.001), runs=5))
    (raw,) = found
    assert raw.name == "share of logs/rare"
    assert raw.value == pytest.approx(2.0)
    assert (raw.first, raw.second) == (pytest.approx(0.001), pytest.approx(0.0005))


FEW = {f"episodes of logs/{name}" for name in ("nominal", "wheel_slip", "rare")}


@pytest.mark.parametrize(
    ("planted", "least", "most"),
    [
        ({"slip": 0.5}, {"mix", "share of fresh/wheel_slip"}, None),
        ({"weight": (1, 0.2, 1, 1, 1)}, {"mix after weights"}, None),  # weights that undo a boost
        ({"log_episodes": 40}, FEW, FEW),
    ],
)
def test_planted_difference_is_found(planted, least, most) -> None:
    names = {check.name for check in failing(feed(1, runs=5), feed(2, runs=5, **planted))}
    assert names >= least
    assert most is None or names <= most
    assert "weight" not in planted or all("after weights" in name for name in names)


def test_shift_within_run_is_found() -> None:
    first, second = feed(1, runs=5), feed(2, runs=5)
    amounts = second.drawn.copy()
    for tenth, times in ((0, 1.5), (9, 0.5)):  # more slip early, less late
        shifted_rows = (second.tenth == tenth) & (second.cell == 1)
        amounts[shifted_rows] *= times
    shifted = Feed(
        CELLS, second.cell, second.tenth, second.episode, second.run, amounts, second.weight
    )
    parts = {check.part for check in failing(first, shifted) if check.name == "mix"}
    assert parts == {"tenth 1", "tenth 10"}


def test_unlabelled_rows_are_inconclusive() -> None:
    first, second = feed(1, runs=5), feed(2, runs=5)
    names = [name.replace("fresh/nominal", "fresh/unlabelled") for name in CELLS]
    unknown = [dataclasses.replace(one, cells=names) for one in (first, second)]
    assert verdict(first, second) == "comparable"
    assert verdict(*unknown) == "inconclusive"
