"""Atomic replacement of files, and reading with errors that name the file.

A reader sees the old file or the new one, never a part of it. If a file cannot be read (missing,
truncated, damaged), the error is the `RestockError` subclass that the caller asked for. It names
the file and says what to do.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from restock.errors import ConfigError, RestockError


def read_table(
    path: Path,
    schema: pa.Schema | None = None,
    *,
    columns: Sequence[str] | None = None,
    error: type[RestockError] = RestockError,
    remedy: str | None = None,
) -> pa.Table:
    """Read a Parquet file, and verify the checksums of its pages if it has them.

    A column of `schema` that is missing in the file is null in the table. A column that is not in
    `schema` is refused: its name may be damaged, because checksums do not cover names.

    Raises:
        RestockError: (of type `error`) the file does not exist or is damaged.
    """
    try:
        if schema is not None:
            for name in pq.read_schema(path).names:
                if name not in schema.names:
                    raise pa.ArrowInvalid(f"it has an unknown column {name!r}")
        return pq.read_table(
            path,
            schema=schema,
            columns=None if columns is None else list(columns),
            partitioning=None,
            page_checksum_verification=True,
        )
    except (pa.ArrowException, OSError) as problem:
        raise _unreadable(path, problem, error, remedy) from problem


def read_json(
    path: Path, *, error: type[RestockError] = RestockError, remedy: str | None = None
) -> dict[str, Any]:
    """Read a JSON object from a file.

    Raises:
        RestockError: (of type `error`) the file does not exist, or is not a JSON object.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as problem:
        raise _unreadable(path, problem, error, remedy) from problem
    if not isinstance(document, dict):
        said = f"is damaged: it holds a {type(document).__name__}, no JSON object"
        raise error(said, where=str(path), remedy=remedy)
    return document


def _unreadable(
    path: Path, problem: Exception, error: type[RestockError], remedy: str | None
) -> RestockError:
    if not path.exists():
        return error("does not exist", where=str(path), remedy=remedy)
    return error(
        f"is damaged or cannot be read: {first_line(problem)}", where=str(path), remedy=remedy
    )


def first_line(error: BaseException | str) -> str:
    """Return the first line of an error, without the system's error number."""
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return next((line for line in said.splitlines() if line.strip()), type(error).__name__)


def write_table(table: pa.Table, path: Path) -> None:
    """Replace a Parquet file atomically; each page has a checksum."""
    temporary = _temporary(path)
    try:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, *, exclusive: bool = False) -> None:
    """Replace a text file atomically, as `write_bytes` does."""
    write_bytes(path, text.encode("utf-8"), exclusive=exclusive)


def write_bytes(path: Path, content: bytes, *, exclusive: bool = False) -> None:
    """Replace a file atomically; a pipe or a device is written to instead.

    Raises:
        FileExistsError: `exclusive` is set, and `path` exists.
    """
    if _takes_a_stream(path) and not exclusive:
        path.write_bytes(content)
        return
    temporary = _temporary(path, replaces=not exclusive)
    try:
        temporary.write_bytes(content)
        if exclusive:
            os.link(temporary, path)
        else:
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _takes_a_stream(path: Path) -> bool:
    """Return whether to write into a path (/dev/stdout, a named pipe), and not to replace it."""
    if path.is_symlink() and str(path.readlink()).startswith("/proc/self/fd"):
        return True
    return path.exists() and not path.is_file() and not path.is_dir()


# File that identifies a kind of folder -> name of the kind, for messages.
_MARKS = {
    "panel.json": "the panel",
    "transitions/_delta_log": "the store",
    "progress.parquet": "the run",
}


def expect_file_place(path: Path | None, option: str) -> None:
    """Check, before any work, that an option's output file is not a folder.

    Raises:
        ConfigError: `path` is a folder.
    """
    if path is not None and path.is_dir():
        raise ConfigError(
            f"{path} is a folder, and a file is to be written",
            where=option,
            remedy="give the name of a file, in this folder for example",
        )


def expect_place(path: Path, error: type[RestockError] = RestockError) -> None:
    """Check that a new folder can be made at `path`, outside of any panel, store and run.

    Raises:
        RestockError: (of type `error`) the folder cannot be made there, or `path` is inside a
            panel, a store or a run, and would be removed together with it.
    """
    absolute = path.absolute()
    parent = next(folder for folder in absolute.parents if folder.exists())
    why = None
    if not parent.is_dir():
        why = f"cannot be made: {parent} is a file"
    elif not os.access(parent, os.W_OK | os.X_OK):
        why = f"cannot be made: {parent} may not be written"
    elif any(map(is_undecoded, str(absolute))):
        why = "cannot be made: its path is not UTF-8, and other libraries cannot write there"
    within = (
        f"is within {kind} {folder}: what replaces or removes that removes this, too"
        for folder in absolute.parents
        for mark, kind in _MARKS.items()
        if (folder / mark).exists()
    )
    if why := next(within, why):
        raise error(why, where=str(path), remedy="choose another --out")


def is_undecoded(letter: str) -> bool:
    """Return whether a character of a path is a surrogate for a byte that is not UTF-8."""
    return "\udc80" <= letter <= "\udcff"


def _temporary(path: Path, *, replaces: bool = True) -> Path:
    if replaces and path.is_dir():  # the later error would name the temporary file
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    return temporary_name(path)


def temporary_name(path: Path) -> Path:
    """Return the path of the temporary file for `path`: beside it, with this process's id."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def remove_leftovers(folder: Path, pattern: str) -> list[Path]:
    """Remove temporary files that killed processes left in `folder`; return the removed ones.

    `pattern` is a glob for the final names. Only names made by `temporary_name` are removed. Files
    of other processes that are still running stay.
    """
    removed = []
    for path in folder.glob(f".{pattern}.*.tmp"):
        process = path.name.removesuffix(".tmp").rpartition(".")[2]
        ours = process.isdigit() and not path.is_symlink() and path.is_file()
        if ours and (int(process) == os.getpid() or not is_running(int(process))):
            path.unlink(missing_ok=True)
            removed.append(path)
    return removed


@contextmanager
def building(out: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `out` in which to build it; remove the folder at the end.

    Folders left by processes that were killed are removed first.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{out.name}.building~"
    for left in out.parent.iterdir():
        host, _, process = left.name.removeprefix(prefix).rpartition("~")[0].rpartition("~")
        of_this_host = (
            left.name.startswith(prefix) and host == platform.node() and process.isdigit()
        )
        if of_this_host and not is_running(int(process)):
            shutil.rmtree(left, ignore_errors=True)
    partial = Path(tempfile.mkdtemp("", f"{prefix}{platform.node()}~{os.getpid()}~", out.parent))
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def is_running(process: int) -> bool:
    """Return whether a process with this id runs on this machine."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
