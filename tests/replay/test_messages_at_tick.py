"""The messages that a trace lists at a tick are those from which ingest made the row."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import LATENCY_NS, Drive, columns, write_bag
from support.long import one_in
from support.paths import ROOT, SHARED
from support.profile_texts import WAREHOUSE as TEXT
from support.profile_texts import framed

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.propose.drives import propose_profile
from restock.ingest.steps.frames import rotations
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import STEP_BITS
from restock.ingest.task.task import nearest_action
from restock.replay.trace.origin import MessageAtTick, messages_at_tick

SAMPLE = ROOT / "sample_logs" / "amr_tuesday"
TURTLEBOT = SHARED / "turtlebot3-sim-humble"
ROWS = 6  # each reads the recording again
# The joint states are more frequent than the commands and continue after the last one.
SIGNALS = """
[signals.left_wheel_radps]
topic = "/joint_states"
type = "sensor_msgs/msg/JointState"
path = "velocity[left_wheel_joint]"
unit = "rad/s"
max_age_s = 0.5

[signals.battery_v]
topic = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
path = "status[name=battery].values[key=voltage].value"
unit = "V"
"""
RATE = ('steps = "command"', 'steps = "rate"')
LOG_TIME = ('alignment = "header.stamp"', 'alignment = "log_time"')


def profile_of(
    *changes: tuple[str, str], from_frames: bool = False, signals: bool = False
) -> Profile:
    text = TEXT + (SIGNALS if signals else "")
    if from_frames:
        text = framed(text)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_profile(text, where="p")


PROFILES = {
    "on the command's clock": profile_of(),
    "at a fixed rate": profile_of(RATE),
    "at a fixed rate, by log time": profile_of(RATE, LOG_TIME),
    "poses from transforms": profile_of(from_frames=True),
    "poses from transforms, at a fixed rate": profile_of(RATE, from_frames=True),
    "custom signals": profile_of(signals=True),
    "poses from transforms, by log time": profile_of(LOG_TIME, from_frames=True),
    "custom signals and transforms, at a fixed rate": profile_of(
        RATE, from_frames=True, signals=True
    ),
}


@pytest.mark.parametrize("name", one_in(3, PROFILES))
def test_row_matches_messages_at_its_tick(name, tmp_path):
    check(SAMPLE, PROFILES[name], tmp_path)


@pytest.mark.skipif(not TURTLEBOT.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize("steps", ["command", "rate"])
@pytest.mark.parametrize("from_frames", [False, True])
def test_turtlebot_row_matches_messages_at_its_tick(steps, from_frames, tmp_path):
    with open_recording(TURTLEBOT) as recording:
        text = propose_profile(recording, "turtlebot").toml
    text = re.sub('steps = "[a-z]+"', f'steps = "{steps}"', text)
    if from_frames:
        text = re.sub(r"\[inputs.pose\][^[]*", "", text)
        text = text.replace("[clock]", '[frames]\nfixed = "odom"\nbase = "base_link"\n\n[clock]')
    profile = parse_profile(text, where="proposed")
    assert (profile.inputs.pose is None, profile.clock.steps) == (from_frames, steps)
    check(TURTLEBOT, profile, tmp_path)


class Battery(Drive):
    """A drive with a topic that has less delay than all others and continues after them."""

    def topics(self) -> dict[str, TopicColumns]:
        at = columns(np.arange(0.0, self.duration_s + 1.0, 0.1), {})
        voltage = 24.0 + np.arange(len(at)) / 1000
        log_time_ns = at.log_time_ns - LATENCY_NS + 500_000
        battery = TopicColumns(log_time_ns, log_time_ns, at.fields | {"voltage": voltage})
        return super().topics() | {"/battery": battery}


@pytest.mark.parametrize("rate", [False, True])
def test_custom_signal_topics_are_aligned_as_in_ingest(rate, tmp_path):
    """They move commands, which have no stamp, by 1.5 ms and extend the ticks of a fixed rate."""
    signal = '[signals.volts]\ntopic = "/battery"\ntype = "sensor_msgs/msg/BatteryState"\n'
    text = TEXT + signal + 'path = "voltage"\nunit = "V"\n'
    profile = parse_profile(text.replace(*RATE) if rate else text, where="p")
    check(write_bag(Battery(), tmp_path / "bag"), profile, tmp_path)


def check(recording: Path, profile: Profile, folder: Path) -> None:
    """Compare rows of a recording with the messages at their ticks."""
    outcome = ingest(recording, profile, store=StoreWriter(folder / "store"))
    rows = StoreWriter(folder / "store").rows(
        outcome.manifest["recording_id"], outcome.manifest["ingest_id"]
    )
    rng = np.random.default_rng(0)
    for index in rng.choice(len(rows), min(ROWS, len(rows)), replace=False):
        row = rows.slice(int(index), 1).to_pylist()[0]
        messages = messages_at_tick(
            recording,
            profile,
            recording_id=row["recording_id"],
            tick=row["transition_id"] & ((1 << STEP_BITS) - 1),
            stamp_ns=row["stamp_ns"],
        )
        check_row(profile, row, messages)


def check_row(profile: Profile, row: dict[str, Any], messages: list[MessageAtTick]) -> None:
    named: dict[str, MessageAtTick] = {message.input: message for message in messages}

    def value(name: str, key: str) -> Any:
        return named[name].fields[getattr(profile.inputs, name).fields[key]]

    command = [value("command", key) for key in ("speed_mps", "yaw_rate_radps")]
    stored = [row["command_speed_mps"], row["command_yaw_rate_radps"]]
    assert command == pytest.approx(stored)
    action, residual = nearest_action(profile.task, *(np.array([part]) for part in command))
    assert action[0] == row["action"]
    assert residual[0] == pytest.approx(row["action_residual"], abs=1e-6)
    for key in ("speed_mps", "yaw_rate_radps"):
        assert value("wheels", key) == pytest.approx(row[f"wheel_{key}"])
    assert value("imu", "yaw_rate_radps") == pytest.approx(row["gyro_yaw_rate_radps"])
    assert value("imu", "accel_x_mps2") == pytest.approx(row["accel_x_mps2"])
    if profile.inputs.pose is not None:
        assert value("pose", "x_m") == pytest.approx(row["pose_x_m"])
        assert value("pose", "y_m") == pytest.approx(row["pose_y_m"])
        assert named["pose"].stamp_ns == row["pose_stamp_ns"]
    else:
        transforms = {m.fields["child"]: m for m in messages if m.input == "pose"}
        position = pytest.approx([row["pose_x_m"], row["pose_y_m"]], abs=1e-5)
        assert pose_of(profile, transforms) == position
        moving = [m.stamp_ns for m in transforms.values() if m.max_age_s is not None]
        assert max(moving) == row["pose_stamp_ns"]
    for name, signal in profile.signals.items():
        message = named.get(f"signals.{name}")
        assert (message and message.fields[signal.path]) == row[name]
    for message in messages:
        assert message.stamp_ns == row["stamp_ns"] - round(message.age_s * 1e9)
    if "true_condition" in named:
        assert value("true_condition", "text") == row["true_condition"]
    if "behaviour_policy" in named:
        assert row["behaviour_policy"] in value("behaviour_policy", "text")


def pose_of(profile: Profile, transforms: dict[str, MessageAtTick]) -> list[float]:
    """Return the base's position in the fixed frame; `transforms` lead to the parent frames."""
    assert profile.frames is not None
    point, frame = np.zeros(3), profile.frames.base
    while frame != profile.frames.fixed:
        step = transforms[frame].fields
        rotation = rotations(*(np.array([step[f"rotation.{axis}"]]) for axis in "xyzw"))[0]
        point = rotation @ point + [step[f"translation.{axis}"] for axis in "xyz"]
        frame = step["parent"]
    return [float(part) for part in point[:2]]


def test_mismatched_recording_or_profile_is_refused():
    with open_recording(SAMPLE) as recording:
        right = recording.recording_id
    where = {"recording_id": right, "tick": 3, "stamp_ns": 5}
    with pytest.raises(
        RecordingError, match="has no tick 3 at 5 ns with the profile 'warehouse_amr"
    ):
        messages_at_tick(SAMPLE, PROFILES["at a fixed rate"], **where)
    with pytest.raises(RecordingError, match="has no tick 9999999 at 5 ns"):
        messages_at_tick(SAMPLE, PROFILES["at a fixed rate"], **where | {"tick": 9_999_999})
    with pytest.raises(RecordingError, match=r"amr_tuesday: does not fit .* no topic /gyro"):
        messages_at_tick(SAMPLE, profile_of(('"/imu"', '"/gyro"')), **where)
    with pytest.raises(RecordingError, match="the row is of x"):
        messages_at_tick(SAMPLE, PROFILES["at a fixed rate"], **where | {"recording_id": "x"})
