"""Conditions: named SQL expressions over the steps of an episode, for logs and twin alike.

A condition is one boolean expression that may use window functions. The window `episode` holds an
episode's steps in order: `lead(…) OVER episode` looks one step ahead, and
`OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW)` looks at the last three steps. The timing
of a condition limits which steps it may look at:

- `pre`: known before acting at step t; looks only at step t and earlier steps;
- `post`: about the outcome of step t; may look at t + 1 and later.

Intermediate results can be named: each `let` is a column that later `let`s and the condition can
use, so that one window function can be applied to the results of another.

A condition may have a **probability** beside its label: an expression of the same kind with values
from 0 to 1, computed from the distance of the signals to the rule's limits and the noise of the
sensors. A step whose probability lies within the condition's `uncertain` band is uncertain.

The limits can depend on the robot. The SQL may name the profile's [noise] and
`Task.condition_limits` (tight clearance, slip limit, control period and more). A number of steps
may be written as a time, `{1.6 s}`, or as the distance driven at the highest speed, `{0.2 m}`.

There are two kinds of condition. An **outcome** (the default) names a result; a row's one
`condition` is an outcome. An **exposure** names the situation, whatever the outcome: someone close
by, a blocked plan. Its timing is `pre`, it has no probability, it is listed in a column of its own
(`exposures`), and it is never a row's `condition`. Use exposures for strata and comparisons of
success if an outcome would select the failures.

A condition can be a `.sql` file that comes with Restock or lies beside a profile. The file contains
the rule, in parts, and the settings as comments:

    -- What it is, and why the rule is as it is.
    -- timing: post
    -- priority: 30
    -- uncertain: 0.2 to 0.8
    -- let slip_mps:
    abs(wheel_speed_mps - localised_speed_mps)
    -- label:
    avg(slip_mps) OVER (episode ROWS BETWEEN 1 PRECEDING AND 1 FOLLOWING) > 0.2
    -- probability:
    1 / (1 + exp(-20 * (slip_mps - 0.2)))

If a file is a single expression, that is the label. Comments before the first part are the doc;
comments within a part are not.

The timing matters to replay: boosting a `post` stratum resamples the outcome of an action and
biases what the critic learns, unless that is corrected. `restock.ingest.task.condition_sql` checks
what the SQL may contain. If a simulator recorded the true conditions, labels are scored against
them.
"""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools
from restock.errors import ConfigError
from restock.files import first_line
from restock.ingest.task.condition_sql import SANDBOX, SELECT, WINDOW, refusal, sandbox
from restock.ingest.task.task import LIDAR_SIGNALS, PLAN_SIGNALS, STAND_IN_LIMITS, Noise
from restock.toml import Checked

if TYPE_CHECKING:  # slow to import, and not needed for conditions that are in the store already
    import duckdb

Timing = Literal["pre", "post"]
Kind = Literal["outcome", "exposure"]
Expression = Literal["sql", "probability"]  # the two expressions of a condition
NOMINAL = "nominal"
_LENGTH = re.compile(r"\{(\d*\.?\d+) ([sm])\}")
# Time limit for all conditions of a recording. The shipped ones need 1/30 of LIMIT_S_PER_STEP.
LIMIT_S, LIMIT_S_PER_STEP = 60.0, 0.001
# Reasons why a condition is unknown.
NO_LIDAR = "no lidar"
DRIVEN_PLAN = "the plan is the path that was driven"  # so no obstacle can have stood on it


Column = tuple[str, NDArray[Any]]  # DuckDB's type, and values (N,), masked if there are nulls
Columns = dict[tuple[str, Expression], Column]  # keys: the condition's name, and the expression


