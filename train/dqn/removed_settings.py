"""Settings of earlier versions that no measurement showed ahead of the default recipe.

The `config.json` of an earlier run has them. Where they were off, they changed nothing, and are
left out wherever such a config is parsed or compared; where they were on, it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from restock.errors import ConfigError


class _Removed(NamedTuple):
    table: str
    key: str
    off: int  # the value at which it changed nothing
    parts: tuple[str, ...] = ()  # keys of the same table that had no effect while it was off


_REMOVED = (
    _Removed("network", "quantiles", 0),
    _Removed("network", "ensemble", 1),
    _Removed("loss", "munchausen", 0, ("munchausen_temperature", "munchausen_floor")),
)


def without_removed(config: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a run's settings without the removed ones that were off."""
    kept = dict(config)
    for removed in _REMOVED:
        table = kept.get(removed.table)
        if isinstance(table, Mapping) and table.get(removed.key, removed.off) == removed.off:
            dropped = {removed.key, *removed.parts}
            kept[removed.table] = {k: v for k, v in table.items() if k not in dropped}
    return kept


def refuse_removed(config: Mapping[str, Any], *, where: str) -> None:
    """Raises ConfigError where a removed setting is left, and names it."""
    for removed in _REMOVED:
        table = config.get(removed.table)
        if isinstance(table, Mapping) and removed.key in table:
            raise ConfigError(
                f"`{removed.table}.{removed.key}` was removed: no measurement showed it ahead of"
                " the default recipe (docs/evidence.md)",
                where=where,
                remedy="leave it out; a run that was trained with it needs an older Restock, but"
                " its policy can still be used once exported to ONNX",
            )


__all__ = ["refuse_removed", "without_removed"]
