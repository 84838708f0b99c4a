"""Read the transitions that a mixture may choose from, with its predicates evaluated by DuckDB.

DuckDB would sort whole rows including their text, which takes more memory. Instead, batches arrive
in the order in which reading threads finish, and the rows are sorted here, one column at a time.
Text is kept as dictionary codes of the smallest type that fits.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.arrays import Bools, Codes, Ints
from restock.errors import ConfigError, MixtureError, PanelError, StoreError
from restock.errors import uncertain_labels as uncertain_text
from restock.ingest.task.condition_sql import expression_problem, repeatability_problem
from restock.ingest.task.conditions import Condition
from restock.replay.mixture.mixture import Mixture
from restock.replay.plan.strata import ResolvedStratum
from restock.replay.store.definitions import install_novelty
from restock.replay.store.parquet_views import damage
from restock.replay.store.query import hint

STRETCH = 1 << 18  # rows in memory at a time


def stretches(rows: int) -> Iterator[tuple[int, int]]:
    """Yield begin and end of successive ranges of at most STRETCH rows."""
    for begin in range(0, rows, STRETCH):
        yield begin, min(begin + STRETCH, rows)


class Places:
    """An index that finds the positions of ids in an array (N,)."""

    def __init__(self, ids: Ints) -> None:
        self._order = np.argsort(ids, kind="stable")  # fast: ids ascend within each recording
        self._ids = ids[self._order]

    @property
    def repeats(self) -> int:
        """Return the number of ids that repeat an earlier id."""
        return int((self._ids[1:] == self._ids[:-1]).sum())

    def of(self, ids: Ints) -> Ints:
        """Return the position of each of these ids (n,); -1 if it is missing."""
        place = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where(self._ids[place] == ids, self._order[place], -1)


KEYS = ("episode_index", "step_index", "transition_id")  # sort keys within a recording
COLUMNS_AT_A_TIME = 2  # columns that are sorted in parallel; more would need more memory
_CODES_AT_A_TIME = 1 << 20  # codes per block when searching for first appearances


def rows_in_order(
    batches: Iterable[pa.RecordBatch],
    schema: pa.Schema,
    *,
    text: Collection[str],
    dropped: Collection[str] = (),
) -> pa.Table:
    """Return the rows of all batches, sorted by recording and KEYS.

    The schema has `recording_id` and KEYS. Columns in `text` are dictionary-encoded, with codes in
    order of first appearance. Columns in `dropped` are left out of the result.
    """
    parts: dict[str, list[pa.Array]] = {name: [] for name in schema.names}
    texts: dict[str, dict[str, int]] = {name: {} for name in schema.names if name in text}
    for batch in batches:
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            if (known := texts.get(name)) is not None:
                parts[name].append(_encode(values, known))
            else:  # copy the column: a reference to it would keep DuckDB's whole batch in memory
                parts[name].append(pa.concat_arrays([values, values[:0]]))

    def whole(name: str) -> pa.Array:
        known = texts.get(name)
        kind = schema.field(name).type if known is None else _code_type(len(known))
        # Codes of early batches may have a narrower type than those of later ones.
        return pa.concat_arrays([pa.array([], kind), *(part.cast(kind) for part in parts[name])])

    ids = pa.array(list(texts["recording_id"]), pa.string())
    rank = np.empty(len(ids), np.int64)
    rank[pc.array_sort_indices(ids).to_numpy()] = np.arange(len(ids))
    keys = [whole(key).to_numpy() for key in reversed(KEYS)]
    order = pa.array(np.lexsort([*keys, rank[whole("recording_id").to_numpy()]]))
    del keys

    def column(name: str) -> pa.Array:
        in_order, known = whole(name).take(order), texts.get(name)
        del parts[name]
        return in_order if known is None else _renumber(in_order, list(known))

    names = [name for name in schema.names if name not in dropped]
    with ThreadPoolExecutor(COLUMNS_AT_A_TIME, "restock-columns") as pool:
        return pa.table(list(pool.map(column, names)), names)


def _code_type(size: int) -> pa.DataType:
    """Return the smallest integer type for the codes of `size` texts."""
    return pa.int8() if size <= 1 << 7 else pa.int16() if size <= 1 << 15 else pa.int32()


def _encode(column: pa.Array, known: dict[str, int]) -> pa.Array:
    """Return the codes of texts in the dictionary `known`, after adding new texts to it."""
    local = column.cast(pa.string()).dictionary_encode()
    codes = pa.array(
        [known.setdefault(text, len(known)) for text in local.dictionary.to_pylist()],
        _code_type(len(known) + len(local.dictionary)),
    )
    return codes.take(local.indices)


def _renumber(codes: pa.Array, names: list[str]) -> pa.DictionaryArray:
    """Renumber codes of `names` in order of first appearance.

    Without this, codes would depend on which thread was first to read its rows.
    """
    wide = codes.cast(pa.int32()).fill_null(len(names)) if codes.null_count else codes
    code = wide.to_numpy()
    first = np.full(len(names) + 1, len(code), np.int64)  # where each code appears; last: null
    for begin in reversed(range(0, len(code), _CODES_AT_A_TIME)):
        some = code[begin : begin + _CODES_AT_A_TIME]
        first[some[::-1]] = np.arange(begin + len(some) - 1, begin - 1, -1)
    order = np.argsort(first[: len(names)], kind="stable")
    dictionary = pa.array(names, pa.string()).take(pa.array(order))
    if (np.diff(order) == 1).all():  # already in this order
        return pa.DictionaryArray.from_arrays(codes, dictionary)
    new = np.empty(len(order), np.int64)
    new[order] = np.arange(len(order))
    return pa.DictionaryArray.from_arrays(pa.array(new, codes.type).take(codes), dictionary)


META_COLUMNS = (
    *("transition_id", "recording_id", "episode_id", "step_index", "stamp_ns", "logged_ns"),
    *("condition", "zone", "behaviour_policy", "behaviour_version", "action_probability"),
    *("action", "reward", "terminated", "truncated", "perturbation", "robot", "site"),
)
# Columns that older stores, and tables outside a store, may lack.
LATER = ("perturbation", "robot", "site")
_TEXT = (
    *("recording_id", "episode_id", "condition", "zone", "behaviour_policy", "behaviour_version"),
    *("task_hash", *LATER),
)
_CERTAIN = "list_filter(conditions, lambda held: NOT list_contains(coalesce(uncertain, []), held))"
_VIEWS = "SELECT table_name FROM information_schema.tables"
BATCH_ROWS = 65_536  # rows read at a time
STORE_COLUMN = "mixture_store"  # number of a row's store, in views over several stores


def meta_columns(connection: duckdb.DuckDBPyConnection) -> str:
    """Return a SELECT list of META_COLUMNS over the connection's `transitions`."""
    has = connection.sql("FROM transitions LIMIT 0").columns
    named = dict.fromkeys((name for name in LATER if name not in has), "NULL::VARCHAR")
    named["condition"] = "primary_condition"
    return ", ".join(f"{named[n]} AS {n}" if n in named else n for n in META_COLUMNS)


