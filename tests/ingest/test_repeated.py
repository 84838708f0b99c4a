"""Ingests detect recordings whose rows are already stored under another id."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.paths import ROOT
from support.shell import Shell
from support.stores import manifest, recording_transitions

from restock.cli import main
from restock.ingest.store.summary import SKETCH_HASHES, row_hashes, sharing
from restock.ingest.store.writer import StoreWriter

MONDAY = ROOT / "sample_logs" / "amr_monday.mcap"


def ingest_result(shell: Shell, *arguments: str | Path) -> dict[str, Any]:
    """Return the result of `restock ingest … --json` for one recording."""
    (result,) = shell.json("ingest", *arguments, code={0, 2, 3})["recordings"]
    return dict(result)


def truncated_recording(tmp_path_factory: pytest.TempPathFactory, name: str, share: float) -> Path:
    """Write the first share of a recording, as a crash would leave it."""
    path, content = tmp_path_factory.mktemp(name) / f"{name}.mcap", MONDAY.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    return path


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return truncated_recording(tmp_path_factory, "part", 1 / 8)


@pytest.fixture(scope="module")
def third(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording that contains the part."""
    return truncated_recording(tmp_path_factory, "third", 1 / 3)


def test_sketches_with_common_hashes_are_found():
    rng = np.random.default_rng(0)
    mine = np.unique(rng.integers(2**63, size=900, dtype=np.uint64))
    parts = [mine[n : n + 40] for n in range(0, 400, 40)]
    unrelated = rng.integers(2**63, size=(3, 40), dtype=np.uint64)
    mixed = [
        np.concatenate([part[:n], other]) for n, other in enumerate(unrelated) for part in parts
    ]
    every = [*parts, *mixed, *unrelated, mine[:0]]
    sketches = {str(place): np.sort(sketch) for place, sketch in enumerate(every)}
    assert sharing(mine, sketches) == {str(place) for place in range(len(parts))}
    assert sharing(mine, {}) == sharing(mine[:0], sketches) == set()


def test_longer_recording_after_its_part_is_reported(part, third, tmp_path, shell):
    store = tmp_path / "store"
    first = ingest_result(shell, part, "--salvage", "--store", store)
    assert first["repeats"] is None
    whole = ingest_result(shell, third, "--salvage", "--store", store)
    assert whole["status"] == "written"
    assert whole["repeats"] == {
        "recording_id": first["recording_id"],
        "source_file": str(part),
        "rows": first["transitions"],
        "share": first["transitions"] / whole["transitions"],
        "share_of_other": 1.0,
        "held": 1.0,
    }
    (note,) = (note for note in whole["notes"] if "a part of the same drive twice" in note)
    assert str(part) in note
    assert f"`restock store remove {store} {first['recording_id']}` removes that one" in note


def test_longer_recording_replaces_its_part_on_request(part, third, tmp_path, shell):
    """The part may be a bag that was still being written; ingesting it again fails."""
    store, replace = tmp_path / "store", ("--repeated", "replace")
    first = ingest_result(shell, part, "--salvage", "--store", store, *replace)
    whole = ingest_result(shell, third, "--salvage", "--store", store, *replace)
    (note,) = (note for note in whole["notes"] if "which was removed" in note)
    assert note.startswith(f"in place of {part} (recording {first['recording_id']}), a part of it")
    assert [row["recording_id"] for row in StoreWriter(store).live().to_pylist()] == [
        whole["recording_id"]
    ]
    again = ingest_result(shell, part, "--salvage", "--store", store, *replace)
    assert again["status"] == "failed"
    assert whole["recording_id"] in again["error"]


def test_corrected_recording_is_not_replaced(part, third, tmp_path, shell):
    store = tmp_path / "store"
    first = ingest_result(shell, part, "--salvage", "--store", store)
    review = tmp_path / "review.csv"
    review.write_text(
        "episode_id,condition,first_step,last_step,verdict\n"
        f"{first['recording_id']}/0,near_collision,0,3,yes\n"
    )
    assert main(["review", str(store), str(review)]) == 0
    whole = ingest_result(shell, third, "--salvage", "--store", store, "--repeated", "replace")
    (note,) = (note for note in whole["notes"] if "It stays" in note)
    assert "people corrected 1 label of it" in note
    assert f"`restock store remove {store} {first['recording_id']}`" in note


def test_other_drives_are_not_repeats(tmp_path: Path) -> None:
    store = StoreWriter(tmp_path / "store")
    for index in (1, 2):
        rows = recording_transitions(index, episodes=40)
        assert len(rows) > 2 * SKETCH_HASHES
        staged = store.stage(manifest(rows), rows)
        assert store.repeated(staged) is None
        store.fit([staged])
        store.commit_staged([staged])
        assert store.repeated(staged) is None


def test_row_hashes_resolve_one_thousandth() -> None:
    rows = recording_transitions(1)
    place = rows.schema.get_field_index("observation")

    def moved(by: float) -> pa.Table:
        values = np.round(np.stack(rows["observation"].to_numpy()), 3)
        values[:, 3] += by
        column = pa.array(list(values.astype(np.float32)), rows.schema.field(place).type)
        return rows.set_column(place, rows.schema.field(place), column)

    assert (row_hashes(moved(0.0)) == row_hashes(moved(0.0002))).all()
    assert (row_hashes(moved(0.0)) != row_hashes(moved(0.0011))).all()
