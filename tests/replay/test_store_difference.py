"""`restock coverage diff` of stores and versions: what came, went and changed."""

import json
from datetime import datetime

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from deltalake import write_deltalake
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array
from support.stores import TASK, manifest, one, recording_transitions, write_store

from restock.cli import main
from restock.errors import ArgumentError, StoreError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT, parse_version, split_version
from restock.ingest.store.writer import StoreWriter
from restock.replay.fleet.store_difference import (
    diff_stores,
    false_discovery_adjusted,
    share_differences,
    shift,
    shifted,
    standardised_difference,
)
from restock.replay.store.store import Store


def relabelled(rows: pa.Table, steps: int) -> pa.Table:
    """Return the same rows of another ingest, the first of them slipping."""
    condition = rows["condition"].to_pylist()
    condition[:steps] = ["wheel_slip"] * steps
    return replaced(rows, {"condition": condition})


def test_what_came_went_and_was_labelled_anew(tmp_path):
    rows = [recording_transitions(number) for number in range(6)]
    first = write_store(tmp_path / "a", rows[:4])
    again = relabelled(recording_transitions(2, ingest="b"), 20)
    second = write_store(tmp_path / "b", [rows[0], again, *rows[3:]])
    with Store(first) as a, Store(second) as b:
        found = diff_stores(a, b).document()
    changes = {row["source_file"]: row["change"] for row in found["recordings"]}
    assert changes == {
        "logs/1.mcap": "out",
        "logs/2.mcap": "written again",
        "logs/4.mcap": "in",
        "logs/5.mcap": "in",
    }
    episodes = found["episodes"]
    assert (episodes["in"], episodes["out"], episodes["changed"], episodes["same"]) == (
        24,
        12,
        0,
        36,
    )
    before = rows[2]["condition"].to_pylist()[:20]
    moved = {(row["from"], row["to"]): row["rows"] for row in found["labels"]["changes"]}
    assert moved == {(n, "wheel_slip"): before.count(n) for n in set(before) - {"wheel_slip"}}
    assert found["labels"]["rows_compared"] == len(rows[2])
    nominal = next(row for row in found["shares"] if row["value"] == "nominal")
    assert nominal["difference"] == pytest.approx(nominal["share_b"] - nominal["share_a"])
    assert nominal["difference_low"] <= nominal["difference"] <= nominal["difference_high"]


def test_rows_ingested_again_as_they_were_are_no_difference(tmp_path):
    first = write_store(tmp_path / "a", [recording_transitions(1)])
    second = write_store(tmp_path / "b", [recording_transitions(1, ingest="b")])
    with Store(first) as a, Store(second) as b:
        found = diff_stores(a, b)
    assert not found.different
    assert found.rows_paired == len(recording_transitions(1))
    assert all(line["difference"] == 0 == line["difference_high"] for line in found.shares)


def test_rows_that_changed_make_their_episode_another(tmp_path):
    rows, again = recording_transitions(1), recording_transitions(1, ingest="b")
    reward = again["reward"].to_numpy().copy()
    reward[3] += 1
    again = replaced(again, {"reward": reward})
    first, second = (write_store(tmp_path / n, [t]) for n, t in (("a", rows), ("b", again)))
    with Store(first) as a, Store(second) as b:
        found = diff_stores(a, b).document()
    assert [row["change"] for row in found["episodes"]["changes"]] == ["changed"]
    assert found["recordings"][0]["episodes_changed"] == 1


