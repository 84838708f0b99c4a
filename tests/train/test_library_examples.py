"""Run each example of docs/examples, shortened."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest
import torch
from support.panels import panel_of
from support.paths import ROOT
from support.stores import recording_transitions, write_store

from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture

EXAMPLES = ROOT / "docs" / "examples"
NEEDS = {
    "sb3_dqn": "stable_baselines3",
    "sb3_sac": "stable_baselines3",
    "sb3_mixture": "stable_baselines3",
    "tianshou_dqn": "tianshou",
    "cleanrl_dqn": "torch",
    "any_task": "stable_baselines3",
}


def example(name: str) -> Any:
    """Return an example's module; skip the test if its library is not installed."""
    pytest.importorskip(NEEDS[name])
    torch.set_num_threads(1)
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    task = load_profile("warehouse_amr").task
    folder = tmp_path_factory.mktemp("examples")
    store = write_store(folder / "store", [recording_transitions(1, task=task)], task=task)
    mixture = parse_mixture('[each_condition]\nshare = "natural"\n')
    return panel_of(store, mixture, folder / "panel").path


def test_every_example_is_tested_and_documented() -> None:
    own = {"qr_dqn"}  # tests/train/test_own_algorithm.py trains it
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*NEEDS, *own}
    page = (EXAMPLES.parent / "libraries.md").read_text(encoding="utf-8")
    assert all(f"examples/{name}.py" in page for name in NEEDS)


@pytest.mark.long
def test_stable_baselines3_dqn() -> None:
    done = example("sb3_dqn").main(steps=320, num_envs=4)
    assert done["env_steps"] == 320
    assert done["updates"] == (320 - 80) / 4  # from step 80 on
    assert isinstance(done["success"], bool)


@pytest.mark.long
def test_stable_baselines3_sac_on_continuous_actions() -> None:
    done = example("sb3_sac").main(steps=200, num_envs=4)
    assert done["env_steps"] == 200
    assert done["updates"] == (200 - 48) / 4  # from step 48 on
    speed, yaw_rate = done["command"]
    assert -0.4 <= speed <= 1.0
    assert -1.2 <= yaw_rate <= 1.2


def test_stable_baselines3_with_a_mixture(panel: Path, tmp_path: Path) -> None:
    done = example("sb3_mixture").main(
        str(panel), str(tmp_path / "run"), offline_updates=20, steps=200, num_envs=4
    )
    assert done["env_steps"] == 200
    assert done["updates"] == 20 + (200 - 48) / 4
    assert (tmp_path / "run" / "strata.parquet").is_file()


def test_custom_task_learns_rare_condition() -> None:
    done = example("any_task").main(updates=200, episodes=200)
    assert done["success"] == {"nominal": True, "rare": True}
    assert done["rows fed"] == {"nominal": 200 * 64, "rare": 200 * 64}


@pytest.mark.long  # the import takes seconds
def test_tianshou_dqn() -> None:
    done = example("tianshou_dqn").main(steps=96, num_envs=8)
    assert done["env_steps"] == 96
    assert done["updates"] == 96 / 4


@pytest.mark.long
def test_cleanrl_dqn_on_vector_environment() -> None:
    done = example("cleanrl_dqn").main(steps=2400, num_envs=8)
    assert done["env_steps"] == 2400
    assert done["updates"] == (2400 - 600) / 4
    assert done["episodes"] >= 8
    assert done["loss"] >= 0


@pytest.mark.long
def test_cleanrl_dqn_on_logs_and_fresh_rows(panel: Path) -> None:
    done = example("cleanrl_dqn").main(steps=96, num_envs=8, panel=str(panel), offline_updates=20)
    assert done["updates"] == 20 + (96 - 24) / 4  # 24 steps are collected first
    assert done["loss"] >= 0
