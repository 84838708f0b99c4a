"""Which of Delta's features a table uses, and which of them Restock can read and write.

Other tools may set features that change what a file's rows mean (deletion vectors, column mapping),
or that every writer must follow (constraints, change feeds). Delta's library opens some of these
tables, while Restock reads the Parquet files themselves: a feature that is not known here is
refused by name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from deltalake import DeltaTable

from restock.errors import StoreError

# They change nothing about files of rows: a column type, the log's checkpoints, who may vacuum.
_READ = {"timestampNtz", "v2Checkpoint", "vacuumProtocolCheck"}
_WRITTEN = {"timestampNtz", "v2Checkpoint"}
# What a table's version of the protocol stands for where it does not list features.
_BY_READER_VERSION = {2: ("columnMapping",)}
_BY_WRITER_VERSION = {
    2: ("appendOnly", "invariants"),
    3: ("checkConstraints",),
    4: ("changeDataFeed", "generatedColumns"),
    5: ("columnMapping",),
    6: ("identityColumns",),
}
_LISTED_READER, _LISTED_WRITER = 3, 7  # the versions that list features, and the newest
# Features that ask nothing unless the table's properties, or a column's, say so: the key of one.
_PROPERTIES = {
    "appendOnly": r"delta\.appendOnly=true",
    "checkConstraints": r"delta\.constraints\..*",
    "changeDataFeed": r"delta\.enableChangeDataFeed=true",
    "columnMapping": r"delta\.columnMapping\.mode=(?!none).*",
    "invariants": r"delta\.invariants=.*",
    "generatedColumns": r"delta\.generationExpression=.*",
}
_REMOVE = (
    "take it off the table with the tool that set it (in Spark: ALTER TABLE … DROP FEATURE, DROP"
    " CONSTRAINT or UNSET TBLPROPERTIES)"
)
_AGAIN = "ingest the recordings into a new store"
_EARLIER = f"name a version from before with --version, or {_AGAIN}"
_UNSUPPORTED = re.compile(r"Feature '([^']+)' is not supported")  # Delta's library


def expect_readable(table: DeltaTable, *, where: str) -> None:
    """See that the rows of a store's table are those of its files.

    Raises:
        StoreError: the table uses a feature that Restock cannot read.
    """
    protocol, name = table.protocol(), table.table_uri.rstrip("/").rpartition("/")[2]
    version = protocol.min_reader_version
    if version > _LISTED_READER:
        raise _unreadable(f"version {version} of the protocol (minReaderVersion)", name, where)
    listed = version == _LISTED_READER and protocol.reader_features
    for feature in listed or _legacy(_BY_READER_VERSION, version):
        if feature not in _READ and _in_use(table, feature):
            raise _unreadable(f"feature `{feature}`", name, where)


def expect_writable(table: DeltaTable, *, where: str, removing: bool = False) -> None:
    """See that commits may be made to a store's table; `removing`: that take files out.

    Raises:
        StoreError: the table uses a feature that Restock cannot write.
    """
    protocol, name = table.protocol(), table.table_uri.rstrip("/").rpartition("/")[2]
    version = protocol.min_writer_version
    if version > _LISTED_WRITER:
        raise _unwritable(f"version {version} of the protocol (minWriterVersion)", name, where)
    listed = version == _LISTED_WRITER and protocol.writer_features
    for feature in listed or _legacy(_BY_WRITER_VERSION, version):
        allowed = feature in _WRITTEN or (feature == "appendOnly" and not removing)
        if not allowed and _in_use(table, feature):
            raise _unwritable(f"feature `{feature}`", name, where)


def unsupported(error: Exception, name: str, *, where: str) -> StoreError | None:
    """The refusal of table `name` for a feature that Delta's library could not open, if that is
    the error."""
    named = _UNSUPPORTED.search(str(error))
    if named is None:
        return None
    # Older versions cannot be named: the library opens the newest first.
    return _unreadable(f"feature `{named[1]}`", name, where, otherwise=_AGAIN)


def _legacy(by_version: Mapping[int, tuple[str, ...]], version: int) -> Iterator[str]:
    return (one for least, several in by_version.items() if least <= version for one in several)


def _in_use(table: DeltaTable, feature: str) -> bool:
    """Whether a feature that a table lists is in use; one that is not known is taken to be."""
    if feature not in _PROPERTIES:
        return True
    columns = [field.metadata for field in table.schema().fields]
    return any(
        re.fullmatch(_PROPERTIES[feature], f"{key}={value}", re.DOTALL)
        for properties in (table.metadata().configuration, *columns)
        for key, value in properties.items()
    )


def _unreadable(what: str, name: str, where: str, otherwise: str = _EARLIER) -> StoreError:
    return StoreError(
        f"its table `{name}` uses Delta's {what}, which Restock cannot read",
        where=where,
        remedy=f"{_REMOVE}, or {otherwise}",
    )


def _unwritable(what: str, name: str, where: str) -> StoreError:
    return StoreError(
        f"its table `{name}` uses Delta's {what}, which Restock cannot write: nothing changed",
        where=where,
        remedy=f"{_REMOVE}, or {_AGAIN}",
    )