def test_two_versions_of_a_store_by_number_and_by_time(tmp_path, capsys):
    writer = StoreWriter(tmp_path / "store")
    for number in (1, 2):
        newest = writer.write(*one(number))
    assert (
        main(["coverage", "diff", f"{tmp_path}/store@{newest - 1}", f"{tmp_path}/store", "--json"])
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert [row["change"] for row in found["recordings"]] == ["in"]
    assert (found["a"]["version"], found["b"]["version"]) == (newest - 1, newest)
    assert main(["coverage", "diff", f"{tmp_path}/store", f"{tmp_path}/store", "--exit-code"]) == 0
    assert (
        main(
            [
                "coverage",
                "diff",
                f"{tmp_path}/store@{newest - 1}",
                f"{tmp_path}/store",
                "--exit-code",
            ]
        )
        == 1
    )
    with Store(tmp_path / "store", version=parse_version("2999-01-01T00:00Z")) as store:
        assert store.version == newest
    with pytest.raises(StoreError, match="the first is from"):
        Store(tmp_path / "store", version=parse_version("2001-01-01"))
    with pytest.raises(StoreError, match=f"its newest is {newest}"):
        Store(tmp_path / "store", version=99)
    with Store(tmp_path / "store", version=datetime(2999, 1, 1)) as store:  # of UTC
        assert store.version == newest
    with pytest.raises(ArgumentError, match="version must be an int or datetime, got 'newest'"):
        Store(tmp_path / "store", version="newest")  # type: ignore[arg-type]


def test_stores_of_two_tasks_are_refused_with_both_names(tmp_path, capsys):
    other = msgspec.structs.replace(TASK, actions=TASK.actions[:3])
    first = write_store(tmp_path / "a", [recording_transitions(1)])
    second = write_store(tmp_path / "b", [recording_transitions(1, task=other)], task=other)
    assert main(["coverage", "diff", str(first), str(second)]) == 2
    message = capsys.readouterr().err
    assert TASK.hash in message
    assert other.hash in message
    assert "--profile" in message


def test_a_signal_that_moved_is_named(tmp_path):
    rows = [recording_transitions(number) for number in range(4)]
    faster = rows[3]["wheel_speed_mps"].to_numpy() + 3
    rows[3] = replaced(rows[3], {"wheel_speed_mps": faster})
    store = write_store(tmp_path / "store", rows)
    with Store(store, version=2) as a, Store(store) as b:
        found = diff_stores(a, b).document()["signals"]
    assert found["compared"] == "the new episodes of b, compared with those of a"
    assert found["shifts"][0]["signal"] == "wheel_speed_mps"
    assert found["shifts"][0]["p_adjusted"] < 1e-6
    assert sum(row["p_adjusted"] < 0.01 for row in found["shifts"]) == 1
    assert [row["signal"] for row in shifted(found["shifts"])] == ["wheel_speed_mps"]
    # The surest of all has p = 0; what is constant has none.
    bounds = [{"p_adjusted": p} for p in (0.0, 0.049, 0.05, None)]
    assert shifted(bounds) == bounds[:2]


def test_a_version_is_split_unless_a_folder_is_called_so(tmp_path):
    assert split_version("store@12") == ("store", 12)
    assert split_version("s3://bucket/store@2026-11-01T08:00Z")[0] == "s3://bucket/store"
    assert split_version("me@home/store") == ("me@home/store", None)
    (tmp_path / "store@12").mkdir()
    assert split_version(f"{tmp_path}/store@12") == (f"{tmp_path}/store@12", None)


@given(st.integers(0, 2**32 - 1), st.integers(2, 40))
def test_a_sample_beside_itself_differs_in_nothing(seed, episodes):
    rng = np.random.default_rng(seed)
    rows = csr_array(rng.integers(1, 9, (episodes, 3)).astype(float))
    for one_ in share_differences(rows, rows, [slice(0, 3)], rng=rng, resamples=20):
        assert (one_.low, one_.value, one_.high) == (0, 0, 0)
    values = rng.normal(size=episodes)
    assert standardised_difference(values, values).value == 0


def test_intervals_of_share_differences_hold_the_truth():
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        # Episodes of 20 rows with a common rate each: rows are not independent.
        a, b = (rng.binomial(20, rng.beta(2, 6, 60)) for _ in range(2))
        empty = np.zeros(60)
        first, second = (
            csr_array(np.stack([np.append(x, empty), np.append(20 - x, empty)], 1).astype(float))
            if index == 0
            else csr_array(np.stack([np.append(empty, x), np.append(empty, 20 - x)], 1))
            for index, x in enumerate((a, b))
        )
        difference = share_differences(first, second, [slice(0, 2)], rng=rng, resamples=200)[0]
        held += difference.low <= 0 <= difference.high
    assert 0.90 <= held / 200 <= 0.99


def test_intervals_are_of_resamples_with_rows_on_both_sides():
    """Of two episodes, a Poisson resample has neither in one of seven."""
    rng = np.random.default_rng(0)
    first = csr_array(np.array([[9.0, 0], [6, 0], [0, 0], [0, 0]]))
    second = csr_array(np.array([[0.0, 0], [0, 0], [5, 0], [8, 0]]))
    for found in share_differences(first, second, [slice(0, 2)], rng=rng, resamples=200):
        assert (found.low, found.value, found.high) == (0, 0, 0)


def test_one_episode_has_no_interval_and_none_no_difference():
    rng = np.random.default_rng(0)
    two = csr_array(np.array([[4.0, 0], [1, 3]]))
    (found, _) = share_differences(
        two, csr_array(np.array([[0.0, 0], [2, 2]])), [slice(0, 2)], rng=rng
    )
    assert found.value == 0.5 - 5 / 8
    assert np.isnan([found.low, found.high]).all()
    (found, _) = share_differences(two, csr_array(np.zeros((2, 2))), [slice(0, 2)], rng=rng)
    assert np.isnan([found.value, found.low, found.high]).all()


def test_adjusted_p_values_are_scipys_and_unknown_ones_stay():
    from scipy.stats import false_discovery_control

    given_ = [0.001, 0.2, 0.03, 0.04, 0.9]
    adjusted = false_discovery_adjusted([*given_, float("nan")])
    assert adjusted[:5] == pytest.approx(false_discovery_control(given_).tolist())
    assert np.isnan(adjusted[5])


def test_too_few_episodes_give_no_interval():
    found = shift(np.arange(3.0), np.arange(40.0))
    assert np.isnan(found.p_value)
    assert found.mean == (1.0, 19.5)


def test_the_manifest_of_an_empty_store_is_no_task(tmp_path):
    rows = recording_transitions(1)
    empty = write_store(tmp_path / "a", [])
    write_deltalake(str(empty / "recordings"), manifest(rows).slice(0, 0), description=FORMAT)
    write_deltalake(str(empty / "transitions"), rows.slice(0, 0), description=FORMAT)
    full = write_store(tmp_path / "b", [rows])
    with Store(empty) as a, Store(full) as b:
        found = diff_stores(a, b).document()
    assert found["a"]["rows"] == 0
    assert found["episodes"]["in"] == 12
