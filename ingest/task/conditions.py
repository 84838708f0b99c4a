"""Conditions: named SQL expressions over the steps of an episode, for logs and twin alike.

A condition is one boolean expression, with window functions allowed: `OVER episode` orders an
episode's steps up to the current one's place (`lead(…)` looks one step ahead), and
`OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW)` is a window of that order. Its timing
says what it may look at:

- `pre`: known before acting at step t; looks at step t and earlier ones only;
- `post`: about the outcome of step t; may look at t + 1 and later.

The difference matters to replay: boosting a `post` stratum resamples the outcome of an action and
biases what the critic learns, unless it is corrected for. What else a condition may not say is in
`restock.ingest.task.condition_sql`. Where a simulator says the truth, labels are scored against it:
`restock.ingest.task.label_scores`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.task.condition_sql import SANDBOX, refusal, select_of
from restock.toml import Checked

Timing = Literal["pre", "post"]
NOMINAL = "nominal"
LARGEST_BYTES = 100_000  # of a condition's file


class Condition(Checked, frozen=True):
    """A named label. Lower priority numbers win where a row needs one condition."""

    name: str
    timing: Timing
    sql: str
    priority: int = 50
    doc: str = ""

    def check(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.name) or self.name == NOMINAL:
            raise ValueError(
                f"name must be letters, digits and _, and not {NOMINAL!r}: {self.name!r}"
            )


def shipped() -> dict[str, Condition]:
    """The conditions that come with Restock, by name: `ingest/task/conditions/*.sql`."""
    folder = files("restock.ingest.task") / "conditions"
    conditions = {}
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".sql"):
            name = entry.name.removesuffix(".sql")
            text = entry.read_text(encoding="utf-8")
            conditions[name] = msgspec.convert({"name": name, **settings_of(text)}, Condition)
    return conditions


def settings_of(text: str) -> dict[str, str | int]:
    """What a .sql file says: `sql`, and of its comments `timing`, `priority` and `doc`."""
    comments = [line[2:].strip() for line in text.splitlines() if line.startswith("--")]
    keys = ("timing: ", "priority: ")
    settings: dict[str, str | int] = {}
    for line in comments:
        if line.startswith(keys):
            key, value = line.split(": ", 1)
            settings[key] = int(value) if value.lstrip("-").isdigit() else value
    doc = " ".join(line for line in comments if not line.startswith(keys))
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


def runnable(steps: pa.Table, conditions: Sequence[Condition]) -> list[Condition]:
    """The conditions whose SQL runs over steps with these columns; `label` says why another not."""
    run = []
    for condition in conditions:
        with suppress(ConfigError):
            label(steps.slice(0, 0), [condition])
            run.append(condition)
    return run


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


def with_files(document: dict[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """A profile's TOML with the text of each `[[condition]] file = "…"` in place of its name.

    A file may say `-- timing: pre` and `-- priority: 45` in comments, as the shipped ones do;
    what the TOML says goes first. Its name must stay in the profile's folder: profiles are
    passed between strangers.

    Raises:
        ConfigError: no such file, or one that lies elsewhere; names the key.
    """
    conditions = document.get("condition")
    if not isinstance(conditions, list):
        return document
    read = [
        _read(entry, f"condition[{place}]", folder, where)
        if isinstance(entry, dict) and "file" in entry
        else entry
        for place, entry in enumerate(conditions)
    ]
    return document | {"condition": read}


def _read(entry: dict[str, Any], key: str, folder: Path | None, where: str) -> dict[str, Any]:
    name = entry["file"]

    def refused(what: str, remedy: str | None = None) -> ConfigError:
        return ConfigError(f"`{key}.file` {what}", where=where, remedy=remedy)

    if "sql" in entry:
        raise refused("stands beside `sql`: give one of them")
    if not isinstance(name, str) or not name.endswith(".sql"):
        raise refused(f"must name a .sql file, got {name!r}")
    if folder is None:
        raise refused("needs a profile that is a file: it is looked for beside it")
    path = (folder / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise refused(f"leads out of the profile's folder: {name}", "put it beside the profile")
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise refused(f"is larger than {LARGEST_BYTES:,} bytes: {name}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise refused(f"cannot be read: {name}: {error}") from error
    stem = {"name": path.stem} if path.stem.isidentifier() else {}
    return stem | settings_of(text) | {k: value for k, value in entry.items() if k != "file"}
