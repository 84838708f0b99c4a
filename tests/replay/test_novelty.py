"""Novelty: rows far from other episodes are found without labels; `novel` is a stratum."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from deltalake import DeltaTable
from scipy.stats import mannwhitneyu
from support.panels import NO_SPLIT, panel_of
from support.paths import ROOT
from support.stores import TASK, recording_transitions, write_store

from restock import cli
from restock.errors import ConfigError, RunError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter, compact
from restock.ingest.task.task import Task
from restock.replay.store import novelty
from restock.replay.store.novelty import NEAREST, REFERENCE, Reference, strangest
from restock.replay.store.store import Store
from restock.replay.trace.trace import listed_rows

NOVEL = "[[strata]]\nname = 'novel'\nshare = 0.3\n[each_condition]\nshare = 'natural'\n"


def crowded(recording: int, *, seed: int = 0, **given: object) -> pa.Table:
    """Return rows whose observations are all near one point."""
    table = recording_transitions(recording, seed=seed, **given)  # type: ignore[arg-type]
    size = len(table["observation"][0])
    near = np.random.default_rng([seed, recording]).normal(0.5, 0.01, (len(table), size))
    return replaced(table, {"observation": list(near.astype(np.float32))})


def moved(table: pa.Table, chosen: np.ndarray, entry: int, value: float) -> pa.Table:
    """Return the table with one entry of the observation of some rows set."""
    observation = np.stack(table["observation"].to_numpy())
    observation[chosen, entry] = value
    return replaced(table, {"observation": list(observation)})


def read(store: Store | Path, text: str = "FROM novelty") -> list[dict[str, object]]:
    if isinstance(store, Path):
        with Store(store) as opened:
            return read(opened, text)
    return store.sql(text).to_arrow_table().to_pylist()


def test_planted_rows_rank_first_with_reason(tmp_path):
    table = crowded(1)
    planted = np.array([40, 160])
    slip = TASK.observation_names.index("slip_speed")
    store = write_store(tmp_path / "store", [moved(table, planted, slip, 3.0), crowded(2)])
    ids = table["transition_id"].to_numpy()[planted]
    with Store(store) as opened:
        rows = strangest(opened)
        assert {int(row["row"]) for row in rows[:2]} == set(ids.tolist())
        assert all(row["strange"].startswith("slip_speed 3.00 (near: 0.") for row in rows[:2])
        assert len({row["episode_id"] for row in rows}) == len(rows) == 20
        novel = read(opened, "SELECT transition_id FROM novelty WHERE novel")
    assert set(ids.tolist()) <= {row["transition_id"] for row in novel}
    assert listed_rows(store) == rows


def test_rows_of_same_episode_do_not_count(tmp_path):
    """A long episode of equal rows is as novel as one of its rows."""
    table = crowded(1)
    episode = np.asarray(table["episode_index"]) == 3
    store = write_store(tmp_path / "store", [moved(table, episode, 0, 9.0), crowded(2)])
    found = read(store, "SELECT novelty, episode_index = 3 AND recording_id LIKE '%1' AS far FROM"
                 " transitions JOIN novelty USING (transition_id)")  # fmt: skip
    assert min(row["novelty"] for row in found if row["far"]) > 8
    assert max(row["novelty"] for row in found if not row["far"]) < 1


def test_novelty_is_mean_distance_to_nearest_rows(tmp_path):
    tables = [recording_transitions(number) for number in (1, 2)]
    rows = pa.concat_tables(tables).sort_by("transition_id")
    assert len(rows) < REFERENCE  # so all rows are the reference
    x = np.stack(rows["observation"].to_numpy()).astype(np.float64)
    episode = np.array(rows["episode_id"].to_pylist())
    distance = np.linalg.norm(x[:, None] - x[None], axis=2)
    distance[episode[:, None] == episode] = np.inf
    expected = np.sort(distance, axis=1)[:, :NEAREST].mean(axis=1)
    found = read(write_store(tmp_path / "store", tables))
    assert [row["transition_id"] for row in found] == rows["transition_id"].to_pylist()
    np.testing.assert_allclose([row["novelty"] for row in found], expected, rtol=1e-5)


def test_novelty_ignores_compaction_and_file_order(tmp_path):
    tables = [recording_transitions(number, episodes=40) for number in (1, 2, 3)]
    one = write_store(tmp_path / "one", tables)
    other = write_store(tmp_path / "other", tables[::-1])
    before = read(one)
    assert len(before) > REFERENCE
    assert read(other) == before
    compact(StoreWriter(one))
    assert DeltaTable(one / "transitions").version() > len(tables) - 1
    assert read(one) == before


def test_memory_is_bounded_by_reference_size():
    rows, size = 20_000, 8
    rng = np.random.default_rng(0)
    given = rng.normal(size=(rows, size)).astype(np.float32)
    episodes = pa.array([f"e{index}" for index in range(rows)])
    reference = Reference.of(
        pa.table({"observation": list(given[:REFERENCE]), "episode_id": episodes[:REFERENCE]})
    )
    tracemalloc.start()
    _, found = reference.compare(given, episodes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(found).all()
    assert peak < 4 * rows * REFERENCE / 4  # a quarter of all distances


def test_novelty_is_measured_once_per_file_set(tmp_path, monkeypatch):
    store = write_store(tmp_path / "store", [recording_transitions(1)])
    measured = []
    measure = novelty.read_novelty
    monkeypatch.setattr(
        novelty, "read_novelty", lambda connection: (measured.append(1), measure(connection))[1]
    )
    assert read(store) == read(store)
    assert len(measured) == 1
    (store / novelty.KEPT).write_bytes(b"cut short")
    first = read(store)
    assert len(measured) == 2
    write_store(store, [recording_transitions(2)])
    assert len(read(store)) > len(first)
    assert len(measured) == 3
    assert read(Path(f"{store}@0")) == first  # an older version is measured by its own rows


def test_novelty_is_null_if_unmeasurable(tmp_path, shell):
    store = write_store(tmp_path / "store", [recording_transitions(1, episodes=1)])
    assert {(row["novelty"], row["novel"]) for row in read(store)} == {(None, None)}
    assert listed_rows(store) == []
    assert cli.main(["trace", str(store)]) == 0
    assert shell.json("coverage", store)[-1]["rows_held"] == 0


def test_novelty_is_measured_within_task(tmp_path):
    wide = Task(TASK.body, TASK.actions, sectors=8)
    store = write_store(tmp_path / "store", [crowded(1)])
    write_store(store, [crowded(2, task=wide), crowded(3, task=wide)], task=wide)
    query = "SELECT task_hash, max(novelty) AS most, count(*) AS n, countif(novel) AS novel"
    found = read(store, f"{query} FROM transitions JOIN novelty USING (transition_id) GROUP BY ALL")
    assert {row["task_hash"] for row in found} == {TASK.hash, wide.hash}
    for row in found:
        assert 0 < row["most"] < 1
        assert int(row["novel"]) == pytest.approx(row["n"] * novelty.NOVEL_SHARE, abs=1)


def test_novelty_covers_every_store_of_mixture(tmp_path):
    write_store(tmp_path / "other", [crowded(7)])
    store = write_store(tmp_path / "store", [crowded(1), crowded(2)])
    other = f"[[sources.stores]]\nname = 'other'\npath = '{tmp_path}/other'\nshare = 0.2\n"
    text = other + "[sources]\nlogs = 0.4\n" + NO_SPLIT + NOVEL
    panel = panel_of(store, text, tmp_path / "panel")
    assert {line.name for line in panel.strata} > {"novel", "other/novel"}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[strata]]\nname = 'nowel'\nshare = 1.0\n", "name one of nominal, novel, "),
        ("[[strata]]\nname = 'far'\nwhere = 'novelty > zone'\nshare = 1.0\n", "does not run"),
    ],
)
def test_invalid_strata_are_refused(store_path, tmp_path, text, problem):
    with pytest.raises(ConfigError, match=re.escape(problem)):
        panel_of(store_path, text, tmp_path / "panel")
    with pytest.raises(RunError, match="is not a run or a store"):
        listed_rows(tmp_path)


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("novelty") / "store"
    assert cli.main(["ingest", str(ROOT / "sample_logs"), "--store", str(store)]) == 0
    return store


def test_labelled_conditions_have_high_novelty(sample):
    rows = read(
        sample, "SELECT conditions, novelty FROM transitions JOIN novelty USING (transition_id)"
    )
    score = np.array([row["novelty"] for row in rows])
    for condition in ("wheel_slip", "near_collision", "recovery", "blocked_aisle"):
        held = np.array([condition in row["conditions"] for row in rows])
        area = mannwhitneyu(score[held], score[~held]).statistic / (held.sum() * (~held).sum())
        assert area > 0.8, condition


def test_novel_quota_is_mixed_from_sample_logs(sample, tmp_path, shell):
    mixture = str(tmp_path / "mixture.toml")
    Path(mixture).write_text("max_replays_per_row = 400\n" + NO_SPLIT + NOVEL)
    assert cli.main(["mix", str(sample), "--mixture", mixture, "--out", str(tmp_path / "p")]) == 0
    query = (
        "SELECT count(*) AS rows, countif(novel) AS novel, countif(len(conditions) = 0) AS nominal"
        f" FROM mixture_rows('{mixture}') JOIN novelty USING (transition_id)"
        " JOIN transitions USING (transition_id) WHERE stratum = 'novel'"
    )
    (counted,) = shell.json("sql", sample, query)
    assert 0 < counted["rows"] == counted["novel"]
    *_, line = shell.json("coverage", sample)
    assert line["condition"] == "novel"
    # Rows with a condition are in its stratum; an uncertain condition does not count.
    assert line["nominal_rows"] <= counted["rows"] < line["rows_held"]
    gaps = shell.json("coverage", "gaps", sample, "--mixture", mixture)["gaps"]
    (gap,) = [gap for gap in gaps if gap["asked_by"] == f"mixture {mixture}"]
    assert (gap["cell"], gap["there"], gap["rate"] > 0) == ("novel", counted["rows"], True)


def test_coverage_page_lists_most_novel_rows(sample, tmp_path):
    page = tmp_path / "page.html"
    assert cli.main(["coverage", str(sample), "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    first, *others = listed_rows(sample)
    assert '<section id="strangest">' in text
    assert all(row["row"] in text for row in (first, *others))
    assert cli.main(["trace", str(sample), first["row"]]) == 0


def test_rows_of_one_episode_have_no_novelty(tmp_path, shell):
    rows = recording_transitions(1, episodes=1)
    store = write_store(tmp_path / "store", [rows])
    assert "No row has a novelty" in shell.out("coverage", store)
    assert len(rows) > NEAREST
