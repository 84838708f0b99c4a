"""Each audit finds the fault planted for it, and nothing in data without it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import panel_of
from support.stores import TASK, manifest, recording_transitions, views_over, write_store

from restock import cli
from restock.errors import ConfigError
from restock.ingest.store.writer import StoreWriter
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.places import open_place
from restock.replay.store import definitions
from restock.replay.store.audit import (
    Audit,
    Finding,
    junit_suites,
    load_audits,
    load_thresholds,
    run_audits,
    shipped_audits,
)
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store

AUDITS = {audit.name: audit for audit in shipped_audits()}
Tables = tuple[pa.Table, pa.Table]  # transitions, recordings


def replaced(table: pa.Table, name: str, values: object) -> pa.Table:
    place = table.schema.get_field_index(name)
    field = table.schema.field(place)
    if not isinstance(values, pa.Array):
        values = pa.array(values, field.type)
    return table.set_column(place, pa.field(name, values.type), values)


@pytest.fixture(scope="module")
def clean() -> Tables:
    """Enough recent data of every condition that only the two logs' infos have anything to say."""
    tables = [recording_transitions(index, episodes=120) for index in (1, 2)]
    recordings = pa.concat_tables([manifest(table) for table in tables])
    table = pa.concat_tables(tables)
    # Of one week: where the data begins in one and ends in the next, drift compares the two.
    now = datetime.now(UTC)
    monday = (now - timedelta(days=now.weekday() + 7)).replace(hour=0, minute=0, second=0)
    recent = int(monday.timestamp()) * 10**9 + 10**14
    table = replaced(table, "stamp_ns", table["stamp_ns"].to_numpy() % 10**13 + recent)
    return table, recordings


@pytest.fixture(scope="module")
def statuses(clean: Tables) -> dict[str, str]:
    """Return what every audit of a store alone says of it."""
    alone = [audit for audit in AUDITS.values() if audit.needs is None]
    thresholds = load_thresholds()
    chosen = {audit.name: thresholds[audit.name] for audit in alone if audit.parameters}
    with duckdb.connect() as connection:
        views_over(connection, *clean)
        return {one.audit.name: one.status for one in run_audits(connection, alone, chosen)}


def found(tables: Tables, name: str, **thresholds: float) -> Finding:
    with duckdb.connect() as connection:
        views_over(connection, *tables)
        chosen = {name: load_thresholds().get(name, {}) | thresholds}
        (finding,) = run_audits(connection, [AUDITS[name]], chosen)
    return finding


Plant = Callable[[pa.Table, pa.Table], Tables]


def rows_where(table: pa.Table, name: str, value: object) -> np.ndarray:
    return np.array([entry == value for entry in table[name].to_pylist()])


def slipping(table: pa.Table) -> np.ndarray:
    return np.array(["wheel_slip" in held for held in table["conditions"].to_pylist()])


def no_slip(table: pa.Table, recordings: pa.Table) -> Tables:
    return table.filter(pa.array(~slipping(table))), recordings


def slip_of_one_episode(table: pa.Table, recordings: pa.Table) -> Tables:
    slip = slipping(table)
    one = table.filter(pa.array(slip))["episode_id"][0].as_py()
    return table.filter(pa.array(~slip | rows_where(table, "episode_id", one))), recordings


def never_back(table: pa.Table, recordings: pa.Table) -> Tables:
    gone = rows_where(table, "condition", "recovery") & rows_where(table, "action", 4)
    return table.filter(pa.array(~gone)), recordings


def never_slipped_in_the_twin(table: pa.Table, recordings: pa.Table) -> Tables:
    slip = slipping(table)
    return replaced(table, "perturbation", np.where(slip, None, "wet").tolist()), recordings


def old_slip(table: pa.Table, recordings: pa.Table) -> Tables:
    stamps = table["stamp_ns"].to_numpy().copy()
    stamps[slipping(table)] -= 400 * 86400 * 10**9
    return replaced(table, "stamp_ns", stamps), recordings


def only_planner_slips(table: pa.Table, recordings: pa.Table) -> Tables:
    policy = np.array(table["behaviour_policy"].to_pylist())
    policy[rows_where(table, "condition", "wheel_slip")] = "planner"
    return replaced(table, "behaviour_policy", policy), recordings


def null_reward(table: pa.Table, recordings: pa.Table) -> Tables:
    reward = table["reward"].to_pylist()
    reward[17] = None
    return replaced(table, "reward", reward), recordings


def null_in_an_observation(table: pa.Table, recordings: pa.Table) -> Tables:
    observation = table["next_observation"].to_pylist()
    observation[17] = [*observation[17][:-1], None]
    return replaced(table, "next_observation", observation), recordings


def nan_observation(table: pa.Table, recordings: pa.Table) -> Tables:
    observation = table["observation"].to_pylist()
    observation[5] = [float("nan"), *observation[5][1:]]
    observation[6] = [*observation[6][:-1], float("inf")]
    return replaced(table, "observation", observation), recordings


