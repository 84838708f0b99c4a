"""Check quotas that fresh rows fill: their strata, the record and reported shortfalls."""

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.panels import by_priority
from support.stores import CONDITIONS, EXPOSURES, recording_transitions
from support.toy_run import config, run_to_end, session
from support.toy_twin import CONDITIONS as TOY_CONDITIONS
from support.toy_twin import TASK as TOY_TASK

from restock.cli.data.mix import TRAINING
from restock.errors import ConfigError
from restock.ingest.task.conditions import held
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.store.audit import load_audits, load_thresholds
from restock.train.dqn.config import TrainConfig
from restock.train.feed.collector import FreshStrata
from restock.train.feed.logs import Logs
from restock.train.loop import time_left
from restock.train.prepare import refuse_short_budget
from restock.train.resolve import planned_draws
from restock.train.run.replay_audit import fed_shares, shortfalls

TABLE = pa.concat_tables([recording_transitions(index) for index in (1, 2, 3)])
OF_STEPS = "[each_condition]\nshare = 'equal'\n"
OF_EPISODES = by_priority(CONDITIONS)
TWO_STEPS = by_priority(CONDITIONS, "min_steps = 2\n")
SITUATIONS = by_priority(EXPOSURES)


@pytest.mark.parametrize("text", [OF_STEPS, OF_EPISODES, TWO_STEPS, SITUATIONS])
def test_fresh_and_logged_episodes_get_equal_strata(text: str, tmp_path: Path) -> None:
    mixture = parse_mixture(f"evaluation_split = {{by = 'none'}}\nuncertain = 'keep'\n{text}")
    conditions = [*CONDITIONS, *EXPOSURES]
    panel = build_panel(TABLE, mixture, tmp_path / "panel", conditions=conditions)
    logged = {
        (row["episode_id"], row["step_index"]): panel.strata[row["stratum_code"]].name
        for row in panel.meta.select(["episode_id", "step_index", "stratum_code"]).to_pylist()
    }
    strata = FreshStrata.of(panel, conditions)
    assert strata.known.all()
    names = [c.name for c in CONDITIONS]
    labels = held(TABLE["conditions"], names)
    labels |= held(TABLE["exposures"], [c.name for c in EXPOSURES])
    episode = np.array(TABLE["episode_id"].to_pylist(), object)
    same = 0
    for key in dict.fromkeys(episode.tolist()):
        at = np.flatnonzero(episode == key)
        of_episode = {name: holds[at] for name, holds in labels.items()}
        codes = strata.codes(of_episode, len(at), np.zeros(len(strata.names), np.int64))
        for step, code in enumerate(codes.tolist()):
            assert (key, step) in logged
            assert strata.names[code] == logged[key, step]
            same += 1
    assert same == len(TABLE)


def test_episode_of_several_strata_joins_smallest() -> None:
    mixture = parse_mixture("[each_condition]\nshare = 'equal'\nunit = 'episode'\n")
    names = ["nominal", "recovery", "wheel_slip"]
    strata = FreshStrata(mixture, names, [c for c in CONDITIONS if c.name in names])
    labels = {name: np.zeros(4, np.bool_) for name in ("recovery", "wheel_slip")}
    assert strata.codes(labels, 4, np.array([0, 0, 0])).tolist() == [0, 0, 0, 0]
    labels["recovery"][2] = labels["wheel_slip"][0] = True
    assert strata.codes(labels, 4, np.array([0, 9, 5])).tolist() == [2, 2, 2, 2]
    assert strata.codes(labels, 4, np.array([0, 3, 5])).tolist() == [1, 1, 1, 1]


@settings(max_examples=30)
@given(st.data())
def test_step_stratum_matches_its_conditions(data: st.DataObject) -> None:
    mixture = parse_mixture(data.draw(st.sampled_from([OF_STEPS, OF_EPISODES])))
    names = ["nominal", *(c.name for c in CONDITIONS)]
    strata = FreshStrata(mixture, names, CONDITIONS)
    steps = data.draw(st.integers(1, 12))
    holds = st.lists(st.booleans(), min_size=steps, max_size=steps)
    labels = {c.name: np.array(data.draw(holds)) for c in CONDITIONS}
    for step, code in enumerate(strata.codes(labels, steps, np.zeros(5, np.int64)).tolist()):
        of_episode = strata._strata[code].rule.unit == "episode"
        if names[code] == "nominal":
            assert not any(labels[c.name][step] for c in CONDITIONS)
        else:
            found = labels[names[code]]
            assert found.any() if of_episode else found[step]


