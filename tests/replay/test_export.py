"""Exports: trajectories are reassembled, and each format is read back by its library if installed.

Not every library can live in one environment (d3rlpy pins an old Gymnasium, lerobot a torch with
CUDA), so those two are read with the Python that RESTOCK_NEIGHBOURS_PYTHON names, else with that of
`.venv-neighbours` if there is one, else with this one.
"""

import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.neighbours import read_with
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import TASK, recording_transitions, write_store

from restock.errors import ConfigError, ExitCode, PanelError, QueryError, StoreError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.store.transitions import replaced
from restock.process import install_command
from restock.replay.export import FORMATS
from restock.replay.export.dataset import export_dataset
from restock.replay.export.selection import open_selection
from restock.replay.export.trajectory import Counts, Trajectory, trajectories
from restock.replay.panel.panel import Panel

SLIP = "FROM held_conditions WHERE condition = 'wheel_slip'"


def read_trajectories(path: Path, **arguments: Any) -> tuple[list[Trajectory], Counts]:
    counts = Counts()
    with open_selection(path, **arguments) as selection:
        found = trajectories(
            selection.batches, continuous=selection.continuous, counts=counts, where="here"
        )
        return list(found), counts


def ordered(transitions: pa.Table) -> pa.Table:
    keys = ("recording_id", "episode_index", "step_index")
    return transitions.sort_by([(key, "ascending") for key in keys])


def matrix(column: pa.ChunkedArray) -> np.ndarray:
    return np.array(column.to_pylist(), np.float32)


def n_step_panel(store: Path, out: Path, n_step: int, where: str = "") -> Panel:
    return panel_of(store, f"n_step = {n_step}\n{where}{EVERY}{NO_SPLIT}", out)


def test_tags_are_exported(tmp_path):
    """Robot and site are columns if the format has them; all tags are in the provenance."""
    tables = [recording_transitions(number, episodes=3) for number in (1, 2)]
    tags = {"robot": "amr-07", "line": "B"}
    store = write_store(tmp_path / "store", tables, tags=[tags, {}])
    done = export_dataset(store, "parquet", tmp_path / "a.parquet")
    assert done["provenance"]["tags"] == {f"{1:016x}": tags}
    rows = pq.read_table(tmp_path / "a.parquet").to_pylist()
    robots = {row["episode_id"].split("/")[0]: (row["robot"], row["site"]) for row in rows}
    assert robots == {f"{1:016x}": ("amr-07", None), f"{2:016x}": (None, None)}
    export_dataset(store, "lerobot", tmp_path / "lerobot")
    (file,) = (tmp_path / "lerobot" / "meta" / "episodes").rglob("*.parquet")
    episodes = pq.read_table(file)
    assert episodes["restock/robot"].to_pylist() == ["amr-07"] * 3 + [""] * 3
    panel = n_step_panel(store, tmp_path / "panel", 1)
    export_dataset(panel.path, "parquet", tmp_path / "b.parquet")
    robots = pq.read_table(tmp_path / "b.parquet")["robot"].to_pylist()
    assert robots.count("amr-07") == len(tables[0])
    # A query without these columns is exported without them.
    plain = "SELECT * EXCLUDE (robot, site, recording_id) FROM transitions"
    out = tmp_path / "c.parquet"
    assert export_dataset(store, "parquet", out, query=plain)["provenance"]["tags"] == {}
    assert "robot" not in pq.read_schema(out).names


def test_rows_left_out_by_query_cut_episodes(store_path, transitions):
    found, counts = read_trajectories(store_path, query=SLIP)
    slipping = {
        row["transition_id"]: row
        for row in transitions.to_pylist()
        if "wheel_slip" in row["conditions"]
    }
    assert counts.transitions == len(slipping)
    assert counts.cut > 0
    for t in found:
        ids = t.carried["transition_id"].tolist()
        assert ids == list(range(ids[0], ids[0] + len(t)))  # consecutive steps
        np.testing.assert_array_equal(t.observations[-1], slipping[ids[-1]]["next_observation"])
        last = slipping[ids[-1]]
        assert t.terminated == last["terminated"]
        assert t.cut == (not last["terminated"] and not last["truncated"])


