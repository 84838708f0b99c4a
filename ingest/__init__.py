"""Ingest: turns recordings (MCAP files, bags) into labelled transitions, the rows of a store."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.ingest.batch import IngestJob as IngestJob
    from restock.ingest.batch import ingest_all as ingest_all
    from restock.ingest.containers.open_recording import open_recording as open_recording
    from restock.ingest.containers.open_recording import recordings_in as recordings_in
    from restock.ingest.live.observer import LiveObserver as LiveObserver
    from restock.ingest.pipeline import ingest as ingest
    from restock.ingest.profile.profile import Profile as Profile
    from restock.ingest.profile.profile import load_profile as load_profile
    from restock.ingest.relabel import relabel_store as relabel_store
    from restock.ingest.store.writer import StoreWriter as StoreWriter
else:
    __getattr__, __dir__, __all__ = lazy(__name__)
