"""Clone the drivers of the logs as a policy: quality, caching and rejections."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.kept_run import TASK, kept_run
from support.panels import panel_of
from support.stores import recording_transitions, write_store

from restock.ingest.store.transitions import replaced
from restock.replay.panel.panel import Panel
from restock.train.dqn.fitted_q import cloned_probabilities
from restock.train.evaluation import policies
from restock.train.evaluation.policies import load_cloned
from restock.train.run.kept_evaluations import read_clones
from restock.train.run.run import Run

MIXTURE = "[each_condition]\nshare = 'natural'\n[evaluation_split]\nshare = 0.3\n"
ACTIONS = len(TASK.actions)


@pytest.fixture(autouse=True)
def few_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clone with few updates, since the drivers of these tests are simple."""
    monkeypatch.setattr(policies, "UPDATES", (50, 100))


def rows_of_rule_driver(recording: int, who: str, *, chance: bool = False) -> pa.Table:
    """Return rows whose driver turns toward the near waypoint, or at random."""
    table = recording_transitions(recording, task=TASK)
    rng = np.random.default_rng(recording)
    observation = np.zeros((len(table), TASK.observation_size), np.float32)
    observation[:, 0] = rng.normal(size=len(table))
    last = rng.integers(ACTIONS, size=len(table))
    observation[:, 12 : 12 + ACTIONS] = np.eye(ACTIONS, dtype=np.float32)[last]
    action = np.where(observation[:, 0] > 0, 1, 2)
    if chance:
        action = rng.integers(ACTIONS, size=len(table))
    columns = {"observation": list(observation), "action": action, "behaviour_policy": who}
    return replaced(table, columns)


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Panel:
    folder = tmp_path_factory.mktemp("cloned")
    tables = [rows_of_rule_driver(1, "planner"), rows_of_rule_driver(2, "teleop")]
    return panel_of(write_store(folder / "store", tables, task=TASK), MIXTURE, folder / "panel")


def test_clone_matches_drivers_and_reports_agreement(panel, tmp_path):
    run = Run.open(kept_run(tmp_path / "run", panel=panel))
    policy = load_cloned(run, "cloned", seed=3)
    reported = policy.quality
    assert reported.drivers == ["planner", "teleop"]
    assert reported.rows == len(panel)
    assert reported.held_out_rows > 20
    assert reported.agreement > 0.8
    assert reported.repeating < 0.3
    assert reported.poor is None
    assert "held-out rows the drivers' action is its likeliest" in reported.text
    observation = np.array(panel.rows[:200, : panel.observation_size])
    action, probability = policy.act(None, observation)
    of_each = cloned_probabilities(policy.network, observation)
    assert (action == np.where(observation[:, 0] > 0, 1, 2)).mean() > 0.8
    assert np.allclose(probability, of_each[np.arange(200), action])
    # Draws are seeded.
    assert (load_cloned(run, "cloned", seed=3).act(None, observation)[0] == action).all()
    assert (load_cloned(run, "cloned", seed=4).act(None, observation)[0] != action).any()


def test_clone_is_cached(panel, tmp_path, monkeypatch):
    run = Run.open(kept_run(tmp_path / "run", panel=panel))
    first = load_cloned(run, "cloned:teleop")
    assert first.quality.drivers == ["teleop"]
    assert first.quality.rows < len(panel)
    load_cloned(run, "cloned:planner")
    assert [one.policy for one in read_clones(run.path)] == ["cloned:teleop", "cloned:planner"]
    monkeypatch.setattr(policies, "clone_of", None)  # calling it would fail
    again = load_cloned(run, "cloned:teleop")
    assert again.quality == first.quality
    weights, before = again.network.state_dict(), first.network.state_dict()
    assert all((weights[name] == before[name]).all() for name in before)


def test_clone_of_random_driver_is_poor(tmp_path: Path) -> None:
    tables = [rows_of_rule_driver(recording, "teleop", chance=True) for recording in (1, 2)]
    store = write_store(tmp_path / "store", tables, task=TASK)
    panel = panel_of(store, MIXTURE, tmp_path / "panel")
    reported = load_cloned(Run.open(kept_run(tmp_path / "run", panel=panel)), "cloned").quality
    assert reported.poor is not None
    assert "a poor clone" in reported.text
    everything = panel_of(store, MIXTURE.replace("0.3", "0.0"), tmp_path / "all")
    reported = load_cloned(Run.open(kept_run(tmp_path / "b", panel=everything)), "cloned").quality
    assert reported.held_out_rows == 0
    assert reported.agreement is None
    assert "the quality of the clone is not known" in reported.text


def test_eval_drives_the_clone(panel, tmp_path, shell):
    run = kept_run(tmp_path / "run", panel=panel)
    line = ["eval", str(run), "--episodes", "nominal=2", "--perturbations", "none", "--json"]
    document = json.loads(shell.out(*line, "--policies", "agent,cloned"))
    assert {row["policy"] for row in document["results"]} == {"agent", "cloned"}
    (clone,) = document["clones"]
    assert clone["policy"] == "cloned"
    assert clone["text"].startswith("cloned is behaviour cloning")
    query = "SELECT rows, agreement > .8 AS good FROM eval_clones"
    assert shell.json("sql", run, query) == [{"rows": len(panel), "good": True}]


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("cloned:nobody", "its logs have no driver named 'nobody'"),
        ("cloned:", "there is no 'cloned:'"),
    ],
)
def test_clone_of_unknown_driver_is_rejected(panel, tmp_path, policy, message, shell):
    run = kept_run(tmp_path / "run", panel=panel)
    assert message in shell.err("eval", run, "--policies", policy, "--dry-run")
    none = kept_run(tmp_path / "none")
    assert "did not learn from logs" in shell.err("eval", none, "--policies", "cloned", "--dry-run")