class Condition(Checked, frozen=True):
    """A named label. Of a row's labels, that with the lowest priority number is its condition."""

    name: str
    timing: Timing
    sql: str
    priority: int = 50
    doc: str = ""
    let: dict[str, str] = msgspec.field(default_factory=dict)  # name -> SQL; may use earlier names
    probability: str = ""  # SQL with values from 0 to 1; "": the condition has no probability
    uncertain: tuple[float, float] = (0.2, 0.8)  # range of probabilities that count as uncertain
    constants: dict[str, float] = msgspec.field(default_factory=dict)  # name -> value for the SQL
    kind: Kind = "outcome"

    def with_constants(self, constants: Mapping[str, float]) -> Condition:
        """Return the condition with added `constants` of a robot: those that its SQL names.

        The condition's own constants take precedence. If `constants` has `control_period_s`, times
        such as `{1.6 s}` and distances such as `{0.2 m}` are replaced by numbers of steps.
        """
        words, replaced = self.words, dict[str, Any]()
        used = {name: value for name, value in constants.items() if name in words}
        if "control_period_s" in constants:
            replaced = {
                "sql": in_steps(self.sql, constants),
                "probability": in_steps(self.probability, constants),
                "let": {name: in_steps(sql, constants) for name, sql in self.let.items()},
            }
        return msgspec.structs.replace(self, constants=used | self.constants, **replaced)

    @property
    def words(self) -> set[str]:
        """Return every word in the condition's SQL, `let`s and probability."""
        expressions = (self.sql, self.probability, *self.let.values())
        return {word for text in expressions for word in re.findall(r"\w+", text)}

    def check(self) -> None:
        if not 0 <= self.uncertain[0] <= self.uncertain[1] <= 1:
            raise ValueError(f"uncertain must be [low, high] in [0, 1], got {self.uncertain}")
        if self.kind == "exposure" and (self.timing != "pre" or self.probability):
            raise ValueError(
                f"an exposure is a situation known before acting: timing must be 'pre', and there "
                f"can be no probability; got timing {self.timing!r}"
            )
        for name in (*self.constants, *self.let):
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
                raise ValueError(
                    f"let and constants: a name must be letters, digits and _: {name!r}"
                )
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.name) or self.name == NOMINAL:
            raise ValueError(
                f"name must be letters, digits and _, and not {NOMINAL!r}: {self.name!r}"
            )


def in_steps(sql: str, constants: Mapping[str, float]) -> str:
    """Replace `{1.6 s}`, and `{0.2 m}` at top speed, in SQL by a number of steps, at least 1."""
    period_s = constants["control_period_s"]
    a_step = {"s": period_s, "m": period_s * constants["fastest_mps"]}
    return _LENGTH.sub(lambda found: str(max(round(float(found[1]) / a_step[found[2]]), 1)), sql)


def of_kind(conditions: Iterable[Condition], kind: Kind) -> list[Condition]:
    """Select the conditions of one kind, keeping their order."""
    return [condition for condition in conditions if condition.kind == kind]


def stored(manifest: Mapping[str, Any], kind: Kind = "outcome") -> list[Condition]:
    """Read the conditions of a kind from a row of the manifest (the `recordings` table)."""
    text = manifest["conditions_json" if kind == "outcome" else "exposures_json"]
    read = msgspec.json.decode(text, type=list[Condition], strict=False)
    return [msgspec.structs.replace(condition, kind=kind) for condition in read]


def signals_named(
    conditions: Iterable[Condition], signals: Collection[str] = LIDAR_SIGNALS
) -> dict[str, list[str]]:
    """Return condition -> the `signals` that it names, without conditions that name none of them.

    `signals` are unknown in a recording; by default, they are those that need a lidar. A condition
    that names one is null at every step, whatever its SQL makes of a null.
    """
    lost = {one.name: sorted(one.words & set(signals)) for one in conditions}
    return {name: named for name, named in lost.items() if named}


def unknown_rows(
    conditions: Iterable[Condition], *, lidar: bool, driven_plan: bool = False
) -> list[dict[str, Any]]:
    """Return the conditions that are unknown for a recording, as rows for the manifest.

    `driven_plan` means that the plan is the path that was driven, as with goals in hindsight.
    """
    definitions = list(conditions)
    unknown: dict[str, tuple[list[str], str]] = {}
    for known, signals, because in (
        (not driven_plan, PLAN_SIGNALS, DRIVEN_PLAN),
        (lidar, LIDAR_SIGNALS, NO_LIDAR),
    ):
        if not known:
            lost = signals_named(definitions, signals)
            unknown |= {name: (named, because) for name, named in lost.items()}
    return [
        {
            "condition": one.name,
            "kind": one.kind,
            "signals": unknown[one.name][0],
            "because": unknown[one.name][1],
        }
        for one in definitions
        if one.name in unknown
    ]