def test_small_batches_give_same_trajectories(store_path, monkeypatch):
    whole, _ = read_trajectories(store_path)
    monkeypatch.setattr("restock.replay.export.selection.BATCH_ROWS", 7)
    with open_selection(store_path) as selection:
        pieces = [
            piece.slice(start, 7)
            for piece in selection.batches
            for start in range(0, len(piece), 7)
        ]
    some = list(trajectories(iter(pieces), continuous=False, counts=Counts(), where="here"))
    assert len(some) == len(whole)
    for one, other in zip(some, whole, strict=True):
        assert (one.episode_id, one.first_step) == (other.episode_id, other.first_step)
        np.testing.assert_array_equal(one.observations, other.observations)


def test_discontinuous_observation_cuts_episode():
    rows = recording_transitions(1, episodes=1)
    broken = rows["next_observation"].to_pylist()
    broken[3][0] += 1.0
    rows = replaced(rows, {"next_observation": broken})
    found = list(
        trajectories(iter(rows.to_batches()), continuous=False, counts=Counts(), where="here")
    )
    assert [len(t) for t in found] == [4, len(rows) - 4]
    assert [t.cut for t in found] == [True, False]


@pytest.mark.parametrize("n_step", [1, 3])
def test_panel_exports_single_steps_of_store(store_path, tmp_path, n_step):
    panel = n_step_panel(store_path, tmp_path / "panel", n_step, 'where = "step_index % 5 <> 4"\n')
    found, counts = read_trajectories(panel.path)
    whole, _ = read_trajectories(store_path)
    by_id = {
        identity: (t, at)
        for t in whole
        for at, identity in enumerate(t.carried["transition_id"].tolist())
    }
    for t in found:
        origin, at = by_id[int(t.carried["transition_id"][0])]
        expected = origin.observations[at : at + len(t) + 1]
        np.testing.assert_array_equal(t.observations, expected)
        np.testing.assert_array_equal(t.rewards, origin.rewards[at : at + len(t)])
    assert counts.transitions == counts.rows == len(panel)


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_formats_have_provenance_and_write_all_or_nothing(to, store_path, tmp_path, monkeypatch):
    if FORMATS[to][1]:
        pytest.importorskip(FORMATS[to][1])
    out = tmp_path / f"out{FORMATS[to][2]}"

    def broken(self: Trajectory) -> bool:
        raise RuntimeError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Trajectory, "truncated", property(broken))
        patched.setattr(Trajectory, "__len__", broken)
        with pytest.raises(RuntimeError, match="disk is full"):
            export_dataset(store_path, to, out)
    assert not list(tmp_path.iterdir())
    document = export_dataset(store_path, to, out, query=SLIP)
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    assert document["provenance"]["query"] == SLIP
    assert document["provenance"]["task_hash"] == TASK.hash
    assert provenance_in(to, out)["counts"] == {
        name: document[name] for name in Counts().describe()
    }
    with pytest.raises(StoreError, match="already there"):
        export_dataset(store_path, to, out)


def provenance_in(to: str, out: Path) -> Any:
    """Read the provenance from an exported data set."""
    text: Callable[[], Any] = {
        "parquet": lambda: pq.read_metadata(out).metadata[b"restock"],
        "lerobot": lambda: (out / "meta/restock.json").read_text(),
        "minari": lambda: json.loads((out / "metadata.json").read_text())["restock"],
        "d3rlpy": lambda: __import__("h5py").File(out)["restock"].attrs["provenance"],
    }[to]
    return json.loads(text())


def test_parquet_round_trip(store_path, tmp_path, transitions):
    document = export_dataset(store_path, "parquet", tmp_path / "a.parquet")
    table, rows = pq.read_table(tmp_path / "a.parquet"), ordered(transitions)
    assert (document["rows"], document["transitions"], document["cut"]) == (len(rows), len(rows), 0)
    for name in ("observation", "next_observation"):
        np.testing.assert_array_equal(matrix(table[name]), matrix(rows[name]))
    for name in ("action", "reward", "terminated", "truncated", "transition_id", "condition"):
        assert table[name].to_pylist() == rows[name].to_pylist()
    for name in ("terminated", "truncated"):
        assert document[name] == sum(rows[name].to_pylist())
    export_dataset(store_path, "parquet", tmp_path / "b.parquet", continuous=True)
    commands = [rows[f"command_{name}"].to_numpy() for name in ("speed_mps", "yaw_rate_radps")]
    given = matrix(pq.read_table(tmp_path / "b.parquet")["action"])
    np.testing.assert_array_equal(given.T, commands)


