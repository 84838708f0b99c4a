"""Panels and plans for tests, from a table of transitions or a store."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa

from restock.ingest.task.conditions import Condition
from restock.replay.mixture.mixture import Mixture, parse_mixture
from restock.replay.panel.build import build_panel, open_source
from restock.replay.panel.panel import Panel
from restock.replay.plan.plan import PanelPlan, plan_panel
from restock.replay.store.store import Store
from support.stores import CONDITIONS, TASK

EVERY = "[each_condition]\nshare = 'natural'\n"
NO_SPLIT = "[evaluation_split]\nby = 'none'\n"
# Priorities, a cap a row, corrections and an age limit at once.
LIMITED = """
max_replays_per_row = 40
max_age_env_steps = 900
[sources]
logs = 0.75
[correction]
post = "density_ratio"
[[strata]]
name = "nominal"
share = 0.4
[[strata]]
name = "wheel_slip"
within = "per"
[[strata]]
name = "recovery"
[each_condition]
share = "equal"
within = "uniform"
"""


def by_priority(conditions: Sequence[Condition], more: str = "") -> str:
    """Return strata of the episodes of each condition, and nominal, that go by priority alone."""
    named = [*((c.name, c.priority) for c in conditions), ("nominal", 1000)]
    return "".join(
        f"[[strata]]\nname = '{name}'\npriority = {priority}\nshare = 'equal'\n"
        f"unit = 'episode'\n{more if name != 'nominal' else ''}"
        for name, priority in named
    )


def moment(stamp_ns: int) -> str:
    """Return a time as TOML writes it."""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).isoformat()


def planned(source: pa.Table | Path, text: str) -> PanelPlan:
    """Return a mixture worked out over a table or a store's folder."""
    mixture = parse_mixture(text)
    given: Any = {} if isinstance(source, Path) else {"task": TASK, "conditions": CONDITIONS}
    with open_source(source, mixture, **given) as opened:
        return plan_panel(opened.connection, mixture, opened.conditions)


def panel_of(source: pa.Table | Path, mixture: Mixture | str, out: Path, **given: Any) -> Panel:
    """Return a panel of a table or of a store's folder."""
    if isinstance(mixture, str):
        mixture = parse_mixture(mixture)
    if isinstance(source, pa.Table):
        return build_panel(source, mixture, out, **given)
    with Store(source) as store:
        return build_panel(store, mixture, out, **given)
