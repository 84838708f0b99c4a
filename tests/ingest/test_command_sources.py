"""Drivers of a robot, known from its commands: multiplexer inputs, a button, our own node."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import START_NS, Drive, columns, typed_topics, write_topics
from support.ingested import ingested, proposed
from support.profile_texts import WAREHOUSE

from restock.errors import ConfigError
from restock.ingest.decoding.columns import Ragged, TopicColumns, offsets_of
from restock.ingest.live.node import ACTION, LIMITER, PROPOSAL, SHADOW, TAKEOVER
from restock.ingest.profile.profile import parse_profile
from restock.ingest.steps.episodes import steps_of

TWIST = "geometry_msgs/msg/Twist"
NAV, TELEOP, OUT, JOY = "/cmd_vel_nav", "/teleop_cmd_vel", "/cmd_vel", "/joy"
TAKEN_OVER_S = (4.0, 7.0)
SOURCES = """
[command_sources.navigation]
topic = "/cmd_vel_nav"
type = "geometry_msgs/msg/Twist"
fields = { speed_mps = "linear.x", yaw_rate_radps = "angular.z" }
max_age_s = 0.5

[command_sources.teleop]
topic = "/teleop_cmd_vel"
type = "geometry_msgs/msg/Twist"
fields = { speed_mps = "linear.x", yaw_rate_radps = "angular.z" }
max_age_s = 0.5
"""
PRESSED = """
[command_sources.teleop]
topic = "/joy"
type = "sensor_msgs/msg/Joy"
fields = { pressed = "buttons[4]" }
"""


def twist_columns(time_s: Any, speed_mps: Any, turn_radps: Any) -> TopicColumns:
    fields = {"linear.x": np.asarray(speed_mps), "angular.z": np.asarray(turn_radps)}
    return columns(time_s, fields, stamped=False)


def takeover_drive(duration_s: float = 12.0) -> dict[str, tuple[str, TopicColumns]]:
    """Return a drive of navigation, with a person driving from 4 to 7 s, through a multiplexer."""
    drive = Drive(duration_s)
    names = {"/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped"}
    topics = drive.topics()
    typed = {name: (kind, topics[name]) for name, kind in names.items()}
    typed["/odom"] = ("nav_msgs/msg/Odometry", topics["/odom"])
    nav_s = np.arange(0, duration_s, 0.1)
    hand_s = np.arange(*TAKEN_OVER_S, 0.1) + 0.03
    nav = twist_columns(nav_s, 0.4 + 0.01 * np.sin(nav_s), 0.1 * np.cos(nav_s))
    hand = twist_columns(hand_s, np.full(len(hand_s), 0.2), np.linspace(-0.3, 0.3, len(hand_s)))
    start, end = TAKEN_OVER_S
    drives = (nav_s < start) | (nav_s > end)
    out_s = np.concatenate([nav_s[drives], hand_s]) + 0.002
    order = np.argsort(out_s)
    out = [
        np.concatenate([nav.fields[path][drives], hand.fields[path]])[order]
        for path in ("linear.x", "angular.z")
    ]
    joy_s = np.arange(0, duration_s, 0.05)
    held = (joy_s >= start) & (joy_s <= end)
    buttons = np.zeros((len(joy_s), 8), np.int32)
    buttons[:, 4] = held
    each = offsets_of(np.full(len(joy_s), 8))
    typed |= {
        NAV: (TWIST, nav),
        TELEOP: (TWIST, hand),
        OUT: (TWIST, twist_columns(out_s[order], *out)),
        JOY: (
            "sensor_msgs/msg/Joy",
            columns(joy_s, {"buttons": Ragged(buttons.reshape(-1), each)}),
        ),
    }
    return typed


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the text of a proposal without its command sources."""
    folder = tmp_path_factory.mktemp("plain")
    proposed(write_topics(takeover_drive(), folder / "bag"), file := folder / "p.toml")
    kept, skip = [], False
    for line in file.read_text().splitlines():
        skip = line.startswith("[command_sources") or (skip and not line.startswith("["))
        kept += [] if skip else [line]
    return "\n".join(kept) + "\n"


def write_profile(plain: str, folder: Path, sources: str) -> Path:
    """Write the proposal with these command sources."""
    (folder / "p.toml").write_text(plain + sources)
    return folder / "p.toml"


