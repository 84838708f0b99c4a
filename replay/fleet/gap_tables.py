"""`gaps(name)`: what a mixture and the audits of coverage find missing, as a store's SQL.

Missions are of the kinds that the store's conditions name; `restock coverage gaps` takes those that
the twin can drive.
"""

from __future__ import annotations

import functools
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from restock.replay.panel.mixture_tables import check_names, install_function
from restock.replay.store.store import Store

if TYPE_CHECKING:
    from restock.replay.fleet.shopping_list import ShoppingList

COLUMNS = {
    "asked_by": "VARCHAR",
    "stratum": "VARCHAR",
    "condition": "VARCHAR",
    "zone": "VARCHAR",
    "action": "BIGINT",
    "action_name": "VARCHAR",
    "robot": "VARCHAR",
    "counted": "VARCHAR",
    "needed": "BIGINT",
    "there": "BIGINT",
    "missing": "BIGINT",
    "unit": "VARCHAR",
    "best": "VARCHAR",
    "rate": "DOUBLE",
    "rate_low": "DOUBLE",
    "rate_high": "DOUBLE",
    "amount": "DOUBLE",
    "amount_low": "DOUBLE",
    "amount_high": "DOUBLE",
}


def install_gaps(store: Store) -> None:
    """Make the macro in a store's connection; it plans on one of its own, at the same version."""
    limit = store.bare.sql("SELECT current_setting('memory_limit')").fetchall()[0][0]
    path, version = store.path, store.version

    @functools.lru_cache(maxsize=1)
    def planned(name: str, _changed_ns: int) -> ShoppingList:
        from restock.replay.fleet.gaps import find_gaps
        from restock.replay.fleet.shopping_list import shopping_list
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.store.audit import load_thresholds

        with Store(path, version=version, memory_limit=limit) as own:
            yields, gaps = find_gaps(
                own,
                load_mixture(name),
                name=name,
                folder=Path(name).parent,
                kinds=[condition.name for condition in own.conditions()],
                thresholds=load_thresholds(),
            )
        return shopping_list(yields, gaps)

    install_function(store.bare, "planned_gaps", COLUMNS, gaps_table, planned)
    store.checks.append(functools.partial(check_names, ("gaps",)))
    text = files("restock.replay.fleet").joinpath("gap_tables.sql").read_text(encoding="utf-8")
    store.bare.execute(text)


def gaps_table(found: ShoppingList) -> pa.Table:
    """Return a row a gap, columns COLUMNS."""
    from restock.replay.fleet.shopping_list import document

    lines = [{**line, "unit": found.unit} for line in document(found)["gaps"]]
    return pa.table({name: [line[name] for line in lines] for name in COLUMNS})
