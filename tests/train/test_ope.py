"""Evaluate runs off-policy on held-out episodes, and check when evaluation is refused."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.kept_run import QUICK, kept_network, kept_run
from support.panels import panel_of
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.errors import RunError
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.transitions import replaced
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store
from restock.train.dqn.config import NetworkConfig
from restock.train.evaluation.ope import OpeConfig, evaluate_off_policy
from restock.train.evaluation.ope_dataset import OpeSteps, load_ope_dataset, read_steps

TASK = load_profile("warehouse_amr").task
MIXTURE = parse_mixture("[each_condition]\nshare = 'natural'\n[evaluation_split]\nshare = 0.3\n")
NETWORK = NetworkConfig(hidden=(16,))
CONFIG = OpeConfig(model=QUICK)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ope") / "store"
    known, cloned = (recording_transitions(recording, task=TASK) for recording in (1, 2))
    known = replaced(known, {"action_probability": np.full(len(known), 0.25)})
    return write_store(path, [known, cloned], task=TASK)


@pytest.fixture(scope="module")
def panel(store: Path) -> Panel:
    return panel_of(store, MIXTURE, store.parent / "panel")


def test_training_and_evaluation_episodes_are_disjoint(store: Path, panel: Panel) -> None:
    fed = set(panel.meta["episode_id"].to_pylist())
    held = set(pq.read_table(panel.path / "evaluation_split.parquet")["episode_id"].to_pylist())
    for logs in (None, str(panel.path), str(store)):
        dataset = load_ope_dataset(panel, TASK, logs)
        assert len(dataset.evaluation.condition) == len(held - fed)
        assert len(dataset.training.condition) == len(fed)
        rows = dataset.evaluation.rows
        seen = {tuple(row) for row in dataset.training.rows.observation[:, :3].tolist()}
        assert not seen & {tuple(row) for row in rows.observation[:, :3].tolist()}
    assert "left out" in dataset.notes[0]


def test_logs_without_held_out_episodes_are_rejected(store: Path, tmp_path: Path) -> None:
    everything = parse_mixture(
        "[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n"
    )
    panel = panel_of(store, everything, tmp_path / "p")
    with pytest.raises(RunError, match="no episode that the run did not learn from"):
        load_ope_dataset(panel, TASK, str(store))
    other = msgspec.structs.replace(TASK, time_limit_steps=3)
    with pytest.raises(RunError, match="its rows are of task"):
        load_ope_dataset(panel, other, str(store))
    with pytest.raises(RunError, match="did not learn from a panel"):
        load_ope_dataset(None, TASK)


def test_success_is_arrival_before_contact(tmp_path: Path) -> None:
    table = recording_transitions(1)
    stops = table["terminated"].to_numpy() & (table["episode_index"].to_numpy() % 3 == 0)
    table = replaced(table, {"reward": np.where(stops, -6.0, table["reward"].to_numpy())})
    with Store(write_store(tmp_path / "store", [table])) as opened:
        ids = opened.sql("SELECT transition_id FROM transitions").fetchnumpy()["transition_id"]
        steps = read_steps(opened.connection, np.asarray(ids, np.int64))
        rows = opened.sql(
            "SELECT episode_id, step_index, bumped, terminated, reward FROM transitions"
            " ORDER BY recording_id, episode_index, step_index"
        ).fetchall()
    expected, ends = [], []
    for name in dict.fromkeys(row[0] for row in rows):
        episode = [row for row in rows if row[0] == name]
        # A step has a contact if the bumper reports it in the next row or it ended the episode.
        bumps = [any_after[2] for any_after in episode[1:]]
        bumps.append(episode[-1][3] and episode[-1][4] < TASK.rewards.goal / 2)
        until = bumps.index(True) if True in bumps else len(episode) - 1
        arrived = episode[until][3] and not bumps[until]
        expected.append([0.0] * until + [float(arrived)])
        ends.append(bool(bumps[until] or episode[until][3]))
    measured = steps.measured("success")
    found = [
        measured.rows.reward[measured.episode == index] for index in np.unique(measured.episode)
    ]
    assert [part.tolist() for part in found] == expected
    assert stops.any()
    last = np.flatnonzero(np.diff(measured.episode, append=-1))
    assert measured.rows.terminated[last].tolist() == ends
    assert measured.rows.terminated.sum() == sum(ends)


def test_contact_before_held_out_part_is_ignored(tmp_path: Path) -> None:
    """Regression: a contact before the held-out part removed all its rows (IndexError)."""
    with Store(write_store(tmp_path / "store", [recording_transitions(1)])) as opened:
        found = opened.sql(
            "SELECT transition_id FROM transitions"
            " QUALIFY bool_or(bumped AND step_index > 0) OVER (PARTITION BY episode_id ORDER BY"
            " step_index)"
        ).fetchnumpy()
        steps = read_steps(opened.connection, np.asarray(found["transition_id"], np.int64))
    measured = steps.measured("success")
    assert len(steps.condition) > 1
    assert np.unique(measured.episode).tolist() == list(range(len(steps.condition)))
    first = np.flatnonzero(np.diff(steps.episode, prepend=-1))
    assert not steps.bumped_before[first].any()


def test_weights_fall_back_to_cloned_probabilities(panel):
    dataset = load_ope_dataset(panel, TASK)
    network = kept_network(NETWORK)
    rows = evaluate_off_policy(network, dataset, discount=0.97, config=CONFIG)
    unknown = np.isnan(dataset.evaluation.probability)
    assert 0 < unknown.mean() < 1
    assert {row["estimated_share"] for row in rows} == {unknown.mean()}
    logged = _with_known_probability(dataset.evaluation)
    rows = evaluate_off_policy(
        network,
        replace(dataset, evaluation=logged),
        discount=0.97,
        measures=("return",),
        config=CONFIG,
    )
    assert {row["estimated_share"] for row in rows} == {0.0}
    whole = next(r for r in rows if (r["condition"], r["estimator"]) == ("all", "logged"))
    first = np.flatnonzero(np.diff(logged.episode, prepend=-1))
    power = np.arange(len(logged.rows)) - np.repeat(
        first, np.diff(np.append(first, len(logged.rows)))
    )
    total = (logged.rows.reward * 0.97**power).sum() / len(first)
    assert whole["value"] == pytest.approx(total, rel=1e-5)


def _with_known_probability(steps: OpeSteps) -> OpeSteps:
    return replace(steps, probability=np.full(len(steps.rows), 0.3))


def test_eval_on_logs_reports_values_and_refusals(
    store, panel, tmp_path, quick_models, capsys, shell
):
    run = kept_run(tmp_path / "a", NETWORK, panel)
    argv = ["eval", str(run), "--on-logs", "own"]
    assert main([*argv, "--dry-run"]) == 0  # a dry run fits nothing
    assert not (run / "eval").exists()
    requested = json.loads(capsys.readouterr().out)
    assert (requested["episodes"], requested["measures"]) == (9, ["return", "success"])
    assert "results" not in requested
    assert main(argv) == 0
    output = capsys.readouterr()
    assert f"on 9 episodes ({requested['rows']} rows): {requested['updates']} updates" in output.err
    assert "refused" in output.out
    assert "episodes, less than" in " ".join(output.err.split())
    assert "are estimated (cloned) for" in " ".join(output.err.split())
    # The quick models make 2 regressions, so they see less than the task's 240 steps.
    reach = "looks 2 steps ahead, but an episode may take 240 (9 of 9 held-out episodes are longer)"
    assert reach in " ".join(output.err.split())
    rows = shell.json(*argv)["results"]
    table = pq.read_table(run / "eval" / "off_policy.parquet").to_pylist()
    assert [row["value"] for row in table] == [row["value"] for row in rows]
    assert {row["gradient_steps"] for row in table} == {7}
    assert {row["estimator"] for row in rows} == {"logged", "fqe", "pdwis"}
    for row in rows:
        assert (row["value"] is None) == (row["refused"] is not None)
    assert shell.json("sql", run, "SELECT count(*) AS n FROM eval_off_policy") == [{"n": len(rows)}]
    assert main(["eval", str(run), "--on-logs", str(tmp_path / "nowhere")]) == 2


def test_training_runs_off_policy_evaluation_first(panel, tmp_path, quick_models, capsys):
    path = tmp_path / "run"
    argv = ["train", "--panel", str(panel.path), "--out", str(path), "--env-steps", "0"]
    small = ["schedule.offline_updates=3", "network.hidden=[8]", "evaluation.episodes=1"]
    small += ["record.trackers=[]", "evaluation.off_policy=true", "replay.batch_size=8"]
    assert main([*argv, *(flag for value in small for flag in ("--set", value))]) == 0
    rows = pq.read_table(path / "off_policy.parquet").to_pylist()
    assert {row["measure"] for row in rows} == {"return", "success"}
    assert {row["gradient_steps"] for row in rows} == {3}
    error = " ".join(capsys.readouterr().err.split())  # as `restock eval --on-logs` does
    assert "off-policy evaluation: the fitted model looks 2 steps ahead" in error