def reported(
    conditions: Iterable[Condition], *, lidar: bool, driven_plan: bool = False
) -> list[Condition]:
    """Return the conditions that are not in `unknown_rows`."""
    conditions = list(conditions)
    rows = unknown_rows(conditions, lidar=lidar, driven_plan=driven_plan)
    lost = {row["condition"] for row in rows}
    return [condition for condition in conditions if condition.name not in lost]


def labels_version(conditions: Sequence[Condition]) -> str:
    """Return a hash of a set of conditions, 12 hex digits."""
    definitions = [
        (c.name, c.timing, c.sql, c.priority)
        # Optional settings are hashed only if used: a rule without them keeps its version.
        + ((c.probability, c.uncertain) if c.probability else ())
        + ((list(c.let.items()), sorted(c.constants.items())) if c.let or c.constants else ())
        + ((c.kind,) if c.kind != "outcome" else ())
        for c in conditions
    ]
    content = msgspec.json.encode(sorted(definitions, key=str))
    return hashlib.blake2b(content, digest_size=6).hexdigest()


def label(steps: pa.Table, conditions: Sequence[Condition]) -> dict[str, Bools]:
    """Evaluate every condition over a table of steps, in the table's row order.

    `steps` has `episode_index`, `step_index` and the stored signals, one row per step, including
    the last step of each episode. That step is not a transition, but `lead` needs its signals.

    Raises:
        ConfigError: a condition's SQL does not run or is not boolean; names the condition.
    """
    return _labels(_evaluate(steps, conditions, ("sql",)), conditions)


def label_with_probabilities(
    steps: pa.Table, conditions: Sequence[Condition]
) -> tuple[dict[str, Bools], dict[str, F32]]:
    """Compute `label`, and the probability of every condition that has one; null becomes NaN.

    Common parts are computed only once.

    Raises:
        ConfigError: as `label`, or a probability is not a number in [0, 1].
    """
    columns = _evaluate(steps, conditions, ("sql", "probability"))
    probable = {}
    for condition in conditions:
        if not condition.probability:
            continue
        where = _where(condition, "probability")
        values = _numbers(columns[condition.name, "probability"], where)
        if len(wrong := values[(values < 0) | (values > 1)]):
            raise ConfigError(f"it must be in [0, 1], but gives {wrong[0]:.4g}", where=where)
        probable[condition.name] = values.astype(np.float32)
    return _labels(columns, conditions), probable


def label_several(
    several: Sequence[tuple[pa.Table, Sequence[Condition]]],
) -> list[tuple[dict[str, Bools], dict[str, F32]]]:
    """Compute `label_with_probabilities` of several tables of steps.

    Tables with the same conditions and schema share a query, as planning a query takes longer than
    labelling some hundred steps.
    """
    found: dict[int, tuple[dict[str, Bools], dict[str, F32]]] = {}
    for place, (steps, conditions) in enumerate(several):
        if place in found:
            continue
        alike = [
            other
            for other, (table, rules) in enumerate(several)
            if other not in found and rules == conditions and table.schema == steps.schema
        ]
        if any("episode_index" in condition.words for condition in conditions):
            alike = [place]  # a shared query would renumber the episodes that they name
        parts, first = [], 0
        for table in (several[other][0] for other in alike):
            episodes = np.asarray(table["episode_index"]) + first
            parts.append(table.set_column(0, "episode_index", pa.array(episodes)))
            first = episodes.max(initial=first - 1) + 1
        ends = np.cumsum([len(part) for part in parts])
        held, probable = label_with_probabilities(pa.concat_tables(parts), conditions)
        for other, stop, part in zip(alike, ends, parts, strict=True):
            rows = slice(stop - len(part), stop)
            found[other] = (
                {name: values[rows] for name, values in held.items()},
                {name: values[rows] for name, values in probable.items()},
            )
    return [found[place] for place in range(len(several))]


def _labels(columns: Columns, conditions: Sequence[Condition]) -> dict[str, Bools]:
    labels = {}
    for condition in conditions:
        kind, values = columns[condition.name, "sql"]
        if kind != "BOOLEAN":
            raise ConfigError(
                f"its SQL gives {kind}, not a boolean", where=_where(condition, "sql")
            )
        labels[condition.name] = np.ma.filled(values, False)
    return labels


