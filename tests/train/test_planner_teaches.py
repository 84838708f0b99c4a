"""Check the planner teacher: deviation from navigation's proposals, means of runs, rejections."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.paths import ROOT
from support.shell import Shell
from torch import tensor

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import nearest_action, proposal_reader
from restock.train.dqn.behaviour import plausible_actions
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import Score
from restock.train.evaluation.policies import load_agent, make_learner, save_agent, write_mean
from restock.train.prepare import prepare_new
from restock.train.run.run import Run
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv

TASK = load_profile("warehouse_amr").task
KNOWN = TASK.observation_names.index("nav_known")


def observations_of(command: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return observations (N, D) with these proposed commands (N, 2), in m/s and rad/s."""
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(len(command), TASK.observation_size)).astype(np.float32)
    scaled = command / np.abs(np.asarray(TASK.actions)).max(axis=0)
    observation[:, KNOWN:] = np.where(known[:, None], np.column_stack([known, scaled]), 0.0)
    return observation


@given(st.integers(0, 2**32 - 1))
def test_proposal_reader_returns_nearest_action(seed: int) -> None:
    rng = np.random.default_rng(seed)
    command, known = rng.uniform(-1.2, 1.2, (50, 2)), rng.random(50) < 0.7
    near, offset, says = proposal_reader(TASK)
    observation = observations_of(command, known)
    found = (observation @ near.T + offset).argmax(axis=1)
    wanted, _ = nearest_action(TASK, command[:, 0], command[:, 1])
    assert (found == wanted)[known].all()
    assert ((observation @ says) == known).all()


def make_planner_learner(margin: float, *, path: str | None = None) -> Learner:
    document = {"teacher": {"source": "planner", "margin": margin}}
    document["network"] = {"hidden": [16]}
    return make_learner(parse_config(document, where="test"), TASK, path=path)


def set_q(learner: Learner, q: list[float]) -> None:
    """Make Q equal to `q` (A,) in every state."""
    for network in (learner.network, learner.target_network, learner.policy_network):
        with torch.no_grad():
            network.advantage.weight.zero_()
            network.advantage.bias.copy_(tensor(q))


def test_policy_deviates_only_beyond_the_margin() -> None:
    learner = make_planner_learner(0.3)
    command = np.asarray(TASK.actions)  # every action is proposed once
    observation = observations_of(command, np.ones(len(command), np.bool_))
    set_q(learner, [0.0, 0.25, *[0.0] * (len(command) - 2)])
    assert learner.greedy(observation).tolist() == list(range(len(command)))
    set_q(learner, [0.0, 0.35, *[0.0] * (len(command) - 2)])
    assert learner.greedy(observation).tolist() == [1] * len(command)
    set_q(learner, [0.0, 0.05, *[0.0] * (len(command) - 2)])
    unknown = observations_of(command, np.zeros(len(command), np.bool_))
    assert learner.greedy(unknown).tolist() == [1] * len(command)  # without a proposal, Q decides


@pytest.mark.parametrize("path", ["native", "autograd"])
def test_td_target_uses_action_of_filtered_policy(path: str) -> None:
    learner = make_planner_learner(0.3, path=path)
    set_q(learner, [1.0, 1.2, *[0.5] * (len(TASK.actions) - 2)])
    after = observations_of(np.array([[0.0, 0.0], TASK.actions[2]]), np.ones(2, np.bool_))
    scalars = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5]], np.float32)
    rows = torch.from_numpy(np.concatenate([after, after, scalars], axis=1))
    td, _, _ = learner.td_error(rows)
    # Row 0 keeps the proposed action 0 (1 is better by only .2); row 1 deviates from 2 to 1 (.7).
    assert td.tolist() == pytest.approx([1.0 - 0.5 * 1.0, 1.0 - 0.5 * 1.2])


def test_constant_q_follows_the_planner() -> None:
    learner = make_planner_learner(0.3)
    set_q(learner, [0.0] * len(TASK.actions))
    env = WarehouseVectorEnv(8, seed=3)
    observation, _ = env.reset(seed=3)
    planner = PlannerFollower(epsilon=0.0)
    taken = []
    for _ in range(60):
        wanted = planner.choose(env)
        found = learner.greedy(observation)
        assert (found == wanted).all()
        taken += found.tolist()
        observation, *_ = env.step(found)
    assert len(set(taken)) > 3