def test_stratum_of_logged_columns_has_no_fresh_rows(tmp_path: Path) -> None:
    text = (
        "unlisted = 'drop'\n[[strata]]\nname = 'nominal'\nshare = 0.5\n"
        "[[strata]]\nname = 'first'\nwhere = 'step_index < 2'\nshare = 0.5\n"
    )
    panel = build_panel(TABLE, parse_mixture(text), tmp_path / "panel", conditions=CONDITIONS)
    strata = FreshStrata.of(panel, CONDITIONS)
    assert strata.known.tolist() == [True, False]


QUOTAS = (
    "discount = 0.9\nmax_replays_per_row = 8\n"
    "[[strata]]\nname = 'nominal'\nunit = 'episode'\nshare = 0.5\n"
    "[[strata]]\nname = 'wheel_slip'\nunit = 'episode'\nshare = 0.5\n"
)
SETTINGS = config(replay={"logs_share": None}, schedule={"env_steps": 2400})


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Panel:
    rows = pa.concat_tables(
        [recording_transitions(index, task=TOY_TASK, episodes=40) for index in (1, 2)]
    )
    path = tmp_path_factory.mktemp("panels") / "panel"
    return build_panel(rows, parse_mixture(QUOTAS), path, task=TOY_TASK, conditions=TOY_CONDITIONS)


def logs_of(panel: Panel, settings: Any = SETTINGS) -> Logs:
    return Logs.of_panel(panel, planned_draws(settings))


def test_quotas_are_filled_from_logs_and_ring(panel: Panel, tmp_path: Path) -> None:
    """Limit replays so that logged rows supply few online draws and the ring the others."""
    live = run_to_end(tmp_path / "a", SETTINGS, logs=logs_of(panel))
    nominal, slip = [row for row in fed_shares(live.run) if row["stratum"] != "unlabelled"]
    assert nominal["wanted_share"] == slip["wanted_share"] == 0.5
    assert slip["drawn_share"] == pytest.approx(0.5, abs=0.05)
    assert slip["fresh_share"] > 0.2
    assert slip["logs_share"] + slip["fresh_share"] == pytest.approx(slip["drawn_share"])
    assert shortfalls(fed_shares(live.run)) == []
    table = live.run.table("fed").to_pylist()
    assert sum(row["drawn_rows"] for row in table) == 32 * live.learner.gradient_steps
    strata = live.run.table("strata").to_pylist()
    for source, column in (("logs", "logs_share"), ("fresh", "fresh_share")):
        drawn = sum(
            row["drawn_rows"]
            for row in strata
            if (row["source"], row["stratum"]) == (source, "wheel_slip")
        )
        whole = sum(row["drawn_rows"] for row in table)
        assert drawn / whole == pytest.approx(slip[column])
    audit = live.run.table("audit").to_pylist()
    fresh = [row for row in audit if row["source"] == "fresh"]
    assert {row["stratum"] for row in fresh} >= {"nominal", "wheel_slip"}
    # Strata are of whole episodes, so not every row of the slip stratum slips.
    assert {row["condition"] for row in fresh if row["stratum"] == "wheel_slip"} >= {"nominal"}


def audit_effective_share(run: Path) -> list[dict[str, Any]]:
    (audit,) = [audit for audit in load_audits() if audit.name == "effective_share"]
    sql = audit.sql
    for name, value in load_thresholds()[audit.name].items():
        sql = sql.replace(f"${name}", str(value))
    with duckdb.connect() as connection:
        connection.execute("CREATE SCHEMA run")
        for name in ("fed", "strata"):
            connection.execute(
                f"CREATE VIEW run.{name} AS FROM read_parquet('{run / name}.parquet')"
            )
        found = connection.sql(sql)
        return [dict(zip(found.columns, row, strict=True)) for row in found.fetchall()]


