"""What DuckDB says of a store's damaged files, as an error that says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import duckdb

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.lineage import damage_remedy
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location

# A file of a store, as DuckDB quotes it.
_FILE = re.compile(
    rf"""["'](?P<store>[^"']+)/(?P<file>(?:{TRANSITIONS}|{RECORDINGS}|{FRAMES})/[^"']+\.parquet)["']"""
)
# Of some damage DuckDB does not say in which file it is.
_NAMELESS = re.compile(
    r"TProtocolException|[Dd]ecompress|[Tt]hrift|[Pp]arquet (?:file|page|reader)"
)
_OTHER = (
    *(duckdb.CatalogException, duckdb.BinderException, duckdb.ParserException),
    *(duckdb.OutOfMemoryException, duckdb.InterruptException),
)


def damage(error: duckdb.Error, *, where: str | None = None) -> StoreError | None:
    """The error of a query, if what is wrong is a damaged or missing file; `where` is the place
    that was asked, for damage of which DuckDB does not name the file."""
    text = str(error)
    if isinstance(error, _OTHER):
        return None
    named = _FILE.search(text)
    if named and (Path(named["store"]) / TRANSITIONS / "_delta_log").is_dir():
        missing = not (Path(named["store"]) / named["file"]).exists()
        said = "is missing" if missing else f"cannot be read: {first_line(error)}"
        place = Location.of(named["store"])
        return StoreError(
            f"its file {named['file']} {said}",
            where=str(place),
            remedy=damage_remedy(place, named["file"]),
        )
    if not _NAMELESS.search(text):
        return None
    return StoreError(
        f"is damaged or cannot be read: {first_line(error)}",
        where=where,
        remedy="restore its files from a copy, or let `restock compact STORE --drop-damaged` find"
        " the file: it names the recordings to ingest again",
    )
