"""Fixtures that several of ingest's tests share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from deltalake import DeltaTable
from support.stores import one

from restock.ingest.store.writer import StoreWriter


@pytest.fixture
def writer(tmp_path: Path) -> StoreWriter:
    """Return the writer of a store `s` of two recordings."""
    made = StoreWriter(tmp_path / "s")
    made.write_all([one(1), one(2)])
    return made


@pytest.fixture
def before_commit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function: it has another writer do something right before the next commit."""
    transact = StoreWriter.transact

    def arrange(meanwhile: Callable[[], object], table: str = "") -> None:
        def overtaken(self: StoreWriter, to: DeltaTable, *args: Any) -> None:
            if to.table_uri.rstrip("/").endswith(table):
                monkeypatch.setattr(StoreWriter, "transact", transact)
                meanwhile()
            transact(self, to, *args)

        monkeypatch.setattr(StoreWriter, "transact", overtaken)

    return arrange