def read_candidates(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    *,
    several_stores: bool = False,
) -> pa.Table:
    """Read every row of the connection's `transitions`, sorted by recording, episode and step.

    The columns are META_COLUMNS, `task_hash`, `labelled`, `uncertain` (the row has an uncertain
    condition), `store` (number of the row's store), and one boolean per predicate of the mixture:
    `admitted`, `unsafe`, `stratum_0` …, and `state_0` … for strata with a predicate of the state
    alone. Text columns are dictionary-encoded in order of appearance. If the mixture's `uncertain`
    is "nominal", predicates see `conditions` without the uncertain ones. They may also use the
    columns of `novelty`.

    Raises:
        ConfigError: a predicate that does not run, or might choose other rows when run again.
        StoreError: transitions that cannot be read.
    """
    predicates = {"admitted": ("`where`", mixture.where or "true")}
    unsafe = mixture.safety.unsafe if mixture.safety else "false"
    predicates["unsafe"] = ("safety.unsafe", unsafe)
    for index, stratum in enumerate(strata):
        predicates[f"stratum_{index}"] = (f"stratum {stratum.name!r}", stratum.predicate)
        if stratum.state_predicate is not None:
            state = (f"stratum {stratum.name!r}", stratum.state_predicate)
            predicates[f"state_{index}"] = state
    for place, sql in predicates.values():
        if reason := expression_problem(sql):
            raise ConfigError(reason, where=f"mixture, {place}")
        if reason := repeatability_problem(sql):
            raise ConfigError(
                f"its SQL could choose other rows when it is mixed again: {reason}",
                where=f"mixture, {place}",
                remedy="choose by columns: a part of the episodes by md5_number_lower(episode_id)"
                " % 10 < 3, recent rows by max_age_days and as_of, the order of rows by"
                " ORDER BY transition_id",
            )
    tests = ", ".join(
        f"coalesce(({sql}\n)::BOOLEAN, false) AS {name}" for name, (_, sql) in predicates.items()
    )
    store = STORE_COLUMN if several_stores else "0"
    source, has_uncertain = "transitions", "false"
    columns = connection.sql("FROM transitions LIMIT 0").columns
    if "uncertain" in columns:
        has_uncertain = "coalesce(len(uncertain) > 0, false)"
        if mixture.uncertain == "nominal":
            source = f"(SELECT * REPLACE ({_CERTAIN} AS conditions) FROM transitions)"
    named = re.findall(r"\bnovel(?:ty)?\b", " ".join(sql for _, sql in predicates.values()).lower())
    if not set(named) <= set(columns):
        install_novelty(connection)
        source = f"{source} LEFT JOIN novelty USING (transition_id)"
    query = (
        f"SELECT {meta_columns(connection)}, task_hash, episode_index, ({store})::TINYINT AS store,"
        " coalesce(primary_condition, '') <> '' AND conditions IS NOT NULL AS labelled,"
        f" {has_uncertain} AS uncertain, {tests} FROM {source}"
    )
    try:
        with any_order(connection):
            reader = connection.sql(query).to_arrow_reader(BATCH_ROWS)
            rows = rows_in_order(reader, reader.schema, text=_TEXT, dropped=("episode_index",))
    except duckdb.Error as error:
        if damaged := damage(error):
            raise damaged from error
        _raise_failing_predicate(connection, source, predicates)
        raise StoreError(f"its transitions cannot be read: {error}") from error
    return rows


