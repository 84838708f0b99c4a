"""What Restock's own node published: a proposal reads it as `node --write-profile` does."""

import json
from typing import Any

import numpy as np
import pytest
from support.driven_robot import START_NS, Drive, columns, typed_topics, write_topics
from support.ingested import ingested, proposed

from restock.cli import main
from restock.ingest.live.node import ACTION, LIMITER, PROPOSAL, SHADOW, TAKEOVER

TWIST, BOOL = "geometry_msgs/msg/Twist", "std_msgs/msg/Bool"
TAKEN_S = (4.0, 8.0)
Topics = dict[str, Any]


def driven() -> Topics:
    """Return a drive of a robot whose logs do not say who drives."""
    topics: Topics = typed_topics(Drive(duration_s=12.0))
    del topics["/behaviour_policy"]
    return topics


def taken_over(kind: str = BOOL) -> Topics:
    at_s = np.arange(0, 12, 0.2)
    pressed = (at_s >= TAKEN_S[0]) & (at_s < TAKEN_S[1])
    data = pressed if kind == BOOL else np.where(pressed, "yes", "no").astype(object)
    return driven() | {TAKEOVER: (kind, columns(at_s, {"data": data}, stamped=False))}


def in_shadow() -> Topics:
    """Return a drive in which the node proposes and its limiter holds it back."""
    at_s = np.arange(0, 12, 0.1)
    half = np.full(len(at_s), 0.2)
    slow = {"linear.x": half, "angular.z": 0 * half}
    chosen = {"data": np.ones(len(at_s), np.int16)}
    rule = {"data": (at_s > 6).astype(np.uint8)}
    return driven() | {
        PROPOSAL: (TWIST, columns(at_s, slow | {"linear.x": 2 * half}, stamped=False)),
        SHADOW: (TWIST, columns(at_s, slow, stamped=False)),
        ACTION: ("std_msgs/msg/Int16", columns(at_s, chosen, stamped=False)),
        LIMITER: ("std_msgs/msg/UInt8", columns(at_s, rule, stamped=False)),
    }


def test_the_rows_of_a_takeover_are_the_operators(tmp_path):
    bag, file = write_topics(taken_over(), tmp_path / "bag"), tmp_path / "p.toml"
    profile = proposed(bag, file)
    assert list(profile.command_sources) == ["operator"]
    assert "shadow_action" not in profile.signals
    with ingested(bag, file, tmp_path / "store") as store:
        said = store.sql("SELECT stamp_ns, behaviour_policy FROM transitions").fetchall()
    by_hand = [(stamp - START_NS) * 1e-9 for stamp, policy in said if policy == "operator"]
    assert len(by_hand) == pytest.approx((TAKEN_S[1] - TAKEN_S[0]) / 0.2, abs=1)
    assert min(by_hand) >= TAKEN_S[0]
    assert max(by_hand) < TAKEN_S[1] + 0.01
    assert {policy for _, policy in said} == {"operator", "unknown"}
    assert "[signals.restock_takeover]" not in file.read_text()


def test_a_topic_of_that_name_and_another_type_is_somebody_elses(tmp_path):
    bag = write_topics(taken_over("std_msgs/msg/String"), tmp_path / "bag")
    assert proposed(bag, tmp_path / "p.toml").command_sources == {}


def test_what_a_policy_would_have_driven_does_not_drive(tmp_path, capsys):
    """In shadow it publishes twists beside the command, more of them."""
    bag, file = write_topics(in_shadow(), tmp_path / "bag"), tmp_path / "p.toml"
    profile = proposed(bag, file)
    assert profile.inputs.command.topic == "/cmd_vel"
    assert profile.inputs.nav_command is None
    assert profile.command_sources == {}
    capsys.readouterr()
    assert main(["profile", "new", str(bag), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["commands"] == []
    assert not any(line.startswith("# [signals.restock") for line in file.read_text().splitlines())
