"""Recordings to labelled transitions: MCAP files and ROS 2 bags in, rows of a store out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.ingest.batch import IngestJob as IngestJob
    from restock.ingest.batch import ingest_all as ingest_all
    from restock.ingest.containers.discover import recordings_in as recordings_in
    from restock.ingest.containers.open_recording import open_recording as open_recording
    from restock.ingest.containers.recording import Recording as Recording
    from restock.ingest.describe import describe_recording as describe_recording
    from restock.ingest.live.observer import LiveObserver as LiveObserver
    from restock.ingest.pipeline import ingest as ingest
    from restock.ingest.profile.profile import Profile as Profile
    from restock.ingest.profile.profile import load_profile as load_profile
    from restock.ingest.propose.propose import propose_profile as propose_profile
    from restock.ingest.relabel import RecordingCorrections as RecordingCorrections
    from restock.ingest.relabel import correct_store as correct_store
    from restock.ingest.relabel import relabel_store as relabel_store
    from restock.ingest.relabel import remove_corrections as remove_corrections
    from restock.ingest.remove import remove_recordings as remove_recordings
    from restock.ingest.store.writer import StoreWriter as StoreWriter
else:
    __getattr__, __dir__, __all__ = lazy(
        __name__,
        {
            "restock.ingest.batch": ["IngestJob", "ingest_all"],
            "restock.ingest.containers.discover": ["recordings_in"],
            "restock.ingest.containers.open_recording": ["open_recording"],
            "restock.ingest.containers.recording": ["Recording"],
            "restock.ingest.describe": ["describe_recording"],
            "restock.ingest.pipeline": ["ingest"],
            "restock.ingest.profile.profile": ["Profile", "load_profile"],
            "restock.ingest.propose.propose": ["propose_profile"],
            "restock.ingest.relabel": [
                "RecordingCorrections",
                "correct_store",
                "relabel_store",
                "remove_corrections",
            ],
            "restock.ingest.remove": ["remove_recordings"],
            "restock.ingest.live.observer": ["LiveObserver"],
            "restock.ingest.store.writer": ["StoreWriter"],
        },
    )