def driver_per_row(bag: Path, profile: Path, store: Path) -> list[tuple[float, str]]:
    """Return each row's time in seconds from the start and its driver."""
    with ingested(bag, profile, store) as opened:
        rows = opened.sql("SELECT stamp_ns, behaviour_policy FROM transitions ORDER BY 1")
        return [((stamp - START_NS) * 1e-9, policy) for stamp, policy in rows.fetchall()]


def driver_per_step(
    topics: dict[str, tuple[str, TopicColumns]], text: str
) -> list[tuple[float, str]]:
    """Return each step's time in seconds from the start and its driver, by a profile's text."""
    profile = parse_profile(text, where="p")
    steps = steps_of(profile, {name: one for name, (_, one) in topics.items()})
    at_s = ((steps.signals["stamp_ns"] - START_NS) * 1e-9).tolist()
    return list(zip(at_s, steps.policy, strict=True))


def test_driver_is_source_of_command_in_force(plain, tmp_path, capsys):
    bag = write_topics(takeover_drive(), tmp_path / "bag")
    rows = driver_per_row(bag, write_profile(plain, tmp_path, SOURCES), tmp_path / "s")
    assert len(rows) > 50
    by_hand = [s for s, policy in rows if policy == "teleop"]
    assert min(by_hand) == pytest.approx(TAKEN_OVER_S[0], abs=0.2)
    assert max(by_hand) == pytest.approx(TAKEN_OVER_S[1], abs=0.2)
    assert {policy for s, policy in rows if 4.2 < s < 6.8} == {"teleop"}
    assert {policy for s, policy in rows if s < 3.8 or s > 7.2} == {"navigation"}
    assert "whose command it equals: navigation, teleop" in capsys.readouterr().out


def test_pressed_button_names_driver_without_source(plain):
    topics = takeover_drive()
    del topics[TELEOP], topics[NAV]
    rows = driver_per_step(topics, plain + PRESSED)
    assert {policy for s, policy in rows if 4.2 < s < 6.8} == {"teleop"}
    assert {policy for s, policy in rows if s < 3.8 or s > 7.2} == {"unknown"}


def test_driver_does_not_depend_on_later_commands(plain):
    topics, late = takeover_drive(), START_NS + 5 * 10**9
    before = driver_per_step(topics, plain + SOURCES)
    for name in (NAV, TELEOP):
        topic = topics[name][1]
        topic.fields["linear.x"][topic.log_time_ns > late] = 0.9
    other = driver_per_step(topics, plain + SOURCES)
    assert [p for s, p in before if s < 4.9] == [p for s, p in other if s < 4.9]
    assert {p for s, p in other if s > 5.2} == {"unknown"}


