"""Label corrections: they override rule labels and survive relabelling and re-ingest."""

import datetime as dt
import shutil
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driven_robot import Drive, write_bag
from support.panels import panel_of
from support.profile_texts import WAREHOUSE
from support.stores import one

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.ingest.relabel import (
    RecordingCorrections,
    correct_store,
    relabel_store,
    remove_corrections,
)
from restock.ingest.store.manifest import Correction, Moments, corrected_version, merged
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import Condition
from restock.replay.store.store import Store

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)
SOON = '\n[[condition]]\nname = "soon"\ntiming = "post"\npriority = 1\nsql = "{}"\n'
BEYOND_2_55_M_NEXT, BEYOND_2_8_M = "lead(pose_x_m) OVER episode > 2.55", "pose_x_m > 2.8"


@pytest.fixture(scope="module")
def ingested_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a store of one recording and a profile with the condition `soon`."""
    folder = tmp_path_factory.mktemp("corrections")
    profile(folder, BEYOND_2_55_M_NEXT)
    write_bag(Drive(goals=[(0.0, 11.0, 1.0)]), folder / "a")
    assert ingest(folder) == 0
    return folder


@pytest.fixture
def store(ingested_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(ingested_folder, tmp_path, dirs_exist_ok=True)
    return tmp_path / "store"


def profile(folder: Path, sql: str, text: str = WAREHOUSE) -> None:
    (folder / "amr.toml").write_text(text + SOON.format(sql))


def ingest(folder: Path, force: bool = False) -> int:
    known = ["--store", str(folder / "store"), "--profile", str(folder / "amr.toml")]
    return main(["ingest", str(folder / "a"), *known, *(["--force"] if force else [])])


def labels(store: Path, columns: str = "conditions") -> list[tuple]:
    with Store(store) as opened:
        query = f"SELECT {columns} FROM transitions ORDER BY transition_id"
        return opened.sql(query).fetchall()


def correct(store: Path, first: int, last: int, value: bool, condition: str = "soon") -> None:
    """Correct the label of these steps of the only episode."""
    with Store(store) as opened:
        recording, ingest_id, first_ns, last_ns = opened.sql(
            "SELECT any_value(recording_id), any_value(ingest_id), min(logged_ns), max(logged_ns)"
            f" FROM transitions WHERE step_index BETWEEN {first} AND {last}"
        ).fetchall()[0]
    given = RecordingCorrections(
        ingest_id, [Correction(condition, value, 0, first_ns, last_ns, NOW)]
    )
    correct_store(StoreWriter(store), {recording: given})


def soon_steps(store: Path) -> list[int]:
    """Return the steps labelled `soon`."""
    found = labels(store, "step_index, list_contains(conditions, 'soon')")
    return [step for step, holds in found if holds]


def test_corrections_survive_relabelling_and_ingest(store, tmp_path, capsys):
    before = soon_steps(store)
    correct(store, 2, 4, True)
    correct(store, before[0], before[1], False)
    wanted = [2, 3, 4, *before[2:]]
    assert soon_steps(store) == wanted
    (version,) = {version for (version,) in labels(store, "labels_version")}
    rules = load_profile(tmp_path / "amr.toml").labels_version
    assert version.startswith(f"{rules}+")

    capsys.readouterr()
    assert ingest(tmp_path) == 0  # its definitions are the same
    assert "unchanged" in capsys.readouterr().out

    profile(tmp_path, BEYOND_2_8_M)  # other rules
    conditions = load_profile(tmp_path / "amr.toml").conditions
    relabel_store(StoreWriter(store), lambda name: conditions)
    assert soon_steps(store)[:3] == [2, 3, 4]
    assert not set(soon_steps(store)) & set(before[:2])
    assert len(soon_steps(store)) > 3

    # without the condition: corrections are kept and reported
    (tmp_path / "amr.toml").write_text(WAREHOUSE)
    assert ingest(tmp_path) == 0
    assert "2 of them are about conditions or steps that no longer exist" in capsys.readouterr().out
    profile(tmp_path, BEYOND_2_55_M_NEXT)
    assert ingest(tmp_path) == 0
    assert "2 corrections of its labels are kept" in capsys.readouterr().out
    assert soon_steps(store) == wanted


def test_removing_corrections_restores_rule_labels(store: Path) -> None:
    columns = "* EXCLUDE (ingest_id)"
    before = labels(store, columns)
    correct(store, 2, 4, True)
    correct(store, 3, 3, False)
    assert labels(store, columns) != before
    (outcome,), _ = remove_corrections(StoreWriter(store))
    assert "+" not in outcome.after
    assert labels(store, columns) == before
    assert remove_corrections(StoreWriter(store)) == ([], None)


def test_views_and_panels_show_corrections(store: Path, tmp_path: Path) -> None:
    mixture = "[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n"
    plain = panel_of(store, mixture, tmp_path / "plain").header.labels_version
    correct(store, 2, 4, True)
    with Store(store) as opened:
        query = "SELECT condition, value, rows, last_ns > first_ns, given_at FROM corrections"
        assert opened.sql(query).fetchall() == [("soon", True, 3, True, NOW)]
        stale = (files("restock.replay.store") / "audits" / "stale_labels.sql").read_text("utf-8")
        assert opened.sql(stale).fetchall() == []
    corrected = panel_of(store, mixture, tmp_path / "corrected").header.labels_version
    assert corrected.startswith(f"{plain}+")


def test_correction_updates_all_label_columns(tmp_path: Path) -> None:
    writer = StoreWriter(tmp_path / "store")
    writer.write(*one(1))
    before = writer.rows(*writer_key(writer))
    uncertain = before["uncertain"].to_pylist()
    row = uncertain.index(["recovery"])
    stamp = before["stamp_ns"][row].as_py()
    episode = before["episode_index"][row].as_py()
    for value in (True, False):
        recording, ingest_id = writer_key(writer)
        given = [Correction("recovery", value, episode, stamp, stamp, NOW)]
        correct_store(writer, {recording: RecordingCorrections(ingest_id, given)})
        after = writer.rows(*writer_key(writer))
        held = after["conditions"][row].as_py()
        assert ("recovery" in held) == value
        if value:  # the lowest priority number
            assert after["condition"][row].as_py() == "recovery"
        assert dict(after["probabilities"][row].as_py())["recovery"] == float(value)
        assert after["uncertain"][row].as_py() == []
        others = [i for i in range(len(after)) if i != row]
        for name in ("condition", "probabilities", "uncertain"):
            assert after[name].take(others).to_pylist() == before[name].take(others).to_pylist()
        same = [set(held) for held in after["conditions"].take(others).to_pylist()]
        assert same == [set(held) for held in before["conditions"].take(others).to_pylist()]


def writer_key(writer: StoreWriter) -> tuple[str, str]:
    row = writer.live().to_pylist()[0]
    return row["recording_id"], row["ingest_id"]


INTERVALS = st.lists(st.tuples(st.integers(0, 19), st.integers(0, 6), st.booleans()), max_size=5)


@settings(max_examples=80)
@given(INTERVALS, INTERVALS)
def test_merged_corrections_do_not_overlap_and_last_wins(first, second):
    moments = Moments(np.zeros(20, np.int64), np.arange(20) * 100)
    painted = np.full(20, -1)

    def corrections(intervals: list[tuple[int, int, bool]]) -> list[Correction]:
        accepted: list[Correction] = []
        for begin, more, value in intervals:  # corrections of one file do not contradict each other
            taken = np.zeros(20, bool)
            for other in accepted:
                taken |= moments.covered(other)
            end = min(begin + more, 19)
            if not taken[begin : end + 1].any():
                accepted.append(Correction("x", value, 0, begin * 100, end * 100, NOW))
        return accepted

    before, later = corrections(first), corrections(second)
    for correction in (*before, *later):
        painted[moments.covered(correction)] = correction.value
    every = merged(before, later, moments)
    covered = np.zeros(20, np.int64)
    result = np.full(20, -1)
    for correction in every:
        covered += moments.covered(correction)
        result[moments.covered(correction)] = correction.value
    assert covered.max() <= 1
    np.testing.assert_array_equal(result, painted)
    again = merged(every, later, moments)
    assert corrected_version("r", again) == corrected_version("r", every)


def test_correction_applies_to_its_episode_only() -> None:
    moments = Moments(np.array([0, 0, 1, 1]), np.array([10, 20, 10, 20]))
    correction = Correction("x", True, 1, 10, 20, NOW)
    assert moments.covered(correction).tolist() == [False, False, True, True]
    # Another profile has split the episodes differently since, so the time alone selects the rows.
    moved = Correction("x", True, 7, 10, 10, NOW)
    assert moments.covered(moved).tolist() == [True, False, True, False]


def test_label_uses_the_profile_kept_in_the_store(store, tmp_path, shell):
    text = (tmp_path / "amr.toml").read_text().replace('name = "warehouse_amr"', 'name = "own"', 1)
    (tmp_path / "amr.toml").write_text(text)
    assert ingest(tmp_path, force=True) == 0
    (tmp_path / "amr.toml").unlink()
    relabel_store(StoreWriter(store), lambda name: [Condition("always", "pre", "true")])
    recordings = shell.json("store", "label", store)["recordings"]
    assert [row["changed"] for row in recordings] == [0]
