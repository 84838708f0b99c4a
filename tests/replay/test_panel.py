"""Panels: rows of their store, n-step returns, ids, checksums, and builds all or nothing."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import panel_of
from support.stores import CONDITIONS, TASK, manifest, recording_transitions, write_store

from restock.errors import PanelError, RestockError, StoreError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.task import Task
from restock.replay.mixture.mixture import Mixture, load_mixture, parse_mixture
from restock.replay.panel import build, pack
from restock.replay.panel import panel as panel_module
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import ROWS, Panel
from restock.replay.plan import candidates
from restock.replay.sampling.packed_rows import PACKING_VERSION
from restock.replay.store.store import Store


def uniform(**changes: object) -> Mixture:
    changes.setdefault("uncertain", "keep")
    split = f"[evaluation_split]\nby = '{changes.pop('by', 'none')}'\n"
    text = f"[each_condition]\nshare = 'natural'\n{split}"
    top = "".join(f"{name} = {json.dumps(value)}\n" for name, value in changes.items())
    return parse_mixture(top + text)


def by_episode(table: pa.Table) -> dict[str, list[dict[str, object]]]:
    rows: dict[str, list[dict[str, object]]] = {}
    for row in table.sort_by(
        [("episode_id", "ascending"), ("step_index", "ascending")]
    ).to_pylist():
        rows.setdefault(str(row["episode_id"]), []).append(row)
    return rows


@pytest.mark.parametrize("n_step", [1, 3, 7])
def test_packed_rows_match_naive_computation(transitions, tmp_path, n_step):
    # Shuffled, because a store's files come in any order; and with a step missing.
    order = np.random.default_rng(0).permutation(len(transitions))
    shuffled = transitions.take(pa.array(order)).filter(
        pa.array(transitions["transition_id"].to_numpy()[order] != (2 << 25) + 40)
    )
    mixture = uniform(n_step=n_step, discount=0.9)
    panel = build_panel(shuffled, mixture, tmp_path / "p", task=TASK)
    assert len(panel) == len(transitions) - 1
    episodes = by_episode(shuffled)
    part = panel.columns
    for packed, meta in zip(panel.rows, panel.meta.to_pylist(), strict=True):
        episode = episodes[meta["episode_id"]]
        at = next(i for i, r in enumerate(episode) if r["step_index"] == meta["step_index"])
        span = episode[at : at + n_step]
        for index in range(1, len(span)):
            if span[index]["step_index"] != span[0]["step_index"] + index:
                span = span[:index]
                break
        assert meta["transition_id"] == span[0]["transition_id"]
        assert meta["horizon"] == len(span)
        expected = sum(0.9**k * row["reward"] for k, row in enumerate(span))
        np.testing.assert_allclose(packed[part["reward"]], expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(packed[part["observation"]], span[0]["observation"])
        np.testing.assert_array_equal(
            packed[part["next_observation"]], span[-1]["next_observation"]
        )
        assert packed[part["action"]] == span[0]["action"]
        np.testing.assert_allclose(
            packed[part["discount"]], 0.9 ** len(span) * (not span[-1]["terminated"]), rtol=1e-6
        )


def handed_over(table: pa.Table) -> pa.Table:
    """Return an episode that terminates, whose operator takes over at step 5."""
    rows = np.arange(len(table))
    return replaced(
        table,
        {
            "behaviour_policy": np.where(rows < 5, "planner", "operator").tolist(),
            "terminated": rows == rows[-1],
            "truncated": np.zeros(len(rows), np.bool_),
        },
    )


def test_returns_stop_at_handover(tmp_path):
    table = handed_over(recording_transitions(1, episodes=1))
    panel = build_panel(table, uniform(n_step=4), tmp_path / "p")
    assert panel.meta["horizon"].to_pylist()[:6] == [4, 4, 3, 2, 1, 4]


def test_returns_stop_before_unlikely_actions(tmp_path):
    table = recording_transitions(1, episodes=1)
    # Five actions: chance is 0.2. An exploring step can only be the first of its return.
    probability = np.where(np.arange(len(table)) == 5, 0.1, 0.9)
    probability[7] = 0.2
    table = replaced(table, {"action_probability": probability})
    panel = build_panel(table, uniform(n_step=4), tmp_path / "p", task=TASK)
    assert panel.meta["horizon"].to_pylist()[:8] == [4, 4, 3, 2, 1, 4, 4, 4]
    # Without the task, chance is unknown.
    blind = build_panel(table, uniform(n_step=4), tmp_path / "q")
    assert blind.meta["horizon"].to_pylist()[:8] == [4] * 8


@pytest.mark.parametrize("whole_file", [True, False])
def test_small_batches_pack_same_bytes(tmp_path, monkeypatch, whole_file):
    tables = [recording_transitions(index, episodes=90) for index in (3, 1, 2)]
    table = pa.concat_tables(tables)  # some 9,000 rows, more than DuckDB gives at a time
    if not whole_file:
        table = table.take(pa.array(np.random.default_rng(0).permutation(len(table))))
    mixture = uniform(n_step=5, by="episode")
    at_once = build_panel(table, mixture, tmp_path / "a", task=TASK)
    for module, name, value in (
        (candidates, "STRETCH", 64),
        (candidates, "BATCH_ROWS", 2048),
        (pack, "BATCH_BYTES", 2048 * 8 * TASK.observation_size),
        (pack, "ROW_GROUP_ROWS", 1000),
    ):
        monkeypatch.setattr(module, name, value)
    by_parts = build_panel(table, mixture, tmp_path / "b", task=TASK)
    np.testing.assert_array_equal(at_once.rows, by_parts.rows)
    assert at_once.meta.to_pylist() == by_parts.meta.to_pylist()
    assert at_once.id == by_parts.id
    held = [pq.read_table(panel.path / "evaluation_split.parquet") for panel in (at_once, by_parts)]
    assert held[0].to_pylist() == held[1].to_pylist()


def test_arbitrary_transition_ids_are_accepted(transitions, tmp_path):
    # Ids of three recordings mixed: the runs of rising ids overlap.
    ids = np.random.default_rng(1).permutation(len(transitions))
    panel = build_panel(replaced(transitions, {"transition_id": ids}), uniform(), tmp_path / "p")
    plain = build_panel(transitions, uniform(), tmp_path / "q")
    np.testing.assert_array_equal(panel.rows, plain.rows)


def test_non_finite_row_is_refused(transitions, tmp_path):
    rows = transitions["next_observation"].to_pylist()
    rows[7] = [float("nan"), *rows[7][1:]]
    table = replaced(transitions, {"next_observation": rows})
    with pytest.raises(PanelError, match="isfinite") as caught:
        build_panel(table, uniform(), tmp_path / "p")
    where = str(caught.value).split('where = "')[1].split('"')[0]
    assert len(build_panel(table, uniform(where=where), tmp_path / "p")) == len(table) - 1


def test_store_and_table_pack_same_rows(transitions, store_path, tmp_path):
    mixture = load_mixture("coverage")
    from_table = build_panel(transitions, mixture, tmp_path / "a", task=TASK)
    from_store = panel_of(store_path, mixture, tmp_path / "b")
    np.testing.assert_array_equal(from_table.rows, from_store.rows)
    assert from_table.meta.equals(from_store.meta)
    assert from_store.task == TASK
    assert from_store.task_hash == TASK.hash
    assert from_store.store_version == 2
    assert from_store.header.profile == "warehouse_amr"  # training finds the task by this name
    assert from_table.header.profile == ""


def test_id_depends_on_content_and_packing_version(transitions, tmp_path, monkeypatch):
    def id_of(name: str, **changes: object) -> str:
        return build_panel(transitions, uniform(**changes), tmp_path / name).id

    first = id_of("a")
    assert id_of("b") == first
    other_ids = {id_of("c", n_step=2), id_of("d", seed=1, by="episode")}
    other_ids.add(id_of("e", seed=2, by="episode"))
    for module in (build, panel_module):
        monkeypatch.setattr(module, "PACKING_VERSION", PACKING_VERSION + 1)
    other_ids.add(id_of("f"))
    assert len(other_ids | {first}) == 5
    with pytest.raises(PanelError, match="make it again"):  # packed by another version of Restock
        Panel.open(tmp_path / "a")


def test_rows_of_two_tasks_need_filter(tmp_path):
    other = Task(body=TASK.body, actions=TASK.actions, sectors=6)
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    write_store(path, [recording_transitions(2, task=other)], task=other)
    with Store(path) as store:
        with pytest.raises(StoreError, match="2 tasks"):
            build_panel(store, uniform(), tmp_path / "p")
        mixture = uniform(where=f"task_hash = '{other.hash}'")
        panel = build_panel(store, mixture, tmp_path / "p")
    assert panel.task == other
    assert panel.observation_size == other.observation_size


def test_existing_panel_is_kept_unless_forced(transitions, tmp_path):
    first = build_panel(transitions, uniform(), tmp_path / "p")
    (tmp_path / "mine").mkdir()
    for out, force in (("p", False), ("mine", True), ("p/other", False)):
        with pytest.raises(PanelError) as refused:
            build_panel(transitions, uniform(n_step=3), tmp_path / out, force=force)
        assert str(refused.value.where) == str(tmp_path / out)
    assert Panel.open(tmp_path / "p").id == first.id
    assert build_panel(transitions, uniform(n_step=3), tmp_path / "p", force=True).id != first.id
    (tmp_path / "p").chmod(0o755)
    (tmp_path / "p" / "notes.txt").write_text("mine")
    with pytest.raises(PanelError, match=r"notes\.txt"):
        build_panel(transitions, uniform(), tmp_path / "p", force=True)
    assert (tmp_path / "p" / "notes.txt").read_text() == "mine"


def test_interrupted_build_leaves_nothing(transitions, tmp_path, monkeypatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "_header", interrupt)
    with pytest.raises(KeyboardInterrupt):
        build_panel(transitions, uniform(), tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_slower_of_two_builders_is_refused(transitions, tmp_path, monkeypatch):
    write_meta = pack.Packer.write_meta

    def meanwhile(*args: Path) -> None:
        monkeypatch.undo()
        build_panel(transitions, uniform(), tmp_path / "p")
        write_meta(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(pack.Packer, "write_meta", meanwhile)
    with pytest.raises(PanelError, match="another process built it first"):
        build_panel(transitions, uniform(), tmp_path / "p")
    assert [path.name for path in tmp_path.iterdir()] == ["p"]
    Panel.open(tmp_path / "p", verify=True)


def test_killed_build_does_not_block_next(transitions, tmp_path):
    table = tmp_path / "rows.parquet"
    pq.write_table(transitions, table)
    code = (
        "import os, signal, sys, pyarrow.parquet as pq\n"
        "from restock.replay.panel import build, pack\n"
        "from restock.replay.mixture.mixture import load_mixture\n"
        "pack.Packer.write_meta = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "build.build_panel(pq.read_table(sys.argv[1]), load_mixture('uniform'), sys.argv[2])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(table), str(tmp_path / "p")])
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "p").exists()
    assert len(list(tmp_path.iterdir())) == 2  # the table, and what the build had begun
    build_panel(transitions, uniform(), tmp_path / "p")
    assert {path.name for path in tmp_path.iterdir()} == {"rows.parquet", "p"}


GOLDEN = """
n_step = 3
uncertain = "keep"
evaluation_split = {by = "episode", share = 0.2}
[correction]
pre = "full"
post = "full"
below_natural = "allow"
[each_condition]
share = "equal"
"""


def test_packed_bytes_match_packing_version(transitions, tmp_path):
    """Check the packed bytes: if they change, raise PACKING_VERSION and update the values here."""
    panel = build_panel(
        transitions, parse_mixture(GOLDEN), tmp_path / "p", task=TASK, conditions=CONDITIONS
    )
    digest = hashlib.blake2b(digest_size=16)
    for table in (panel.meta, pq.read_table(panel.path / "evaluation_split.parquet")):
        digest.update(json.dumps(table.drop_columns(["robot", "site"]).to_pydict()).encode())
    rows = hashlib.blake2b((panel.path / ROWS).read_bytes(), digest_size=16)
    packed = [PACKING_VERSION, rows.hexdigest(), digest.hexdigest()]
    assert packed == [6, "8ef3c35f31805b369d555229e0ebe493", "35aac5b0b670221e5b2602639b4f2d7b"]
    assert panel.header.packing_version == PACKING_VERSION


def changed(path: Path, content: bytes) -> None:
    path.chmod(0o644)
    path.write_bytes(content)


def test_damaged_panel_is_refused(transitions, tmp_path, shell):
    panel = build_panel(transitions, uniform(), tmp_path / "p")
    rows, header = panel.path / ROWS, panel.path / "panel.json"
    assert not rows.stat().st_mode & 0o222
    assert panel.id in shell.err("store", "verify", panel.path, code=0)
    good, text = rows.read_bytes(), header.read_bytes()
    between = bytearray(good)
    between[6000] ^= 1  # between two of the blocks that opening a panel checks
    changed(rows, bytes(between))
    Panel.open(panel.path)
    assert str(rows) in "".join(shell.err("store", "verify", panel.path).split())
    for path, content, problem in (
        (rows, good[:-1] + bytes([good[-1] ^ 1]), "checksum"),
        (rows, good[:-4], "bytes, not the"),
        (header, text.replace(b'"n_step": 1', b'"n_step": 2'), "changed after it was written"),
        (header, b'{"id": 3}', "damaged"),
    ):
        changed(rows, good)
        changed(header, text)
        changed(path, content)
        with pytest.raises(PanelError, match=problem):
            Panel.open(panel.path)
    changed(header, text)
    for path, problem in ((rows, "missing"), (header, "not a panel")):
        path.unlink()
        with pytest.raises(PanelError, match=problem):
            Panel.open(panel.path)
    with pytest.raises(PanelError, match="no such panel"):
        Panel.open(tmp_path / "nowhere")


def test_panel_rows_are_read_only(transitions, tmp_path):
    panel = build_panel(transitions, uniform(), tmp_path / "p")
    with pytest.raises(ValueError, match="read-only"):
        panel.rows[0, 0] = 1.0


MEASURED = """
import resource, sys
import scipy.optimize, scipy.special  # before the limit, which is for data
from pathlib import Path
from restock.replay.panel.build import build_panel
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.plan import candidates
from restock.replay.store.store import Store

