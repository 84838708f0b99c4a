"""Returns over three steps where a real recording's episodes are cut: they bootstrap there."""

import re
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import START_NS, Drive, columns, typed_topics, without, write_topics
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store

GAMMA, STEPS = 0.9, 3
MIXTURE = f"""
n_step = {STEPS}
discount = {GAMMA}
[evaluation_split]
by = "none"
[each_condition]
share = "natural"
[correction]
post = "none"
"""
# Where the robot is at .5 m/s from x = 1: by 7.2 s it is within .4 m of the second goal.
DRIVE = Drive(duration_s=9.0, goals=[(0.0, 11.0, 1.0), (6.0, 5.0, 1.0), (8.0, 11.0, 1.0)])
GAP_S = (3.4, 4.4)  # without a command
LIMIT = 12  # steps: 2.4 s
ENDINGS = ("end of the recording", "gap", "goal", "new goal", "time limit")


def write_recording(folder: Path, storage: str) -> Path:
    """Write a drive whose episodes end in every way, as a bag or as the MCAP file of one."""
    topics = typed_topics(DRIVE)
    kind, commands = topics["/cmd_vel"]
    time_s = (commands.log_time_ns - START_NS) * 1e-9
    topics["/cmd_vel"] = kind, without(commands, (time_s < GAP_S[0]) | (time_s > GAP_S[1]))
    # Wheels that are never as fast as a moment ago: every step has a reward and a view of its own.
    fast_s = np.arange(0, DRIVE.duration_s, 0.02)
    speeds = {
        "twist.twist.linear.x": 0.5 + 0.3 * np.sin(7 * fast_s) + 0.01 * fast_s,
        "twist.twist.angular.z": np.zeros(len(fast_s)),
    }
    topics["/odom"] = "nav_msgs/msg/Odometry", columns(fast_s, speeds)
    bag = write_topics(topics, folder / "bag", storage=storage)
    return next(bag.glob("*.mcap")) if storage == "mcap" else bag


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_cut_return_bootstraps_at_its_last_step(tmp_path, storage, capsys):
    profile, mixture = tmp_path / "amr.toml", tmp_path / "three.toml"
    profile.write_text(WAREHOUSE.replace("time_limit_steps = 240", f"time_limit_steps = {LIMIT}"))
    mixture.write_text(MIXTURE)
    store, out = str(tmp_path / "store"), str(tmp_path / "panel")
    log = str(write_recording(tmp_path, storage))
    assert main(["ingest", log, "--store", store, "--profile", str(profile)]) in (0, 3)
    (said,) = re.findall(r"episodes ended by: (.*)", capsys.readouterr().out)
    assert sorted(said.split(", ")) == [f"{why} 1" for why in ENDINGS]
    assert main(["mix", store, "--mixture", str(mixture), "--out", out]) == 0

    with Store(store) as opened:
        raw = opened.sql("FROM transitions ORDER BY episode_id, step_index").to_arrow_table()
    panel = Panel.open(out, verify=True)
    packed = {
        meta["transition_id"]: (row, meta["horizon"])
        for row, meta in zip(panel.rows, panel.meta.to_pylist(), strict=True)
    }
    assert len(packed) == len(raw)
    shortened = {"truncated": 0, "terminated": 0}
    for _, rows in groupby(raw.to_pylist(), key=lambda row: row["episode_id"]):
        episode = list(rows)
        (end,) = {"truncated", "terminated"} & {name for name in shortened if episode[-1][name]}
        assert len({tuple(row["observation"]) for row in episode}) == len(episode)
        for at, first in enumerate(episode):
            check(panel, *packed[first["transition_id"]], episode[at : at + STEPS])
            shortened[end] += at + STEPS > len(episode)
    assert shortened == {"truncated": 2 * 4, "terminated": 2}


def check(panel: Panel, row: np.ndarray, horizon: int, span: list[dict[str, Any]]) -> None:
    """Check a packed row against the raw steps that its return spans."""
    part = {name: row[place] for name, place in panel.columns.items()}
    assert horizon == len(span)
    total = sum(GAMMA**k * step["reward"] for k, step in enumerate(span))
    assert part["reward"][0] == pytest.approx(total, abs=1e-5)
    bootstraps = 0.0 if span[-1]["terminated"] else GAMMA ** len(span)
    assert part["discount"][0] == pytest.approx(bootstraps, rel=1e-6)
    assert part["action"][0] == span[0]["action"]
    np.testing.assert_array_equal(part["observation"], span[0]["observation"])
    np.testing.assert_array_equal(part["next_observation"], span[-1]["next_observation"])