def test_shortfall_is_reported_after_training(tmp_path: Path) -> None:
    """Train with few logged rows of wheel slip and none in the twin."""
    rows = recording_transitions(1, task=TOY_TASK, episodes=60)
    text = QUOTAS.replace("max_replays_per_row = 8", "max_replays_per_row = 1")
    text = text.replace("name = 'wheel_slip'\nunit = 'episode'", "name = 'wheel_slip'")
    text += "correction = 'none'\n"
    built = build_panel(
        rows, parse_mixture(text), tmp_path / "p", task=TOY_TASK, conditions=TOY_CONDITIONS
    )
    nothing_slips = config(
        replay={"logs_share": None},
        schedule={"env_steps": 2400, "offline_updates": 4},
        env={"num_envs": 4, "conditions": {"nominal": 1.0, "wheel_slip": 0.0}},
    )
    live = run_to_end(tmp_path / "a", nothing_slips, logs=logs_of(built, nothing_slips))
    fed = fed_shares(live.run)
    (message,) = shortfalls(fed)
    assert message.startswith("wheel_slip was ")
    assert "less than half of its quota of 50.0%" in message
    assert "the ring has too few fresh rows of it" in message
    (row,) = [row for row in audit_effective_share(live.run.path) if row["source"] == "batch"]
    assert row["stratum"] == "wheel_slip"
    assert row["drawn_share"] < 0.5 * row["wanted_share"]


def test_seconds_budget_includes_evaluations(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config(schedule={"seconds": 100.0}))
    live.learner.gradient_steps = live.config.record.every_updates
    live.progress.wall_s = 60.0
    assert time_left(live)
    assert not time_left(live, 0.5)  # the offline half is over
    live.progress.evaluation_s = 45.0
    assert not time_left(live)  # the last evaluation would exceed the budget
    live.close()


def test_too_short_seconds_budget_is_rejected(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config())
    with pytest.raises(ConfigError, match="an evaluation of 6 episodes takes about") as raised:
        refuse_short_budget(live, 1e-9)
    assert "give --seconds" in str(raised.value)
    refuse_short_budget(live, 1e9)
    assert live.progress.evaluation_s > 0
    live.close()


def test_seconds_budget_uses_measured_speed(panel, tmp_path):
    settings = config(
        replay={"logs_share": None}, schedule={"seconds": 100.0, "env_steps": 10_000_000}
    )
    live = session(tmp_path / "a", settings, logs=logs_of(panel, settings))
    assert live.progress.planned_env_steps == 80_000  # a first guess
    live.progress.wall_s, live.progress.online_from_s = 60.0, 20.0
    live.progress.driving_from_s, live.progress.online_from = 10.0, 200
    live.progress.env_steps = 4_200  # 100 a second
    live.plan()
    assert live.progress.planned_env_steps == pytest.approx(8_200, abs=100)  # time passes here too
    assert live.batches.controller is not None
    assert live.batches.controller.planned.end_env_steps == live.progress.planned_env_steps
    # A resumed run keeps its plan, whatever the machine's speed is now.
    live.progress.env_steps = 0
    live.collector.reset(0)
    live.save()
    live.close()
    again = session(tmp_path / "a", settings, logs=logs_of(panel, settings), resume=True)
    assert again.progress.planned_env_steps == live.progress.planned_env_steps
    assert again.batches.controller is not None
    assert again.batches.controller.planned == live.batches.controller.planned
    again.close()


def test_planned_draws_by_hand() -> None:
    settings = config(schedule={"env_steps": 1_000, "seconds": None})
    assert planned_draws(settings) == PlannedDraws(60 * 32, 800 * 0.25 * 32, 200, 1_000)
    assert planned_draws(settings, 600) == PlannedDraws(60 * 32, 400 * 0.25 * 32, 200, 600)


def test_mix_assumes_default_training_budget() -> None:
    planned, (updates, batch_size) = planned_draws(TrainConfig()), TRAINING
    assert updates * batch_size == planned.offline + planned.online
    assert batch_size == TrainConfig().replay.batch_size
