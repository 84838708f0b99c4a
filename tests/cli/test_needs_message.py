"""Errors of `restock ingest` for a recording that lacks topics of the profile."""

from types import SimpleNamespace

import pytest

from restock.errors import RecordingError
from restock.ingest.decoding.columns import Leaf
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.needs import field_paths, wanted_fields

SCAN, PATH = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Path"


def topic(kind: str, skipped: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(type=kind, expected=9, skipped=skipped)


def test_skipped_topic_is_not_reported_missing() -> None:
    profile = load_profile("warehouse_amr")
    there = {s.topic: topic(s.type) for s in profile.sources.values()}
    leaves = {s.topic: [Leaf(p, (), "") for p in field_paths(s)] for s in profile.sources.values()}
    wanted = wanted_fields(profile, there, leaves)
    optional = next(s.topic for s in profile.sources.values() if s.optional)
    there[optional] = topic("a_msgs/msg/Own", "unknown type a_msgs/msg/Own")
    leaves[optional] = []
    assert optional in wanted_fields(profile, there, leaves).keys() & wanted.keys()
    there["/cmd_vel"] = topic(there["/cmd_vel"].type, "its definition cannot be parsed at 'x'")
    with pytest.raises(RecordingError) as error:
        wanted_fields(profile, there, leaves)
    reason = (
        "/cmd_vel is skipped, with 9 messages: its definition cannot be parsed at 'x' (command)"
    )
    assert reason in str(error.value)
    assert "no topic" not in str(error.value)
