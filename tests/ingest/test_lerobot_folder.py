"""LeRobot v3.0 data sets as recordings: values, time, missing data, and rejected layouts."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.cameras import file_of, picture

from restock.cli import main
from restock.cli.data.watch import incomplete
from restock.errors import RecordingError
from restock.ingest.containers import lerobot_folder
from restock.ingest.containers.lerobot_folder import field_names
from restock.ingest.containers.open_recording import open_recording, recordings_in
from restock.ingest.profile.profile import parse_profile
from restock.ingest.steps.input_columns import reckon
from restock.replay.store.store import Store

NAMES = ["arm_gripper.pos", "x.vel", "y.vel", "theta.vel"]  # names of a LeKiwi with one joint
FPS, FRAMES, EPISODES = 10, 40, 4
VECTOR = {"dtype": "float32", "shape": [4], "names": NAMES}
FILES = [f"data/chunk-000/file-00{number}.parquet" for number in range(2)]  # two episodes each
PROFILE = """
name = "lekiwi"
[task]
goal = "none"
control_period_s = 0.1
sectors = 0
actions = [[0, 0], [0.2, 0], [0.2, 0.5], [0.2, -0.5]]
body = { length_m = 0.25, width_m = 0.25 }
[clock]
alignment = "log_time"
steps = "command"
[inputs.command]
topic = "/action"
type = "lerobot/msg/Action"
fields = { speed_mps = "x_vel", sideways_mps = "y_vel", yaw_rate_radps = "theta_vel in deg/s" }
max_age_s = 0.2
[inputs.wheels]
topic = "/observation.state"
type = "lerobot/msg/ObservationState"
fields = { speed_mps = "x_vel", yaw_rate_radps = "theta_vel in deg/s" }
max_age_s = 0.2
[inputs.pose]
topic = "/observation.state"
type = "lerobot/msg/ObservationState"
fields = { speed_mps = "x_vel", yaw_rate_radps = "theta_vel in deg/s" }
max_age_s = 0.2
"""


def lists(values: np.ndarray) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def frames(episodes: range) -> dict[str, Any]:
    """Return the columns of these episodes: straight ahead at 0.2 m/s, turning at 9 deg/s."""
    count = FRAMES * len(episodes)
    at = np.tile(np.arange(FRAMES), len(episodes))
    episode = np.repeat(np.array(episodes), FRAMES)
    state = np.zeros((count, 4), np.float32)
    state[:, 0], state[:, 1], state[:, 3] = episode * 100 + at, 0.2, 9.0
    return {
        "observation.state": lists(state),
        "action": pa.array(state.tolist(), pa.list_(pa.float32())),
        "timestamp": (at / FPS).astype(np.float32),
        "frame_index": at,
        "episode_index": episode,
        "index": episode * FRAMES + at,
        "task_index": episode * 0,
    }


def rewrite(file: Path, **changes: Any) -> None:
    table = pq.ParquetFile(file).read()
    columns = {name: table[name] for name in table.column_names}
    pq.write_table(pa.table(columns | changes), file)


def write_set(folder: Path, more: dict[str, Any] | None = None, **info: Any) -> Path:
    """Write a data set in LeRobot's layout with two data files of two episodes each.

    `more` are further features by name.
    """
    for part in ("meta", "data/chunk-000"):
        (folder / part).mkdir(parents=True)
    for number, name in enumerate(FILES):
        pq.write_table(pa.table(frames(range(number * 2, number * 2 + 2))), folder / name)
    document = {
        "codebase_version": "v3.0",
        "robot_type": "lekiwi_client",
        "total_frames": FRAMES * EPISODES,
        "features": {"observation.state": VECTOR, "action": VECTOR, **(more or {})},
        **info,
    }
    (folder / "meta/info.json").write_text(json.dumps(document))
    return folder


def test_decoded_values_match_parquet(tmp_path):
    folder = write_set(tmp_path / "set")
    table = pa.concat_tables([pq.ParquetFile(folder / name).read() for name in FILES])
    with open_recording(folder) as recording:
        assert recording.format == "lerobot-v3"
        wanted = ["arm_gripper_pos", "x_vel", "y_vel", "theta_vel"]
        assert recording.leaves("/action") == wanted
        found = recording.read({"/action": wanted, "/frame": ["episode_index", "timestamp"]})
        assert [(a.expected, a.decoded) for a in recording.accounts.values()] == [(160, 160)] * 2
        assert recording.metadata[0].entries == {"robot_type": "lekiwi_client"}
        assert any("no dates" in note for note in recording.notes)
    action = np.stack([found["/action"].fields[name] for name in wanted], axis=1)
    assert action.tolist() == table["action"].to_pylist()
    frame = found["/frame"]
    assert frame.fields["episode_index"].tolist() == table["episode_index"].to_pylist()
    assert frame.fields["timestamp"].tolist() == table["timestamp"].to_pylist()
    gaps = np.diff(frame.log_time_ns) / 1e9
    assert gaps[FRAMES - 1 :: FRAMES].tolist() == [10.0] * 3  # between episodes
    within = np.delete(gaps, np.arange(FRAMES - 1, 159, FRAMES))
    assert np.allclose(within, 1 / FPS, atol=1e-6)


def test_folder_is_recognised_by_its_info_file(tmp_path):
    folder = write_set(tmp_path / "sets" / "one")
    assert recordings_in(tmp_path) == [folder]
    with pytest.raises(RecordingError, match="not a recording"):
        open_recording(folder / FILES[0])
    identity = open_recording(folder).recording_id
    rewrite(folder / FILES[1], task_index=pa.array([7] * 80))
    # depends on the data, not only on the info file
    assert open_recording(folder).recording_id != identity
    (folder / "meta/info.json").write_text('{"name": "of another tool"}')
    with pytest.raises(RecordingError, match="no recording in this folder"):
        recordings_in(tmp_path)


def test_ingest_and_sql_accept_data_set(tmp_path, shell):
    folder = write_set(tmp_path / "set")
    profile, store = tmp_path / "own.toml", tmp_path / "store"
    profile.write_text(PROFILE)
    action = np.zeros((80, 4), np.float32)
    action[5, 1], action[6, 2] = np.nan, 0.1  # one unknown command, and one sideways command
    rewrite(folder / FILES[0], action=lists(action))
    assert shell.json("sql", folder, 'SELECT max(theta_vel) AS m FROM "/action"') == [{"m": 9.0}]
    (document,) = shell.json("ingest", folder, "--profile", profile, "--store", store)["recordings"]
    assert document["drops"] == [{"reason": "command: not finite", "count": 1}]
    assert any("1 of 160 messages of /action contain a sideways" in n for n in document["notes"])
    assert "dead reckoning by the speeds" in str(document["stand_ins"])
    with Store(store) as opened:
        rows = opened.sql("""
            SELECT episode_index, count(*), max(wheel_yaw_rate_radps), max(pose_x_m) - min(pose_x_m)
            FROM transitions GROUP BY ALL ORDER BY 1""").fetchall()
        logged = opened.sql("SELECT max(command_yaw_rate_radps) FROM transitions").fetchall()
    assert [count for _, count, *_ in rows] == [4, 33, 39, 39, 39]  # no step joins two episodes
    assert [turn for _, _, turn, _ in rows] == pytest.approx([np.radians(9)] * 5)
    assert logged[0] == pytest.approx((np.radians(9),))


def test_proposal_lists_topics_of_data_set(tmp_path):
    folder, out = write_set(tmp_path / "set"), tmp_path / "own.toml"
    assert main(["profile", "new", str(folder), "--out", str(out)]) == 3  # not usable without edits
    assert "/observation.state" in out.read_text()


def test_images_are_read_and_videos_listed(tmp_path):
    pictures = [file_of(picture(number), "JPEG" if number % 2 else "PNG") for number in range(160)]
    image = {"dtype": "image", "shape": [32, 48, 3], "names": ["height", "width", "channels"]}
    video = {"dtype": "video", "shape": [32, 48, 3], "names": ["height", "width", "channels"]}
    folder = write_set(tmp_path / "set", {"images.front": image, "images.rear": video})
    for number, name in enumerate(FILES):
        images = [
            {"bytes": content, "path": None} for content in pictures[number * 80 : number * 80 + 80]
        ]
        images[9]["bytes"] = None
        rewrite(folder / name, **{"images.front": pa.array(images)})
    (folder / "videos/images.rear/chunk-000").mkdir(parents=True)
    (folder / "videos/images.rear/chunk-000/file-000.mp4").write_bytes(bytes(123))
    with open_recording(folder) as recording:
        found = recording.read({"/images.front": ["header.stamp", "format", "data"]})
        front = found["/images.front"]
        (account,) = recording.accounts.values()
        assert [(e.name, e.media_type, e.size_bytes) for e in recording.extras] == [
            ("images.rear", "video/mp4", 123)
        ]
    assert front.fields["format"].tolist()[:2] == ["png", "jpeg"]
    assert front.fields["data"][12].tobytes() == pictures[13]  # after a missing frame
    assert front.fields["header.stamp"].tolist() == front.log_time_ns.tolist()
    assert (account.expected, account.decoded, account.lost) == (160, 158, 2)


def truncate_file(folder: Path) -> None:
    (folder / FILES[1]).write_bytes((folder / FILES[1]).read_bytes()[:-9])


def swap_episodes(folder: Path) -> None:
    rewrite(folder / FILES[1], episode_index=pa.array([3] * 40 + [2] * 40))


def freeze_time(folder: Path) -> None:
    rewrite(folder / FILES[0], timestamp=pa.array(np.zeros(80, np.float32)))


def write_nan_time(folder: Path) -> None:
    rewrite(folder / FILES[0], timestamp=pa.array(np.full(80, np.nan, np.float32)))


def drop_action(folder: Path) -> None:
    table = pq.ParquetFile(folder / FILES[0]).read()
    pq.write_table(table.drop_columns("action"), folder / FILES[0])


@pytest.mark.parametrize(
    ("damage", "message", "decoded"),
    [
        (truncate_file, f"{FILES[1]} cannot be read: ", 80),
        (swap_episodes, f"{FILES[1]}: row 40 is of episode 2, after episode 3", 160),
        (freeze_time, f"{FILES[0]}: row 1 of episode 0 is not later than the one before it", 160),
        (write_nan_time, f"{FILES[0]} cannot be read: a timestamp is not a number", 80),
        (drop_action, f"{FILES[0]} cannot be read: it has no column action", 80),
    ],
)
def test_damaged_file_is_rejected_or_salvaged(
    tmp_path: Path, damage: Callable[[Path], None], message: str, decoded: int
) -> None:
    folder = write_set(tmp_path / "set")
    damage(folder)
    with pytest.raises(RecordingError, match=message) as error:
        open_recording(folder)
    assert "--salvage" in str(error.value.remedy)
    assert message in incomplete(folder)
    with open_recording(folder, salvage=True) as recording:
        recording.read({"/action": ["x_vel"]} if "/action" in recording.topics else {})
        account = recording.accounts["/action"]
        assert (account.expected, account.decoded) == (160, decoded)
        assert sum(account.reasons.values()) == account.lost == 160 - decoded
        assert recording.integrity == "damaged"


def test_missing_data_file_is_counted(tmp_path):
    folder = write_set(tmp_path / "set")
    (folder / FILES[0]).unlink()
    with open_recording(folder) as recording:
        recording.read({"/action": ["x_vel"]})
        assert recording.accounts["/action"].lost == 80
    assert "counts 160 frames, and there are 80" in recording.lost_messages[0].reason


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"codebase_version": "v2.1"}, "codebase_version 'v2.1': only v3.0 is read"),
        ({"codebase_version": 3}, "codebase_version 3: only v3.0 is read"),
        ({"features": None}, "it has no features"),
    ],
)
def test_unsupported_layout_is_rejected(tmp_path: Path, info: dict[str, Any], message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        open_recording(write_set(tmp_path / "set", **info))


def test_unsupported_features_are_noted(tmp_path):
    text, wide = {"dtype": "string", "shape": [1]}, {"dtype": "float32", "shape": [4, 4]}
    odd = {
        f"odd{at}": {"dtype": "float32", "shape": s} for at, s in enumerate(([0], ["4"], [10**12]))
    }
    folder = write_set(tmp_path / "set", {"language": text, "map": wide, "none": None, **odd})
    with open_recording(folder) as recording:
        assert list(recording.topics) == ["/action", "/frame", "/observation.state"]
        assert "feature language is a string: it is not read" in recording.notes
        assert any("map has the shape [4, 4]" in note for note in recording.notes)
        assert sum("only one dimension is read" in note for note in recording.notes) == 4


def test_rows_of_wrong_length_are_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_folder, "ROWS", 16)  # so that several batches of a file lose some
    folder = write_set(tmp_path / "set")
    values = [[float(row)] * (4 if row % 10 else 3) for row in range(80)]
    rewrite(folder / FILES[0], action=pa.array(values, pa.list_(pa.float32())))
    with open_recording(folder) as recording:
        action = recording.read({"/action": ["x_vel"]})["/action"]
        account = recording.accounts["/action"]
        assert [*account.reasons.values()] == [account.lost] == [8]
    assert action.fields["x_vel"][:10].tolist() == [1.0, 2, 3, 4, 5, 6, 7, 8, 9, 11]


def test_feature_names_become_field_names():
    assert field_names(["x.vel", "X vel", "3rd", ""], 4) == (
        "x_vel",
        "x_vel_1",
        "value_3rd",
        "value_3",
    )
    assert field_names({"motors": ["a", "b"]}, 2) == ("a", "b")
    assert field_names(None, 2) == field_names(["one"], 2) == ("value_0", "value_1")


def test_dead_reckoning_follows_arc():
    time_ns = np.arange(101) * 10**7 * 2  # 2 s
    rates = np.stack([np.full(101, 0.5), np.zeros(101), np.full(101, 0.8)])
    poses = reckon(time_ns, rates, 0.5)
    assert poses.yaw_rad[-1] == pytest.approx(1.6)
    assert poses.x_m[-1] == pytest.approx(0.5 / 0.8 * np.sin(1.6), abs=1e-4)
    assert poses.y_m[-1] == pytest.approx(0.5 / 0.8 * (1 - np.cos(1.6)), abs=1e-4)
    rates[0, 50] = np.nan
    broken = reckon(time_ns, rates, 0.5)
    assert np.flatnonzero(np.isnan(broken.x_m)).tolist() == [50]
    sideways = reckon(time_ns, np.full((101, 3), [0.0, 0.3, 0.0]).T, 0.5)
    assert sideways.y_m[-1] == pytest.approx(0.6)
    apart = reckon(np.array([0, 10**9]), np.ones((3, 2)), 0.5)
    assert apart.x_m.tolist() == [0.0, 0.0]  # the gap is unknown


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("theta_vel in deg/s", "theta_vel in furlongs", "has an unknown unit"),
        ('speed_mps = "x_vel", yaw', 'x_m = "x_vel", speed_mps = "x_vel", yaw', "unknown 'x_m'"),
        ('speed_mps = "x_vel", yaw', 'sideways_mps = "x_vel", yaw', "missing 'speed_mps'"),
    ],
)
def test_invalid_profile_of_data_set_is_rejected(old: str, new: str, message: str) -> None:
    head, mark, pose = PROFILE.partition("[inputs.pose]")
    with pytest.raises(Exception, match=message):
        parse_profile(head + mark + pose.replace(old, new), where="test")
