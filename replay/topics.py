"""Topics of recordings as tables, decoded while DuckDB reads them, and only if a query names them.

A row is a message: `log_time_ns`, `stamp_ns` if it has a header, then its fields in order. Nested
messages are structs and repeated fields are lists, so a query can use `pose.pose.position.x`. Rows
are in the order of the file. For several recordings, the column `file` has each row's path.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from restock.errors import QueryError, RecordingError, counted, visible
from restock.ingest.containers.open_recording import open_recording, recordings_in
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.decoding.columns import DTYPES, FieldColumn, Leaf, Ragged
from restock.ingest.decoding.decoders import empty_column
from restock.replay.store.definitions import LISTS, make_on_demand
from restock.replay.store.parquet_views import literal

STAMP = "header.stamp"


class Topics:
    """Recordings whose topics are tables of a connection while this object exists.

    Args:
        connection: gets a table for each topic that a query names. The table has the topic's name,
            and a second name with `_` for inner slashes if that is unique. The tables `topics` and
            `columns` list topics and their fields.
        path: a recording, a folder of recordings, or a glob.
        lost: called once for each loss: damage, or lost messages of a topic that was read.

    Raises:
        RecordingError: there is no recording, or none can be opened.
    """

    def __init__(
        self, connection: duckdb.DuckDBPyConnection, path: Path, lost: Callable[[str], None]
    ) -> None:
        self._connection, self._report, self._lost = connection, lost, set[str]()
        self.where = str(path)
        paths = recordings_in(path)
        self._several = paths != [path]
        self._files: dict[Path, dict[str, tuple[TopicInfo, list[Leaf]]]] = {}
        refused: list[RecordingError] = []
        for file in paths:
            try:
                with open_recording(file, salvage=True) as recording:
                    self._files[file] = {
                        name: (info, recording.fields(name))
                        for name, info in recording.topics.items()
                    }
                    self.report(recording)
            except RecordingError as error:
                refused.append(error)
        if not self._files:
            raise refused[0]
        for one in refused:
            self._report_once(f"{one.where}: {one.what}" if one.where else one.what)
        names = sorted({name for topics in self._files.values() for name in topics})
        self._views = dict(
            zip(_make_unique(names, taken=["topics", "columns"]), names, strict=True)
        )
        short_names = [view.strip("/").replace("/", "_") for view in self._views]
        folded = [name.casefold() for name in [*self._views, "topics", "columns", *short_names]]
        self._short_names = {
            name: view
            for name, view in zip(short_names, self._views, strict=True)
            if name and folded.count(name.casefold()) == 1
        }
        self._made: set[str] = set()
        make_on_demand(connection, self)

    def make(self, text: str) -> None:
        """Create the tables that a query names, or all tables if it lists tables."""
        lowered = text.lower()
        if set(re.findall(r"\w+", lowered)) & LISTS:
            self.make_all()
        for view in self._views:
            if _quoted(view)[1:-1].lower() in lowered:
                self._make(view)
                if view not in self._made and _quoted(view).lower() in lowered:
                    self._refuse(view)
        for name, view in self._short_names.items():
            if name.lower() in lowered:
                self._make(view)
        for name, table in (("topics", self._list_topics), ("columns", self._list_columns)):
            if name in lowered and name not in self._made:
                self._connection.register(name, table())
                self._made.add(name)

    def make_all(self) -> None:
        """Create the table of every topic that can be decoded."""
        for view in self._views:
            self._make(view)

    def report(self, recording: Recording) -> None:
        """Report the losses of a recording so far, each only once."""
        for loss in recording.lost_messages:
            count = "" if loss.messages is None else f" ({counted(loss.messages, 'message')})"
            where = f"{recording.path}: " if self._several else ""
            self._report_once(f"{where}{loss.topic or 'the file'}: {loss.reason}{count}")

    def _report_once(self, loss: str) -> None:
        if loss not in self._lost:
            self._lost.add(loss)
            self._report(visible(loss))

    def _make(self, view: str) -> None:
        topic, parts = self._views[view], []
        if view in self._made:
            return
        for number, (file, topics) in enumerate(self._files.items()):
            if topic not in topics or topics[topic][0].skipped:
                continue
            source = f"stored_{number}_{view}" if self._several else view
            taken = ["file"] if self._several else []
            self._connection.register(source, _Source(self, file, *topics[topic], taken))
            parts.append(f"SELECT {literal(visible(str(file)))} AS file, * FROM {_quoted(source)}")
        if not parts:
            return
        if self._several:
            self._create(view, " UNION ALL BY NAME ".join(parts))
        for name in [name for name, of in self._short_names.items() if of == view]:
            self._create(name, f"FROM {_quoted(view)}")
        self._made.add(view)

    def _create(self, view: str, query: str) -> None:
        self._connection.execute(f"CREATE OR REPLACE VIEW {_quoted(view)} AS {query}")

    def _refuse(self, view: str) -> None:
        """Raise QueryError for a topic that cannot be decoded."""
        topic = self._views[view]
        reasons = [topics[topic][0].skipped for topics in self._files.values() if topic in topics]
        raise QueryError(f"{view} cannot be decoded: {reasons[0]}", where=self.where)

    def _list_topics(self) -> pa.Table:
        """Return the table `topics`: type and number of messages of each recording's topics."""
        infos = [
            (file, info) for file, topics in self._files.items() for info, _ in topics.values()
        ]
        table = pa.table(
            {
                "topic": pa.array([info.name for _, info in infos], pa.string()),
                "type": pa.array([info.type for _, info in infos], pa.string()),
                "messages": pa.array([info.expected for _, info in infos], pa.int64()),
                "skipped": pa.array([info.skipped for _, info in infos], pa.string()),
            }
        )
        if self._several:
            files = pa.array([visible(str(file)) for file, _ in infos], pa.string())
            table = table.add_column(0, "file", files)
        return table

    def _list_columns(self) -> pa.Table:
        """Return the table `columns`: each field of each topic with its DuckDB type."""
        rows = []
        for view, topic in self._views.items():
            leaves = next(topics[topic][1] for topics in self._files.values() if topic in topics)
            own = [("file", "VARCHAR")] if self._several else []
            own += [("log_time_ns", "BIGINT")] if leaves else []
            own += [("stamp_ns", "BIGINT")] if STAMP in {leaf.path for leaf in leaves} else []
            fields = [(leaf.path, _KINDS[leaf.kind] + "[]" * len(leaf.dims)) for leaf in leaves]
            rows += [(view, name, kind) for name, kind in own + fields]
        columns = zip(*rows, strict=True) if rows else ((), (), ())
        return pa.table(
            [pa.array(column, pa.string()) for column in columns], ["view", "column_name", "type"]
        )


