"""Select the logged rows to clone: named drivers and successful episodes of other drivers."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.paths import ROOT
from support.stores import hindsight_profile

from restock.cli.learning.train import describe_run
from restock.errors import ConfigError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.mixture.mixture import load_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store
from restock.train.dqn.config import TeacherConfig
from restock.train.feed.logs import Coded
from restock.train.feed.teacher import rows_of_policies, rows_of_successes, select_cloned
from restock.train.prepare import prepare_new

# Drivers of each step and the end of each episode.
EPISODES = {
    "planner's own": (["planner"] * 3, "goal"),
    "operator intervened": (["planner", "operator", "planner"], "goal"),
    "planner bumped": (["planner"] * 2, "bump"),
    "planner truncated": (["planner"] * 2, "cut"),
    "operator's own": (["operator"] * 2, "cut"),
    "teleop's own": (["teleop"] * 2, "goal"),
}


def coded(values: list[str | None]) -> Coded:
    return Coded.of(pa.chunked_array([pa.array(values, pa.string())]))


def rows_of_episodes() -> tuple[Coded, Coded, np.ndarray, np.ndarray]:
    drivers, episodes, reward, discount = [], [], [], []
    for name, (steps, end) in EPISODES.items():
        drivers += steps
        episodes += [name] * len(steps)
        last = {"goal": (5.0, 0.0), "bump": (-6.0, 0.0), "cut": (0.1, 0.99)}[end]
        for place in range(len(steps)):
            of_step = last if place == len(steps) - 1 else (0.1, 0.99)
            reward.append(of_step[0])
            discount.append(of_step[1])
    return coded(drivers), coded(episodes), np.float32(reward), np.float32(discount)


def test_successes_exclude_episodes_with_teacher_steps() -> None:
    policy, episode, reward, discount = rows_of_episodes()
    found = rows_of_successes(policy, episode, reward, discount, ["operator"])
    assert {episode.name(row) for row in np.flatnonzero(found)} == {"planner's own", "teleop's own"}
    assert found.sum() == 5
    everyone = rows_of_successes(policy, episode, reward, discount, ["operator", "teleop"])
    assert {episode.name(row) for row in np.flatnonzero(everyone)} == {"planner's own"}
    assert not (found & rows_of_policies(policy, ["operator"])).any()
    assert not rows_of_policies(policy, ["nobody", "unknown"]).any()


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Panel:
    folder = tmp_path_factory.mktemp("cloned")
    logs_of = ROOT / "sample_logs/amr_monday.mcap"
    ingest(logs_of, load_profile("warehouse_amr"), store=StoreWriter(folder / "store"))
    with Store(folder / "store") as store:
        return build_panel(store, load_mixture("coverage"), folder / "panel")


def test_run_reports_cloned_rows_and_updates(panel: Panel, tmp_path: Path) -> None:
    requested = prepare_new(tmp_path / "run", panel.path, None).config.teacher
    assert requested.source == "operator"
    assert requested.successes is False
    logged = ["teacher.source=logs"]
    prepared = prepare_new(tmp_path / "run", panel.path, None, logged)
    teacher = prepared.config.teacher
    assert teacher.successes is True
    rows = select_cloned(panel, teacher)
    alone = select_cloned(panel, TeacherConfig(policies=teacher.policies, successes=False))
    assert alone.sum() < rows.sum() < len(panel)
    others = int((rows & ~alone).sum())
    drivers = f"({alone.sum():,} of operator, {others:,} of the successes of others)"
    assert f"{rows.sum():,} logged rows are cloned first {drivers}" in describe_run(prepared)
    misspelt = [*logged, "teacher.policies=['operator', 'plannner']"]
    text = describe_run(prepare_new(tmp_path / "run", panel.path, None, misspelt))
    assert " of operator, 0 of plannner, " in text
    # The critic's 2,000 offline updates, scaled by rows / 5,000.
    assert teacher.offline_updates == round(2000 * rows.sum() / 5000)
    fewer = prepare_new(
        tmp_path / "run", panel.path, None, [*logged, "schedule.offline_updates=100"]
    )
    assert fewer.config.teacher.offline_updates == round(100 * rows.sum() / 5000)


def test_hindsight_goals_disable_cloning_of_successes(tmp_path: Path) -> None:
    settings = [f"profile={hindsight_profile(tmp_path)}"]
    assert prepare_new(tmp_path / "r", None, None, settings).config.teacher.successes is False
    with pytest.raises(ConfigError, match=r"teacher\.successes: goals are found in hindsight"):
        prepare_new(tmp_path / "r", None, None, [*settings, "teacher.successes=true"])
