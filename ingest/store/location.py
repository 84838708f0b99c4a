"""The location of a store: a folder on this machine, or `s3://bucket/prefix`.

Settings for S3 come from the same environment variables as for AWS's own tools: `AWS_REGION`,
`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, and `AWS_ENDPOINT_URL` for a
server that is not Amazon's. Delta's library opens tables and commits to them, with conditional puts
to detect other writers. Arrow's S3 client, which is faster, reads and writes Parquet files.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.fs
import pyarrow.parquet as pq
from deltalake import DeltaTable
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.fs import DeltaStorageHandler

from restock.errors import StoreError, quoted
from restock.files import first_line
from restock.ingest.store.version import (
    LOG,
    Version,
    expect_format,
    expect_readable,
    expect_readable_commits,
    expect_whole,
    split_version,
    unsupported,
    version_at,
)

if TYPE_CHECKING:
    import pyarrow.compute as pc

# File that marks another kind of folder of Restock -> what that folder is.
_OTHERS = {"panel.json": "a panel", "config.json": "the folder of a run"}
TRANSITIONS, RECORDINGS, FRAMES = "transitions", "recordings", "frames"  # folders of a store
# With these, a call to an endpoint that is down or silent fails within a minute.
CONNECT_S, REQUEST_S, RETRIES, RETRY_S = 5, 30, 4, 30
DEFAULT_REGION = "us-east-1"  # signatures need a region, even for servers that have none
# One slash suffices: pathlib folds the two slashes of an address into one.
_S3 = re.compile(r"s3a?:/{1,2}(?P<bucket>[^/]+)/?(?P<prefix>.*)")
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/")
_SECRET = re.compile(r"(?s)[A-Za-z][A-Za-z0-9+.-]+:/{1,2}[^/@]*:.*@")
_ENCODED = re.compile(r"%[0-9A-Fa-f]{2}")
_DENIED = re.compile(r"(?s)(?:operation on (?P<file>/[^\n\x1b]*).*)?Permission denied")  # delta-rs
# Pattern in the error text of a server or client, what the error means, and what to do.
_MEANINGS = (
    ("NoSuchBucket|Bucket .* not found", "this bucket does not exist",
     "create it first, or correct the address"),
    ("InvalidAccessKeyId|InvalidClientTokenId", "the server does not know the access key",
     "check AWS_ACCESS_KEY_ID (and AWS_ENDPOINT_URL)"),
    ("SignatureDoesNotMatch", "the server refused the signature",
     "check AWS_SECRET_ACCESS_KEY and AWS_REGION"),
    ("ExpiredToken", "the credentials have expired", "get new ones"),
    ("169.254.169|CredentialsNotLoaded|ECS_CONTAINER|no providers in chain",
     "no credentials were found",
     "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"),
    ("AccessDenied|403 Forbidden|ACCESS_DENIED", "access is denied",
     "the credentials must be allowed to list, read, write and delete there"),
    ("Connection refused|dns error|failed to lookup|NETWORK_CONNECTION|Connect\\)|tcp connect",
     "the server cannot be reached", "check AWS_ENDPOINT_URL"),
    ("timed out|TIMEOUT|timeout was reached", "the server does not answer",
     "check AWS_ENDPOINT_URL and the network"),
    ("PermanentRedirect|301 Moved", "the bucket is in another region", "set AWS_REGION"),
)  # fmt: skip


@dataclass(frozen=True)
class Location:
    """A store's location. `str()` gives it as a user writes it, without a version."""

    text: str
    folder: Path | None  # None: on S3
    version: Version | None = None  # given after an @; None: the newest

    @classmethod
    def of(cls, place: str | Path | Location) -> Location:
        """Parse a path or an address, with an optional version after `@`.

        Raises:
            StoreError: the address is of another kind or contains a secret, or Delta's library
                cannot handle the path.
        """
        if isinstance(place, Location):
            return place
        text, version = split_version(str(place))
        if not text.strip():
            raise StoreError(
                "the name of the store is empty",
                remedy="give a folder, or s3://bucket/prefix: is a variable not set?",
            )
        if _SECRET.match(text):
            raise StoreError(
                "a store's address must not hold a key and its secret",
                where=text,
                remedy="give the address without them, and set AWS_ACCESS_KEY_ID and"
                " AWS_SECRET_ACCESS_KEY; make a new secret if others can read this line",
            )
        on_s3 = _S3.fullmatch(text)
        if not on_s3 and (scheme := _SCHEME.match(text)):
            raise StoreError(
                f"a store cannot be on {scheme[1]}:",
                where=text,
                remedy="give a folder, or s3://bucket/prefix",
            )
        if _ENCODED.search(text if on_s3 else str(Path(text).absolute())):
            # Delta's library would decode `%20` to a space, and read another path.
            raise StoreError(
                "the path of a store cannot contain a percent sign followed by two hex digits",
                where=text,
                remedy="choose another folder, or rename it",
            )
        if on_s3:
            prefix = on_s3["prefix"].strip("/")
            return cls(f"s3://{on_s3['bucket']}" + (f"/{prefix}" if prefix else ""), None, version)
        return cls(text, Path(text), version)

    def __str__(self) -> str:
        return self.text

    @property
    def options(self) -> dict[str, str] | None:
        """Return options for Delta's library, besides those from the environment."""
        if self.folder is not None:
            return None
        return {
            "connect_timeout": f"{CONNECT_S}s",
            "timeout": f"{REQUEST_S}s",
            "max_retries": f"{RETRIES}",
            "retry_timeout": f"{RETRY_S}s",
            "aws_conditional_put": "etag",  # so that only one writer can make a version of the log
            **({"aws_region": region} if (region := _region()) else {}),
            **({"aws_endpoint_url": endpoint} if (endpoint := _endpoint(self.text)) else {}),
            "allow_http": str(endpoint.startswith("http://")).lower(),
        }

    def table(self, name: str) -> str:
        """Return the address of a table."""
        return str(self.folder / name) if self.folder is not None else f"{self.text}/{name}"

    def expect_newest(self) -> None:
        """Raise StoreError if a version is given: the caller needs the newest."""
        if self.version is not None:
            raise StoreError(
                "only the newest version can be changed or verified",
                where=f"{self.text}@{self.version}",
                remedy=f"give {self.text}",
            )

    def has_table(self, name: str) -> bool:
        """Return whether a table exists; raise StoreError if the place cannot be reached.

        A log folder without a commit does not count: a writer may be making the first version.
        """
        with self.translate_errors():
            return bool(DeltaTable.is_deltatable(self.table(name), self.options))

    def expect_both_tables(self) -> None:
        """Check that neither of the two tables is missing while the other exists.

        A first ingest that was killed may leave only `recordings`, without files. That is allowed:
        a writer makes `recordings` first, and adds manifests when it has made both tables.

        Raises:
            StoreError: a table is missing, or the place cannot be reached.
        """
        if self.has_table(TRANSITIONS):
            gone, other = RECORDINGS, TRANSITIONS
        elif self.has_table(RECORDINGS) and len(self.open_table(RECORDINGS).file_uris()):
            gone, other = TRANSITIONS, RECORDINGS
        else:
            return
        if not self.has_table(gone):  # looked up last: a writer may just have made it
            raise StoreError(
                f"its table `{gone}` is missing, while `{other}` is there",
                where=self.text,
                remedy=f"restore {self.table(gone)} from a copy; if there is none, ingest the "
                "recordings into a new store",
            )

    def other(self) -> str | None:
        """Return "a panel" or "the folder of a run" if the store's path is one, else None."""
        for file, kind in _OTHERS.items():
            if self.folder is not None and (self.folder / file).is_file():
                return kind
        return None

    def absent(self) -> StoreError:
        """Return the error for a place without a store."""
        what, remedy = "no such store", self.remedy_if_absent()
        if self.folder is not None and self.folder.exists():
            what = "not a store"
        if self.folder is not None and self.folder.is_file():
            what, remedy = "is a file, not a store", "give the folder of a store"
        elif kind := self.other():
            what = f"is {kind}, not a store"
            remedy = "give its store (its JSON file names it), or another"
        return StoreError(what, where=self.text, remedy=remedy)

    def remedy_if_absent(self) -> str:
        """Return what to do if there is no store."""
        return f"`restock ingest RECORDINGS --store {quoted(self.text)}` makes a store"

    def open_table(self, name: str, version: Version | None = None) -> DeltaTable:
        """Open a table at a version's number, at a time, or by default at its newest version.

        Raises:
            StoreError: there is no such table or version, it has another format or a feature that
                Restock cannot read, its log is damaged, or the place cannot be reached.
        """
        try:
            with self.translate_errors():
                table = DeltaTable(self.table(name), storage_options=self.options)
                if isinstance(version, datetime):
                    version = version_at(table, version, where=self.text)
                newest = table.version()
                if version is not None and version != newest:
                    if not 0 <= version <= newest:
                        raise StoreError(
                            f"has no version {version}: its newest is {newest}", where=self.text
                        )
                    table.load_as_version(version)
                if self.folder is not None:  # disks can hold half a commit, S3 cannot
                    expect_whole(self.folder / name / LOG, table.version(), where=self.text)
                expect_format(table, where=self.text)
                expect_readable(table, where=self.text)
                return table
        except (TableNotFoundError, DeltaError, ValueError) as error:
            if refused := unsupported(error, name, where=self.text):
                raise refused from error
            if self.folder is not None:
                expect_readable_commits(self.folder / name / LOG, where=self.text)
            raise StoreError(
                f"its table `{name}` cannot be opened"
                + (f" at version {version}" if version is not None else "")
                + f": {first_line(error)}",
                where=self.text,
                remedy=f"restore its {LOG} from a copy; a checkpoint that cannot be read may be"
                " deleted, together with _last_checkpoint, if all commits are there",
            ) from error

    def has_new_commits(self, name: str, table: DeltaTable) -> bool:
        """Return whether a table that was read has newer commits, or was replaced meanwhile."""
        version = table.version()
        if self.folder is not None:  # looking for the next commit's file is 100 times faster
            current, following = (f"{name}/{LOG}/{one:020}.json" for one in (version, version + 1))
            return (self.folder / following).exists() or not (self.folder / current).exists()
        with self.translate_errors():
            table.update_incremental()
        return bool(table.version() != version)

    @cached_property
    def files(self) -> pa.fs.FileSystem:
        """Return a file system whose root is the store."""
        if self.folder is not None:
            return pa.fs.SubTreeFileSystem(str(self.folder.absolute()), pa.fs.LocalFileSystem())
        s3 = pa.fs.S3FileSystem(
            region=_region(),
            endpoint_override=_endpoint(self.text) or None,
            connect_timeout=CONNECT_S,
            request_timeout=REQUEST_S,
            retry_strategy=pa.fs.AwsStandardS3RetryStrategy(max_attempts=RETRIES),
        )
        return pa.fs.SubTreeFileSystem(self.text.removeprefix("s3://"), s3)

    def write(self, rows: pa.Table, path: str, **options: Any) -> int:
        """Write a Parquet file, flushed if it is on a disk; return its size in bytes."""
        with self.writing(path) as out:
            pq.write_table(rows, out, **options)
            return int(out.tell())

    @contextmanager
    def writing(self, path: str) -> Iterator[Any]:
        """Open a new file for writing; it is complete, and flushed to disk, when the block ends."""
        if self.folder is None:
            with self.translate_errors(), self.files.open_output_stream(path) as out:
                yield out
            return
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb") as out:
            yield out
            out.flush()
            os.fsync(out.fileno())

    @contextmanager
    def reading(self, path: str) -> Iterator[pa.NativeFile]:
        """Open a file for reading. Raises as `read` does."""
        with self.translate_errors(), self.files.open_input_file(path) as file:
            yield file

    def read(
        self,
        path: str,
        *,
        columns: Sequence[str] | None = None,
        where: pc.Expression | None = None,
        repeated: Sequence[str] = (),
    ) -> pa.Table:
        """Read a Parquet file's rows.

        String views, which other tools write, are cast to strings.

        Those of `columns` that the file lacks are left out. With a filter `where`, all columns are
        read. `repeated` text columns become Arrow dictionaries, with each text in memory once.

        Raises:
            FileNotFoundError: the file does not exist.
            StoreError: the place cannot be reached.
        """
        with self.reading(path) as file:
            whole = open_parquet(file)  # not `read_table`, which imports Arrow's slow data sets
            if where is not None:
                if plain_text(whole.schema_arrow) == whole.schema_arrow:
                    return pq.read_table(
                        file, partitioning=None, filters=where, page_checksum_verification=True
                    )
                groups = map(whole.read_row_group, range(whole.num_row_groups))
                return pa.concat_tables([with_plain_text(one).filter(where) for one in groups])
            names = whole.schema_arrow.names
            if shared := [name for name in repeated if name in names]:
                whole = open_parquet(file, metadata=whole.metadata, read_dictionary=shared)
            read = [name for name in names if columns is None or name in columns]
            return with_plain_text(whole.read(read))

    def row_groups(self, path: str, columns: Sequence[str]) -> Iterator[pa.Table]:
        """Yield a Parquet file's rows, one row group at a time, with those columns that it has.

        `list.field` reads only that field of a list of structs. Raises as `read` does.
        """

        def is_requested(leaf: str) -> bool:
            # The parts of the path between a list and its field depend on the file's writer.
            names = leaf.split(".")
            return names[0] in columns or f"{names[0]}.{names[-1]}" in columns

        with self.reading(path) as file:
            whole = open_parquet(file)
            leaves = [whole.schema.column(number).path for number in range(len(whole.schema))]
            read = [leaf for leaf in leaves if is_requested(leaf)]
            for group in range(whole.num_row_groups):
                yield with_plain_text(whole.read_row_group(group, read))

    def read_schema(self, path: str) -> pa.Schema:
        """Read a Parquet file's schema, with its metadata. Raises as `read` does."""
        with self.translate_errors(), self.files.open_input_file(path) as file:
            return plain_text(pq.read_schema(file))

    def times(self, folder: str) -> dict[str, float]:
        """Return the write times of all files below a folder, by path relative to it.

        Times are in seconds since 1970; infinity if unknown.
        """
        with self.translate_errors():
            infos = self.files.get_file_info(
                pa.fs.FileSelector(folder, recursive=True, allow_not_found=True)
            )
        return {
            info.path.removeprefix(f"{folder}/"): (info.mtime_ns or math.inf) * 1e-9
            for info in infos
            if info.is_file
        }

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; missing ones are not an error."""
        if self.folder is not None:
            for path in paths:
                (self.folder / path).unlink(missing_ok=True)
            return
        # Not with Arrow's client, which puts an empty object in place of a folder's last file.
        with self.translate_errors():
            s3 = DeltaStorageHandler(self.text, self.options)
            for path in paths:
                s3.delete_file(path)

    @contextmanager
    def translate_errors(self) -> Iterator[None]:
        """Turn errors of S3, and of folders that Delta's library may not read, into a StoreError.

        Other errors of Delta, conflicts of writers and errors for missing files pass unchanged.
        """
        try:
            yield
        except (CommitFailedError, TableNotFoundError):
            raise
        except (OSError, DeltaError) as error:
            text = str(error)
            denied = _DENIED.search(text) if self.folder is not None else None
            if denied and not getattr(error, "errno", None):  # Python's own error is clear enough
                raise StoreError(
                    f"permission denied: {denied['file'] or 'its files'} cannot be read",
                    where=self.text,
                    remedy="give this user permission to read the store (and to write, to ingest)",
                ) from error
            if self.folder is not None or not re.search("S3|AWS", text):
                raise
            for pattern, meaning, remedy in _MEANINGS:
                if re.search(pattern, text):
                    raise StoreError(meaning, where=self.text, remedy=remedy) from error
            if isinstance(error, FileNotFoundError):
                raise
            raise StoreError(first_line(error), where=self.text) from error


def open_parquet(source: pa.NativeFile, **options: Any) -> pq.ParquetFile:
    """Open a Parquet file so that reading verifies the checksums of its pages.

    Changed bytes raise an OSError. Files of other tools may have no checksums, and are not checked.
    """
    return pq.ParquetFile(source, page_checksum_verification=True, **options)


def with_plain_text(rows: pa.Table) -> pa.Table:
    """Cast string views to strings: Arrow cannot compare or look up string views."""
    schema = plain_text(rows.schema)
    return rows if schema == rows.schema else rows.cast(schema)


def plain_text(schema: pa.Schema) -> pa.Schema:
    """Replace string views, which other tools write, by strings, also inside nested types."""
    fields = [field.with_type(_plain(field.type)) for field in schema]
    return pa.schema(fields, metadata=schema.metadata)


def _plain(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_string_view(kind):
        return pa.string()
    if pa.types.is_map(kind):
        return pa.map_(_plain(kind.key_type), _plain(kind.item_type))
    if pa.types.is_list(kind):
        return pa.list_(kind.value_field.with_type(_plain(kind.value_type)))
    if pa.types.is_struct(kind):
        return pa.struct([field.with_type(_plain(field.type)) for field in kind])
    return kind


def _region() -> str | None:
    """Return the AWS region from the environment; None if an AWS profile may set it."""
    named = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    return named or (None if os.environ.get("AWS_PROFILE") else DEFAULT_REGION)


def _endpoint(where: str) -> str:
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    if endpoint and not re.match(r"https?://[^/]", endpoint):
        raise StoreError(
            f"AWS_ENDPOINT_URL is {endpoint!r}, which is not the address of a server",
            where=where,
            remedy="write it like http://127.0.0.1:9000",
        )
    return endpoint
