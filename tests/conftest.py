"""Fixtures that several rooms' tests share."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from support.stores import recording_transitions, write_store


@pytest.fixture(scope="session")
def transitions() -> pa.Table:
    """Three recordings' transitions in one table, about 1,200 rows."""
    return pa.concat_tables([recording_transitions(index) for index in (1, 2, 3)])


@pytest.fixture(scope="session")
def store_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the same three recordings."""
    path = tmp_path_factory.mktemp("replay") / "store"
    return write_store(path, [recording_transitions(index) for index in (1, 2, 3)])