@pytest.mark.parametrize("continuous", [False, True])
def test_minari_reads_export(store_path, tmp_path, continuous):
    minari = pytest.importorskip("minari")
    export_dataset(store_path, "minari", tmp_path / "logs", continuous=continuous)
    dataset = minari.MinariDataset(tmp_path / "logs")
    expected, counts = read_trajectories(store_path, continuous=continuous)
    assert dataset.total_steps == counts.transitions
    space = dataset.action_space
    assert isinstance(space, gymnasium.spaces.Box if continuous else gymnasium.spaces.Discrete)
    for episode, t in zip(dataset.iterate_episodes(), expected, strict=True):
        np.testing.assert_array_equal(episode.observations, t.observations)
        np.testing.assert_array_equal(episode.actions, t.actions)
        np.testing.assert_array_equal(episode.rewards, t.rewards)
        assert episode.terminations[-1] == t.terminated
        assert episode.truncations[-1] == t.truncated
        assert not (episode.terminations | episode.truncations)[:-1].any()
        assert all(action in space for action in episode.actions)
        ids = episode.infos["transition_id"]
        assert ids.tolist() == [*t.carried["transition_id"].tolist(), -1]


def test_minari_recovers_twin_environment(tmp_path):
    minari = pytest.importorskip("minari")
    from restock.ingest.profile.profile import load_profile

    task = load_profile("warehouse_amr").task
    store = write_store(tmp_path / "s", [recording_transitions(1, task=task)], task=task)
    registered = gymnasium.spec("restock/Warehouse-v0").kwargs.copy()
    export_dataset(store, "minari", tmp_path / "logs", continuous=True)
    env = minari.MinariDataset(tmp_path / "logs").recover_environment()
    assert env.observation_space.shape == (task.observation_size,)
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    assert gymnasium.spec("restock/Warehouse-v0").kwargs == registered


@pytest.mark.long  # starts another Python
def test_d3rlpy_reads_exports_and_trains(store_path, tmp_path):
    pytest.importorskip("h5py")
    files = {False: tmp_path / "actions.h5", True: tmp_path / "commands.h5"}
    for continuous, file in files.items():
        export_dataset(store_path, "d3rlpy", file, query=SLIP, continuous=continuous)
    for continuous, found in zip(files, read_with("d3rlpy", *files.values()), strict=True):
        expected, counts = read_trajectories(store_path, query=SLIP, continuous=continuous)
        assert found["transitions"] == counts.transitions
        assert found["discrete"] != continuous
        for episode, t in zip(found["episodes"], expected, strict=True):
            assert episode["terminated"] == t.terminated
            actions = np.reshape(episode["actions"], t.actions.shape)
            np.testing.assert_allclose(actions, t.actions, rtol=1e-6)
            np.testing.assert_allclose(episode["rewards"], t.rewards, rtol=1e-6)
            np.testing.assert_allclose(episode["first"], t.observations[:-1, 0], rtol=1e-6)
            # d3rlpy gives zeros after a terminal step.
            steps = slice(1, -1) if t.terminated else slice(1, None)
            expected_next = t.observations[steps, 0]
            np.testing.assert_allclose(episode["next_first"][: len(expected_next)], expected_next)
            assert episode["terminal"] == [0.0] * (len(t) - 1) + [float(t.terminated)]


@pytest.mark.long  # starts another Python
def test_lerobot_reads_export(store_path, tmp_path, transitions):
    export_dataset(store_path, "lerobot", tmp_path / "a")
    found = read_with("lerobot", tmp_path / "a")
    rows = ordered(transitions)
    assert found["fps"] == 1 / TASK.control_period_s
    for name, column in (
        ("action", "action"),
        ("terminated", "terminated"),
        ("truncated", "truncated"),
        ("transition_id", "transition_id"),
        ("condition", "condition"),
    ):
        assert found[name] == rows[column].to_pylist()
    np.testing.assert_allclose(found["reward"], rows["reward"].to_numpy(), rtol=1e-6)
    np.testing.assert_allclose(found["mean_reward"], rows["reward"].to_numpy().mean(), rtol=1e-5)
    for name, column in (("first", "observation"), ("next_first", "next_observation")):
        np.testing.assert_allclose(found[name], matrix(rows[column])[:, 0], rtol=1e-6)
    assert len(found["lengths"]) == found["episodes"]
    begin = found["lengths"][0]
    assert found["chunk"] == found["action"][begin : begin + 2]


STATE = "{'x.vel': wheel_speed_mps, 'theta.vel': degrees(wheel_yaw_rate_radps)}"