def twice(table: pa.Table, recordings: pa.Table) -> Tables:
    return pa.concat_tables([table, table.slice(3, 2)]), recordings


def bag_and_a_part_of_it(table: pa.Table, recordings: pa.Table) -> Tables:
    part = table.filter(pa.array(rows_where(table, "recording_id", f"{1:016x}"))).slice(20, 60)
    part = replaced(part, "recording_id", [f"{9:016x}"] * len(part))
    part = replaced(part, "source_file", ["logs/part.mcap"] * len(part))
    part = replaced(part, "transition_id", (np.int64(9) << 25) + np.arange(len(part)))
    part = replaced(part, "ingest_id", [f"{9:016x}-a"] * len(part)).cast(table.schema)
    return pa.concat_tables([table, part]), pa.concat_tables([recordings, manifest(part)])


def two_tasks(table: pa.Table, recordings: pa.Table) -> Tables:
    hashes = np.where(rows_where(table, "recording_id", f"{2:016x}"), "0" * 12, TASK.hash)
    recordings = replaced(recordings, "task_hash", [TASK.hash, "0" * 12])
    return replaced(table, "task_hash", hashes), recordings


def old_labels(table: pa.Table, recordings: pa.Table) -> Tables:
    old = [datetime(2026, 1, 1, tzinfo=UTC), datetime(2025, 1, 1, tzinfo=UTC)]
    recordings = replaced(recordings, "ingested_at", old)
    versions = [recordings["labels_version"][0].as_py(), "000000000000"]
    return table, replaced(recordings, "labels_version", versions)


def old_labels_and_a_newer_robot(table: pa.Table, recordings: pa.Table) -> Tables:
    table, recordings = old_labels(table, recordings)
    other = recordings.slice(0, 1)
    for name, value in {
        "recording_id": f"{3:016x}",
        "ingest_id": "c",
        "profile": "other",
        "ingested_at": datetime(2026, 2, 1, tzinfo=UTC),
    }.items():
        other = replaced(other, name, [value])
    return table, pa.concat_tables([recordings.cast(other.schema), other])


def poor_labels(table: pa.Table, recordings: pa.Table) -> Tables:
    score = {"condition": "wheel_slip", "precision": 0.5, "recall": 0.9, "labelled": 50}
    scores = [[score | {"support": 30}], []]
    return table, replaced(recordings, "label_scores", scores)


def uncertain_slip(table: pa.Table, recordings: pa.Table) -> Tables:
    slips = rows_where(table, "condition", "wheel_slip")
    return replaced(
        table, "uncertain", [["wheel_slip"] if row else [] for row in slips]
    ), recordings


def failures(table: pa.Table, recordings: pa.Table) -> Tables:
    # Episodes with a slip end in failure: cut instead of terminated.
    failed = set(table.filter(pa.array(slipping(table)))["episode_id"].to_pylist())
    fails = np.array([episode in failed for episode in table["episode_id"].to_pylist()])
    over = table["terminated"].to_numpy()
    table = replaced(table, "terminated", over & ~fails)
    # Others all arrive, so that only this condition is one of failures.
    return table, recordings


def bumping_operator(table: pa.Table, recordings: pa.Table) -> Tables:
    operator = rows_where(table, "behaviour_policy", "operator")
    bumped = operator & (np.arange(len(table)) % 10 == 0)
    return replaced(table, "bumped", bumped), recordings


def many_drops(table: pa.Table, recordings: pa.Table) -> Tables:
    drops = [[{"reason": "stale scan", "count": 2000}], []]
    return table, replaced(recordings, "drops", drops)


def measured(table: pa.Table, recordings: pa.Table) -> Tables:
    stand_ins = [[{"input": "command", "instead": "odometry"}], []]
    return table, replaced(recordings, "stand_ins", stand_ins)


def by_poses(table: pa.Table, recordings: pa.Table) -> Tables:
    stand_ins = [[{"input": "wheels", "instead": "speeds from poses"}], []]
    return table, replaced(recordings, "stand_ins", stand_ins)


def two_clocks(table: pa.Table, recordings: pa.Table) -> Tables:
    one = {"kind": "order", "topic": "/odom", "what": "too early", "steps": 9, "cause": "clock"}
    found = [[one | {"remedy": "chrony", "repaired": again} for again in (True, False)], []]
    return table, replaced(recordings, "findings", found)


def without_lidar(table: pa.Table, recordings: pa.Table) -> Tables:
    lost = {"condition": "recovery", "kind": "outcome", "signals": ["clearance_m"]}
    unknown = [[lost | {"because": "no lidar"}], []]
    return table, replaced(recordings, "unknown_conditions", unknown)


def by_hindsight(table: pa.Table, recordings: pa.Table) -> Tables:
    first = rows_where(table, "recording_id", f"{1:016x}")
    return replaced(table, "goal_source", np.where(first, "hindsight", None)), recordings


