"""Compare two panels: mixture, rows, shares and weights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec
import numpy as np

from restock.errors import PanelError
from restock.replay.panel.panel import Panel

Rows = list[dict[str, Any]]
# Header fields that are not compared by key: compared separately, or derived from other content.
_ELSEWHERE = ("id", "files", "strata", "mixture", "task_json", "task_hash")
SHARES = ("natural_share", "wanted_share", "share", "effective_share")


def diff_panels(first: Panel, second: Panel) -> dict[str, Any]:
    """Return how `second` differs, as plain values: the JSON of `restock coverage diff`.

    Raises:
        PanelError: their rows are of different tasks.
    """
    if first.task_hash != second.task_hash:
        raise PanelError(
            f"its rows are of task {second.task_hash}, those of {first.path} of"
            f" {first.task_hash}: their observations, actions and rewards do not mean the same",
            where=str(second.path),
            remedy="mix both from stores that one profile read",
        )
    rows, weights = _rows(first, second)
    return {
        "kind": "panel",
        "different": first.id != second.id,
        **{side: _side(panel) for side, panel in (("a", first), ("b", second))},
        "header": key_differences(_header(first), _header(second)),
        "mixture": key_differences(
            msgspec.to_builtins(first.header.mixture), msgspec.to_builtins(second.header.mixture)
        ),
        "rows": rows,
        "strata": _strata(first, second),
        "weights": weights,
    }


def key_differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> Rows:
    """Return the dotted keys whose values differ; null if one side lacks the key."""
    a, b = dict(_flat(first)), dict(_flat(second))
    return [
        {"key": key, "a": a.get(key), "b": b.get(key)}
        for key in dict.fromkeys([*a, *b])
        if a.get(key) != b.get(key)
    ]


def _flat(value: Any, prefix: str = "") -> Iterable[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(item, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        # Key a list of tables by name: an added table then does not shift the keys of the others.
        for place, item in enumerate(value):
            name = item.get("name", place) if isinstance(item, Mapping) else place
            yield from _flat(item, f"{prefix}[{name}]")
    else:
        yield prefix, value


def _side(panel: Panel) -> dict[str, Any]:
    header = panel.header
    return {
        "path": str(panel.path),
        "id": panel.id,
        "store": header.store,
        "store_version": header.store_version,
        "task": header.task_hash,
        "rows": len(panel),
        "effective_rows": header.effective_rows,
        "logs_share": header.logs_share,
    }


def _header(panel: Panel) -> dict[str, Any]:
    fields = msgspec.to_builtins(panel.header)
    return {key: value for key, value in fields.items() if key not in _ELSEWHERE}


def _rows(first: Panel, second: Panel) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare rows by id: those added and removed, and changes of stratum and weight."""
    ids = [np.asarray(panel.meta_column("transition_id"), np.int64) for panel in (first, second)]
    both, at_a, at_b = np.intersect1d(ids[0], ids[1], return_indices=True)
    names = [
        np.array([s.name for s in panel.strata], object)[panel.stratum_code]
        for panel in (first, second)
    ]
    moved = names[0][at_a] != names[1][at_b]
    pairs = Counter(zip(names[0][at_a][moved], names[1][at_b][moved], strict=True))
    weights = [panel.weights[at] for panel, at in ((first, at_a), (second, at_b))]
    changed = ~np.isclose(weights[0], weights[1], rtol=1e-6)
    rows = {
        "in": len(ids[1]) - len(both),
        "out": len(ids[0]) - len(both),
        "both": len(both),
        "moved": [
            {"from": before, "to": after, "rows": count}
            for (before, after), count in sorted(pairs.items())
        ],
    }
    largest = [float(panel.weights.max(initial=0.0)) for panel in (first, second)]
    return rows, {
        "rows_changed": int(changed.sum()),
        "largest_a": largest[0],
        "largest_b": largest[1],
    }


def _strata(first: Panel, second: Panel) -> Rows:
    """Return one row per stratum, with its figures in both panels; None for a panel without it."""
    sides = [{s.name: s for s in panel.strata} for panel in (first, second)]
    lines = []
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        line: dict[str, Any] = {"stratum": name}
        for field in ("rows", "episodes", *SHARES, "replays_per_row", "largest_weight"):
            for side, strata in zip("ab", sides, strict=True):
                line[f"{field}_{side}"] = getattr(strata[name], field) if name in strata else None
        lines.append(line)
    return lines
