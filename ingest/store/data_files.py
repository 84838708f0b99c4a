"""The Parquet files of a store's tables: how they are written, and several written as one."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake.exceptions import DeltaError
from deltalake.transaction import AddAction

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.lineage import (
    INGESTS,
    Ingest,
    StoredFile,
    damage_named,
    packed_ingests,
)
from restock.ingest.store.location import (
    TRANSITIONS,
    Location,
    open_parquet,
    with_plain_text,
)

GROUP_ROWS = 65_536  # of a compacted file's row groups
GROUP_BYTES = 64 << 20  # or where rows are large, as manifests are
READ_ROWS = 2048


@dataclass
class AddedFile:
    """A file to be committed."""

    recording_id: str
    path: str  # in its table
    rows: int
    size: int = 0  # bytes, once it is written


def add_action(file: AddedFile, now_ms: int) -> AddAction:
    """What a commit says of a file."""
    stats = json.dumps({"numRecords": file.rows})
    return AddAction(file.path, file.size, {}, now_ms, True, stats)


def parquet_options(schema: pa.Schema) -> dict[str, Any]:
    """How the tables' columns are encoded. Each page has a checksum: see `open_parquet`."""
    return {
        "compression": "zstd",
        "write_page_checksum": True,
        "use_dictionary": [f.name for f in schema if pa.types.is_string(f.type)],
        "use_byte_stream_split": _float_columns(schema),
    }


def compacted_name() -> str:
    """The path of a file of several ingests."""
    return f"compacted/{uuid.uuid4().hex}.parquet"


def rewrite(place: Location, file: StoredFile, kept: Sequence[Ingest]) -> AddedFile:
    """A compacted file of transitions without the ingests that are not kept."""
    path = f"{TRANSITIONS}/{file.path}"
    with damage_named(place, path):
        schema = place.read_schema(path)
    return merge(place, TRANSITIONS, [file], kept, schema)


def merge(
    place: Location,
    name: str,
    files: Sequence[StoredFile],
    kept: Sequence[Ingest],
    schema: pa.Schema,
    *,
    extra: Sequence[pa.Table] = (),
    summarised: bool = False,
) -> AddedFile:
    """One file of what these files of a table hold of some ingests, in their order, and of `extra`
    manifests.

    What it holds is listed in it if the manifests describe these rows: Restock wrote the files, or
    all that others changed in them is `summarised` again. A row group at a time is in memory.
    Columns of `schema` that a file lacks are null. What is written is deleted where that fails.

    Raises:
        StoreError: a file is missing or damaged, or it cannot be written.
    """
    wanted = pa.array([one.ingest_id for one in kept], pa.string())
    rows = [(one["recording_id"][0].as_py(), one["ingest_id"][0].as_py()) for one in extra]
    held = [*kept, *(Ingest(*ids, 1) for ids in rows)]
    listed = summarised or all(file.listed for file in files)
    schema = schema.with_metadata({INGESTS: packed_ingests(held)} if listed else None)
    made = AddedFile("", compacted_name(), 0)
    with (
        written_whole(place, f"{name}/{made.path}"),
        place.writing(f"{name}/{made.path}") as sink,
        pq.ParquetWriter(sink, schema, **parquet_options(schema)) as writer,
    ):
        waiting = [conformed(one, schema) for one in extra]
        rows_waiting = size_waiting = 0
        for part in _parts(place, name, files, wanted, schema):
            waiting.append(part)
            rows_waiting, size_waiting = rows_waiting + len(part), size_waiting + part.nbytes
            if rows_waiting >= GROUP_ROWS or size_waiting >= GROUP_BYTES:
                made.rows += _flush(writer, waiting)
                rows_waiting = size_waiting = 0
        made.rows += _flush(writer, waiting)
        writer.close()
        made.size = sink.tell()
    return made


@contextmanager
def written_whole(place: Location, path: str) -> Iterator[None]:
    """Delete a file that the block writes where it fails or is interrupted: on a full disk its
    part would keep the disk full.

    Raises:
        StoreError: it cannot be written.
    """
    try:
        yield
    except BaseException as error:
        with suppress(OSError, StoreError, DeltaError):
            place.delete([path])
        if isinstance(error, OSError):
            raise unwritten(place, error) from error
        raise


def unwritten(place: Location, error: OSError | DeltaError) -> StoreError:
    """What is wrong where a store cannot be written, and what to do."""
    said = str(error)
    if re.search(r"No space left|Disk quota exceeded|os error (28|122)\b", said):
        return StoreError(
            "cannot be written: there is no space left on its disk",
            where=str(place),
            remedy="free some space, then run the same command again: what the store has is kept",
        )
    # Delta's library has the cause in its last line, behind an arrow.
    causes = [line.rsplit("↳\x1b[0m ")[-1].strip() for line in said.splitlines() if "↳" in line]
    return StoreError(
        "cannot be written: " + ": ".join([first_line(error), *causes[-1:]]), where=str(place)
    )


def conformed(rows: pa.Table, schema: pa.Schema) -> pa.Table:
    """A table with the columns of a schema, in its order; null where it has none."""
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


def _parts(
    place: Location, name: str, files: Sequence[StoredFile], wanted: pa.Array, schema: pa.Schema
) -> Iterator[pa.Table]:
    import pyarrow.compute as pc  # slow to import

    for file in files:
        path = f"{name}/{file.path}"
        with damage_named(place, path), place.reading(path) as source:
            for batch in open_parquet(source).iter_batches(READ_ROWS):
                rows = with_plain_text(pa.table(batch))
                rows = rows.filter(pc.is_in(rows["ingest_id"], wanted))
                yield conformed(rows, schema)


def _flush(writer: pq.ParquetWriter, waiting: list[pa.Table]) -> int:
    rows = pa.concat_tables(waiting) if waiting else None
    waiting.clear()
    if not rows:
        return 0
    writer.write_table(rows, row_group_size=GROUP_ROWS)
    return len(rows)


def _float_columns(schema: pa.Schema) -> list[str]:
    """Parquet's paths of the float columns, those in lists of floats included."""
    paths = []
    for field in schema:
        if pa.types.is_floating(field.type):
            paths.append(field.name)
        elif pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type):
            paths.append(f"{field.name}.list.element")
    return paths