def test_lerobot_state_from_chosen_signals(store_path, tmp_path, transitions):
    query = f'SELECT *, {STATE} AS "observation.state" FROM transitions'
    document = export_dataset(store_path, "lerobot", tmp_path / "a", query=query, continuous=True)
    info = json.loads((tmp_path / "a/meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] == ["x.vel", "theta.vel"]
    assert info["features"]["observation.state"]["shape"] == [2]
    assert "next.observation.state" not in info["features"]
    rows = ordered(transitions)
    with open_recording(tmp_path / "a") as recording:  # an export can be read as a recording
        state = recording.read({"/observation.state": ["x_vel", "theta_vel"]})["/observation.state"]
        command = recording.read({"/action": ["command_speed_mps"]})["/action"]
    assert document["transitions"] == len(state) == len(rows)
    np.testing.assert_allclose(state.fields["x_vel"], rows["wheel_speed_mps"], rtol=1e-6)
    turn = np.degrees(rows["wheel_yaw_rate_radps"])
    np.testing.assert_allclose(state.fields["theta_vel"], turn, rtol=1e-6)
    np.testing.assert_allclose(
        command.fields["command_speed_mps"], rows["command_speed_mps"], rtol=1e-6
    )


def test_rows_with_unknown_state_are_left_out(store_path, tmp_path, transitions):
    speed = "CASE step_index WHEN 3 THEN NULL WHEN 4 THEN 'nan'::FLOAT ELSE wheel_speed_mps END"
    query = f"""SELECT *, {{'v': {speed}}} AS "observation.state" FROM transitions"""
    document = export_dataset(store_path, "lerobot", tmp_path / "a", query=query)
    steps = np.asarray(transitions["step_index"])
    unknown = int(((steps == 3) | (steps == 4)).sum())
    assert document["left_out"] == {"observation.state is not known": unknown}
    assert document["transitions"] == len(transitions) - unknown
    assert document["cut"] > 0


@pytest.mark.parametrize(
    ("to", "state", "words"),
    [
        ("lerobot", "wheel_speed_mps", "its observation.state is a FLOAT, not numbers by name"),
        ("lerobot", "{'zone': zone}", "not numbers by name"),
        ("lerobot", "{'v': NULL::FLOAT}", "rows has observation.state"),
        ("parquet", STATE, "the format parquet holds the task's observation"),
    ],
)
def test_invalid_state_is_refused(store_path, tmp_path, to, state, words):
    query = f'SELECT *, {state} AS "observation.state" FROM transitions'
    out = tmp_path / ("a.parquet" if to == "parquet" else "a")
    with pytest.raises((QueryError, StoreError), match=words):
        export_dataset(store_path, to, out, query=query)
    assert not out.exists()


def test_lerobot_layout_is_complete(store_path, tmp_path):
    out = tmp_path / "a"
    document = export_dataset(store_path, "lerobot", out)
    info = json.loads((out / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["total_frames"] == document["transitions"]
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for episode in episodes:
        path = info["data_path"].format(
            chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"]
        )
        frames = pq.read_table(
            out / path, filters=[("episode_index", "==", episode["episode_index"])]
        )
        span = range(episode["dataset_from_index"], episode["dataset_to_index"])
        assert frames["index"].to_pylist() == list(span)
        assert set(frames.column_names) == set(info["features"])
    stats = json.loads((out / "meta/stats.json").read_text())
    reward = pq.ParquetDataset(out / "data").read()["next.reward"].to_numpy()
    np.testing.assert_allclose(stats["next.reward"]["mean"], reward.mean(), rtol=1e-5)
    np.testing.assert_allclose(stats["next.reward"]["std"], reward.std(), rtol=1e-5)
    pytest.importorskip("pandas")  # tasks are the index of a data frame
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pandas()
    assert tasks.iloc[0].name.startswith("Drive along")


def replacing(column: str, value: str) -> dict[str, str]:
    return {"query": f"SELECT * REPLACE ({value} AS {column}) FROM transitions"}


def without(*columns: str) -> dict[str, str]:
    return {"query": f"SELECT * EXCLUDE ({', '.join(columns)}) FROM transitions;"}


REFUSED: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"to": "tfrecord"}, StoreError, "tfrecord"),
    ({"out": "a.zip"}, StoreError, ".parquet"),
    ({"query": "FROM transitions WHERE false"}, StoreError, "no rows"),
    ({"query": "FROM transitions UNION ALL FROM transitions"}, StoreError, "twice"),
    ({"query": "COPY transitions TO 'a.csv'"}, QueryError, "read-only"),
    ({"query": "FROM nowhere"}, QueryError, "nowhere"),
    (without("next_observation", "truncated"), QueryError, "no next_observation, truncated"),
    (without("command_speed_mps") | {"continuous": True}, QueryError, "no command_speed_mps"),
    (replacing("observation", "1.5"), QueryError, "observation"),
    # Regressions: a ValueError, an episode end in every row, and an action of 2.
    (replacing("action", "'a'"), QueryError, "action"),
    (replacing("terminated", "'no'"), QueryError, "terminated"),
    (replacing("action", "2.5"), QueryError, "action"),
    (replacing("reward", "'1'"), QueryError, "reward"),
    (replacing("next_observation", "['a']"), QueryError, "next_observation"),
    (replacing("action", "99"), StoreError, "99 to 99"),
    (replacing("observation", "observation[1:3]"), StoreError, "3 entries"),
    (
        replacing("next_observation", "observation[1:3] AS observation, observation[1:3]"),
        StoreError,
        "3 entries, those of its task 28",
    ),
    (replacing("reward", "NULL::FLOAT"), StoreError, "no reward"),
    (replacing("reward", "'nan'::FLOAT"), StoreError, "reward that is not a number"),
    (replacing("reward", "error('boom')::FLOAT"), QueryError, "boom"),
]


@pytest.mark.parametrize(("given", "error", "named"), REFUSED)
def test_invalid_exports_are_refused(given, error, named, store_path, tmp_path):
    given = {"to": "parquet", "out": "a.parquet"} | given
    with pytest.raises(error, match=re.escape(named)):
        export_dataset(store_path, given.pop("to"), tmp_path / given.pop("out"), **given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("to", ["minari", "d3rlpy"])
def test_hdf5_export_stops_before_disk_is_full(to, store_path, tmp_path, monkeypatch):
    pytest.importorskip(FORMATS[to][1])
    free = iter([10**10, 10**10, 2**20])  # less after each episode
    monkeypatch.setattr(
        "shutil.disk_usage", lambda path: SimpleNamespace(free=next(free), path=path)
    )
    out = tmp_path / ("out.h5" if to == "d3rlpy" else "out")
    with pytest.raises(StoreError, match=r"nearly full: 1 MiB are free") as refused:
        export_dataset(store_path, to, out)
    assert refused.value.where == str(out)
    assert not list(tmp_path.iterdir())


def test_panel_exports_same_rows_as_query(store_path, tmp_path):
    panel = n_step_panel(store_path, tmp_path / "panel", 1, "where = \"zone = 'cross'\"\n")
    alone, beside = tmp_path / "a.parquet", tmp_path / "b.parquet"
    export_dataset(panel.path, "parquet", alone, continuous=True)
    query = "FROM transitions SEMI JOIN panel.rows USING (transition_id)"
    document = export_dataset(
        store_path, "parquet", beside, query=query, panel=panel.path, continuous=True
    )
    assert document["transitions"] == len(panel)
    assert document["provenance"]["panel"] == panel.id
    for name in ("transition_id", "action", "next_observation"):
        assert pq.read_table(alone)[name].equals(pq.read_table(beside)[name])
    with pytest.raises(PanelError, match="only a panel of one store"):
        export_dataset(panel.path, "parquet", tmp_path / "c.parquet", query=query)


def test_export_verb_reports_counts(store_path, tmp_path, shell):
    out = tmp_path / "a.parquet"
    document = shell.json("export", store_path, "--to", "parquet", "--out", out)
    assert document["transitions"] == document["rows"] == pq.read_metadata(out).num_rows
    arguments = ["export", str(store_path), "--to", "parquet", "--out", str(tmp_path / "b.parquet")]
    assert "cut where rows are missing" in shell.out(*arguments, "--query", SLIP)
    out, err = shell.printed(*arguments, code=ExitCode.USAGE)
    assert "already there" in err
    assert out == ""


def test_missing_library_names_install_command(store_path, tmp_path, monkeypatch):
    find = importlib.util.find_spec

    def absent(name: str, package: str | None = None) -> Any:
        return None if name == "h5py" else find(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", absent)
    with pytest.raises(ConfigError, match=re.escape(install_command("libraries"))):
        export_dataset(store_path, "d3rlpy", tmp_path / "logs.h5")
