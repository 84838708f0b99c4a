"""The audit of whether more success earns more, over synthetic drivers."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_ind, ttest_rel
from support.finished_runs import document, make_run
from support.stores import recording_transitions, write_store

from restock import cli
from restock.cli.data.audit import audit_reward
from restock.errors import ConfigError, RunError
from restock.ingest.store.transitions import replaced
from restock.replay.store.audit import load_audits, load_thresholds
from restock.replay.store.definitions import definitions
from restock.replay.store.store import Store
from restock.stats import wilson
from restock.train.run.kept_evaluations import add_evaluation
from restock.train.run.run_tables import EVAL_EPISODES

Episode = tuple[str, list[float], str]  # driver, reward of each step, goal | bump
STEP = -0.02


def earlier_reward(route_m: float, steps: int, bumps: bool) -> tuple[list[float], str]:
    """Return a mission's rewards under an earlier rule: -3 for each of two steps in contact."""
    rewards = [route_m / steps + STEP] * steps
    if bumps:
        rewards[steps // 2] -= 3.0
        rewards[steps // 2 + 1] -= 3.0
    rewards[-1] += 5.0
    return rewards, "goal after a bump" if bumps else "goal"


def shipped_reward(route_m: float, steps: int, bumps: bool) -> tuple[list[float], str]:
    """Return a mission's rewards under the shipped rule: a bump ends the episode and costs 6."""
    rewards, _ = earlier_reward(route_m, steps, False)
    if not bumps:
        return rewards, "goal"
    rewards = rewards[: steps // 2 + 1]
    rewards[-1] -= 6.0
    return rewards, "bump"


def hasty_and_careful(pay: Callable[..., tuple[list[float], str]], count: int) -> list[Episode]:
    """Return missions of a careful planner, and of a faster agent that bumps in a quarter."""
    rng = np.random.default_rng(0)
    lengths = rng.uniform(6, 10, count).tolist()
    careful: list[Episode] = [("planner", *pay(m, round(m * 9), False)) for m in lengths]
    hasty: list[Episode] = [
        ("agent", *pay(m, round(m * 6), number % 4 == 0)) for number, m in enumerate(lengths)
    ]
    return careful + hasty


@cache
def some_rows() -> pa.Table:
    """Return more rows than any store here needs; the audited columns are replaced."""
    return recording_transitions(1, episodes=500)


def store_of(path: Path, episodes: Sequence[Episode]) -> Path:
    """Return a store of these episodes, in order."""
    lengths = np.array([len(rewards) for _, rewards, _ in episodes])
    rows = int(lengths.sum())
    table = some_rows().slice(0, rows)
    of_row = np.repeat(np.arange(len(episodes)), lengths)
    step = np.concatenate([np.arange(length) for length in lengths])
    last = np.append(step[1:] == 0, True)
    how = np.array([outcome for *_, outcome in episodes])[of_row]
    changed = {
        "episode_id": [f"{1:016x}/{index}" for index in of_row],
        "episode_index": of_row,
        "step_index": step,
        "reward": np.concatenate([rewards for _, rewards, _ in episodes]),
        "terminated": last,
        "truncated": np.zeros(rows, bool),
        "behaviour_policy": np.array([driver for driver, *_ in episodes])[of_row],
        "bumped": (how == "goal after a bump") & (step == 5),
        "true_condition": ["nominal"] * rows,
    }
    return write_store(path, [replaced(table, changed)])


def audited(place: Path, **options: Any) -> dict[str, str]:
    """Return audit statuses, and verdicts by condition and pair of drivers."""
    found = audit_reward(place, load_audits(), load_thresholds(), **options)
    status = {
        finding.audit.name.removeprefix("evaluated_"): finding.status for finding in found.findings
    }
    pairs = {f"{r['condition']}: {r['driver']} > {r['other']}": r["verdict"] for r in found.order}
    return status | pairs


def test_reward_that_does_not_favour_haste_passes(tmp_path):
    found = audited(store_of(tmp_path / "store", hasty_and_careful(shipped_reward, 120)))
    pair = {"nominal: planner 1 > agent 1": "agrees"}
    assert found == {"reward_order": "pass", "reward_undetermined": "pass"} | pair


def test_audit_verb_fails_with_numbers_and_remedy(tmp_path, shell):
    place = str(store_of(tmp_path / "store", hasty_and_careful(earlier_reward, 60)))
    shown = " ".join(
        shell.out("audit", place, "--reward", "--discount", "0.97", code=1).split()
    )  # a cell may be wrapped
    assert "discounted by 0.97" in shown
    assert all(text in shown for text in ("goal after a bump", "bump_terminates", "1 reversed"))
    document = shell.json("audit", place, "--reward", "--discount", "0.97", code=1)
    (pair,) = document["order"]
    assert (pair["driver"], pair["verdict"], document["failed"]) == ("planner 1", "reversed", 1)
    assert pair["more_success"][0] > 0 > pair["more_return"][1]
    of_all = {r["driver"]: r for r in document["returns"] if r["outcome"] == "all"}
    assert of_all["agent 1"]["success_share"] == 0.75
    assert of_all["agent 1"]["discounted_mean"] > of_all["planner 1"]["discounted_mean"]
    # The returns are a view as well.
    assert cli.main(["sql", place, "SELECT sum(episodes) FROM returns WHERE outcome = 'all'"]) == 0
    with pytest.raises(ConfigError, match="'reward_order'"):  # the nearest name
        audit_reward(Path(place), load_audits(), {"reward_orders": {"min_share": 0.5}})


def test_returns_are_discounted_from_first_step(tmp_path):
    rewards = [1.0, 2.0, 4.0]
    place = store_of(tmp_path / "store", [("planner", rewards, "goal"), ("agent", [9.0], "goal")])
    with Store(place) as store:
        rows = store.sql("SELECT discounted_return FROM discounted_episodes(0.5) ORDER BY ALL")
        assert [value for (value,) in rows.fetchall()] == [1.0 + 1.0 + 1.0, 9.0]
    # The returns listed beside the audits are discounted, too.
    found = audit_reward(place, load_audits(), load_thresholds(), discount=0.5)
    assert {row["discounted_mean"] for row in found.returns} == {3.0, 9.0}


@pytest.mark.parametrize("drivers", ["few", "one", "handed over"])
def test_undetermined_order_warns(tmp_path, shell, drivers):
    episodes = hasty_and_careful(earlier_reward, 19 if drivers == "few" else 60)
    if drivers == "one":
        episodes = [("planner", rewards, outcome) for _, rewards, outcome in episodes]
    place = store_of(tmp_path / "store", episodes)
    if drivers == "handed over":
        place = store_of(tmp_path / "other", [e for e in episodes if e[0] == "planner"])
    found = audited(place)
    assert (found["reward_order"], found["reward_undetermined"]) == ("pass", "warn")
    assert "undetermined" in shell.out("audit", place, "--reward", "--strict", code=1)


def test_evaluation_is_compared_mission_by_mission(tmp_path):
    """Missions differ far more than drivers do, so only paired differences are conclusive."""
    run = make_run(tmp_path / "run", document())
    with pytest.raises(RunError, match="no evaluation with discounted returns"):
        audited(run)
    rng = np.random.default_rng(1)
    mission_returns = rng.normal(0, 20, 60)
    rows: list[dict[str, Any]] = []
    for policy, success, bonus in (("operator", 1.0, -0.5), ("agent", 0.7, 0.0)):
        rows += [
            dict.fromkeys(EVAL_EPISODES.names)
            | {
                "policy": policy,
                "version": "1",
                "perturbation": "none",
                "condition": "near_collision",
                "block": "none",
                "episode_seed": seed,
                "success": bool(seed < success * len(mission_returns)),
                "discounted_return": float(mission_returns[seed] + bonus + rng.normal(0, 0.1)),
                "return": 0.0,
                "failure": None if seed < success * len(mission_returns) else "bump",
            }
            for seed in range(len(mission_returns))
        ]
    add_evaluation(run, pa.Table.from_pylist(rows, EVAL_EPISODES))
    found = audited(run)
    assert found["reward_order"] == "fail"
    assert found["near_collision: operator 1 > agent 1"] == "reversed"
    # The run has a discount of its own.
    assert cli.main(["audit", str(run), "--reward", "--discount", "0.5"]) == 2


def ordered(
    first: Sequence[float],
    second: Sequence[float],
    *,
    success: tuple[float, float] = (1.0, 0.0),
    paired: bool = False,
    min_episodes: int = 20,
) -> dict[str, Any]:
    """Return the `return_order` of drivers a and b with these returns and success shares."""
    rows = [
        {
            "condition": "c",
            "driver": driver,
            "mission": str(number) if paired else None,
            "success": number < round(share * len(returns)),
            "discounted_return": float(value),
            "handed_over": False,
        }
        for driver, returns, share in zip("ab", (first, second), success, strict=True)
        for number, value in enumerate(returns)
    ]
    schema = pa.schema([
        *(("condition", pa.string()), ("driver", pa.string()), ("mission", pa.string())),
        *(("success", pa.bool_()), ("discounted_return", pa.float64())),
        ("handed_over", pa.bool_())
    ])  # fmt: skip
    with duckdb.connect() as connection:
        connection.register("driven", pa.Table.from_pylist(rows, schema))
        connection.execute(definitions(names=("return_order.sql",)))
        found = connection.sql(f"FROM return_order('driven', {min_episodes}, 0.1)")
        (row,) = found.fetchall()
        return dict(zip(found.columns, row, strict=True))


@pytest.mark.parametrize("paired", [True, False])
def test_fewer_than_three_episodes_have_no_interval(paired):
    for few in (1, 2):
        many = few if paired else 40
        row = ordered([5.0] * few, list(range(many)), paired=paired, min_episodes=1)
        assert row["more_return"] == [None, None]
        assert row["verdict"] in ("undetermined", "same success")
        assert ordered([5.0] * few, list(range(many)), paired=paired)["verdict"] == "undetermined"


def test_audit_verb_shows_pair_without_interval(tmp_path, shell):
    episodes: list[Episode] = [("planner", [1.0], "goal"), ("agent", [2.0], "goal")]
    place = str(store_of(tmp_path / "store", [*episodes, ("agent", [3.0], "bump")]))
    shown = shell.out("audit", place, "--reward")
    assert "undetermined" in shown
    assert "nan" not in shown
    assert shell.json("audit", place, "--reward")["order"][0]["more_return"] == [None, None]


@pytest.mark.long
@settings(max_examples=30)
@given(st.integers(3, 60), st.integers(3, 60), st.floats(0.1, 10), st.integers(0, 99))
def test_return_interval_matches_student_t(n, m, spread, seed):
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(0, 1, n), rng.normal(3, spread, m), rng.normal(0, 1, m)
    for row, test in (
        (ordered(a, b), ttest_ind(a, b, equal_var=False)),
        (ordered(c, b, paired=True), ttest_rel(c, b)),
    ):
        low, high = test.confidence_interval()
        found = row["more_return"]
        assert found[1] - found[0] == pytest.approx(high - low, rel=0.01)
        assert found[0] + found[1] == pytest.approx(low + high)


def test_constant_returns_are_ordered():
    row = ordered([2.0] * 30, [1.0] * 30)
    assert (row["verdict"], row["more_return"]) == ("agrees", [1.0, 1.0])


@pytest.mark.parametrize("paired", [True, False])
def test_success_difference_is_within_one(paired):
    for count in (1, 3, 30):
        low, high = ordered(range(count), range(count), paired=paired)["more_success"]
        assert -1 <= low < high <= 1


@settings(max_examples=30)
@given(
    st.tuples(st.integers(1, 60), st.integers(0, 60)),
    st.tuples(st.integers(1, 60), st.integers(0, 60)),
)
def test_success_difference_has_newcombe_interval(first, second):
    (n, k), (m, j) = ((total, min(hits, total)) for total, hits in (first, second))
    row = ordered(range(n), range(m), success=(k / n, j / m), min_episodes=1)
    (a, total_a), (b, total_b) = ((k, n), (j, m)) if row["driver"] == "a" else ((j, m), (k, n))
    p, q = a / total_a, b / total_b
    (low_a, high_a), (low_b, high_b) = wilson(a, total_a), wilson(b, total_b)
    low, high = row["more_success"]
    assert low == pytest.approx(p - q - np.hypot(p - low_a, high_b - q), abs=1e-4)
    assert high == pytest.approx(p - q + np.hypot(high_a - p, q - low_b), abs=1e-4)
