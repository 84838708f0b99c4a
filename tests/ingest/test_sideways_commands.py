"""Commands that ask for a speed sideways, which no action has: used without it, and counted."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.driven_robot import Drive, typed_topics, write_topics

from restock.cli import main
from restock.ingest.profile.tables import Input
from restock.ingest.steps.aligned_inputs import sideways_notes, sideways_path


def command(field: str) -> Input:
    return Input(topic="/cmd_vel", type="a type", fields={"speed_mps": field}, max_age_s=1.0)


@pytest.mark.parametrize(
    ("field", "aside"),
    [("twist.linear.x", "twist.linear.y"), ("linear.x", "linear.y"), ("drive.speed", "")],
)
def test_a_speed_sideways_stands_beside_the_one_ahead(field: str, aside: str) -> None:
    assert sideways_path(command(field)) == aside


def test_commands_with_a_speed_sideways_are_counted() -> None:
    requested = {"linear.y": np.array([0.0, 0.3, -0.45, 0.0])}
    notes = sideways_notes(command("linear.x"), requested)
    assert len(notes) == 1
    assert "2 of 4 messages of /cmd_vel contain a sideways speed, up to 0.45 m/s" in notes[0]
    assert sideways_notes(command("linear.x"), {"linear.y": np.zeros(4)}) == []
    assert sideways_notes(command("drive.speed"), {}) == []


def test_a_proposal_names_sideways_or_missing_commands(tmp_path, capsys) -> None:
    """`start` shows what a proposal advises, and not what an ingest notes."""
    said = {}
    for name, mps in (("aside", 0.3), ("never", 0.0)):
        topics = typed_topics(Drive(duration_s=3.0))
        fields = topics["/cmd_vel"][1].fields
        count = len(topics["/cmd_vel"][1])
        fields["linear.y"] = np.full(count, mps)
        if not mps:
            fields |= {"linear.x": np.zeros(count), "angular.z": np.zeros(count)}
        assert main(["profile", "new", str(write_topics(topics, tmp_path / name)), "--json"]) == 0
        advice = json.loads(capsys.readouterr().out)["advice"]
        said[name] = {one["key"]: one["text"] for one in advice}
    assert "of /cmd_vel contain a sideways speed, up to 0.3 m/s" in said["aside"]["inputs.command"]
    assert "never asks the robot to move: the actions are a guess" in said["never"]["task.actions"]
    assert not {"task.actions", "inputs.command"} <= said["aside"].keys()