class _Source:
    """One topic of one recording as an Arrow stream for DuckDB; each scan reads the file again."""

    def __init__(
        self, topics: Topics, file: Path, topic: TopicInfo, leaves: list[Leaf], taken: list[str]
    ) -> None:
        self._topics, self._file, self._topic = topics, file, topic.name
        self._leaves, self._taken = leaves, taken
        empty = {leaf.path: empty_column(leaf.kind, leaf.dims) for leaf in self._leaves}
        self._schema = self._batch(np.zeros(0, np.int64), empty).schema

    def __arrow_c_schema__(self) -> object:
        """Return the schema of the topic's table."""
        return self._schema.__arrow_c_schema__()

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return a stream of all messages of the topic."""
        reader = pa.RecordBatchReader.from_batches(self._schema, self._batches())
        return reader.__arrow_c_stream__()

    def _batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the topic's messages; report losses at the end, or when a query ends early."""
        paths = [leaf.path for leaf in self._leaves]
        try:
            with open_recording(self._file, salvage=True) as recording:
                try:
                    for log_ns, fields in recording.batches(self._topic, paths):
                        yield self._batch(log_ns, fields)
                finally:
                    self._topics.report(recording)
        except RecordingError as error:  # the file changed while it was read
            self._topics._report_once(f"{self._topic}: {error.what}")

    def _batch(self, log_ns: Any, fields: Mapping[str, FieldColumn]) -> pa.RecordBatch:
        columns = {"log_time_ns": pa.array(log_ns)}
        if STAMP in fields:
            columns["stamp_ns"] = pa.array(fields[STAMP])
        arrays, names = _message_arrays(self._leaves, [fields[one.path] for one in self._leaves], 0)
        names = [*columns, *_make_unique(names, taken=[*columns, *self._taken])]
        return pa.RecordBatch.from_arrays([*columns.values(), *arrays], names)


def _message_arrays(
    leaves: Sequence[Leaf], columns: Sequence[FieldColumn], depth: int
) -> tuple[list[pa.Array], list[str]]:
    """Return a message's fields as arrays, and their names, from the columns of its leaves."""
    arrays, names = [], []
    pairs = zip(leaves, columns, strict=True)
    for name, group in groupby(pairs, key=lambda pair: pair[0].steps[depth].name):
        some, values = zip(*group, strict=True)
        arrays.append(_field_array(some, values, depth))
        names.append(name)
    return arrays, names


def _field_array(leaves: Sequence[Leaf], columns: Sequence[FieldColumn], depth: int) -> pa.Array:
    """Return one field as an array: of lists if it is repeated, of structs if it is a message."""
    if leaves[0].steps[depth].many:
        first = columns[0]
        rows = len(first)
        if isinstance(first, Ragged):
            offsets = first.offsets
        else:
            offsets = np.arange(rows + 1, dtype=np.int64) * first.shape[1]
        items = [
            column.values
            if isinstance(column, Ragged)
            else column.reshape(rows * column.shape[1], *column.shape[2:])
            for column in columns
        ]
        return pa.LargeListArray.from_arrays(pa.array(offsets), _item_arrays(leaves, items, depth))
    return _item_arrays(leaves, columns, depth)


def _item_arrays(leaves: Sequence[Leaf], columns: Sequence[FieldColumn], depth: int) -> pa.Array:
    if len(leaves[0].steps) > depth + 1:
        arrays, names = _message_arrays(leaves, columns, depth + 1)
        return pa.StructArray.from_arrays(arrays, _make_unique(names))
    (values,) = columns
    assert not isinstance(values, Ragged)
    if values.dtype == object:
        return pa.array(values, pa.string())
    return pa.array(values.astype(values.dtype.newbyteorder("="), copy=False))


def _make_unique(names: Iterable[str], taken: Sequence[str] = ()) -> list[str]:
    """Make names unique for DuckDB, which ignores case and does not allow empty names."""
    used, given = {name.casefold() for name in taken}, []
    for name in names:
        free = name = name or "_"
        number = 0
        while free.casefold() in used:
            number += 1
            free = f"{name}_{number}"
        used.add(free.casefold())
        given.append(free)
    return given


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


_KINDS = {"string": "VARCHAR", "time": "BIGINT"} | {
    kind: {"f": "DOUBLE" if dtype.itemsize == 8 else "FLOAT", "b": "BOOLEAN"}.get(
        dtype.kind,
        ("U" if dtype.kind == "u" else "")
        + {1: "TINYINT", 2: "SMALLINT", 4: "INTEGER", 8: "BIGINT"}[dtype.itemsize],
    )
    for kind, dtype in DTYPES.items()
}
