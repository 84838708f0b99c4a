"""An alarm from a panel: where logged failures began, and what `restock export` makes of them."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.kept_run import TASK, kept_run
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.ingest.live.policy_file import PolicyFile
from restock.replay.panel.panel import Panel
from restock.train.evaluation.onnx_policy import logged_alarm, logged_episodes

STEPS = 60


def episodes_of(endings: list[str]) -> pa.Table:
    """Return a recording of episodes of 60 steps; entry 0 of an observation is the step."""
    table = recording_transitions(1, episodes=3 * len(endings), task=TASK)
    table = table.slice(0, STEPS * len(endings))
    step, episode = (np.tile(np.arange(STEPS), len(endings)), np.arange(len(table)) // STEPS)
    ending, last = np.array(endings)[episode], step == STEPS - 1
    observation = np.random.default_rng(0).normal(size=(len(table), TASK.observation_size))
    observation[:, 0] = step
    changed = {
        "episode_id": [f"{1:016x}/{index}" for index in episode],
        "episode_index": episode,
        "step_index": step,
        "observation": list(observation.astype(np.float32)),
        "reward": np.where(last & (ending != "bump"), 100.0, 0.0) * (ending != "stuck"),
        "terminated": last & ~np.isin(ending, ["stuck", "slow"]),
        "truncated": last & np.isin(ending, ["stuck", "slow"]),
        "behaviour_policy": np.where((ending == "takeover") & (step >= 30), "operator", "planner"),
        "bumped": (ending == "touch") & (step >= 21) & (step < 25),
        "pose_x_m": 0.2 * np.where(ending == "stuck", np.minimum(step, 7), step),
        "pose_y_m": np.zeros(len(table)),
    }
    for name, values in changed.items():
        at = table.column_names.index(name)
        table = table.set_column(at, name, pa.array(values, table.schema.field(name).type))
    return table


def panel_with(endings: list[str], path: Path) -> Panel:
    store = write_store(path / "store", [episodes_of(endings)], task=TASK)
    return panel_of(store, EVERY + NO_SPLIT, path / "panel")


def test_windows_end_before_the_first_failure_begins(tmp_path: Path) -> None:
    panel = panel_with(["goal", "bump", "touch", "takeover", "stuck", "slow"], tmp_path)
    windows = {
        (failure, *np.round(observation[[0, -1], 0]).astype(int).tolist())
        for failure, observation in logged_episodes(panel)
    }
    assert windows == {
        (None, 0, STEPS - 1),  # `slow` did not arrive and did not stop: it is neither
        ("bump", 49, 58),  # in its last step
        ("bump", 10, 19),  # reported at step 21, so in step 20
        ("takeover", 20, 29),
        ("stuck", 0, 4),  # from step 5 within .5 m of where it stays, for more than 10 s
    }


def test_an_exported_policy_has_the_alarm_of_its_panel(tmp_path, capsys):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    panel = panel_with(["goal"] * 4 + ["bump", "takeover"] * 5, tmp_path)
    run = kept_run(tmp_path / "run", panel=panel)
    export = ["export", str(run), "--to", "onnx", "--out"]
    out = tmp_path / "p.onnx"
    assert main([*export, str(out), "--alarm", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "misses at most 0.2 of episodes that fail like the logged ones (5 bump, 5 take" in said
    assert PolicyFile(out).alarm == logged_alarm(panel, 0.2)
    plain = kept_run(tmp_path / "plain")
    for more, why in (
        ([str(run), "--alarm", "0.1"], "needs 17 episodes that failed, there are 10"),
        ([str(plain), "--alarm", "0.2"], "did not learn from a panel"),
        ([str(plain), str(panel.path)], "applies only to a data set"),
    ):
        refused = tmp_path / "refused.onnx"
        argv = ["export", more[0], "--to", "onnx", "--out", str(refused), *more[1:]]
        assert main(argv) == 2
        assert why in " ".join(capsys.readouterr().err.split())
        assert not refused.exists()
    given = [str(plain), str(panel.path), "--to", "onnx", "--out", str(tmp_path / "given.onnx")]
    assert main(["export", *given, "--alarm", "0.2"]) == 0
    assert PolicyFile(tmp_path / "given.onnx").alarm == PolicyFile(out).alarm
