"""Ordered candidates: the same table for any batches of their rows."""

import itertools

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.replay.plan.candidates import KEYS, rows_in_order

TEXT = ("recording_id", "episode_id", "zone")


def rows_of(recordings: int, episodes: int, steps: int) -> pa.Table:
    """Return recordings whose ids are not in the order of their names; some zones null."""
    rng = np.random.default_rng(recordings * 100 + steps)
    count = recordings * episodes * steps
    recording = np.repeat(np.arange(recordings), episodes * steps)
    episode = np.tile(np.repeat(np.arange(episodes), steps), recordings)
    zones = [["aisle", "dock", None][n] for n in rng.integers(0, 3, count)]
    names = [f"{(7 * n) % 11:x}-{n}" for n in recording.tolist()]
    return pa.table(
        {
            "recording_id": names,
            "episode_id": [f"{a}/{b}" for a, b in zip(names, episode.tolist(), strict=True)],
            "episode_index": pa.array(episode, pa.int32()),
            "step_index": pa.array(np.tile(np.arange(steps), recordings * episodes), pa.int32()),
            "transition_id": (recording.astype(np.int64) << 32) + np.arange(count),
            "zone": pa.array(zones, pa.string()),
            "reward": pa.array(rng.normal(size=count), pa.float32()),
            "terminated": rng.integers(0, 2, count).astype(bool),
        }
    )


def in_order(batches: list[pa.RecordBatch], schema: pa.Schema) -> pa.Table:
    return rows_in_order(batches, schema, text=TEXT, dropped=("episode_index",))


def check(found: pa.Table, table: pa.Table) -> None:
    keys = [(key, "ascending") for key in ("recording_id", *KEYS)]
    expected = table.sort_by(keys).drop_columns(["episode_index"])
    assert found.column_names == expected.column_names
    assert found.to_pylist() == expected.to_pylist()
    for name in TEXT:  # codes in the order of the first rows that have them
        values = [value for value in expected[name].to_pylist() if value is not None]
        column = found[name].combine_chunks()
        assert column.dictionary.to_pylist() == list(dict.fromkeys(values))


@settings(max_examples=60)
@given(
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(1, 9),
    st.lists(st.integers(1, 60), max_size=6),
    st.randoms(use_true_random=False),
    st.sampled_from(["files", "batches", "rows"]),
)
def test_batches_in_any_order_give_same_table(recordings, episodes, steps, cuts, random, mixed):
    table = rows_of(recordings, episodes, steps)
    if mixed == "rows":
        order = list(range(len(table)))
        random.shuffle(order)  # type: ignore[attr-defined]
        table = table.take(pa.array(order))
    ends = sorted({min(cut, len(table)) for cut in np.cumsum([0, *cuts]).tolist()} | {len(table)})
    batches = [
        batch
        for begin, end in itertools.pairwise(ends)
        for batch in table.slice(begin, end - begin).combine_chunks().to_batches()
    ]
    if mixed == "batches":
        random.shuffle(batches)  # type: ignore[attr-defined]
    check(in_order(batches, table.schema), table)


@pytest.mark.parametrize("names", [1, 127, 128, 129, 32_768, 32_769])
def test_code_width_fits_dictionary(names):
    count = names + 3
    table = pa.table(
        {
            "recording_id": ["r"] * count,
            "episode_id": [f"e{min(n, names - 1)}" for n in range(count)],
            "episode_index": pa.array(np.zeros(count), pa.int32()),
            "step_index": pa.array(range(count), pa.int32()),
            "transition_id": pa.array(range(count), pa.int64()),
            "zone": pa.array([None] * count, pa.string()),
        }
    )
    batches = table.to_batches(max_chunksize=max(count // 3, 1))
    found = in_order(batches[::-1], table.schema)
    check(found, table)
    bits = 8 if names <= 128 else 16 if names <= 32_768 else 32
    assert found["episode_id"].type.index_type.bit_width == bits


def test_no_batches_give_empty_table():
    table = rows_of(1, 1, 1).slice(0, 0)
    assert in_order([], table.schema).num_rows == 0
