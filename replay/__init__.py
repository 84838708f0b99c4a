"""Stores, mixtures and panels: what is there, what a run samples, and where a row came from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.replay.export.dataset import export_dataset as export_dataset
    from restock.replay.fleet.drift import measure_drift as measure_drift
    from restock.replay.fleet.gaps import find_gaps as find_gaps
    from restock.replay.fleet.missions_file import read_missions as read_missions
    from restock.replay.fleet.panel_difference import diff_panels as diff_panels
    from restock.replay.fleet.shopping_list import shopping_list as shopping_list
    from restock.replay.fleet.store_difference import diff_stores as diff_stores
    from restock.replay.mixture.mixture import Mixture as Mixture
    from restock.replay.mixture.mixture import load_mixture as load_mixture
    from restock.replay.panel.build import build_panel as build_panel
    from restock.replay.panel.iterable import PanelDataset as PanelDataset
    from restock.replay.panel.logged_sampler import sampler_for as sampler_for
    from restock.replay.panel.panel import Panel as Panel
    from restock.replay.review.doubtful import doubtful_events as doubtful_events
    from restock.replay.review.verdicts import read_verdicts as read_verdicts
    from restock.replay.sampling.chunked import ChunkedSampler as ChunkedSampler
    from restock.replay.sampling.gather import gather_rows as gather_rows
    from restock.replay.sampling.priorities import Lap as Lap
    from restock.replay.sampling.priorities import Per as Per
    from restock.replay.sampling.priorities import PrioritySampler as PrioritySampler
    from restock.replay.sampling.sampler import QuotaSampler as QuotaSampler
    from restock.replay.sampling.sampler import Sampler as Sampler
    from restock.replay.store.audit import load_audits as load_audits
    from restock.replay.store.audit import load_thresholds as load_thresholds
    from restock.replay.store.audit import run_audits as run_audits
    from restock.replay.store.capacity import recommend_capacity as recommend_capacity
    from restock.replay.store.frames import CameraFrame as CameraFrame
    from restock.replay.store.frames import camera_frames as camera_frames
    from restock.replay.store.store import Store as Store
    from restock.replay.trace.trace import TracePlaces as TracePlaces
    from restock.replay.trace.trace import audited_rows as audited_rows
    from restock.replay.trace.trace import trace_row as trace_row
else:
    __getattr__, __dir__, __all__ = lazy(
        __name__,
        {
            "restock.replay.export.dataset": ["export_dataset"],
            "restock.replay.fleet.drift": ["measure_drift"],
            "restock.replay.fleet.gaps": ["find_gaps"],
            "restock.replay.fleet.missions_file": ["read_missions"],
            "restock.replay.fleet.panel_difference": ["diff_panels"],
            "restock.replay.fleet.shopping_list": ["shopping_list"],
            "restock.replay.fleet.store_difference": ["diff_stores"],
            "restock.replay.mixture.mixture": ["Mixture", "load_mixture"],
            "restock.replay.panel.build": ["build_panel"],
            "restock.replay.panel.iterable": ["PanelDataset"],
            "restock.replay.panel.logged_sampler": ["sampler_for"],
            "restock.replay.panel.panel": ["Panel"],
            "restock.replay.review.doubtful": ["doubtful_events"],
            "restock.replay.review.verdicts": ["read_verdicts"],
            "restock.replay.sampling.chunked": ["ChunkedSampler"],
            "restock.replay.sampling.gather": ["gather_rows"],
            "restock.replay.sampling.priorities": ["Lap", "Per", "PrioritySampler"],
            "restock.replay.sampling.sampler": ["QuotaSampler", "Sampler"],
            "restock.replay.store.audit": ["load_audits", "load_thresholds", "run_audits"],
            "restock.replay.store.capacity": ["recommend_capacity"],
            "restock.replay.store.frames": ["CameraFrame", "camera_frames"],
            "restock.replay.store.store": ["Store"],
            "restock.replay.trace.trace": ["TracePlaces", "audited_rows", "trace_row"],
        },
    )
