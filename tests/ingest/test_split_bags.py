"""A bag of several files: which parts are missing, empty, copied or under another name."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from support.bag_samples import STORE, TOPICS, compress_files, messages

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

PARTS = 3
EACH = 70  # messages of a part


def split_bag(folder: Path, ending: str = "db3") -> Path:
    """Write a bag of three parts, with the metadata.yaml of all of them."""
    folder.mkdir()
    every = list(messages(10 * PARTS))
    plugin = StoragePlugin.SQLITE3 if ending == "db3" else StoragePlugin.MCAP
    for part in range(PARTS):
        written = folder.parent / f"{folder.name}-part-{part}"
        with BagWriter(written, version=9, storage_plugin=plugin) as bag:
            add = bag.add_connection
            to = {topic: add(topic, kind, typestore=STORE) for topic, kind in TOPICS.items()}
            for topic, log, message in every[part * EACH : (part + 1) * EACH]:
                bag.write(to[topic], log, STORE.serialize_cdr(message, TOPICS[topic]))
        (file,) = written.glob(f"*.{ending}")
        file.rename(folder / f"{folder.name}_{part}.{ending}")
    listed = "\n".join(f"  - {folder.name}_{part}.{ending}" for part in range(PARTS))
    text = (written / "metadata.yaml").read_text()
    head, _, rest = text.partition("  relative_file_paths:\n")
    _, _, rest = rest.partition("\n")
    text = f"{head}  relative_file_paths:\n{listed}\n{rest}"
    text = text.replace("message_count: 10\n", f"message_count: {10 * PARTS}\n")
    (folder / "metadata.yaml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("split")
    (folder / "mcap").mkdir()
    return {"db3": split_bag(folder / "run"), "mcap": split_bag(folder / "mcap" / "run", "mcap")}


@pytest.fixture
def split(whole: dict[str, Path], tmp_path: Path) -> Callable[..., Path]:
    """Return a function: it returns a copy of the bag to spoil."""
    return lambda ending="db3": shutil.copytree(whole[ending], tmp_path / "run")


def without_metadata(folder: Path) -> None:
    (folder / "metadata.yaml").unlink()


def part(folder: Path, number: int) -> Path:
    return next(folder.glob(f"{folder.name}_{number}.*"))


def seen(folder: Path, **options: bool) -> tuple[int, list[str], list[str]]:
    with open_recording(folder, **options) as recording:
        return recording.messages, [item.what for item in recording.damage], recording.notes


@pytest.mark.parametrize("ending", ["db3", "mcap"])
def test_a_whole_bag_is_whole(split, ending):
    folder = split(ending)
    assert seen(folder) == (PARTS * EACH, [], [])
    without_metadata(folder)
    assert seen(folder)[:2] == (PARTS * EACH, [])


@pytest.mark.parametrize("ending", ["db3", "mcap"])
@pytest.mark.parametrize("number", [0, 1])
def test_a_part_that_is_missing_is_damage(split, ending, number, shell):
    folder = split(ending)
    part(folder, number).unlink()
    count, damage, _ = seen(folder)
    assert count == 2 * EACH
    assert damage[0] == f"metadata.yaml lists run_{number}.{ending}, which is missing"
    assert not any("numbers" in what for what in damage)
    without_metadata(folder)
    count, damage, _ = seen(folder)
    assert count == 2 * EACH
    assert damage == [f"run_{number}.{ending} is missing, by the numbers of its files"]
    assert f"run_{number}.{ending}" in shell.err("info", folder, code=3)


@pytest.mark.parametrize("number", [0, 1])
def test_only_a_hole_is_damage_despite_the_metadata(split, number):
    """As `ros2 bag reindex` makes it, of what is there; a recorder may keep the last parts."""
    folder = split()
    part(folder, number).unlink()
    text = (folder / "metadata.yaml").read_text()
    text = text.replace(f"  - run_{number}.db3\n", "").replace("count: 30\n", "count: 20\n")
    (folder / "metadata.yaml").write_text(text)
    damage = ["run_1.db3 is missing, by the numbers of its files"] if number else []
    assert seen(folder) == (2 * EACH, damage, [])


def rename(folder: Path) -> None:
    part(folder, 1).rename(folder / "middle.db3")


def rename_all(folder: Path) -> None:
    for number in range(PARTS):
        part(folder, number).rename(folder / f"drive_{number}.db3")


@pytest.mark.parametrize("change", [rename, rename_all])
def test_another_name_is_no_damage_where_every_message_is_there(split, change: Callable):
    folder = split()
    change(folder)
    count, damage, notes = seen(folder)
    assert (count, damage) == (PARTS * EACH, [])
    assert any("run_1.db3" in note for note in notes)


def copy(folder: Path) -> None:
    shutil.copy(part(folder, 1), folder / "run_1 (copy).db3")


def copy_as_next(folder: Path) -> None:
    shutil.copy(part(folder, 2), folder / "run_3.db3")


def compress_too(folder: Path) -> None:
    plain = {file: file.read_bytes() for file in folder.glob("*.db3")}
    compress_files(folder)
    for file, content in plain.items():
        file.write_bytes(content)


@pytest.mark.parametrize("change", [copy, copy_as_next, compress_too])
@pytest.mark.parametrize("metadata", [True, False])
def test_a_copy_is_counted_once_and_named(split, change: Callable, metadata):
    folder = split()
    change(folder)
    if not metadata:
        without_metadata(folder)
    if change is copy and not metadata:
        return  # its name is none of a part: the files are several recordings
    count, damage, notes = seen(folder)
    assert (count, damage) == (PARTS * EACH, [])
    assert any("read once" in note for note in notes)


def test_a_part_without_bytes_is_refused_and_named_with_salvage(split):
    folder = split()
    without_metadata(folder)
    part(folder, 1).write_bytes(b"")
    with pytest.raises(RecordingError, match=r"run_1\.db3: an empty file"):
        open_recording(folder)
    count, damage, _ = seen(folder, salvage=True)
    assert count == 2 * EACH
    assert damage == ["run_1.db3: an empty file"]
    part(folder, 0).write_bytes(b"")
    part(folder, 2).write_bytes(b"")
    with pytest.raises(RecordingError, match=r"run_0\.db3: an empty file"):
        open_recording(folder, salvage=True)


def test_a_part_without_messages_before_the_last_is_damage(split, tmp_path):
    folder = split()
    without_metadata(folder)
    empty = tmp_path / "empty"
    with BagWriter(empty, version=9) as bag:
        bag.add_connection("/policy", TOPICS["/policy"], typestore=STORE)
    (file,) = empty.glob("*.db3")
    shutil.copy(file, folder / "run_3.db3")  # the last: nothing more came
    assert seen(folder)[:2] == (PARTS * EACH, [])
    shutil.copy(file, part(folder, 1))
    assert seen(folder)[:2] == (2 * EACH, ["run_1.db3 holds no message"])
