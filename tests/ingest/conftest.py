"""Fixtures shared by the tests of ingest."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from deltalake import DeltaTable
from support.stores import one

from restock.ingest.store.writer import StoreWriter


@pytest.fixture
def writer(tmp_path: Path) -> StoreWriter:
    """Return the writer of a store `s` that holds two recordings."""
    store_writer = StoreWriter(tmp_path / "s")
    store_writer.write_all([one(1), one(2)])
    return store_writer


@pytest.fixture
def before_commit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that runs another writer's action right before the next commit."""
    transact = StoreWriter.transact

    def arrange(meanwhile: Callable[[], object], table: str = "") -> None:
        def transact_late(self: StoreWriter, delta_table: DeltaTable, *args: Any) -> None:
            if delta_table.table_uri.rstrip("/").endswith(table):
                monkeypatch.setattr(StoreWriter, "transact", transact)
                meanwhile()
            transact(self, delta_table, *args)

        monkeypatch.setattr(StoreWriter, "transact", transact_late)

    return arrange
