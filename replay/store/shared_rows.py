"""`shared_rows` from what manifests keep of their rows' contents: sorted, one number a row.

DuckDB would count each content in a table of all of them, and hold lists many times over on the
way: that was most of what an audit and a panel held in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import duckdb
import numpy as np
import pyarrow as pa

from restock.arrays import Bools, Ints

SHARED = ("shared_rows", "repeated_rows", "same_steps")  # the view, and what is made of it
COLUMNS = ("ingest_id", "distinctive_rows")  # of the manifests


def install_shared_rows(
    connection: duckdb.DuckDBPyConnection,
    manifests: Iterable[pa.Table],
    recording_of: Mapping[str, str],
) -> None:
    """Put a table in place of the connection's view `shared_rows`.

    `manifests` have COLUMNS; `recording_of` names the recording of each ingest whose rows count.
    """
    contents: list[Ints] = []
    ids: list[Ints] = []
    counts: list[int] = []
    recordings: list[str | None] = []
    for part in manifests:
        for chunk in part.combine_chunks().to_batches():
            named = [recording_of.get(ingest) for ingest in chunk.column("ingest_id").to_pylist()]
            kept = [place for place, recording in enumerate(named) if recording is not None]
            lists = chunk.column("distinctive_rows").take(pa.array(kept, pa.int64()))
            rows = lists.flatten()  # structs
            contents.append(rows.field("content").to_numpy())
            ids.append(rows.field("transition_id").to_numpy())
            counts += lists.value_lengths().fill_null(0).to_pylist()
            recordings += [named[place] for place in kept]
    content = np.concatenate([np.empty(0, np.int64), *contents])
    at = np.flatnonzero(occurs_again(content))
    of_row = np.searchsorted(np.cumsum(counts), at, "right")
    shared = {
        "recording_id": pa.array(recordings, pa.string()).take(pa.array(of_row, pa.int64())),
        "transition_id": np.concatenate([np.empty(0, np.int64), *ids])[at],
        "content": content[at],
    }
    # A table of its own: joins must know that it is the small side.
    connection.register("found_shared_rows", pa.table(shared))
    connection.execute(
        "CREATE TABLE stored_shared_rows AS FROM found_shared_rows;"
        " CREATE OR REPLACE VIEW shared_rows AS FROM stored_shared_rows"
    )
    connection.unregister("found_shared_rows")


def occurs_again(values: Ints) -> Bools:
    """Which of these (N,) are not the only one of their value, (N,)."""
    in_order = np.sort(values)
    several = np.unique(in_order[1:][in_order[1:] == in_order[:-1]])
    if not len(several):
        return np.zeros(len(values), np.bool_)
    place = np.minimum(np.searchsorted(several, values), len(several) - 1)
    return np.asarray(several[place] == values, np.bool_)
