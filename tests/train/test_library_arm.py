"""Stable-Baselines3's DQN and PPO as arms of a study: runs that are evaluated as any other."""

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from support.long import one_in

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.train.evaluation.policies import load_agent
from restock.train.feed.batch_record import NotFinite
from restock.train.libraries.library_arm import (
    TRAINED,
    LibraryArm,
    dqn_arguments,
    resolve,
    train_library,
)
from restock.train.run.run import Run

TASK = load_profile("warehouse_amr").task
SETTINGS = (
    "network.hidden=[16]",
    "env.num_envs=2",
    "schedule.env_steps=160",
    "schedule.warmup_env_steps=40",
    "schedule.updates_per_env_step=0.5",
    "replay.batch_size=16",
    "evaluation.every_env_steps=1000",
    "evaluation.episodes=1",
    "record.every_updates=20",
)


def trained(out: Path, library: str, **arguments: object) -> Run:
    pytest.importorskip("stable_baselines3")
    train_library(LibraryArm(str(out), library, SETTINGS, dict(arguments)))  # type: ignore[arg-type]
    return Run.open(out)


def test_dqn_leaves_a_run_that_says_what_it_was_fed(tmp_path: Path) -> None:
    run = trained(tmp_path / "dqn", "sb3-dqn")
    known = run.document["library"]
    assert known["algorithm"] == "sb3-dqn"
    assert known["arguments"]["buffer_size"] == run.document["config"]["replay"]["ring_capacity"]
    assert known["arguments"]["gamma"] == run.document["config"]["loss"]["discount"]
    updates = run.table("progress")["gradient_steps"][-1].as_py()
    assert updates == 60  # (160 - 40) environment steps, one update every second one
    fed = run.table("sampled_episodes")
    assert pc.sum(fed["drawn_rows"]).as_py() == updates * 16
    assert set(fed["source"].to_pylist()) == {"fresh"}
    evaluated = run.table("evaluations")
    assert len(evaluated) == 4  # one episode of each kind
    assert json.loads((tmp_path / "dqn" / "library.json").read_text())["env_steps"] == 160


@pytest.mark.parametrize("library", ["sb3-dqn", "sb3-ppo"])
def test_an_arm_whose_network_is_not_finite_ends_with_an_error(library, tmp_path):
    own = {"sb3-ppo": {"n_steps": 40, "batch_size": 20, "n_epochs": 2}}.get(library, {})
    with pytest.raises(NotFinite, match="not finite"):
        trained(tmp_path / "run", library, learning_rate=float("inf"), **own)
    assert not (tmp_path / "run" / TRAINED).exists()
    assert not Run.open(tmp_path / "run").best.exists()


@pytest.mark.parametrize(
    ("library", "name", "own"),
    one_in(
        2,
        [
            ("sb3-dqn", "DQN", {}),
            ("sb3-ppo", "PPO", {"n_steps": 40, "batch_size": 20, "n_epochs": 2}),
        ],
    ),
)
def test_what_is_kept_acts_as_the_library_does(tmp_path, monkeypatch, library, name, own):
    pytest.importorskip("stable_baselines3")
    from restock.train.libraries import sb3_drive

    models: dict[str, object] = {}
    made = getattr(sb3_drive, name)
    monkeypatch.setattr(sb3_drive, name, lambda *a, **k: models.setdefault(name, made(*a, **k)))
    observations = np.random.default_rng(0).normal(size=(64, TASK.observation_size))
    observations = observations.astype(np.float32)
    run = trained(tmp_path / name, library, **own)
    theirs, _ = models[name].predict(observations, deterministic=True)  # type: ignore[attr-defined]
    ours, _ = load_agent(run).act(None, observations)
    assert ours.tolist() == theirs.tolist()


def test_ppo_was_fed_every_step_of_its_rollouts_some_epochs_long(tmp_path: Path) -> None:
    run = trained(tmp_path / "ppo", "sb3-ppo", n_steps=30, batch_size=20, n_epochs=3)
    assert run.document["target"] == {"rule": "none"}
    assert run.document["library"]["replay"].startswith("none")
    last = run.table("progress").slice(run.table("progress").num_rows - 1)
    # 160 steps are two rollouts of 2 x 30, and 40 steps that were not learnt from.
    assert last["env_steps"][0].as_py() == 160
    assert last["gradient_steps"][0].as_py() == 2 * 3 * 3
    assert pc.sum(run.table("sampled_episodes")["drawn_rows"]).as_py() == 2 * 60 * 3


def test_the_clocks_of_dqn_are_the_configs() -> None:
    given = dqn_arguments(resolve((*SETTINGS, 'target={rule = "hard", every = 100}'), "sb3-dqn"))
    assert (given["train_freq"], given["gradient_steps"]) == (1, 1)
    assert (given["target_update_interval"], given["tau"]) == (200, 1.0)
    sets = ("env.num_envs=16", "schedule.updates_per_env_step=0.125")
    given = dqn_arguments(resolve((*sets, 'target={rule = "polyak", tau = 0.01}'), "sb3-dqn"))
    assert (given["train_freq"], given["gradient_steps"]) == (1, 2)
    assert given["target_update_interval"] == 16
    assert given["tau"] == pytest.approx(1 - 0.99**2)
    given = dqn_arguments(
        resolve(("env.num_envs=2", "schedule.updates_per_env_step=0.1"), "sb3-dqn")
    )
    assert (given["train_freq"], given["gradient_steps"]) == (5, 1)


def test_without_the_library_it_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ConfigError, match=r"\[libraries\]"):
        train_library(LibraryArm(str(tmp_path / "x"), "sb3-dqn"))
    assert not (tmp_path / "x").exists()


def test_the_library_refuses_arguments_it_does_not_know(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"refused its arguments: .*wings"):
        trained(tmp_path / "x", "sb3-dqn", wings=2)


def test_networks_side_by_side_are_refused_to_a_library() -> None:
    with pytest.raises(ConfigError, match=r"sb3-dqn does not have network\.members"):
        resolve(("network.members=3",), "sb3-dqn")