def both_kinds_of_goals(table: pa.Table, recordings: pa.Table) -> Tables:
    first = rows_where(table, "recording_id", f"{1:016x}")
    return replaced(table, "goal_source", np.where(first, "hindsight", "logged")), recordings


def far_operator(table: pa.Table, recordings: pa.Table) -> Tables:
    operator = rows_where(table, "behaviour_policy", "operator")
    return replaced(table, "action_residual", np.where(operator, 0.4, 0.0)), recordings


def worn_wheel(table: pa.Table, recordings: pa.Table) -> Tables:
    """Return a store whose second recording, a week later, has wheels that report too much."""
    later = rows_where(table, "recording_id", f"{2:016x}")
    stamp = table["stamp_ns"].to_numpy() + later * 7 * 86_400 * 10**9
    table = replaced(replaced(table, "stamp_ns", stamp), "pose_stamp_ns", stamp)
    noise = np.random.default_rng(0).normal(0, 0.02, len(table))
    for name, values in {
        "wheel_speed_mps": np.full(len(table), 0.8),
        "wheel_yaw_rate_radps": np.zeros(len(table)),
        "localised_speed_mps": 0.8 * np.where(later, 0.9, 1.0) + noise,
    }.items():
        table = replaced(table, name, values.astype(np.float32))
    return table, recordings


def picky_operator(table: pa.Table, recordings: pa.Table) -> Tables:
    """Return a store whose operator drives only nominal episodes, in which all arrive."""
    episode = np.array(table["episode_id"].to_pylist())
    names = np.unique(episode)
    number = np.searchsorted(names, episode)
    slips = number % 3 == 0
    table = replaced(table, "true_condition", np.where(slips, "wheel_slip", "nominal"))
    operator = (number % 3 == 1) & (number % 2 == 0)
    table = replaced(table, "behaviour_policy", np.where(operator, "operator", "planner"))
    last = np.append(episode[1:] != episode[:-1], True)
    arrives = last & (~slips | (number % 2 == 0))
    table = replaced(table, "terminated", arrives)
    table = replaced(table, "truncated", last & ~arrives)
    return replaced(table, "reward", np.where(arrives, 5.0, -0.1).astype(np.float32)), recordings


def mostly_easy_operator(table: pa.Table, recordings: pa.Table) -> Tables:
    """As picky, but it drove one in ten of its episodes on a slippery floor, and failed there."""
    table, recordings = picky_operator(table, recordings)
    policy = np.array(table["behaviour_policy"].to_pylist())
    number = np.array([int(name.split("/")[1]) for name in table["episode_id"].to_pylist()])
    slips = rows_where(table, "true_condition", "wheel_slip")
    return replaced(
        table, "behaviour_policy", np.where(slips & (number % 30 == 3), "operator", policy)
    ), recordings


def haste_pays(table: pa.Table, recordings: pa.Table) -> Tables:
    """Return a store whose planner bumps in half of its episodes and still earns more."""
    episode = np.array(table["episode_id"].to_pylist())
    number = np.array([int(name.split("/")[1]) for name in episode])
    last = np.append(episode[1:] != episode[:-1], True)
    operator = number % 2 == 0
    arrives = last & (operator | (number % 4 == 1))
    table = replaced(table, "true_condition", ["nominal"] * len(table))
    table = replaced(table, "behaviour_policy", np.where(operator, "operator", "planner"))
    table = replaced(table, "bumped", np.zeros(len(table), bool))
    table = replaced(table, "terminated", last)
    table = replaced(table, "truncated", np.zeros(len(table), bool))
    return replaced(
        table, "reward", np.where(arrives, 5.0, np.where(operator, -0.1, 0.5)).astype(np.float32)
    ), recordings


def two_robots(table: pa.Table, recordings: pa.Table) -> Tables:
    return table, replaced(recordings, "tags", [{"robot": "a", "site": "o"}, {"robot": "b"}])


def only_one_robot_slips(table: pa.Table, recordings: pa.Table) -> Tables:
    slip = rows_where(table, "condition", "wheel_slip")
    of_b = rows_where(table, "recording_id", f"{2:016x}")
    return two_robots(table.filter(pa.array(~slip | ~of_b)), recordings)


def one_circle(table: pa.Table, recordings: pa.Table) -> Tables:
    of_one = rows_where(table, "recording_id", f"{1:016x}")
    action = np.where(of_one, 3, table["action"].to_numpy())
    return replaced(table, "action", action), recordings


def replayed(table: pa.Table, recordings: pa.Table) -> Tables:
    """Return a store whose second recording is the first one, later, its poses in another frame."""
    one = table.filter(pa.array(rows_where(table, "recording_id", f"{1:016x}")))
    one = replaced(one, "wheel_speed_mps", np.linspace(0.1, 0.9, len(one)).astype(np.float32))
    again = replaced(one, "recording_id", [f"{2:016x}"] * len(one))
    again = replaced(again, "stamp_ns", one["stamp_ns"].to_numpy() + 33 * 10**15)
    again = replaced(again, "pose_x_m", one["pose_x_m"].to_numpy() + 4)
    return pa.concat_tables([one, again.cast(one.schema)]), recordings


