"""How old the logs of a run are: when it began, not beside the newest of their store."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.kept_run import TASK
from support.stores import START_NS, recording_transitions

import restock
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel

DAY_NS = 86_400 * 10**9
TINY = [
    *("env.num_envs=2", "schedule.offline_updates=20", "schedule.env_steps=4"),
    *("network.hidden=[16]", "evaluation.episodes=1", "record.every_updates=10"),
    *("record.trackers=[]", "replay.batch_size=32", "record.audit_share=1.0"),
]


def test_logs_of_264_days_are_264_days_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mixture = parse_mixture(
        "[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n"
    )
    rows = recording_transitions(0, episodes=20, task=TASK)
    build_panel(rows, mixture, tmp_path / "panel", task=TASK)
    began_ns = START_NS + 264 * DAY_NS + DAY_NS // 2
    monkeypatch.setattr("restock.train.prepare.now_ns", lambda: began_ns)
    restock.train.train(panel=tmp_path / "panel", out=tmp_path / "run", settings=TINY)
    document = json.loads((tmp_path / "run" / "config.json").read_text())
    assert document["created_ns"] == began_ns
    assert document["panel"]["newest_ns"] == int(rows["stamp_ns"].to_numpy().max())
    ages = pq.read_table(tmp_path / "run" / "ages.parquet").to_pylist()
    days = [row for row in ages if row["unit"] == "days"]
    assert {row["bucket"] for row in days} == {8}  # 256 to 511 days
    assert all(264 < row["p50"] < 265 for row in days)
    audit = pq.read_table(tmp_path / "run" / "audit.parquet").to_pylist()
    assert all(264 < row["age_days"] < 265 for row in audit if row["source"] == "logs")
