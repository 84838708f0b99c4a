"""How large a ring beside a panel must be, by the diversity of the panel's own rows."""

from __future__ import annotations

from restock.replay.panel.panel import Panel
from restock.replay.store.capacity import Capacity, capacity_of_rows

_COLUMNS = ("transition_id", "episode_id", "logged_ns", "condition", "zone", "action")


def capacity_of_panel(panel: Panel) -> Capacity:
    """What the newest of a panel's rows cover, and how many keep its diversity.

    As `recommend_capacity` says of a store: but of the rows that a run is fed, with none of the
    evaluation split.
    """
    return capacity_of_rows(panel.meta.select(list(_COLUMNS)))


__all__ = ["capacity_of_panel"]
