"""A moment as an MCAP file: read back with a reader of ROS, value by value."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from support.kept_run import kept_run
from support.paths import ROOT

from restock import cli
from restock.errors import ConfigError, RecordingError, RunError, StoreError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.replay.trace.moment import find_moment
from restock.replay.trace.trace import Trace, trace_row
from restock.train.dqn.config import parse_config
from restock.train.dqn.learner import Learner
from restock.train.run import checkpoint
from restock.train.run.run import Run
from restock.train.session import Progress
from restock.train.view.mcap_view import ViewOptions, critic_along, layout_of, write_view

RECORDING = ROOT / "sample_logs" / "amr_tuesday"


@dataclass
class Event:
    """A slip of the recording, in a store, and a run whose critic is asked."""

    store: Path
    run: Path
    row: dict[str, Any]
    steps: list[dict[str, Any]]  # from 2 s before it to 1 s after

    @property
    def trace(self) -> Trace:
        return trace_row(self.store, str(self.row["transition_id"]))


@pytest.fixture(scope="module")
def event(tmp_path_factory: pytest.TempPathFactory) -> Event:
    folder = tmp_path_factory.mktemp("view")
    ingest(RECORDING, load_profile("warehouse_amr"), store=StoreWriter(folder / "store"))
    with Store(folder / "store") as store:
        slips = "FROM transitions WHERE primary_condition = 'wheel_slip' AND step_index > 12"
        slips += " ORDER BY ALL"
        row = store.sql(slips).to_arrow_table().slice(0, 1).to_pylist()[0]
        window = (
            f"FROM transitions WHERE stamp_ns BETWEEN {row['stamp_ns'] - 2 * 10**9}"
            f" AND {row['stamp_ns'] + 10**9} ORDER BY stamp_ns"
        )
        steps = store.sql(window).to_arrow_table().to_pylist()
    run = kept_run(folder / "run")
    made = Run.open(run)
    config = parse_config(made.document["config"], where="test")
    task = load_profile("warehouse_amr").task
    learner = Learner(config, task.observation_size, len(task.actions))
    with torch.no_grad():  # a target that lags
        for parameter in learner.target_network.parameters():
            parameter.mul_(0.9)
    progress = asdict(Progress(evaluated_at=0))
    checkpoint.save(made.latest, {"learner": learner.state_dict(), "progress": progress})
    return Event(folder / "store", run, row, steps)


def options(event: Event, **changes: Any) -> ViewOptions:
    given = {"before_s": 2.0, "after_s": 1.0, "recording": RECORDING, "critic": str(event.run)}
    return ViewOptions(**(given | changes))


@pytest.fixture(scope="module")
def shown(event: Event, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shown") / "slip.mcap"
    write_view(event.trace, path, options(event))
    return path


def test_an_mcap_holds_the_recordings_own_messages_unchanged(event: Event, shown: Path) -> None:
    low, high = event.row["stamp_ns"] - 2 * 10**9, event.row["stamp_ns"] + 10**9
    with AnyReader([RECORDING]) as source:
        original: dict[str, list[bytes]] = {}
        for connection, log_ns, data in source.messages():
            held = original.setdefault(connection.topic, [])
            offset = 2_000_000  # log time is some 1 ms ahead of the stamps in this recording
            if low + offset <= log_ns <= high - offset:
                held.append(bytes(data))
    with shown.open("rb") as stream:
        copied: dict[str, list[bytes]] = {}
        for _, channel, message in make_reader(stream).iter_messages():
            copied.setdefault(channel.topic, []).append(message.data)
    for topic, payloads in original.items():
        if payloads:
            assert set(payloads) <= set(copied[topic]), topic
            assert len(payloads) <= len(copied[topic]) <= len(payloads) + 3, topic
    # What was in force before it is there, from the start on.
    assert {"/map", "/tf_static", "/goal_pose", "/plan"} <= copied.keys()


def test_an_mcap_holds_what_the_store_has_of_each_step(event: Event, shown: Path) -> None:
    decoded: dict[str, list[Any]] = {}
    with AnyReader([shown]) as reader:
        for connection, log_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            decoded.setdefault(connection.topic, []).append((log_ns, message))

    def said(topic: str, field: str = "data") -> list[Any]:
        return [getattr(message, field) for _, message in decoded[f"/restock/{topic}"]]

    steps = event.steps
    assert said("condition") == [step["primary_condition"] for step in steps]
    assert "wheel_slip" in said("condition")
    assert said("true_condition") == [step["true_condition"] for step in steps]
    assert said("reward") == pytest.approx([step["reward"] for step in steps])
    assert [t.linear.x for _, t in decoded["/restock/command"]] == pytest.approx(
        [step["command_speed_mps"] for step in steps]
    )
    assert [p.position.x for p in said("pose", "pose")] == pytest.approx(
        [step["pose_x_m"] for step in steps]
    )
    # The scan that ingest read is one that the recording has; the policy saw its nearest returns.
    own = [np.asarray(message.ranges) for _, message in decoded["/scan"]]
    read = [np.asarray(message.ranges) for _, message in decoded["/restock/scan"]]
    assert all(any(np.array_equal(scan, other) for other in own) for scan in read)
    seen = [np.asarray(message.ranges) for _, message in decoded["/restock/seen"]]
    assert len(seen) == len(steps)
    nearest = [float(scan[scan > 0.05].min()) for scan in read[: len(seen)]]
    assert [float(scan.min()) for scan in seen] == pytest.approx(nearest, abs=0.05)
    (at, moment) = decoded["/restock/moment"][0]
    assert json.loads(moment.data)["transition_id"] == event.row["transition_id"]
    assert abs(at - event.row["stamp_ns"]) < 10**7


def test_the_critic_is_that_of_the_last_checkpoint(event: Event, shown: Path) -> None:
    assert event.trace.origin is not None
    moment = find_moment(event.trace.origin, before_s=2, after_s=1)
    critic = critic_along(event.run, moment)
    made = Run.open(event.run)
    config = parse_config(made.document["config"], where="test")
    learner = Learner(config, moment.task.observation_size, len(moment.task.actions))
    learner.load_state_dict(checkpoint.load(made.latest)["learner"])
    with torch.no_grad():
        q = learner.network(torch.from_numpy(moment.observations))
        after = torch.tensor(np.array(moment.column("next_observation"), np.float32))
        best = learner.network(after).argmax(dim=1)  # double Q
        bootstrap = learner.target_network(after)[torch.arange(len(best)), best]
    goes_on = 1 - np.array(moment.column("terminated"), np.float32)
    target = np.array(moment.column("reward")) + config.loss.discount * goes_on * bootstrap.numpy()
    taken = q.numpy()[np.arange(len(q)), moment.column("action")]
    np.testing.assert_allclose(critic.value, taken, rtol=1e-5)
    np.testing.assert_allclose(critic.td, taken - target, atol=1e-4)
    with shown.open("rb") as stream:
        td = [m for _, _, m in make_reader(stream).iter_messages(["/restock/critic/td_error"])]
    assert [np.frombuffer(m.data, "<f8", offset=4)[0] for m in td] == pytest.approx(critic.td)


def test_the_layout_shows_topics_that_the_file_has(shown: Path) -> None:
    layout = json.loads(layout_of(shown).read_text())
    with shown.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}

    def placed(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else placed(node["first"]) + placed(node["second"])

    panels = layout["configById"]
    assert sorted(placed(layout["layout"])) == sorted(panels)
    assert set(panels["3D!moment"]["topics"]) <= topics
    assert {"/map", "/restock/scan", "/restock/plan"} <= set(panels["3D!moment"]["topics"])
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    assert {path.removesuffix(".data") for path in paths} <= topics
    assert "/restock/critic/td_error.data" in paths


def test_a_store_alone_shows_what_it_has(event: Event, tmp_path: Path) -> None:
    made = write_view(event.trace, tmp_path / "s.mcap", options(event, recording=None, critic=None))
    assert made["topics"].keys().isdisjoint({"/scan", "/restock/scan", "/restock/critic/value"})
    assert made["topics"]["/restock/seen"] == len(event.steps) == made["steps"]
    assert any("--recording" in note for note in made["notes"])


def test_what_cannot_be_shown_is_said_and_leaves_nothing(event: Event, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"must end in \.mcap"):
        write_view(event.trace, tmp_path / "moment.bag")
    (tmp_path / "there.mcap").touch()
    with pytest.raises(ConfigError, match="exists already"):
        write_view(event.trace, tmp_path / "there.mcap")
    (tmp_path / "there.mcap").unlink()
    with pytest.raises(StoreError, match="row from the twin"):
        write_view(Trace(episode={"episode": 1}), tmp_path / "a.mcap")
    other = ROOT / "sample_logs" / "amr_monday.mcap"
    with pytest.raises(RecordingError, match="the row is of"):
        write_view(event.trace, tmp_path / "a.mcap", options(event, recording=other))
    with pytest.raises(RunError, match=r"no config\.json"):
        write_view(event.trace, tmp_path / "a.mcap", options(event, critic=str(event.store)))
    assert list(tmp_path.iterdir()) == []


def test_the_command_names_the_file_and_its_layout(event, tmp_path, capsys):
    row, path = str(event.row["transition_id"]), tmp_path / "m.mcap"
    words = ["trace", str(event.store), row, "--view", str(path), "--json"]
    assert cli.main(words) == 0
    made = json.loads(capsys.readouterr().out)["view"]
    assert made["path"] == str(path)
    assert made["layout"] == str(layout_of(path))
    assert Path(made["layout"]).exists()
    assert cli.main(["trace", str(event.run), "--view", str(tmp_path / "x.mcap")]) == 2
    assert "give ROW" in capsys.readouterr().err
    assert cli.main(["trace", str(event.store), row, "--critic", "none"]) == 2
    assert "--critic: has no effect without --view" in capsys.readouterr().err