def test_drivers_are_unknown_without_sources(plain):
    hashes = {parse_profile(text, where="p").hash for text in (plain + SOURCES, plain)}
    assert len(hashes) == 2
    topics = takeover_drive()
    del topics[NAV], topics[TELEOP], topics[JOY]
    assert {policy for _, policy in driver_per_step(topics, plain + SOURCES)} == {"unknown"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PRESSED.replace('pressed = "buttons[4]"', 'speed_mps = "axes[1]"'), "does not show when"),
        (PRESSED.replace("pressed", "presed"), "unknown 'presed'"),
    ],
)
def test_sources_without_driver_information_are_rejected(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_profile(WAREHOUSE + text, where="p")


def test_missing_button_field_is_reported_with_its_key(plain, tmp_path, shell):
    bag = write_topics(takeover_drive(2.0), tmp_path / "bag")
    profile = write_profile(plain, tmp_path, PRESSED.replace("buttons", "button"))
    assert "`command_sources.teleop.fields`: /joy: no field 'button'" in shell.err(
        "profile", "check", profile, bag
    )


def test_proposal_finds_multiplexer_by_its_commands(tmp_path):
    """Topic names do not matter: the output is the topic that repeats the others' commands."""
    topics = takeover_drive()
    topics["/cmd_vel_out_of_planner"] = topics.pop(NAV)
    topics["/wheels/command"] = topics.pop(OUT)
    bag = write_topics(topics, tmp_path / "bag")
    profile = proposed(bag, file := tmp_path / "p.toml")
    assert profile.inputs.command.topic == "/wheels/command"
    sources = {name: source.topic for name, source in profile.command_sources.items()}
    assert sources == {"navigation": "/cmd_vel_out_of_planner", "teleop": TELEOP}
    rows = driver_per_row(bag, file, tmp_path / "s")
    assert {policy for s, policy in rows if 4.2 < s < 6.8} == {"teleop"}
    assert {policy for s, policy in rows if s < 3.8 or s > 7.2} == {"navigation"}


def test_proposed_driver_of_teleop_only_command(tmp_path):
    topics = {n: t for n, t in takeover_drive().items() if n not in (NAV, TELEOP, JOY)}
    topics["/teleop/cmd_vel"] = topics.pop(OUT)
    bag = write_topics(topics, tmp_path / "bag")
    assert proposed(bag, file := tmp_path / "p.toml").behaviour_policy == "teleop"
    assert 'behaviour_policy = "teleop"  # by the name of /teleop/cmd_vel' in file.read_text()


BOOL = "std_msgs/msg/Bool"
TAKEN_S = (4.0, 8.0)
Topics = dict[str, Any]


def drive_without_driver() -> Topics:
    """Return a drive of a robot whose logs do not name the driver."""
    topics: Topics = typed_topics(Drive(duration_s=12.0))
    del topics["/behaviour_policy"]
    return topics


def with_takeover(kind: str = BOOL) -> Topics:
    at_s = np.arange(0, 12, 0.2)
    pressed = (at_s >= TAKEN_S[0]) & (at_s < TAKEN_S[1])
    data = pressed if kind == BOOL else np.where(pressed, "yes", "no").astype(object)
    return drive_without_driver() | {TAKEOVER: (kind, columns(at_s, {"data": data}, stamped=False))}


def with_shadow_policy() -> Topics:
    """Return a drive in which the node proposes commands and its limiter reduces them."""
    at_s = np.arange(0, 12, 0.1)
    half = np.full(len(at_s), 0.2)
    slow = {"linear.x": half, "angular.z": 0 * half}
    chosen = {"data": np.ones(len(at_s), np.int16)}
    rule = {"data": (at_s > 6).astype(np.uint8)}
    return drive_without_driver() | {
        PROPOSAL: (TWIST, columns(at_s, slow | {"linear.x": 2 * half}, stamped=False)),
        SHADOW: (TWIST, columns(at_s, slow, stamped=False)),
        ACTION: ("std_msgs/msg/Int16", columns(at_s, chosen, stamped=False)),
        LIMITER: ("std_msgs/msg/UInt8", columns(at_s, rule, stamped=False)),
    }


def test_takeover_rows_have_operator_as_driver(tmp_path):
    bag, file = write_topics(with_takeover(), tmp_path / "bag"), tmp_path / "p.toml"
    profile = proposed(bag, file)
    assert list(profile.command_sources) == ["operator"]
    assert "shadow_action" not in profile.signals
    with ingested(bag, file, tmp_path / "store") as store:
        rows = store.sql("SELECT stamp_ns, behaviour_policy FROM transitions").fetchall()
    by_hand = [(stamp - START_NS) * 1e-9 for stamp, policy in rows if policy == "operator"]
    assert len(by_hand) == pytest.approx((TAKEN_S[1] - TAKEN_S[0]) / 0.2, abs=1)
    assert min(by_hand) >= TAKEN_S[0]
    assert max(by_hand) < TAKEN_S[1] + 0.01
    assert {policy for _, policy in rows} == {"operator", "unknown"}
    assert "[signals.restock_takeover]" not in file.read_text()


def test_takeover_topic_of_another_type_is_ignored(tmp_path):
    bag = write_topics(with_takeover("std_msgs/msg/String"), tmp_path / "bag")
    assert proposed(bag, tmp_path / "p.toml").command_sources == {}


def test_shadow_policy_is_not_proposed_as_driver(tmp_path, shell):
    """A shadow policy publishes more twists than the command topic has."""
    bag, file = write_topics(with_shadow_policy(), tmp_path / "bag"), tmp_path / "p.toml"
    profile = proposed(bag, file)
    assert profile.inputs.command.topic == "/cmd_vel"
    assert profile.inputs.nav_command is None
    assert profile.command_sources == {}
    assert shell.json("profile", "new", bag)["commands"] == []
    assert not any(line.startswith("# [signals.restock") for line in file.read_text().splitlines())
