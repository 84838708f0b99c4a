"""Conditions: named SQL expressions over the steps of an episode, for logs and twin alike.

A condition is one boolean expression, with window functions allowed: `OVER episode` orders an
episode's steps up to the current one's place (`lead(…)` looks one step ahead), and
`OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW)` is a window of that order. Its timing
says what it may look at:

- `pre`: known before acting at step t; looks at step t and earlier ones only;
- `post`: about the outcome of step t; may look at t + 1 and later.

The difference matters to replay: boosting a `post` stratum resamples the outcome of an action and
biases what the critic learns, unless it is corrected for. What else a condition may not say is in
`restock.ingest.task.condition_sql`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Literal

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.task.condition_sql import SANDBOX, refusal, select_of

Timing = Literal["pre", "post"]
NOMINAL = "nominal"


class Condition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named label. Lower priority numbers win where a row needs one condition."""

    name: str
    timing: Timing
    sql: str
    priority: int = 50
    doc: str = ""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.name) or self.name == NOMINAL:
            raise ValueError(
                f"name must be letters, digits and _, and not {NOMINAL!r}: {self.name!r}"
            )


def shipped() -> dict[str, Condition]:
    """The conditions that come with Restock, by name: `ingest/task/conditions/*.sql`."""
    folder = files("restock.ingest.task") / "conditions"
    found = {}
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".sql"):
            name = entry.name.removesuffix(".sql")
            text = entry.read_text(encoding="utf-8")
            found[name] = msgspec.convert({"name": name, **settings_of(text)}, Condition)
    return found


def settings_of(text: str) -> dict[str, str | int]:
    """What a .sql file says: `sql`, and of its comments `timing`, `priority` and `doc`."""
    comments = [line[2:].strip() for line in text.splitlines() if line.startswith("--")]
    told = ("timing: ", "priority: ")
    settings: dict[str, str | int] = {}
    for line in comments:
        if line.startswith(told):
            key, value = line.split(": ", 1)
            settings[key] = int(value) if value.lstrip("-").isdigit() else value
    doc = " ".join(line for line in comments if not line.startswith(told))
    sql = "\n".join(line for line in text.splitlines() if not line.startswith("--")).strip()
    return {"sql": sql, "doc": doc, **settings}


def labels_version(conditions: Sequence[Condition]) -> str:
    """Names a set of conditions by what they say: 12 hex digits."""
    content = msgspec.json.encode(sorted((c.name, c.timing, c.sql, c.priority) for c in conditions))
    return hashlib.blake2b(content, digest_size=6).hexdigest()


def label(steps: pa.Table, conditions: Sequence[Condition]) -> dict[str, NDArray[np.bool_]]:
    """Every condition over a table of steps, in the table's row order.

    `steps` holds `episode_index`, `step_index` and the stored signals, one row a step, including
    the last step of each episode (which is no transition, but whose signals `lead` sees).

    Raises:
        ConfigError: a condition's SQL does not run, or gives no boolean; names the condition.
    """
    if not conditions:
        return {}
    for condition in conditions:
        if reason := refusal(condition.sql, condition.timing):
            raise ConfigError(reason, where=f"condition {condition.name!r}")
    with duckdb.connect(config=SANDBOX) as connection:
        connection.register("steps", steps.append_column("row_", pa.array(range(len(steps)))))
        connection.execute("SET lock_configuration = true").fetchall()
        try:
            rows = _query(connection, conditions)
        except duckdb.Error:
            for condition in conditions:  # again one by one, to say which
                try:
                    _query(connection, [condition])
                except duckdb.Error as error:
                    raise ConfigError(
                        f"its SQL does not run over the steps: {_first_line(error)}",
                        where=f"condition {condition.name!r}",
                        remedy=f"the steps have the columns {', '.join(steps.column_names)}",
                    ) from error
            raise
    labels = {}
    for condition in conditions:
        column = rows[condition.name]
        if not pa.types.is_boolean(column.type):
            raise ConfigError(
                f"its SQL gives {column.type}, not a boolean", where=f"condition {condition.name!r}"
            )
        labels[condition.name] = np.asarray(column.fill_null(False).combine_chunks(), np.bool_)
    return labels


def _query(connection: duckdb.DuckDBPyConnection, conditions: Sequence[Condition]) -> pa.Table:
    columns = ",\n".join(f'({c.sql}\n) AS "{c.name}"' for c in conditions)
    return connection.sql(select_of(columns)).to_arrow_table()


def primary(labels: dict[str, NDArray[np.bool_]], conditions: Sequence[Condition]) -> list[str]:
    """The one condition of each row: the one of lowest priority number, or `nominal`."""
    ordered = sorted(conditions, key=lambda condition: (condition.priority, condition.name))
    if not ordered:
        return []
    table = np.stack([labels[condition.name] for condition in ordered], axis=1)
    names = [condition.name for condition in ordered] + [NOMINAL]
    first = np.where(table.any(axis=1), table.argmax(axis=1), len(ordered))
    return [names[index] for index in first]


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


__all__ = [
    "NOMINAL",
    "Condition",
    "Timing",
    "label",
    "labels_version",
    "primary",
    "settings_of",
    "shipped",
]