text = "n_step = 3\\nevaluation_split = {by = 'none'}\\n[each_condition]"
mixture = parse_mixture(text)
with Store(sys.argv[1], memory_limit="110MB") as store:
    store.sql("SET threads = 1")
    status = Path("/proc/self/status").read_text().split("VmData:")[1].split()[0]
    limit = int(status) * 1024 + int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    build_panel(store, mixture, sys.argv[2])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_store_larger_than_memory_is_packed(tmp_path):
    task = Task(body=TASK.body, actions=TASK.actions, sectors=76)
    limit = 480 << 20  # bytes beyond those of the process with an open store
    first = recording_transitions(1, episodes=1500, task=task)
    recordings = []
    for number in range(1, 17):
        name = f"{number:016x}"
        recordings.append(
            replaced(
                first,
                {
                    "transition_id": (np.int64(number) << 25) + np.arange(len(first)),
                    "recording_id": [name] * len(first),
                    "episode_id": [f"{name}/{e}" for e in first["episode_index"].to_pylist()],
                    "ingest_id": [f"{name}-a"] * len(first),
                },
            )
        )
    store = tmp_path / "store"
    StoreWriter(store).write_all((manifest(table, task=task), table) for table in recordings)
    command = [sys.executable, "-c", MEASURED, str(store), str(tmp_path / "p"), str(limit)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    panel = Panel.open(tmp_path / "p", verify=True)
    assert panel.rows.nbytes > 2 * limit
    order = np.random.default_rng(0).integers(len(panel), size=50)
    ids = panel.meta_column("transition_id")
    observation = first["observation"].combine_chunks()
    for row in order:
        expected = observation[int(ids[row]) & ((1 << 25) - 1)].as_py()
        np.testing.assert_array_equal(panel.rows[row, panel.columns["observation"]], expected)


def test_invalid_tables_are_refused(transitions, tmp_path):
    texts = pa.array(["1"] * len(transitions))
    place = transitions.column_names.index
    for table, named in (
        (pa.table({}), "must be a Store or a table"),
        (transitions.to_pylist(), "must be a Store or a table"),
        (transitions.drop_columns(["observation", "pose_x_m"]), "observation, pose_x_m"),
        (transitions.set_column(place("observation"), "observation", texts), "observation"),
        (transitions.set_column(place("reward"), "reward", texts), "reward"),
        (recording_transitions(1), "cannot be split"),  # there is only one recording
    ):
        with pytest.raises(RestockError, match=named):
            build_panel(table, uniform(by="recording"), tmp_path / "panel", task=TASK)
        assert not list(tmp_path.iterdir())


def test_compatible_column_types_are_accepted(transitions, tmp_path):
    table = transitions
    for name, kind in {
        "reward": pa.float64(),
        "zone": pa.dictionary(pa.int32(), pa.string()),
        "terminated": pa.int8(),
        "observation": pa.list_(pa.float64()),
        "behaviour_version": pa.null(),
    }.items():
        column = pa.nulls(len(table)) if kind == pa.null() else table[name].cast(kind)
        table = table.set_column(table.column_names.index(name), name, column)
    panel = panel_of(table, uniform(), tmp_path / "panel", task=TASK, conditions=CONDITIONS)
    same = panel_of(transitions, uniform(), tmp_path / "same", task=TASK, conditions=CONDITIONS)
    np.testing.assert_array_equal(panel.rows[:, :-1], same.rows[:, :-1])
