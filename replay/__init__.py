"""Query stores, build panels from mixtures, sample batches, and trace rows to their recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.replay.export.dataset import export_dataset as export_dataset
    from restock.replay.fleet.drift import measure_drift as measure_drift
    from restock.replay.fleet.gaps import find_gaps as find_gaps
    from restock.replay.fleet.store_difference import diff_stores as diff_stores
    from restock.replay.mixture.mixture import load_mixture as load_mixture
    from restock.replay.panel.build import build_panel as build_panel
    from restock.replay.panel.logged_sampler import sampler_for as sampler_for
    from restock.replay.panel.panel import Panel as Panel
    from restock.replay.sampling.rules import RULES as RULES
    from restock.replay.sampling.rules import Rule as Rule
    from restock.replay.sampling.rules import StratumDraws as StratumDraws
    from restock.replay.sampling.rules import StratumRows as StratumRows
    from restock.replay.sampling.sampler import QuotaSampler as QuotaSampler
    from restock.replay.store.audit import load_audits as load_audits
    from restock.replay.store.audit import load_thresholds as load_thresholds
    from restock.replay.store.audit import recommend_capacity as recommend_capacity
    from restock.replay.store.audit import run_audits as run_audits
    from restock.replay.store.frames import camera_frames as camera_frames
    from restock.replay.store.store import Store as Store
    from restock.replay.trace.trace import trace_row as trace_row
else:
    __getattr__, __dir__, __all__ = lazy(__name__)
