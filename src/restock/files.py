"""Files that are replaced in one step: a reader sees the old one or the new one, never a part."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq


def write_table(table: pa.Table, path: Path) -> None:
    """Replace a Parquet file in one step."""
    temporary = _temporary(path)
    try:
        pq.write_table(table, temporary, compression="zstd")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, *, exclusive: bool = False) -> None:
    """Replace a text file in one step; as `write_bytes`."""
    write_bytes(path, text.encode("utf-8"), exclusive=exclusive)


def write_bytes(path: Path, content: bytes, *, exclusive: bool = False) -> None:
    """Replace a file in one step.

    Raises:
        FileExistsError: `exclusive`, and there is something at `path` already.
    """
    temporary = _temporary(path)
    try:
        temporary.write_bytes(content)
        if exclusive:
            os.link(temporary, path)
        else:
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


__all__ = ["write_bytes", "write_table", "write_text"]