def stored_view(connection: duckdb.DuckDBPyConnection) -> str:
    """Return the name of the view with the rows of `transitions` that is cheapest to read."""
    views = connection.sql(_VIEWS).fetchall()
    return "stored_transitions" if ("stored_transitions",) in views else "transitions"


@contextmanager
def any_order(connection: duckdb.DuckDBPyConnection) -> Iterator[None]:
    """Allow DuckDB to return rows in any order while the block runs: that is faster."""
    connection.execute("SET preserve_insertion_order = false")
    try:
        yield
    finally:
        connection.execute("RESET preserve_insertion_order")


def _raise_failing_predicate(
    connection: duckdb.DuckDBPyConnection, source: str, predicates: dict[str, tuple[str, str]]
) -> None:
    """Run each predicate by itself over all rows, and raise ConfigError for one that fails."""
    for place, sql in predicates.values():
        test = f"SELECT transition_id, ({sql}\n)::BOOLEAN AS holds FROM {source}"
        try:
            connection.sql(f"SELECT countif(holds) FROM ({test})").fetchall()
        except duckdb.Error as cause:
            raise ConfigError(
                f"its SQL does not run over `transitions`: {str(cause).splitlines()[0]}",
                where=f"mixture, {place}",
                remedy=hint(cause),
            ) from cause


def without_measured_actions(
    connection: duckdb.DuckDBPyConnection, table: pa.Table
) -> tuple[pa.Table, int]:
    """Drop rows whose action is odometry instead of a command.

    Returns the other rows, and the number of rows dropped.

    Raises:
        MixtureError: no row has a commanded action.
    """
    views = connection.sql(_VIEWS).fetchall()
    if ("recordings",) not in views:  # assume that actions are commands
        return table, 0
    measured = connection.sql(
        "SELECT DISTINCT recording_id FROM recordings"
        " WHERE list_contains(list_transform(stand_ins, lambda one: one.input), 'command')"
    ).fetchall()
    if not measured:
        return table, 0
    ids = pa.array([recording for (recording,) in measured], pa.string())
    kept = table.filter(pc.invert(pc.is_in(table["recording_id"].cast(pa.string()), ids)))
    if not len(kept):
        raise MixtureError(
            "the action of every transition is odometry in place of a command",
            remedy="record the commands, or set odometry_as_command = true in the mixture",
        )
    return kept, len(table) - len(kept)


def unknown_conditions(connection: duckdb.DuckDBPyConnection) -> dict[str, str]:
    """Return the reason for each condition or exposure that is unknown in every recording."""
    if "recordings" not in {name for (name,) in connection.sql(_VIEWS).fetchall()}:
        return {}  # assume that all conditions are known
    rows: list[tuple[str, str]] = connection.sql(
        "SELECT unknown.condition, any_value(unknown.because)"
        " FROM (SELECT recording_id, unnest(unknown_conditions) AS unknown FROM recordings)"
        " GROUP BY unknown.condition"
        " HAVING count(DISTINCT recording_id) = (SELECT count(*) FROM recordings)"
    ).fetchall()
    return dict(rows)


