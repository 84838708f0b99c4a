"""Check that conditions of fresh rows reach every table once their episodes end."""

from typing import Any

import duckdb
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.toy_run import config, run_to_end, tables
from support.toy_twin import TASK

from restock.train.feed.fresh_labels import NEVER, WAITING, EpisodeLabels
from restock.train.session import Session

# Every batch is audited, so that the sums can be counted from the audited rows.
EVERY_BATCH = {"record": {"audit_share": 1.0}, "schedule": {"env_steps": 1000}}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return run_to_end(tmp_path_factory.mktemp("run") / "a", config(**EVERY_BATCH))


def rows(run: Session, query: str) -> list[dict[str, Any]]:
    with duckdb.connect() as connection:
        for name, table in tables(run.run.path).items():
            connection.register(name, table)
        found: list[dict[str, Any]] = connection.sql(query).to_arrow_table().to_pylist()
    return found


def test_only_rows_of_open_episodes_lack_a_condition(live: Session) -> None:
    (whole,) = rows(
        live,
        "SELECT count(*) AS fresh, count(*) FILTER (condition IS NULL) AS unknown,"
        " count(*) FILTER ((condition IS NULL) <> (ended.episode IS NULL)) AS wrong FROM audit"
        " LEFT JOIN (SELECT episode FROM episodes) ended ON audit.episode = ended.episode::VARCHAR"
        " WHERE source = 'fresh'",
    )
    assert whole["fresh"] > 1000
    assert whole["wrong"] == 0
    assert whole["unknown"] < 0.02 * whole["fresh"]
    (open_ones,) = rows(
        live,
        "SELECT count(DISTINCT episode) AS episodes FROM audit"
        " WHERE source = 'fresh' AND condition IS NULL",
    )
    assert open_ones["episodes"] <= live.config.env.num_envs


@pytest.mark.parametrize(
    ("table", "condition", "measure"),
    [
        ("strata", "stratum", "drawn_rows"),
        ("conditions", "condition", "drawn_rows"),
        ("sampled_episodes", "condition", "drawn_rows"),
        ("actions", "condition", "drawn_rows"),
    ],
)
def test_tables_agree_on_drawn_rows(live, table, condition, measure):
    every = live.config.record.every_updates
    assert rows(
        live,
        f"SELECT gradient_steps, {condition} AS condition, sum({measure})::BIGINT AS n"
        f" FROM {table} WHERE source = 'fresh' AND {measure} > 0 GROUP BY ALL ORDER BY ALL",
    ) == rows(
        live,
        # Intervals end every `every` updates and at the end of the run.
        f"SELECT least(ceil(gradient_step / {every})::BIGINT * {every},"
        " (SELECT max(gradient_steps) FROM progress)) AS gradient_steps,"
        " coalesce(condition, 'unlabelled') AS condition, count(*) AS n"
        " FROM audit WHERE source = 'fresh' GROUP BY ALL ORDER BY ALL",
    )


def test_actions_table_counts_drawn_and_greedy_actions(live: Session) -> None:
    per_cell = rows(
        live,
        "SELECT source, condition, action, name, sum(drawn_rows)::BIGINT AS drawn,"
        " sum(greedy_rows)::BIGINT AS wanted, sum(audited_rows)::BIGINT AS audited"
        " FROM actions GROUP BY ALL ORDER BY ALL",
    )
    assert [row["name"] for row in per_cell[:3]] == TASK.action_names
    counted = rows(
        live,
        "SELECT source, coalesce(condition, 'unlabelled') AS condition, action,"
        " count(*) AS drawn FROM audit GROUP BY ALL",
    )
    drawn = {(r["source"], r["condition"], r["action"]): r["drawn"] for r in counted}
    wanted = rows(
        live,
        "SELECT source, coalesce(condition, 'unlabelled') AS condition, greedy_action AS action,"
        " count(*) AS n FROM audit GROUP BY ALL",
    )
    greedy = {(r["source"], r["condition"], r["action"]): r["n"] for r in wanted}
    for row in per_cell:
        key = row["source"], row["condition"], row["action"]
        assert row["drawn"] == drawn.get(key, 0)
        assert row["wanted"] == greedy.get(key, 0)
    # Wheels slip only on forward commands, so no other action was drawn there.
    slip = [row for row in per_cell if row["condition"] == "wheel_slip"]
    assert {row["name"] for row in slip if not row["drawn"]} == {"stop", TASK.action_names[2]}
    (shares,) = rows(
        live,
        "SELECT max(abs(total - 1)) AS off FROM (SELECT sum(drawn_share) AS total FROM actions"
        " GROUP BY gradient_steps, source, stratum, condition)",
    )
    assert shares["off"] < 1e-9


@given(st.data())
def test_labels_reach_rows_in_any_order(data: st.DataObject) -> None:
    lengths = data.draw(st.dictionaries(st.integers(0, 30), st.integers(1, 9), max_size=8))
    known = data.draw(st.sets(st.sampled_from(sorted(lengths)))) if lengths else set()
    lost = data.draw(st.sets(st.integers(31, 35)))
    labels = EpisodeLabels()
    for episode in known:
        codes = (np.arange(lengths[episode]) + episode) % 5
        labels.note(episode, codes, codes - 1)
    for episode in sorted(lost):
        labels.give_up(episode)
    steps = [(key, step) for key, length in lengths.items() for step in range(length)]
    drawn = data.draw(st.lists(st.sampled_from(steps))) if steps else []
    drawn += [(episode, 0) for episode in sorted(lost)]
    condition = np.full(len(drawn), WAITING, np.int16)
    stratum = condition.copy()
    key = np.array([one for one, _ in drawn], np.int64)
    step = np.array([one for _, one in drawn], np.int32)
    labels.fill(condition, stratum, key, step)
    for code, in_stratum, (episode, at) in zip(
        condition.tolist(), stratum.tolist(), drawn, strict=True
    ):
        if episode in known:
            assert code == (at + episode) % 5
            assert in_stratum == code - 1
        else:
            assert code == (NEVER if episode in lost else WAITING)
