"""Bumpers of common message types: fields, bits or detections, pressed if any of them is."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from support import driven_robot
from support.driven_robot import Drive, columns, ragged, typed_topics, write_topics
from support.ingested import proposed, steps_in
from support.profile_texts import WAREHOUSE

from restock.ingest.live.observer import LiveObserver, _columns
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.signal_paths import pressed_in

SECONDS = 6.0
PRESSED = (2.0, 2.5)  # start and end in seconds, end exclusive
DEFINITIONS = {
    "create_msgs/msg/Bumper": "std_msgs/Header header\nbool is_left_pressed\n"
    "bool is_right_pressed\nbool is_light_left\n",
    "irobot_create_msgs/msg/HazardDetection": "std_msgs/Header header\nuint8 type\n",
    "irobot_create_msgs/msg/HazardDetectionVector": "std_msgs/Header header\n"
    "irobot_create_msgs/HazardDetection[] detections\n",
    "kobuki_ros_interfaces/msg/SensorState": "std_msgs/Header header\nuint8 bumper\nuint8 cliff\n",
    "kobuki_ros_interfaces/msg/BumperEvent": "uint8 bumper\nuint8 state\n",
}


@pytest.fixture(autouse=True)
def _register_types(monkeypatch: pytest.MonkeyPatch) -> None:
    types = driven_robot._humble()
    for name, text in DEFINITIONS.items():
        if name not in types.types:
            types.register(get_types_from_msg(text, name))
    monkeypatch.setitem(driven_robot.ITEMS, "detections", "irobot_create_msgs/msg/HazardDetection")


def bumper(kind: str) -> tuple[str, Any]:
    """Return messages of this type, pressed during PRESSED only, with unrelated values besides."""
    name = next(one for one in DEFINITIONS if one.endswith(f"/{kind}"))
    tenth = np.arange(0, SECONDS, 0.1) + 0.001
    pressed = (tenth >= PRESSED[0]) & (tenth < PRESSED[1])
    if kind == "Bumper":
        late = tenth > sum(PRESSED) / 2  # first one side, then the other
        light = np.ones(len(tenth), np.bool_)
        fields: dict[str, Any] = {
            "is_left_pressed": pressed & ~late,
            "is_right_pressed": pressed & late,
            "is_light_left": light,
        }
        return name, columns(tenth, fields)
    if kind == "SensorState":
        bits = np.where(pressed, 4, 0).astype(np.uint8)
        return name, columns(tenth, {"bumper": bits, "cliff": np.full(len(tenth), 1, np.uint8)})
    if kind == "BumperEvent":
        fields = {"bumper": np.full(2, 1, np.uint8), "state": np.array([1, 0], np.uint8)}
        return name, columns(np.array(PRESSED) + 0.001, fields, stamped=False)
    first = np.full(len(tenth), 2, np.uint8)  # a cliff in every message
    second = np.where(pressed, 1, 5).astype(np.uint8)
    return name, columns(tenth, {"detections[].type": ragged([first, second])})


@pytest.mark.parametrize("kind", ["Bumper", "HazardDetectionVector", "SensorState", "BumperEvent"])
def test_known_bumper_types_are_proposed_and_read(kind, tmp_path, capsys):
    topics = typed_topics(Drive(SECONDS))
    del topics["/bumper"]
    bag = write_topics(topics | {"/touch": bumper(kind)}, tmp_path / "bag", storage="mcap")
    profile = proposed(bag, tmp_path / "p.toml")
    assert profile.inputs.bumper is not None
    assert profile.inputs.bumper.topic == "/touch"
    assert profile.task.bump_terminates
    steps = steps_in(bag, profile)
    time_s = (steps.signals["stamp_ns"] - driven_robot.START_NS) * 1e-9
    expected = (time_s >= PRESSED[0] + 0.01) & (time_s < PRESSED[1] + 0.01)
    differing = np.flatnonzero(steps.signals["bumped"] != expected)
    assert expected.sum() in (2, 3)
    assert len(differing) <= 1  # at the end: a press since the previous tick counts
    assert not [problem for problem in steps.problem if problem.startswith("bumper")]
    assert "inputs.bumper" not in capsys.readouterr().err


def test_live_observer_reads_bumper_detections() -> None:
    topic, pressed = "/hazard_detection", "detections[type=1].type"
    text = WAREHOUSE.replace('topic = "/bumper"', f'topic = "{topic}"')
    text = text.replace('pressed = "data"', f'pressed = "{pressed}"')
    observer = LiveObserver(parse_profile(text, where="p"))
    for second, kinds in enumerate(([], [2], [2, 1])):
        stamp = SimpleNamespace(sec=second, nanosec=0)
        hazards = [SimpleNamespace(type=kind) for kind in kinds]
        message = SimpleNamespace(header=SimpleNamespace(stamp=stamp), detections=hazards)
        observer.receive(topic, message, second * 10**9)
    kept = _columns(observer._buffers[topic])
    assert pressed_in(kept.fields, pressed, len(kept)).tolist() == [False, False, True]
