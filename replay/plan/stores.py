"""Several stores as one: the transitions of a mixture's other stores beside those of the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import duckdb
import msgspec

from restock.errors import MixtureError, StoreError
from restock.replay.mixture.mixture import Mixture, OtherStore
from restock.replay.plan.candidates import STORE_COLUMN
from restock.replay.store.definitions import definitions
from restock.replay.store.parquet_views import parquet_view
from restock.replay.store.store import Store


class PinnedStore(msgspec.Struct, frozen=True):
    """Another store of a panel, at the version that was taken."""

    name: str
    path: str  # as it was found
    version: int
    repeated_rows: int  # of recordings that a store before it has too: taken from that one


@dataclass(frozen=True)
class AllStores:
    """One connection over all the stores of a mixture; its view `transitions` holds their rows."""

    connection: duckdb.DuckDBPyConnection
    others: tuple[PinnedStore, ...]


@contextmanager
def all_stores(first: Store, mixture: Mixture, folder: Path | None = None) -> Iterator[AllStores]:
    """Yield the first store with the mixture's others beside it, each at its pinned version.

    A relative path is looked up in `folder` (that of the mixture's file), else where one stands.
    The first store's own views stay as they are.

    Raises:
        StoreError: one of them cannot be opened, has no such version, or no rows.
        MixtureError: the stores before one of them have all of its rows too.
    """
    if not mixture.sources.stores:
        yield AllStores(first.connection, ())
        return
    with ExitStack() as opened:
        others = [
            (wanted, opened.enter_context(_open(wanted, folder)))
            for wanted in mixture.sources.stores
        ]
        connection = opened.enter_context(duckdb.connect())
        repeated_rows = _attach(connection, first, others)
        pinned = tuple(
            PinnedStore(wanted.name, str(store.path), store.version, repeated)
            for (wanted, store), repeated in zip(others, repeated_rows, strict=True)
        )
        yield AllStores(connection, pinned)


def _open(wanted: OtherStore, folder: Path | None) -> Store:
    path: str | Path = wanted.path
    if "://" not in wanted.path:
        path = Path(wanted.path).expanduser()
        if not path.is_absolute() and folder is not None:
            path = folder / path
    try:
        store = Store(path, version=wanted.version)
        store.verify()
        return store
    except StoreError as error:
        raise StoreError(
            f"the mixture's store {wanted.name!r}: {error.what}",
            where=error.where,
            remedy=error.remedy,
        ) from error


def _attach(
    connection: duckdb.DuckDBPyConnection, first: Store, others: Sequence[tuple[OtherStore, Store]]
) -> list[int]:
    """Make the view; returns how many rows of each other store are in one before it."""
    tables: dict[str, list[str]] = {"stored_transitions": [], "stored_recordings": []}
    repeated = []
    for number, store in enumerate([first, *(store for _, store in others)]):
        schema = f'"store_{number}"'
        connection.execute(f"CREATE SCHEMA {schema}")
        for table in tables:
            if not store.files[table]:
                raise StoreError("it holds no transitions", where=str(store.path))
            connection.execute(parquet_view(table, store.files[table], schema=f"store_{number}"))
        connection.execute(
            f"CREATE TABLE {schema}.mine AS SELECT DISTINCT recording_id"
            f" FROM {schema}.stored_transitions"
        )
        before = " UNION ALL ".join(f'FROM "store_{i}".mine' for i in range(number))
        known = f"recording_id IN ({before})" if before else "false"
        if number:
            count = f"SELECT countif({known}), count(*) FROM {schema}.stored_transitions"
            [(repeats, rows)] = connection.sql(count).fetchall()
            if repeats == rows:
                raise _all_repeated(others[number - 1][0].name, rows, number)
            repeated.append(int(repeats))
        for table in tables:
            tables[table].append(
                f"SELECT *, {number} AS {STORE_COLUMN} FROM {schema}.{table} WHERE NOT ({known})"
            )
    for table, parts in tables.items():
        connection.execute(f"CREATE VIEW {table} AS " + " UNION ALL BY NAME ".join(parts))
    connection.execute(definitions(names=["rows.sql"]))
    return repeated


def _all_repeated(name: str, rows: int, number: int) -> MixtureError:
    where = "the main store" if number == 1 else "the stores before it"
    return MixtureError(
        f"all {rows:,} rows of {name!r} are also in {where}, and are drawn from there",
        remedy="leave this store out of the mixture: a stratum with a larger `share` draws them"
        " more often, and its `where` may name their recordings (recording_id IN (…))",
    )