def let_values(steps: pa.Table, condition: Condition) -> dict[str, F64]:
    """Compute every `let` of a condition at each step, (N,); NaN for null.

    Raises:
        ConfigError: the SQL does not run, or a value is not a number.
    """
    values: dict[str, F64] = {}
    for name in condition.let:
        requested = msgspec.structs.replace(condition, sql=name)
        values |= {name: numbers(steps, [requested])[condition.name]}
    return values


def numbers(steps: pa.Table, conditions: Sequence[Condition]) -> dict[str, F64]:
    """Evaluate the SQL of conditions as numbers at each step, (N,): true is 1, null is NaN.

    Raises:
        ConfigError: the SQL does not run, or its values are not numbers; names the condition.
    """
    columns = _evaluate(steps, conditions, ("sql",)).items()
    return {name: _numbers(column, f"condition {name!r}") for (name, _), column in columns}


def _numbers(column: Column, where: str) -> F64:
    """Return a column's numbers (N,); NaN for null."""
    kind, values = column
    if values.dtype.kind not in "biuf":
        raise ConfigError(f"its SQL gives {kind}, not a number", where=where)
    return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))


def uncertain_steps(
    probable: Mapping[str, F32], conditions: Sequence[Condition]
) -> dict[str, Bools]:
    """Return at which steps each condition's probability lies within its `uncertain` band, (N,)."""
    bands = {condition.name: condition.uncertain for condition in conditions}
    return {
        name: (values >= bands[name][0]) & (values <= bands[name][1])
        for name, values in probable.items()
    }


def _evaluate(
    steps: pa.Table, conditions: Sequence[Condition], which: Sequence[Expression]
) -> Columns:
    """Evaluate the expressions `which` of all conditions over the steps.

    Conditions with the same `let`s and constants share a query. If it fails, each of its
    expressions runs alone.
    """
    requested = [(c, part) for c in conditions for part in which if part == "sql" or c.probability]
    together: dict[str, list[tuple[Condition, Expression]]] = {}  # FROM clause -> its expressions
    for condition, part in requested:
        _refuse(condition, part, steps.column_names)
        together.setdefault(_source(condition), []).append((condition, part))
    columns: Columns = {}
    if not requested:
        return columns
    import duckdb

    with sandbox().cursor() as connection:
        named = {word.lower() for c, _ in requested for word in c.words} | {
            "episode_index",
            "step_index",
        }
        used = steps.select([name for name in steps.column_names if name.lower() in named])
        connection.register("steps", used.append_column("row_", pa.array(np.arange(len(steps)))))
        limit_s = LIMIT_S + len(steps) * LIMIT_S_PER_STEP
        began = time.monotonic()
        for several in together.values():
            left_s = max(limit_s - (time.monotonic() - began), 0.0)
            try:
                columns |= _query(connection, several, len(steps), left_s)
            except duckdb.Error:  # run each alone, so that an error names the condition
                for one in several:
                    try:
                        columns |= _query(connection, [one], len(steps), limit_s / len(requested))
                    except duckdb.Error as error:
                        _raise_reason(error, steps, _where(*one), limit_s)
    return columns


def _raise_reason(error: duckdb.Error, steps: pa.Table, where: str, limit_s: float) -> NoReturn:
    """Raise DuckDB's error about a condition's SQL as a ConfigError."""
    import duckdb

    if isinstance(error, duckdb.InterruptException):
        raise ConfigError(
            f"its SQL takes too long: the conditions may take {limit_s:.0f} s on"
            f" {len(steps):,} steps",
            where=where,
            remedy="make it simpler, or shorten its windows",
        ) from error
    if isinstance(error, duckdb.OutOfMemoryException):
        raise ConfigError(
            f"its SQL takes more memory than conditions may ({SANDBOX['memory_limit']})",
            where=where,
            remedy="make the values that it computes smaller, or shorten its windows",
        ) from error
    raise ConfigError(
        f"its SQL fails on the steps: {first_line(error)}",
        where=where,
        remedy=f"the steps have the columns {', '.join(steps.column_names)}",
    ) from error


