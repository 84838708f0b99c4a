"""What drives first: candidates on held-out logs, the one whose bound is best, and its way out."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import nearest_action
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.panel import Panel
from restock.train import loop
from restock.train.describe import describe_run
from restock.train.dqn.behaviour import FilteredNetwork, ProposedNetwork
from restock.train.dqn.config import OfflineStartConfig
from restock.train.dqn.fitted_q import FittedQConfig
from restock.train.dqn.learner import greedy_actions
from restock.train.dqn.network import QNetwork
from restock.train.dqn.start_policy import StartPolicy, start_network
from restock.train.evaluation import offline_start
from restock.train.evaluation.off_policy.estimators import EssGate, OpeEpisodes
from restock.train.evaluation.offline_start import LEARNT, candidates, chosen_of, estimates
from restock.train.evaluation.onnx_policy import to_onnx
from restock.train.evaluation.ope import OpeConfig
from restock.train.evaluation.policies import load_agent
from restock.train.loop import TrainingInterrupted, train
from restock.train.prepare import prepare_new, prepare_resumed
from restock.train.run import checkpoint
from restock.train.run.run import Run

TASK = load_profile("warehouse_amr").task
MIXTURE = parse_mixture("[each_condition]\nshare = 'natural'\n[evaluation_split]\nshare = 0.3\n")
QUICK = FittedQConfig(iterations=2, updates=2, batch_size=32, hidden=(8,), cloning_updates=10)


def network(seed: int) -> QNetwork:
    made = torch.Generator().manual_seed(seed)
    return QNetwork(TASK.observation_size, len(TASK.actions), hidden=(16,), generator=made)


def filtered(ratio: float) -> FilteredNetwork:
    return FilteredNetwork(network(1), network(2), torch.tensor(ratio))


def observations(count: int, known: bool = True) -> np.ndarray:
    rng = np.random.default_rng(5)
    seen = rng.normal(size=(count, TASK.observation_size)).astype(np.float32)
    table = TASK.scaled_actions
    seen[:, -2:] = table[rng.integers(len(table), size=count)] + rng.normal(0, 0.02, (count, 2))
    seen[:, -3] = known
    return seen


def test_a_proposal_is_followed_by_its_nearest_action_where_it_is_known() -> None:
    seen = observations(500)
    proposed = start_network(StartPolicy(proposed=True), network(1), TASK.scaled_actions)
    fastest = np.abs(np.asarray(TASK.actions)).max(axis=0)
    expected, _ = nearest_action(TASK, *(seen[:, -2:] * fastest).T)
    assert greedy_actions(proposed, seen).tolist() == expected.tolist()
    unknown = observations(500, known=False)
    assert (greedy_actions(proposed, unknown) == greedy_actions(network(1), unknown)).all()


def test_a_proposal_that_is_not_plausible_leaves_the_choice_to_the_filtered_values() -> None:
    seen, inner = observations(500), filtered(0.6)
    led = start_network(StartPolicy(0.6, proposed=True), inner, TASK.scaled_actions)
    fastest = np.abs(np.asarray(TASK.actions)).max(axis=0)
    nearest, _ = nearest_action(TASK, *(seen[:, -2:] * fastest).T)
    values = inner(torch.from_numpy(seen)).detach().numpy()
    plausible = np.isfinite(values[np.arange(len(seen)), nearest])
    assert 0.1 < plausible.mean() < 0.9
    expected = np.where(plausible, nearest, values.argmax(axis=1))
    assert greedy_actions(led, seen).tolist() == expected.tolist()
    # The clone alone takes its own likeliest action.
    cloned = start_network(StartPolicy(1.0), inner, TASK.scaled_actions)
    assert (greedy_actions(cloned, seen) == greedy_actions(inner.behaviour, seen)).all()


@pytest.mark.parametrize("ratio", [None, 0.6])
def test_what_is_led_by_proposals_is_the_same_as_a_file(ratio: float | None) -> None:
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    led = start_network(StartPolicy(ratio, proposed=True), filtered(0.3), TASK.scaled_actions)
    session = runtime.InferenceSession(to_onnx(led).SerializeToString())
    for seen in (observations(300), observations(50, known=False)):
        values, action = session.run(["values", "action"], {"observation": seen})
        assert action.tolist() == greedy_actions(led, seen).tolist()
        expected = led(torch.from_numpy(seen)).detach().numpy()
        np.testing.assert_allclose(values, expected, atol=1e-5)


def test_candidates_are_those_that_the_run_can_make() -> None:
    config = OfflineStartConfig(ratios=(0.1, 0.3, 1.0))

    def names(policy: QNetwork | FilteredNetwork, proposed: bool) -> list[str]:
        return [one.name for one in candidates(policy, TASK, config, proposed=proposed)]

    assert names(network(1), False) == [LEARNT]
    assert names(network(1), True) == [LEARNT, "proposed"]
    ratio = float(torch.tensor(0.3))
    assert names(filtered(ratio), True) == [
        LEARNT, "filtered 0.1", "cloned", "proposed, filtered 0.1", "proposed, filtered 0.3",
        "values", "proposed",
    ]  # fmt: skip


def episodes(count: int, steps: int, ratio: float, reward: float) -> OpeEpisodes:
    """Every other episode ends well; in the others policy and logs agree by `ratio` a step."""
    ratios = np.ones((count, steps))
    ratios[1::2] = ratio
    rewards = np.zeros((count, steps))
    rewards[::2, -1] = reward
    zeros = np.zeros((count, steps))
    return OpeEpisodes(ratios, rewards, zeros, zeros, np.zeros(count), 1.0)


def test_a_bound_is_of_both_halves_and_refused_where_weights_do_not_reach() -> None:
    parts = {"nominal": episodes(40, 4, 0.5, 1.0), "rare": episodes(10, 4, 1.0, 1.0)}
    of_all, nominal, rare = estimates(parts, EssGate(0.2, 5), seed=0)
    assert nominal["value"] == pytest.approx(1 / (1 + 0.5**4))
    assert rare["value"] == pytest.approx(0.5)
    assert of_all["value"] == pytest.approx((nominal["value"] + rare["value"]) / 2)
    assert rare["low"] < 0.35 < of_all["low"] < of_all["value"] < of_all["high"]
    assert (of_all["episodes"], of_all["reach"], of_all["refused"]) == (50, 4, None)
    parts["rare"] = episodes(8, 4, 0.01, 1.0)
    of_all, nominal, rare = estimates(parts, EssGate(0.2, 5), seed=0)
    assert nominal["refused"] is None
    assert "an effective sample of 4.0 of 8 episodes" in rare["refused"]
    assert of_all["refused"] == rare["refused"]


def test_the_best_bound_drives_and_where_there_is_none_what_navigation_proposes() -> None:
    def row(candidate: str, low: float, refused: str | None = None) -> dict[str, object]:
        return {"condition": "all", "candidate": candidate, "low": low, "refused": refused}

    rows = [row(LEARNT, 0.9, "few"), row("cloned", 0.5), row("proposed", 0.6)]
    assert chosen_of(rows) == "proposed"
    assert chosen_of([*rows, row("filtered 0.1", 0.7)]) == "filtered 0.1"
    assert chosen_of([row(LEARNT, 0.9, "few"), row("proposed", 0.1, "few")]) == "proposed"
    assert chosen_of([row(LEARNT, 0.9, "few"), row("cloned", 1.0, "few")]) == LEARNT


@pytest.fixture
def panel(tmp_path: Path) -> Panel:
    tables = []
    for number in (1, 2):
        table = recording_transitions(number, task=TASK)
        for name in ("observation", "next_observation"):
            place = table.schema.get_field_index(name)
            rows = np.stack(table[name].to_numpy(zero_copy_only=False))
            rows[:, -3] = 1.0  # navigation always proposes something
            column = pa.array(list(rows), table.schema.field(place).type)
            table = table.set_column(place, table.schema.field(place), column)
        tables.append(table)
    return panel_of(write_store(tmp_path / "store", tables, task=TASK), MIXTURE, tmp_path / "panel")


@pytest.mark.long
def test_a_run_begins_with_what_was_chosen_and_keeps_it_until_it_is_beaten(
    panel: Panel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(offline_start, "OpeConfig", partial(OpeConfig, model=QUICK))
    path = tmp_path / "run"
    argv = ["train", "--panel", str(panel.path), "--out", str(path), "--env-steps", "40"]
    settings = {
        "offline_start.choose": "true",
        "offline_start.ratios": "[0.5, 1.0]",
        "teacher.source": "logs",
        "teacher.offline_updates": "3",
        "teacher.hidden": "[8]",
        "schedule.offline_updates": "3",
        "schedule.warmup_env_steps": "20",
        "env.num_envs": "2",
        "env.conditions": "{nominal = 1.0}",
        "network.hidden": "[8]",
        "evaluation.episodes": "1",
        "evaluation.every_env_steps": "100000",
        "record.tensorboard": "false",
        "replay.batch_size": "8",
    }
    flags = [flag for key, value in settings.items() for flag in ("--set", f"{key}={value}")]
    assert main([*argv, *flags]) == 0
    rows = pq.read_table(path / "offline_start.parquet").to_pylist()
    assert {row["condition"] for row in rows} == {"all", "nominal", "rare"}
    assert {row["gradient_steps"] for row in rows} == {3}
    (chosen,) = {row["candidate"] for row in rows if row["chosen"]}
    assert chosen == chosen_of(rows)
    acted = pq.read_table(path / "policies.parquet").to_pylist()
    assert {"start"} <= {row["behaviour_policy"] for row in acted if row["source"] == "fresh"}
    # Nothing that was learnt in ten updates drives better than what navigation proposes.
    assert chosen.startswith("proposed")
    assert isinstance(load_agent(Run.open(path)).network, ProposedNetwork)


def test_what_needs_held_out_logs_says_so_where_there_are_none(tmp_path: Path) -> None:
    rows = recording_transitions(0, episodes=20, task=TASK)
    whole, held = (
        panel_of(rows, mixture, tmp_path / name, task=TASK)
        for name, mixture in (("whole", EVERY + NO_SPLIT), ("held", MIXTURE))
    )
    requested = ["offline_start.choose=true", "evaluation.off_policy=true"]
    cloning = [
        *("teacher.policies=['planner']", "teacher.successes=true", "teacher.logs_share=0.5"),
        "teacher.offline_updates=7",
    ]
    no_panel = "has no effect: there is no panel"
    for panel, settings, said in (
        (
            None,
            cloning + requested,
            [f"{name.split('=')[0]} {no_panel}" for name in cloning + requested],
        ),
        (None, ["teacher.hidden=[8]"], []),
        (whole, requested[:1], ["offline_start.choose has no effect: the panel holds out no rows"]),
        (whole, [], []),
        (held, requested, []),
    ):
        path = None if panel is None else panel.path
        lines = describe_run(prepare_new(tmp_path / "run", path, None, settings)).splitlines()
        reported = [line.split(" (")[0] for line in lines if "has no effect" in line]
        assert reported == said


@pytest.mark.long
@pytest.mark.parametrize("during", ["off_policy", "offline_start"])
def test_a_choice_is_abandoned_and_made_by_the_resumed_run(
    panel: Panel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:
    """So is the evaluation on held-out logs before it."""
    for module in (offline_start, loop):
        monkeypatch.setattr(module, "OpeConfig", partial(OpeConfig, model=QUICK))
    settings = [
        *("offline_start.choose=true", "offline_start.ratios=[0.5]", "evaluation.off_policy=true"),
        *("teacher.source=logs", "teacher.offline_updates=3", "teacher.hidden=[8]"),
        *("schedule.offline_updates=3", "schedule.env_steps=0", "env.conditions={nominal=1.0}"),
        *("network.hidden=[8]", "evaluation.episodes=1", "env.num_envs=2"),
        *("record.tensorboard=false", "replay.batch_size=8"),
    ]

    def outcome(path: Path) -> dict[str, Any]:
        run = Run.open(path)
        state = checkpoint.load(run.latest)
        rows = {name: run.table(name).to_pylist() for name in ("off_policy", "offline_start")}
        return {**rows, "start": state["start"], "tables": state["tables"]}

    whole = prepare_new(tmp_path / "whole", panel.path, None, settings).open()
    train(whole)
    whole.close()
    cut = prepare_new(tmp_path / "cut", panel.path, None, settings).open()
    requested = iter(range(2))

    def stop() -> bool:
        begun = cut.learner.gradient_steps == 3
        evaluated = bool(cut.run.table("off_policy").num_rows)
        return begun and evaluated == (during == "offline_start") and next(requested, None) is None

    with pytest.raises(TrainingInterrupted):
        train(cut, stop=stop)
    cut.close()
    assert not cut.run.table("offline_start").num_rows
    assert bool(cut.run.table("off_policy").num_rows) == (during == "offline_start")
    again = prepare_resumed(tmp_path / "cut").open()
    train(again)
    again.close()
    expected = outcome(tmp_path / "whole")
    assert expected["off_policy"]
    assert expected["offline_start"]
    np.testing.assert_equal(outcome(tmp_path / "cut"), expected)
