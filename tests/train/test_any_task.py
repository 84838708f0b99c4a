"""Record, compare and diagnose a custom training loop on a table of any task."""

from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pytest
from support.library_buffers import run_tables
from support.panels import NO_SPLIT, panel_of

from restock.errors import PanelError, RestockError, RunError
from restock.replay.panel.panel import Panel
from restock.train.judge.compare import compare
from restock.train.judge.diagnose import diagnose
from restock.train.run.run import Run

pytest.importorskip("stable_baselines3")
from restock.train.libraries.sb3_buffer import MixtureReplayBuffer

SPACES = gym.spaces.Box(-9, 9, (3,), np.float32), gym.spaces.Discrete(4)
SETTINGS = {"target": {"rule": "polyak", "tau": 0.005}}


@pytest.fixture(scope="module")
def panels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Panel]:
    """Return two panels of one table with a tenth of rare rows: drawn by quota and uniformly."""
    rng, rows = np.random.default_rng(0), []
    for episode in range(50):
        for step in range(8):
            row = {"observation": rng.normal(size=3), "action": int(rng.integers(4))}
            row |= {"reward": 1.0, "terminated": step == 7, "truncated": False, "episode": episode}
            rows.append(row | {"condition": "nominal" if episode % 10 else "rare"})
    head = f"correction = {{pre = 'none', post = 'none'}}\n{NO_SPLIT}"
    texts = {
        "quotas": f"{head}[[strata]]\nname = 'rare'\nshare = 0.5\n[each_condition]\n",
        "uniform": f"{head}[[strata]]\nname = 'all'\nwhere = 'true'\n",
    }
    folder = tmp_path_factory.mktemp("any")
    given = pa.Table.from_pylist(rows)
    return {name: panel_of(given, text, folder / name) for name, text in texts.items()}


def train_on_panel(panel: Panel, run: Path, *, seed: int = 0, **options: Any) -> list[np.ndarray]:
    """Draw 30 batches with three evaluations, as a training loop; return their observations."""
    given = {"audit_share": 1.0, "log_every": 7, "settings": SETTINGS} | options
    buffer = MixtureReplayBuffer(100, *SPACES, "cpu", panel=panel, run=run, seed=seed, **given)
    buffer.critic = lambda batch: (batch.rewards * 0 + 1, batch.rewards * 0 + 0.1)
    batches = []
    for update in range(1, 31):
        batches.append(buffer.sample(32).observations.numpy())
        if update % 10 == 0:
            names = ("nominal", "rare")
            measured = {"rows": 200, "td_abs_mean": 0.1, "td_online_abs_mean": 0.1, "q_lag": 0.05}
            buffer.feed.evaluated(
                [
                    {"condition": name, "episode_seed": one, "success": one % 2 > 0, "return": 1.0}
                    for name in names
                    for one in range(12)
                ],
                [{"condition": "rare", **measured}, {"condition": "nominal", **measured}],
            )
    buffer.close()
    return batches


def test_record_matches_sampled_batches(panels: dict[str, Panel], tmp_path: Path) -> None:
    panel = panels["quotas"]
    batches = train_on_panel(panel, tmp_path / "run")
    row_of = {row.tobytes(): at for at, row in enumerate(panel.rows[:, :3])}
    rows = [[row_of[row.tobytes()] for row in batch] for batch in batches]
    drawn = np.concatenate(rows)
    names = panel.meta["condition"].to_numpy()[drawn]
    episodes = Counter(panel.meta["episode_id"].to_numpy()[drawn].tolist())
    tables = run_tables(tmp_path / "run")
    recorded = Counter[str]()
    for row in tables["conditions"]:
        recorded[row["condition"]] += row["drawn_rows"]
    assert recorded == Counter(names.tolist())
    assert recorded["rare"] == recorded["nominal"] == 30 * 16
    sampled = Counter[str]()
    for row in tables["sampled_episodes"]:
        sampled[row["episode"]] += row["drawn_rows"]
    assert sampled == episodes
    assert [row["panel_row"] for row in tables["audit"]] == drawn.tolist()


def test_runs_fed_differently_are_incomparable(panels: dict[str, Panel], tmp_path: Path) -> None:
    runs = {
        name: [tmp_path / f"{name}{seed}" for seed in range(3)] for name in ("quotas", "uniform")
    }
    for name, paths in runs.items():
        for seed, path in enumerate(paths):
            train_on_panel(panels[name], path, seed=seed)
    refused = compare(runs["quotas"], runs["uniform"])
    assert refused.verdict == "incomparable"
    assert "panel.id" in [difference.setting for difference in refused.refused]
    assert any(
        check.name == "share of logs/rare" and check.verdict == "incomparable"
        for check in refused.checks
    )
    as_mixtures = compare(runs["quotas"], runs["uniform"], treatment="mixture")
    assert as_mixtures.verdict == "comparable"
    assert [row["success"] for row in as_mixtures.rows] == [[0.5, 0.5]] * 2
    found = diagnose([Run.open(path) for path in runs["uniform"]])
    assert found.cause == "HEALTHY"
    assert {symptom.condition for symptom in found.figures[0].symptoms} == {"nominal", "rare"}


def test_fresh_steps_take_condition_from_info(panels: dict[str, Panel], tmp_path: Path) -> None:
    options = {"run": tmp_path / "run", "logs_share": 0.5, "log_every": 5}
    buffer = MixtureReplayBuffer(60, *SPACES, "cpu", panel=panels["quotas"], **options)
    names = ["nominal", "rare", "rare", "wet", None, "nominal"]  # one condition per episode
    for name in names:
        for step in range(4):
            seen = np.full((1, 3), step, np.float32)
            given = (np.array([step]), np.array([1.0]), np.array([step == 3]))
            buffer.add(seen, seen + 1, *given, [{} if name is None else {"condition": name}])
    ring, labels = buffer.ring, buffer.feed.labels
    codes = ring.condition(np.arange(len(ring)))
    shown = [labels.names[code] if code >= 0 else "?" for code in codes.tolist()]
    assert shown == [n if n in ("nominal", "rare") else "?" for n in names for _ in range(4)]
    for _ in range(5):
        buffer.sample(32)
    buffer.close()
    fresh = {
        r["condition"] for r in run_tables(tmp_path / "run")["conditions"] if r["source"] == "fresh"
    }
    assert {"nominal", "rare"} <= fresh


@pytest.mark.parametrize("missing", ["target", "evaluation"])
def test_diagnosis_names_missing_record(
    panels: dict[str, Panel], tmp_path: Path, missing: str
) -> None:
    if missing == "target":
        train_on_panel(panels["quotas"], tmp_path / "run", settings={})
    else:
        buffer = MixtureReplayBuffer(9, *SPACES, panel=panels["quotas"], run=tmp_path / "run")
        buffer.sample(32)
        buffer.close()
    with pytest.raises(RunError, match=missing):
        diagnose([Run.open(tmp_path / "run")])


def test_wrong_observation_size_is_rejected(panels: dict[str, Panel]) -> None:
    space = gym.spaces.Box(-9, 9, (2,), np.float32)
    buffer = MixtureReplayBuffer(9, space, SPACES[1], panel=panels["quotas"])
    with pytest.raises(PanelError, match="have 3 entries, the environment's have 2"):
        buffer.sample(1)


def test_profile_of_generic_task_run_is_rejected(panels: dict[str, Panel], tmp_path: Path) -> None:
    from restock.train.run.run_profile import profile_of_run

    train_on_panel(panels["quotas"], tmp_path / "run")
    with pytest.raises(RestockError, match="a table of another task"):
        profile_of_run(Run.open(tmp_path / "run"))