def _refuse(condition: Condition, which: Expression, columns: Sequence[str]) -> None:
    """Raise ConfigError if a name is taken or the SQL contains what conditions may not."""
    taken = {"row_", *(name.lower() for name in columns)}
    for name in (*condition.constants, *condition.let):
        if name.lower() in taken:
            raise ConfigError(f"{name!r} is already used: choose another name",
                              where=f"condition {condition.name!r}")  # fmt: skip
        taken.add(name.lower())
    for name, sql in (*condition.let.items(), ("", getattr(condition, which))):
        if reason := refusal(sql, condition.timing):
            where = f"`let` {name!r} of condition {condition.name!r}" if name else None
            curly = (
                "curly brackets hold times, {1.6 s}, or distances, {0.2 m}" if "{" in sql else None
            )
            raise ConfigError(reason, where=where or _where(condition, which), remedy=curly)


def _where(condition: Condition, which: Expression) -> str:
    name = f"condition {condition.name!r}"
    return name if which == "sql" else f"the probability of {name}"


def _source(condition: Condition) -> str:
    """Build the FROM clause of a condition: the steps, its constants, and a subquery per `let`."""
    source = "steps"
    if condition.constants:
        named = (f'{float(value)!r}::DOUBLE AS "{n}"' for n, value in condition.constants.items())
        source = f"(SELECT *, {', '.join(named)} FROM steps) AS steps"
    for name, sql in condition.let.items():
        source = f'(SELECT *, ({sql}\n) AS "{name}" FROM {source} {WINDOW}) AS steps'
    return source


def runnable(steps: pa.Table, conditions: Sequence[Condition]) -> list[Condition]:
    """Return the conditions whose SQL runs over steps with the columns of `steps`."""
    run = []
    for condition in conditions:
        with suppress(ConfigError):
            label_with_probabilities(steps.slice(0, 0), [condition])
            run.append(condition)
    return run


def _query(
    connection: duckdb.DuckDBPyConnection,
    requested: Sequence[tuple[Condition, Expression]],
    count: int,
    limit_s: float,
) -> Columns:
    """Evaluate conditions with the same FROM clause: one value for each of `count` steps.

    Raises:
        duckdb.Error: the query fails, returns another number of values, or exceeds `limit_s`.
    """
    import duckdb

    columns = ",\n".join(
        f"({getattr(condition, part)}\n) AS column_{place}"
        for place, (condition, part) in enumerate(requested)
    )
    query = SELECT.format(columns=f"{columns},\nrow_", source=_source(requested[0][0]))
    with _interrupted_after(connection, limit_s):
        found = connection.execute(query)  # connection.sql() would plan the query twice
        kinds = [str(column[1]) for column in found.description]
        *values, row = found.fetchnumpy().values()
    if not np.array_equal(row, np.arange(count)):
        raise duckdb.InvalidInputException(
            f"it gives {len(row):,} values, not one for each of the {count:,} steps"
        )
    names = [(condition.name, part) for condition, part in requested]
    return dict(zip(names, zip(kinds, values, strict=False), strict=True))


@contextmanager
def _interrupted_after(connection: duckdb.DuckDBPyConnection, limit_s: float) -> Iterator[None]:
    """Interrupt the connection's query if the block takes longer than `limit_s`."""
    done = threading.Event()

    def interrupt() -> None:
        wait_s = limit_s
        while not done.wait(wait_s):
            connection.interrupt()  # repeated: between two queries, it has no effect
            wait_s = 0.1

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()  # a thread that still runs could interrupt the next query


def primary(labels: dict[str, Bools], conditions: Sequence[Condition]) -> list[str]:
    """Return one condition per row: its outcome with the lowest priority number, or `nominal`."""
    outcomes = of_kind(conditions, "outcome")
    ordered = sorted(outcomes, key=lambda condition: (condition.priority, condition.name))
    if not ordered:
        return []
    table = np.stack([labels[condition.name] for condition in ordered], axis=1)
    names = [condition.name for condition in ordered] + [NOMINAL]
    first = np.where(table.any(axis=1), table.argmax(axis=1), len(ordered))
    return [names[index] for index in first]


def held(column: pa.ChunkedArray, names: Sequence[str]) -> dict[str, Bools]:
    """Return which rows (N,) of a column of lists contain each name; a null contains none."""
    import pyarrow.compute as pc  # slow to import

    lists = column.combine_chunks()
    lengths = np.asarray(pc.list_value_length(lists).fill_null(0))
    row, named = np.repeat(np.arange(len(lists)), lengths), np.asarray(lists.flatten(), object)
    holds = {}
    for name in names:
        holds[name] = np.zeros(len(lists), np.bool_)
        holds[name][row[named == name]] = True
    return holds