def uncertain_labels(
    connection: duckdb.DuckDBPyConnection, names: Sequence[str]
) -> tuple[str, ...]:
    """Return a warning if labels of any of these conditions and exposures are uncertain."""
    if "recordings" not in {name for (name,) in connection.sql(_VIEWS).fetchall()}:
        return ()
    guessed = "list_intersect(uncertain_conditions, $names::VARCHAR[])"
    (found,) = connection.execute(
        f"SELECT list_sort(list_distinct(flatten(list({guessed})))), count_if(len({guessed}) > 0)"
        " FROM recordings",
        {"names": list(names)},
    ).fetchall()
    return (uncertain_text(*found),) if found[1] else ()


def episodes_met(
    connection: duckdb.DuckDBPyConnection, mixture: Mixture, conditions: Sequence[Condition]
) -> dict[str, list[tuple[int, int]]]:
    """Count the episodes that met each condition or exposure, by store.

    Returns name -> one pair per store: episodes that met it, and episodes in which it is known. The
    connection has a view over several stores; only rows that the mixture's `where` admits count.
    """
    held = "conditions" if mixture.uncertain == "keep" else _CERTAIN
    rows = (
        f"(SELECT {STORE_COLUMN}, recording_id, episode_id, {held} AS conditions, exposures"
        f" FROM transitions WHERE coalesce(({mixture.where or 'true'}\n)::BOOLEAN, false))"
    )
    observed: dict[tuple[str, str], int] = {
        (recording, name): episodes
        for recording, name, episodes in connection.sql(
            "SELECT recording_id, held, count(DISTINCT episode_id) FROM (SELECT recording_id,"
            f" episode_id, unnest(list_concat(conditions, exposures)) AS held FROM {rows})"
            " GROUP BY ALL"
        ).fetchall()
    }
    recordings = connection.sql(
        f"SELECT {STORE_COLUMN}, recording_id, episodes, exposed,"
        " coalesce(list_transform(unknown_conditions, lambda one: one.condition), [])"
        f" FROM (SELECT {STORE_COLUMN}, recording_id, count(DISTINCT episode_id) AS episodes,"
        f" count(exposures) > 0 AS exposed FROM {rows} GROUP BY ALL)"
        " JOIN (SELECT recording_id, any_value(unknown_conditions) AS unknown_conditions"
        " FROM recordings GROUP BY recording_id) USING (recording_id)"
    ).fetchall()
    stores = 1 + len(mixture.sources.stores)
    counts = {condition.name: np.zeros((stores, 2), np.int64) for condition in conditions}
    for store, recording, episodes, exposed, unknown in recordings:
        for condition in conditions:
            if condition.name not in unknown and (exposed or condition.kind == "outcome"):
                counts[condition.name][store] += (
                    observed.get((recording, condition.name), 0),
                    episodes,
                )
    return {
        name: [(met_it, could_tell) for met_it, could_tell in of_stores.tolist()]
        for name, of_stores in counts.items()
    }


def matrix(column: pa.Array, size: int) -> NDArray[np.float32]:
    """Convert a list column (n lists of `size` floats) to an array (n, size).

    Raises:
        PanelError: a list has another size.
    """
    flat = column.flatten().to_numpy(zero_copy_only=False)
    if flat.size != len(column) * size:
        raise PanelError(f"observations are not all of {size} entries; `restock audit` names them")
    rows: NDArray[np.float32] = flat.reshape(len(column), size)
    return rows


def find_task_hash(table: pa.Table) -> str:
    """Return the one task hash of all rows that the mixture admits.

    Raises:
        MixtureError: the mixture admits no row.
        StoreError: the rows belong to several tasks.
    """
    hashes = sorted(table["task_hash"].filter(table["admitted"]).unique().to_pylist())
    if not hashes:
        raise MixtureError("the mixture's `where` admits no transition")
    if len(hashes) > 1:
        raise StoreError(
            f"it holds transitions of {len(hashes)} tasks ({', '.join(hashes)}):"
            " their observations, actions and rewards do not mean the same",
            remedy="""choose one in the mixture, e.g. where = "task_hash = '"""
            + f"""{hashes[0]}'", or ingest into one store per task""",
        )
    return str(hashes[0])


def codes(table: pa.Table, name: str) -> Codes:
    """Return the dictionary codes of a text column, (N,); -1 for null."""
    column = table[name].combine_chunks()
    return np.asarray(column.indices.fill_null(-1).to_numpy(), np.int32)


def bools(table: pa.Table, name: str) -> Bools:
    return np.asarray(table[name].to_numpy(), np.bool_)