def make_kept_run(path, seed, **teacher):
    """Write a run with a policy of random weights; return the policy."""
    document = {"teacher": teacher, "network": {"hidden": [16]}, "seed": seed}
    config = parse_config(document, where="test")
    torch.manual_seed(seed)
    network = make_learner(config, TASK).policy
    about = {"config": msgspec.to_builtins(config), "task_hash": TASK.hash, "created_ns": 1}
    run = Run.create(path, about)
    clocks = {"env_steps": 100, "gradient_steps": 7}
    save_agent(run, network, TASK, Score({}, 0.0, 0.0), clocks)
    return load_agent(run)


def test_mean_of_runs_has_a_smaller_margin(tmp_path: Path, shell: Shell) -> None:
    first, second = (
        make_kept_run(tmp_path / "runs" / name, seed, source="planner", margin=0.3)
        for seed, name in enumerate("ab")
    )
    words = ["export", str(tmp_path / "runs"), "--to", "run", "--out", str(tmp_path / "mean")]
    assert "mean of runs of 200 steps together" in shell.out(*words)
    run = Run.open(tmp_path / "mean")
    assert run.document["created_ns"] > 1  # newer than the averaged runs
    made = load_agent(run)
    observation = torch.from_numpy(observations_of(np.asarray(TASK.actions), np.arange(10) > 4))
    with torch.no_grad():
        mean = (first.network.values(observation) + second.network.values(observation)) / 2
        torch.testing.assert_close(made.network.values(observation), mean)
        margin = (made.network(observation) - mean).amax(dim=1)
    torch.testing.assert_close(margin, torch.where(torch.arange(10) > 4, 0.3 / 2**0.5, 0.0))
    assert main(words) == 2  # the folder exists


def test_mean_of_means_averages_logits(tmp_path: Path) -> None:
    places = [tmp_path / name for name in "abcd"]
    filters = {"source": "operator", "ratio": 0.9}
    alone = [make_kept_run(place, seed, **filters).network for seed, place in enumerate(places)]
    pairs = [tmp_path / "ab", tmp_path / "cd"]
    for first, pair in zip((0, 2), pairs, strict=True):
        write_mean(places[first : first + 2], pair)
    made = write_mean(pairs, tmp_path / "all").network
    observation = torch.from_numpy(observations_of(np.asarray(TASK.actions), np.arange(10) > 4))
    with torch.no_grad():
        logits = sum(one.behaviour(observation) for one in alone) / 4
        mean = sum(one.values(observation) for one in alone) / 4
        plausible = plausible_actions(logits, made.ratio)
        torch.testing.assert_close(made(observation), mean.masked_fill(~plausible, -torch.inf))
    assert not plausible.all()


@pytest.mark.parametrize(
    ("teacher", "why"),
    [("none", "is not of the same task, network, algorithm and teacher"), (None, "holds 1 run")],
)
def test_runs_that_cannot_be_averaged_are_rejected(
    tmp_path: Path, teacher, why: str, shell: Shell
) -> None:
    make_kept_run(tmp_path / "runs" / "a", 0, source="planner")
    if teacher:
        make_kept_run(tmp_path / "runs" / "b", 1, source=teacher)
    words = ["export", str(tmp_path / "runs"), "--to", "run", "--out", str(tmp_path / "mean")]
    assert why in shell.err(*words)
    assert not (tmp_path / "mean").exists()


def test_planner_teacher_needs_navigation_input(tmp_path: Path) -> None:
    text = (ROOT / "ingest/profile/profiles/warehouse_amr.toml").read_text("utf-8")
    begin = text.index("[inputs.nav_command]")
    end = text.index("\n[", begin)
    mute = tmp_path / "mute.toml"
    mute.write_text(text[:begin] + text[end + 1 :])
    words = ["teacher.source=planner", f"profile={mute}"]
    with pytest.raises(ConfigError, match="does not read what navigation proposes") as refused:
        prepare_new(tmp_path / "run", None, TrainConfig(), words)
    assert refused.value.where == "teacher.source"
    assert not (tmp_path / "run").exists()