def recorded_twice_at_once(table: pa.Table, recordings: pa.Table) -> Tables:
    """Return two recordings, the second of which begins 20 s before the first ends."""
    starts = recordings["start_stamp_ns"].to_pylist()[0] + np.array([0, 40 * 10**9])
    recordings = replaced(recordings, "start_stamp_ns", starts)
    return table, replaced(recordings, "end_stamp_ns", starts + 60 * 10**9)


PLANTS: list[tuple[str, Plant, int, dict[str, object]]] = [
    ("rare_condition", no_slip, 1, {"condition": "wheel_slip", "rows_held": 0}),
    (
        "few_effective_episodes",
        slip_of_one_episode,
        1,
        {"condition": "wheel_slip", "episodes_held": 1},
    ),
    (
        "missing_cells",
        never_back,
        1,
        {"condition": "recovery", "action_name": "back 0.4", "rows": 0},
    ),
    ("thin_perturbation", never_slipped_in_the_twin, 1, {"condition": "wheel_slip", "rows": 0}),
    ("stale_data", old_slip, 1, {"condition": "wheel_slip"}),
    ("single_behaviour_policy", only_planner_slips, 1, {"condition": "wheel_slip"}),
    ("null_values", null_reward, 1, {"transition_id": (1 << 25) + 17}),
    ("null_values", null_in_an_observation, 1, {"transition_id": (1 << 25) + 17}),
    ("non_finite_values", nan_observation, 2, {"transition_id": (1 << 25) + 5}),
    ("duplicate_transitions", twice, 2, {"copies": 2}),
    ("several_tasks", two_tasks, 2, {"recordings": 1}),
    ("stale_labels", old_labels, 1, {"recording_id": f"{2:016x}"}),
    ("stale_labels", old_labels_and_a_newer_robot, 1, {"recording_id": f"{2:016x}"}),
    ("label_quality", poor_labels, 1, {"condition": "wheel_slip", "precision": 0.5}),
    ("uncertain_labels", uncertain_slip, 1, {"condition": "wheel_slip"}),
    ("stratum_of_failures", failures, 1, {"condition": "wheel_slip", "success_share": 0.0}),
    ("unsafe_data", bumping_operator, 1, {"behaviour_policy": "operator"}),
    ("dropped_ticks", many_drops, 1, {"dropped": 2000}),
    ("odometry_as_command", measured, 1, {"instead": "odometry"}),
    ("goals_by_hindsight", by_hindsight, 1, {"recording_id": f"{1:016x}"}),
    ("mixed_goal_sources", both_kinds_of_goals, 1, {"logged_episodes": 120}),
    ("speeds_from_poses", by_poses, 1, {"instead": "speeds from poses"}),
    ("contradictions", two_clocks, 1, {"topic": "/odom", "remedy": "chrony"}),
    ("unknown_conditions", without_lidar, 1, {"condition": "recovery", "recordings": 1}),
    ("far_actions", far_operator, 1, {"behaviour_policy": "operator", "far_share": 1.0}),
    ("one_action", one_circle, 1, {"recording_id": f"{1:016x}", "action": 3, "share": 1.0}),
    ("same_drive", replayed, 1, {"same_as": f"{2:016x}", "later_s": 33e6}),
    ("overlapping_recordings", recorded_twice_at_once, 1, {"both_s": 20.0}),
    ("repeated_steps", bag_and_a_part_of_it, 1, {"same_as_file": "logs/part.mcap", "rows": 60}),
    ("signal_drift", worn_wheel, 2, {"signal": "odometry_scale", "scope": "alone"}),
    ("untagged_recordings", two_robots, 1, {"recording_id": f"{2:016x}", "untold": "site"}),
    ("single_robot", only_one_robot_slips, 1, {"condition": "wheel_slip", "robot": "a"}),
    ("policy_bias", picky_operator, 1, {"behaviour_policy": "operator"}),
    ("reward_order", haste_pays, 1, {"driver": "operator 1", "other": "planner 1"}),
    ("policy_bias", mostly_easy_operator, 1, {"behaviour_policy": "operator"}),
]


# Labels of the stand-in data fall at random, so that failures of one condition touch all others.
STRICTER: dict[str, dict[str, float]] = {
    "stratum_of_failures": {"min_success_share": 0.01},
    "thin_perturbation": {"min_rows": 1},  # there is little of the stand-in data
}


@pytest.mark.parametrize(("name", "plant", "rows", "first"), PLANTS, ids=[p[0] for p in PLANTS])
def test_each_audit_finds_its_planted_fault_and_nothing_else(
    clean: Tables,
    statuses: dict[str, str],
    name: str,
    plant: Plant,
    rows: int,
    first: dict[str, object],
) -> None:
    # The random residuals of the stand-in data are far, and its recordings of one time.
    if name not in ("far_actions", "overlapping_recordings"):
        assert statuses[name] == "pass"
    finding = found(plant(*clean), name, **STRICTER.get(name, {}))
    assert finding.rows == rows
    expected = {"error": "fail", "warning": "warn", "info": "info"}[AUDITS[name].severity]
    assert finding.status == expected
    assert first.items() <= finding.sample[0].items()