MAX_BYTES = 100_000  # largest size of a condition's file
_PART = re.compile(r"-- (?:let ([A-Za-z]\w*)|(label|probability)):\s*")
_SETTINGS = ("kind", "timing", "priority", "uncertain")


def shipped(
    constants: Mapping[str, float] | None = None, kind: Kind = "outcome"
) -> dict[str, Condition]:
    """Read the conditions of a kind that come with Restock: `ingest/task/conditions/*.sql`.

    `constants` are the `Profile.constants` of the robot whose steps they label; None: those of the
    stand-in robot, with the default noise of profiles.
    """
    constants = constants or Noise().constants | STAND_IN_LIMITS
    return {one.name: one for one in of_kind(_with_robot_constants(tuple(constants.items())), kind)}


@lru_cache(maxsize=64)
def _with_robot_constants(constants: tuple[tuple[str, float], ...]) -> list[Condition]:
    return [one.with_constants(dict(constants)) for one in _read_shipped()]


@cache
def _read_shipped() -> list[Condition]:
    """Read the shipped conditions of both kinds, sorted by name, without a robot's constants."""
    folder = files("restock.ingest.task") / "conditions"
    texts = {
        one.name: one.read_text("utf-8") for one in folder.iterdir() if one.name[-4:] == ".sql"
    }
    return [
        msgspec.convert({"name": name.removesuffix(".sql"), **settings_of(text)}, Condition)
        for name, text in sorted(texts.items())
    ]


def settings_of(text: str) -> dict[str, Any]:
    """Parse `sql`, `doc` and the other settings of a condition's file."""
    settings: dict[str, Any] = {}
    doc: list[str] = []
    parts: dict[str, list[str]] = {}
    part: list[str] = []
    lets: dict[str, list[str]] = {}
    for line in text.splitlines():
        if found := _PART.fullmatch(line):
            name, kind = found.groups()
            part = lets.setdefault(name, []) if name else parts.setdefault(kind, [])
        elif not line.startswith("--"):
            if line.strip() and not (lets or parts):
                part = parts.setdefault("label", [])
            part.append(line)
        elif not (lets or parts):
            key, colon, value = line[2:].strip().partition(": ")
            if colon and key in _SETTINGS:
                settings[key] = _value(value)
            else:
                doc.append(line[2:].strip())
    sql = {name: "\n".join(lines).strip() for name, lines in (parts | lets).items()}
    values: dict[str, Any] = {"sql": sql.get("label", ""), "doc": " ".join(doc)}
    if lets:
        values["let"] = {name: sql[name] for name in lets}
    if "probability" in parts:
        values["probability"] = sql["probability"]
    return values | settings


def _value(text: str) -> str | int | list[str | float]:
    """Parse a whole number, `0.2 to 0.8`, or a word; a later check reports wrong types."""
    if text.lstrip("-").isdigit():
        return int(text)
    if " to " not in text:
        return text
    ends = text.split(" to ")
    return [float(end) if re.fullmatch(r"\d*\.?\d+", end) else end for end in ends]


def with_files(document: dict[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """Replace each `[[condition]] file = "…"` of a profile's TOML by the settings in that file.

    Keys in the TOML override settings in comments of the file, such as `-- timing: pre`. The file
    must be in the profile's folder, so that a stranger's profile cannot read other files.

    Raises:
        ConfigError: the file does not exist or is outside the folder; names the key.
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
        raise refused("is given together with `sql`: give only one of them")
    if not isinstance(name, str) or not name.endswith(".sql"):
        raise refused(f"must name a .sql file, got {name!r}")
    if folder is None:
        raise refused("needs a profile that is a file: the name is relative to its folder")
    path = (folder / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise refused(
            f"is outside the profile's folder: {name}", "put it into the profile's folder"
        )
    try:
        if path.stat().st_size > MAX_BYTES:
            raise refused(f"is larger than {MAX_BYTES:,} bytes: {name}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise refused(f"cannot be read: {name}: {first_line(error)}") from error
    stem = {"name": path.stem} if path.stem.isidentifier() else {}
    return stem | settings_of(text) | {k: value for k, value in entry.items() if k != "file"}
