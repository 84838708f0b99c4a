"""Bags of several files: missing, empty, copied and renamed parts."""

import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from support.bag_samples import STORE, TOPICS, compress_files, messages

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

PARTS = 3
EACH = 70  # messages per part


def split_bag(folder: Path, ending: str = "db3") -> Path:
    """Write a bag of three parts, with one metadata.yaml for all of them."""
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
def intact_bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("split")
    (folder / "mcap").mkdir()
    return {"db3": split_bag(folder / "run"), "mcap": split_bag(folder / "mcap" / "run", "mcap")}


@pytest.fixture
def split(intact_bags: dict[str, Path], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that copies the bag, so that the copy can be damaged."""
    return lambda ending="db3": shutil.copytree(intact_bags[ending], tmp_path / "run")


def remove_metadata(folder: Path) -> None:
    (folder / "metadata.yaml").unlink()


def part(folder: Path, number: int) -> Path:
    return next(folder.glob(f"{folder.name}_{number}.*"))


def open_and_describe(folder: Path, **options: bool) -> tuple[int, list[str], list[str]]:
    with open_recording(folder, **options) as recording:
        return recording.messages, [item.what for item in recording.damage], recording.notes


@pytest.mark.parametrize("ending", ["db3", "mcap"])
def test_complete_bag_has_no_damage(split, ending):
    folder = split(ending)
    assert open_and_describe(folder) == (PARTS * EACH, [], [])
    remove_metadata(folder)
    assert open_and_describe(folder)[:2] == (PARTS * EACH, [])


@pytest.mark.parametrize("ending", ["db3", "mcap"])
@pytest.mark.parametrize("number", [0, 1])
def test_missing_part_is_damage(split, ending, number, shell):
    folder = split(ending)
    part(folder, number).unlink()
    count, damage, _ = open_and_describe(folder)
    assert count == 2 * EACH
    assert damage[0] == f"metadata.yaml lists run_{number}.{ending}, which is missing"
    assert not any("numbers" in text for text in damage)
    remove_metadata(folder)
    count, damage, _ = open_and_describe(folder)
    assert count == 2 * EACH
    assert damage == [f"run_{number}.{ending} is missing, by the numbers of its files"]
    assert f"run_{number}.{ending}" in shell.err("info", folder, code=3)


@pytest.mark.parametrize("number", [0, 1])
def test_only_a_gap_in_numbers_is_damage_after_reindex(split, number):
    """`ros2 bag reindex` lists the existing files; a recorder may keep only the last parts."""
    folder = split()
    part(folder, number).unlink()
    text = (folder / "metadata.yaml").read_text()
    text = text.replace(f"  - run_{number}.db3\n", "").replace("count: 30\n", "count: 20\n")
    (folder / "metadata.yaml").write_text(text)
    damage = ["run_1.db3 is missing, by the numbers of its files"] if number else []
    assert open_and_describe(folder) == (2 * EACH, damage, [])


def rename_part(folder: Path) -> None:
    part(folder, 1).rename(folder / "middle.db3")


def rename_parts(folder: Path) -> None:
    for number in range(PARTS):
        part(folder, number).rename(folder / f"drive_{number}.db3")


@pytest.mark.parametrize("change", [rename_part, rename_parts])
def test_renamed_parts_are_not_damage(split, change: Callable):
    folder = split()
    change(folder)
    count, damage, notes = open_and_describe(folder)
    assert (count, damage) == (PARTS * EACH, [])
    assert any("run_1.db3" in note for note in notes)


def copy_part(folder: Path) -> None:
    shutil.copy(part(folder, 1), folder / "run_1 (copy).db3")


def copy_as_next_part(folder: Path) -> None:
    shutil.copy(part(folder, 2), folder / "run_3.db3")


def keep_compressed_too(folder: Path) -> None:
    plain = {file: file.read_bytes() for file in folder.glob("*.db3")}
    compress_files(folder)
    for file, content in plain.items():
        file.write_bytes(content)


@pytest.mark.parametrize(
    ("change", "metadata"),
    [
        (copy_part, True),  # without metadata, a file of another name is a separate recording
        *product([copy_as_next_part, keep_compressed_too], [True, False]),
    ],
)
def test_copied_part_is_read_once_and_noted(split, change: Callable, metadata):
    folder = split()
    change(folder)
    if not metadata:
        remove_metadata(folder)
    count, damage, notes = open_and_describe(folder)
    assert (count, damage) == (PARTS * EACH, [])
    assert any("read once" in note for note in notes)


def test_empty_part_is_rejected_or_reported_by_salvage(split):
    folder = split()
    remove_metadata(folder)
    part(folder, 1).write_bytes(b"")
    with pytest.raises(RecordingError, match=r"run_1\.db3: an empty file"):
        open_recording(folder)
    count, damage, _ = open_and_describe(folder, salvage=True)
    assert count == 2 * EACH
    assert damage == ["run_1.db3: an empty file"]
    part(folder, 0).write_bytes(b"")
    part(folder, 2).write_bytes(b"")
    with pytest.raises(RecordingError, match=r"run_0\.db3: an empty file"):
        open_recording(folder, salvage=True)


def test_part_without_messages_is_damage_unless_last(split, tmp_path):
    folder = split()
    remove_metadata(folder)
    empty = tmp_path / "empty"
    with BagWriter(empty, version=9) as bag:
        bag.add_connection("/policy", TOPICS["/policy"], typestore=STORE)
    (file,) = empty.glob("*.db3")
    shutil.copy(file, folder / "run_3.db3")  # the last part: recording ended
    assert open_and_describe(folder)[:2] == (PARTS * EACH, [])
    shutil.copy(file, part(folder, 1))
    assert open_and_describe(folder)[:2] == (2 * EACH, ["run_1.db3 holds no message"])