def test_every_shipped_audit_of_a_store_has_a_planted_fault() -> None:
    alone = {name for name, audit in AUDITS.items() if audit.needs is None}
    # The stand-in data itself has no action probabilities and drivers that do about as well;
    # test_exposure_strata plants the third, test_compaction the last.
    elsewhere = {"no_action_probability", "reward_undetermined", "chosen_on_outcome"}
    elsewhere |= {"many_small_files"}
    assert {name for name, *_ in PLANTS} | elsewhere == alone


def test_missing_action_probabilities_are_said(clean: Tables) -> None:
    finding = found(clean, "no_action_probability")
    assert finding.status == "info"
    assert {row["behaviour_policy"] for row in finding.sample} == {"planner", "operator"}


def test_an_evaluation_full_of_easy_episodes_is_biased(tmp_path: Path) -> None:
    # The logs are about nominal and blocked episodes in equal parts; the evaluation is nine parts
    # nominal, where the policy succeeds. Only the last evaluation counts.
    table = recording_transitions(1, episodes=40)
    truth = np.where(table["episode_index"].to_numpy() % 2 == 0, "nominal", "blocked_aisle")
    evaluations = [
        {"env_steps": steps, "condition": condition, "success": condition == "nominal"}
        for steps in (100, 200)
        for condition in ["nominal"] * (9 if steps == 200 else 1) + ["blocked_aisle"]
    ]
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    store = write_store(tmp_path / "store", [replaced(table, "true_condition", truth)])
    name = "evaluation_bias"
    thresholds = {name: load_thresholds()[name]}
    pq.write_table(pa.Table.from_pylist(evaluations), run / "evaluations.parquet")
    with open_place(store, beside={"run": run}) as connection:
        (finding,) = run_audits(connection, [AUDITS[name]], thresholds, beside=["run"])
        assert finding.rows == 1
        assert finding.sample[0] == {
            "condition": "nominal",
            "share": 0.9,
            "share_in_logs": 0.5,
            "success_share": 1.0,
        }
        assert run_audits(connection, [AUDITS[name]], thresholds)[0].status == "skipped"
    # Where the policy does as well everywhere, more of one condition biases nothing.
    everywhere = [row | {"success": True} for row in evaluations]
    pq.write_table(pa.Table.from_pylist(everywhere), run / "evaluations.parquet")
    with open_place(store, beside={"run": run}) as connection:
        assert run_audits(connection, [AUDITS[name]], thresholds, beside=["run"])[0].rows == 0


@pytest.fixture(scope="module")
def panels(store_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a panel of the store for each way of holding out."""
    folder, made = tmp_path_factory.mktemp("panels"), {}
    with Store(store_path) as store:
        for by in ("episode", "recording", "time"):
            text = f"evaluation_split = {{by = '{by}'}}\nplanned_draws = 6400\n"
            text += "correction = {post = 'none'}\n[each_condition]\nshare = 'equal'"
            mixture = parse_mixture(text)
            made[by] = build_panel(store, mixture, folder / by).path
    return made


def beside_panel(store: Path, panel: Path, name: str, spoil: str = "SELECT 1") -> Finding:
    """Return what an audit finds of a panel whose held-out list was spoilt."""
    chosen = {name: load_thresholds()[name]} if AUDITS[name].parameters else {}
    with open_place(store, beside={"panel": panel}) as connection:
        install_named(connection, spoil)
        connection.execute(spoil).fetchall()
        return run_audits(connection, [AUDITS[name]], chosen, beside=["panel"])[0]


def test_strata_that_the_panel_overrepresents_are_named(
    store_path: Path, panels: dict[str, Path]
) -> None:
    finding = beside_panel(store_path, panels["episode"], "panel_bias")
    boosted = {row["stratum"] for row in finding.sample}
    assert boosted == {"wheel_slip", "blocked_aisle", "near_collision", "recovery"}


LEAKS = {
    "episode": ("episode", "the same episode", "SELECT * FROM panel.rows LIMIT 1"),
    "recording": (
        "recording",
        "a recording that is held out",
        "SELECT * REPLACE ('elsewhere' AS episode_id) FROM panel.rows LIMIT 1",
    ),
    "time": (
        "time",
        "later than what is held out",
        "SELECT * REPLACE ('elsewhere' AS episode_id) FROM panel.rows ORDER BY logged_ns LIMIT 1",
    ),
}


@pytest.mark.parametrize(("by", "leak", "spoilt"), LEAKS.values(), ids=LEAKS)
def test_what_leaks_from_held_out_data_is_found(
    store_path: Path, panels: dict[str, Path], by: str, leak: str, spoilt: str
) -> None:
    assert beside_panel(store_path, panels[by], "leakage").status == "pass"
    spoil = (
        "CREATE OR REPLACE VIEW panel.evaluation_split AS"
        f" SELECT *, '{by}' AS split_by FROM ({spoilt})"
    )
    finding = beside_panel(store_path, panels[by], "leakage", spoil)
    assert finding.status == "fail"
    assert leak in {row["leak"] for row in finding.sample}


def test_a_copy_of_a_held_out_step_is_a_leak(tmp_path: Path) -> None:
    one = recording_transitions(1)
    copy = replaced(one, "recording_id", [f"{7:016x}"] * len(one))
    episodes = [f"{7:016x}/{index}" for index in one["episode_index"].to_pylist()]
    copy = replaced(copy, "episode_id", episodes)
    copy = replaced(copy, "transition_id", (np.int64(7) << 25) + np.arange(len(one)))
    copy = replaced(copy, "ingest_id", ["copy"] * len(one))
    path = write_store(tmp_path / "store", [one, copy])
    # A panel leaves such steps out itself: one of a store without the copy, and one beside it.
    mixture = parse_mixture("[each_condition]\n[evaluation_split]\nby = 'none'")
    panel = panel_of(write_store(tmp_path / "alone", [one]), mixture, tmp_path / "p")
    spoil = (
        "CREATE OR REPLACE VIEW panel.evaluation_split AS SELECT *,"
        f" 'recording' AS split_by FROM transitions WHERE recording_id = '{7:016x}'"
    )
    finding = beside_panel(path, panel.path, "leakage", spoil)
    assert {row["leak"] for row in finding.sample} == {"the same step under another id"}
    assert finding.rows == len(one["episode_id"].unique())


def test_strata_of_few_episodes_are_found_in_a_panel_and_in_a_run(
    store_path: Path, panels: dict[str, Path], tmp_path: Path
) -> None:
    assert beside_panel(store_path, panels["episode"], "few_panel_episodes").status == "pass"
    spoil = "UPDATE panel.strata SET effective_episodes = 2.5 WHERE name = 'wheel_slip'"
    finding = beside_panel(store_path, panels["episode"], "few_panel_episodes", spoil)
    assert [row["stratum"] for row in finding.sample] == ["wheel_slip"]

    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    pq.write_table(pa.table({"condition": ["nominal"]}), run / "evaluations.parquet")
    name = "few_drawn_episodes"
    chosen = {name: load_thresholds()[name]}
    with open_place(store_path, beside={"run": run}) as connection:  # from before there was one
        (older,) = run_audits(connection, [AUDITS[name]], chosen, beside=["run"])
    assert older.status == "skipped"
    own = recording_transitions(1)["recording_id"][0].as_py()
    drawn = [("nominal", f"{own}/{index}", 10) for index in range(20)]
    slipped = ((0, 500), (1, 3), (2, 3))
    drawn += [("wheel_slip", f"{own}/{index}", count) for index, count in slipped]
    rows = [
        {"source": "logs", "stratum": stratum, "episode": episode, "drawn_rows": count}
        for stratum, episode, count in drawn
    ]
    pq.write_table(pa.Table.from_pylist(rows), run / "sampled_episodes.parquet")
    with open_place(store_path, beside={"run": run}) as connection:
        (finding,) = run_audits(connection, [AUDITS[name]], chosen, beside=["run"])
    assert [(row["stratum"], row["episodes"]) for row in finding.sample] == [("wheel_slip", 3)]
    assert finding.sample[0]["effective_episodes"] == pytest.approx(1.02, abs=0.01)


def test_ones_own_audits_and_thresholds(tmp_path: Path, clean: Tables) -> None:
    (tmp_path / "slow.sql").write_text(
        "-- severity: error\n-- advice: Drive on.\n-- doc: Slow steps.\n"
        "SELECT transition_id FROM transitions WHERE command_speed_mps < $least LIMIT 3"
    )
    (tmp_path / "rare_condition.sql").write_text(
        "-- severity: info\n-- advice: None.\n-- doc: Nothing.\nSELECT 1 WHERE false"
    )
    audits = {audit.name: audit for audit in load_audits(tmp_path)}
    assert audits["rare_condition"].severity == "info"
    assert audits.keys() == AUDITS.keys() | {"slow"}
    (tmp_path / "mine.toml").write_text("[slow]\nleast = 0.5\n[stale_data]\nmax_age_days = 7")
    thresholds = load_thresholds(tmp_path / "mine.toml")
    assert thresholds["stale_data"] == {"max_age_days": 7}
    with duckdb.connect() as connection:
        views_over(connection, *clean)
        (finding,) = run_audits(connection, [audits["slow"]], {"slow": thresholds["slow"]})
        assert (finding.status, finding.rows) == ("fail", 3)
        with pytest.raises(ConfigError, match="no threshold least"):
            run_audits(connection, [audits["slow"]], {})
        with pytest.raises(ConfigError, match=r"slow\.most is not a threshold"):
            run_audits(connection, [audits["slow"]], {"slow": {"least": 1, "most": 2}})
        for old, new, renamed in (
            ("flattering_policy", {}, "policy_bias"),
            ("slow", {"max_flattery": 1}, "max_bias"),
        ):
            with pytest.raises(ConfigError, match=f"it is now called '{renamed}'"):
                run_audits(connection, [audits["slow"]], {old: new})
        with pytest.raises(ConfigError, match="no audit named 'sloow'"):
            run_audits(connection, [audits["slow"]], {"sloow": {"least": 1}})
        named = Audit("named", "error", "", "", None, "SELECT 1 WHERE $Min2_m + $v2 > 0")
        values: dict[str, float | str] = {"Min2_m": 1.0, "v2": 0.5}
        assert run_audits(connection, [named], {"named": values})[0].status == "fail"
        broken = Audit("broken", "error", "", "", None, "SELECT nothing FROM transitions")
        with pytest.raises(ConfigError, match=r"broken.*does not run"):
            run_audits(connection, [broken], {})


@pytest.mark.parametrize(
    "text",
    [
        "-- severity: error\n-- doc: x\nSELECT 1",
        "-- severity: bad\n-- advice: x\n-- doc: x\nSELECT 1",
    ],
)
def test_an_audit_without_a_whole_header_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.sql").write_text(text)
    with pytest.raises(ConfigError, match=r"mine\.sql"):
        load_audits(tmp_path)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("rare_condition = 3", "rare_condition"),
        ("stale_data.max_age_days = 'x'", "stale_data.max_age_days"),
        ("stale_data.max_age_days = nan", "stale_data.max_age_days"),  # no row would be above it
        ("[rare", "t.toml"),
        (None, "t.toml"),
    ],
)
def test_wrong_files_of_thresholds_are_refused(
    tmp_path: Path, text: str | None, place: str
) -> None:
    if text is not None:
        (tmp_path / "t.toml").write_text(text)
    with pytest.raises(ConfigError, match=re.escape(place)):
        load_thresholds(tmp_path / "t.toml")


@pytest.mark.parametrize("folder", [".", "audits"])
def test_a_folder_without_audits_is_refused(tmp_path: Path, folder: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(str(tmp_path))):
        load_audits(tmp_path / folder)


def test_thresholds_are_those_the_audits_use() -> None:
    shipped = load_thresholds()
    assert {name: set(table) for name, table in shipped.items()} == {
        name: audit.parameters for name, audit in AUDITS.items() if audit.parameters
    }


@pytest.mark.long
def test_findings_do_not_depend_on_what_is_held_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = StoreWriter(tmp_path / "store")
    for number in (1, 2, 3):
        rows = recording_transitions(number)
        writer.write(manifest(rows), rows)

    kept: dict[tuple[int, int], list[str]] = {}

    def findings(rows: int, summarised_rows: int) -> list[tuple[str, str, int]]:
        """With what is held of stores of so many rows at most."""
        monkeypatch.setattr(definitions, "FEW_ROWS", rows)
        monkeypatch.setattr(definitions, "FEW_SUMMARISED_ROWS", summarised_rows)
        tables: list[str] = []

        def look(_: str) -> None:
            held = store.bare.sql("SELECT table_name FROM duckdb_tables()").fetchall()
            tables[:] = {"transitions", "stored_summaries"}.intersection(name for (name,) in held)

        with Store(tmp_path / "store") as store:
            found = run_audits(store.connection, shipped_audits(), load_thresholds(), done=look)
            kept[rows, summarised_rows] = sorted(tables)
            look("")
            assert not tables
        return [(one.audit.name, one.status, one.rows) for one in found]

    nothing = findings(0, 0)
    assert sum(bool(rows) for *_, rows in nothing) > 5
    assert findings(0, 10**6) == findings(10**6, 10**6) == nothing
    assert kept == {
        (0, 0): [],
        (0, 10**6): ["stored_summaries"],
        (10**6, 10**6): ["stored_summaries", "transitions"],
    }


def test_the_verb_fails_on_an_error_and_passes_without(
    store_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "audit.xml"
    assert cli.main(["audit", str(store_path), "--json", "--junit", str(junit)]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["failed"] == 1
    assert [a["audit"] for a in document["audits"] if a["status"] == "fail"] == ["rare_condition"]
    (root,) = ElementTree.fromstring(junit.read_text())
    failed = [case.get("name") for case in root if case.find("failure") is not None]
    assert failed == ["rare_condition"]
    assert root.get("tests") == str(len(AUDITS))
    easy = tmp_path / "easy.toml"
    easy.write_text("[rare_condition]\nmin_rows = 1\nmin_episodes = 1")
    assert cli.main(["audit", str(store_path), "--thresholds", str(easy)]) == 0
    out = capsys.readouterr().out
    assert "stale_data" in out
    assert "skipped" in out
    assert cli.main(["audit", str(store_path), "--memory-limit", "lots"]) == 2
    assert "no memory limit 'lots'" in capsys.readouterr().err
    assert cli.main(["audit", str(store_path), "--capacity", "--memory-limit", "1GB"]) == 0
    strict = ["--thresholds", str(easy), "--strict", "--junit", str(junit), "--memory-limit", "1GB"]
    assert cli.main(["audit", str(store_path), *strict]) == 1
    assert int(ElementTree.fromstring(junit.read_text())[0].get("failures", "")) > 0


@pytest.mark.parametrize("words", [["audit"], ["audit", "--reward"]], ids=" ".join)
def test_a_store_that_lost_all_its_rows_passes_no_gate(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, rows = tmp_path / "store", recording_transitions(1)
    StoreWriter(store).write(manifest(rows), rows)
    for file in (store / "transitions").rglob("*.parquet"):
        file.unlink()
    assert cli.main(["store", "compact", str(store), "--drop-damaged"]) == 3
    assert cli.main([words[0], str(store), *words[1:]]) == 2
    assert "it holds no transitions: there is nothing to audit" in capsys.readouterr().err


def test_the_verb_refuses_a_run_that_is_none_and_a_file_it_cannot_write(
    store_path: Path, panels: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = str(store_path)
    assert cli.main(["audit", str(tmp_path)]) == 2
    assert "not a store" in capsys.readouterr().err
    assert cli.main(["audit", store, "--run", str(panels["time"])]) == 2
    assert "is not a run directory" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert cli.main(["audit", store, "--junit", str(tmp_path / "file" / "x.xml")]) == 2
    assert "cannot be read or written" in capsys.readouterr().err


def test_a_panel_or_a_run_of_another_store_is_refused(
    store_path: Path, panels: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_store(tmp_path / "other", [recording_transitions(4)])
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    own = recording_transitions(1)["recording_id"][0].as_py()
    rows = [{"source": "logs", "stratum": "a", "episode": f"{own}/0", "drawn_rows": 1}]
    rows.append(rows[0] | {"source": "fresh", "episode": "7"})
    pq.write_table(pa.Table.from_pylist(rows), run / "sampled_episodes.parquet")
    for words in (["audit", "--panel", panels["time"]], ["audit", "--run", run]):
        verb, flag, place = map(str, words)
        assert cli.main([verb, str(other), flag, place]) == 2
        said = " ".join(capsys.readouterr().err.split())
        assert "none of its logged rows are of a recording in" in said
        assert f"this {flag[2:]} was made from another store" in said
    moved = shutil.copytree(store_path, tmp_path / "moved")
    with open_place(moved, beside={"panel": panels["time"], "run": run}):
        pass


def test_a_panel_that_shares_only_some_recordings_with_the_store_fails(
    store_path: Path, panels: dict[str, Path], tmp_path: Path
) -> None:
    name, panel = "panel_of_another_store", panels["time"]
    assert beside_panel(store_path, panel, name).status == "pass"
    part = write_store(tmp_path / "part", [recording_transitions(1), recording_transitions(4)])
    finding = beside_panel(part, panel, name)
    assert finding.status == "fail"
    meta = Panel.open(panel).meta
    held = meta["recording_id"].to_pylist()
    absent = sorted(set(held) - {f"{1:016x}"})
    assert finding.sample == [
        {"recording_id": one, "missing_rows": held.count(one), "panel_recordings": len(set(held))}
        for one in absent
    ]
    # Rows of the mixture's other stores are not looked for in this one.
    others = "CREATE OR REPLACE TABLE panel.strata AS SELECT * REPLACE ('b' AS source)"
    assert beside_panel(part, panel, name, f"{others} FROM panel.strata").status == "pass"


def test_junit_is_as_its_readers_expect() -> None:
    """The rules of junit-10.xsd that concern us: names of elements, attributes, and the counts."""
    rows = [{"source_file": "a\x00b\x1b[31m\ud800<&>", "rows": 3}]
    findings = [
        Finding(AUDITS["rare_condition"], "fail", 3, ["rows"], rows, {}),
        Finding(AUDITS["stale_data"], "warn", 1, ["rows"], rows, {}),
        Finding(AUDITS["several_tasks"], "pass", 0, [], [], {}),
        Finding(AUDITS["leakage"], "skipped", 0, [], [], {}),
    ]
    text = junit_suites({"audit \x07 store": findings}, {"fail"})
    (root,) = ElementTree.fromstring(text.encode("utf-8"))  # what XML cannot hold is not in it
    assert root.tag == "testsuite"
    assert root.keys() == ["name", "tests", "failures", "errors", "skipped"]
    assert [root.get(name) for name in ("tests", "failures", "errors", "skipped")] == list("4101")
    for case in root:
        assert case.tag == "testcase"
        assert {"name", "classname"} == set(case.keys())
        assert {child.tag for child in case} <= {"failure", "skipped", "system-out"}
    failure = root[0].find("failure")
    assert failure is not None
    assert "<&>" in str(failure.text)
    assert root[1].find("failure") is None
    assert root[3].find("skipped") is not None
