"""From a mixture and a store to the rows of a panel: which, in which stratum, with which weight.

DuckDB says what each row is; everything that must come out the same on every machine and version
(the draws, the held-out episodes) is done here on transition ids, with hashes of our own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import ConfigError, MixtureError, StoreError
from restock.ingest.conditions import Condition
from restock.replay.layout import F32, Bools, Ints
from restock.replay.mixture import HeldOut, Mixture
from restock.replay.shares import SharePlan, plan_shares
from restock.replay.strata import (
    NO_STRATUM,
    Stratum,
    assign,
    effective_count,
    effective_shares,
    importance_weights,
    resolve_strata,
)

DAY_NS = 86_400 * 10**9

META_COLUMNS = (
    *("transition_id", "recording_id", "episode_id", "step_index", "stamp_ns", "logged_ns"),
    *(
        "condition",
        "zone",
        "behaviour_policy",
        "behaviour_version",
        "action_probability",
        "action",
        "reward",
    ),
    *("terminated", "truncated"),
)
BATCH_ROWS = 65_536  # read at a time
_CODED = pa.dictionary(pa.int32(), pa.string())
_TEXT = ("recording_id", "episode_id", "condition", "zone", "behaviour_policy", "behaviour_version")


@dataclass(frozen=True)
class StratumPlan:
    """One line of the plan's table."""

    stratum: str
    timing: str
    correction: str
    rows: int
    episodes: int
    natural_share: float  # of the panel's rows
    wanted_share: float
    share: float
    replays_per_row: float  # expected over the planned updates
    effective_episodes: float  # (sum n)^2 / sum n^2 over the rows per episode
    largest_weight: float
    effective_share: float  # after weights
    note: str


@dataclass(frozen=True)
class Plan:
    """A mixture worked out against a store. Row arrays are over the store's rows, in order."""

    mixture: Mixture
    rows: pa.Table  # META_COLUMNS of every row of the store, by recording, episode, step
    task_hash: str
    stratum: NDArray[np.int16]  # (N,) of each row; -1 where it is not in the panel
    weight: F32  # (n,) of the panel's rows
    held_out: Bools  # (N,)
    strata: tuple[StratumPlan, ...]
    logs_share: float  # of a batch
    left_out: dict[str, int]  # rows not in the panel, by reason
    effective_rows: float  # rows drawn equally often that the weighted draw is worth
    newest_ns: int  # when the newest row was logged

    @property
    def panel_rows(self) -> Ints:
        """Which of the store's rows are in the panel, (n,)."""
        return np.flatnonzero(self.stratum != NO_STRATUM)


def plan_panel(
    connection: duckdb.DuckDBPyConnection, mixture: Mixture, conditions: Sequence[Condition]
) -> Plan:
    """Work a mixture out over the connection's `transitions`.

    Raises:
        ConfigError: a predicate that does not run.
        MixtureError: too few rows where the mixture refuses that; rows outside every stratum.
        StoreError: no rows, rows of several tasks, or ids that are not unique.
    """
    strata = resolve_strata(mixture, conditions)
    table = _read(connection, mixture, strata)
    if not len(table):
        raise StoreError("it holds no transitions", remedy="`restock ingest` recordings first")
    task_hash = _one_task(table)
    ids = table["transition_id"].to_numpy()
    if len(np.unique(ids)) != len(ids):
        raise StoreError(
            f"{len(ids) - len(np.unique(ids))} transition ids occur twice",
            remedy="`restock audit` names them; ingest those recordings again",
        )
    member = np.stack([_bools(table, f"stratum_{i}") for i in range(len(strata))], axis=1)
    stratum = assign(member, strata)
    logged = table["logged_ns"].to_numpy()
    held_out = hold_out(table, mixture.held_out, mixture.seed)
    left_out: dict[str, int] = {}
    gone = np.zeros(len(table), np.bool_)

    def leave_out(reason: str, rows: Bools) -> None:
        new = rows & ~gone
        if new.any():
            left_out[reason] = int(new.sum())
        gone[rows] = True

    leave_out("refused by the mixture's `where`", ~_bools(table, "admitted"))
    if mixture.max_age_days is not None:
        leave_out("too old", logged < int(logged.max()) - int(mixture.max_age_days * DAY_NS))
    leave_out("held out", held_out)
    unlisted = (stratum == NO_STRATUM) & ~gone
    if unlisted.any() and mixture.unlisted == "refuse":
        seen = sorted(set(table["condition"].to_numpy(zero_copy_only=False)[unlisted]))
        raise MixtureError(
            f"{int(unlisted.sum())} rows belong to no stratum (conditions: {', '.join(seen)})",
            remedy='list a stratum for them, add [each_condition], or set unlisted = "drop"',
        )
    leave_out("in no stratum", unlisted)
    stratum[gone] = NO_STRATUM
    state_code = assign(member, strata, only_pre=True)
    return _finish(mixture, strata, table, task_hash, stratum, state_code, held_out, left_out)


def _finish(
    mixture: Mixture,
    strata: Sequence[Stratum],
    table: pa.Table,
    task_hash: str,
    stratum: NDArray[np.int16],
    state_code: NDArray[np.int16],
    held_out: Bools,
    left_out: dict[str, int],
) -> Plan:
    chosen = np.flatnonzero(stratum != NO_STRATUM)
    code = stratum[chosen]
    episode = _codes(table, "episode_id")[chosen]
    per_episode = [np.unique(episode[code == i], return_counts=True)[1] for i in range(len(strata))]
    rows = np.bincount(code, minlength=len(strata)).astype(np.int64)
    episodes = np.array([len(counts) for counts in per_episode], np.int64)
    shares = plan_shares(mixture, [s.rule for s in strata], rows, episodes)
    # Rows of a stratum that is never drawn are no part of the panel.
    never = (shares.got[code] <= 0) if len(code) else np.zeros(0, np.bool_)
    if never.any():
        left_out["in a stratum of share 0"] = int(never.sum())
        stratum[chosen[never]] = NO_STRATUM
        chosen, code = chosen[~never], code[~never]
    weight = importance_weights(code, state_code[chosen], strata, shares.got, mixture.correction)
    drawn = (shares.got / np.maximum(rows, 1))[code]
    effective = effective_count(drawn * weight)
    lines = _lines(mixture, strata, shares, rows, episodes, per_episode, code, weight)
    return Plan(
        mixture=mixture,
        rows=table.select(META_COLUMNS),
        task_hash=task_hash,
        stratum=stratum,
        weight=weight,
        held_out=held_out,
        strata=tuple(lines),
        logs_share=mixture.sources.logs * shares.scale,
        left_out=left_out,
        effective_rows=effective,
        newest_ns=int(table["logged_ns"].to_numpy().max()),
    )


def _lines(
    mixture: Mixture,
    strata: Sequence[Stratum],
    shares: SharePlan,
    rows: Ints,
    episodes: Ints,
    per_episode: Sequence[Ints],
    code: NDArray[np.int16],
    weight: F32,
) -> list[StratumPlan]:
    draws = mixture.planned.updates * mixture.planned.batch_size * mixture.sources.logs
    after = effective_shares(code, weight, shares.got)
    lines = []
    for i, stratum in enumerate(strata):
        lines.append(
            StratumPlan(
                stratum=stratum.name,
                timing=stratum.timing,
                correction=stratum.correction,
                rows=int(rows[i]),
                episodes=int(episodes[i]),
                natural_share=float(rows[i] / max(rows.sum(), 1)),
                wanted_share=float(shares.wanted[i]),
                share=float(shares.got[i]),
                replays_per_row=float(draws * shares.scale * shares.got[i] / max(rows[i], 1)),
                effective_episodes=effective_count(per_episode[i]),
                largest_weight=float(weight[code == i].max(initial=0.0)),
                effective_share=float(after[i]),
                note=shares.notes[i],
            )
        )
    return lines


def _read(
    connection: duckdb.DuckDBPyConnection, mixture: Mixture, strata: Sequence[Stratum]
) -> pa.Table:
    predicates = {"admitted": mixture.where or "true"}
    predicates |= {f"stratum_{index}": s.predicate for index, s in enumerate(strata)}
    names = {"admitted": "where"} | {f"stratum_{i}": s.name for i, s in enumerate(strata)}
    tests = ", ".join(
        f"coalesce(({sql}\n)::BOOLEAN, false) AS {name}" for name, sql in predicates.items()
    )
    columns = ", ".join(META_COLUMNS)
    query = (
        f"SELECT {columns}, task_hash, {tests} FROM transitions"
        " ORDER BY recording_id, episode_index, step_index"
    )
    try:
        # Text becomes codes batch by batch: whole columns of it would be most of the memory.
        reader = connection.sql(query).to_arrow_reader(BATCH_ROWS)
        table = pa.Table.from_batches([_encoded(batch) for batch in reader], _schema(reader.schema))
    except duckdb.Error as error:
        for name, sql in predicates.items():  # one by one, to say which
            try:
                connection.sql(f"SELECT ({sql}\n)::BOOLEAN FROM transitions LIMIT 0")
            except duckdb.Error as cause:
                raise ConfigError(
                    f"its SQL does not run over `transitions`: {str(cause).splitlines()[0]}",
                    where=f"mixture, stratum {names[name]!r}"
                    if name != "admitted"
                    else "mixture, `where`",
                ) from cause
        raise StoreError(f"its transitions cannot be read: {error}") from error
    return table.unify_dictionaries().combine_chunks()


def _schema(schema: pa.Schema) -> pa.Schema:
    for name in _TEXT:
        place = schema.get_field_index(name)
        schema = schema.set(place, schema.field(place).with_type(_CODED))
    return schema


def _encoded(batch: pa.RecordBatch) -> pa.RecordBatch:
    schema = _schema(batch.schema)
    columns = [
        column.cast(pa.string()).dictionary_encode() if field.name in _TEXT else column
        for column, field in zip(batch.columns, schema, strict=True)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _one_task(table: pa.Table) -> str:
    admitted = table.filter(table["admitted"])
    hashes = sorted(admitted["task_hash"].unique().to_pylist())
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


def hold_out(table: pa.Table, rule: HeldOut, seed: int) -> Bools:
    """Which rows are held out, (N,): whole episodes, whole recordings, or the latest episodes.

    Raises:
        MixtureError: the rule would hold out everything, or there is only one group to split.
    """
    if rule.by == "none" or rule.share == 0:
        return np.zeros(len(table), np.bool_)
    column = "recording_id" if rule.by == "recording" else "episode_id"
    code = _codes(table, column)
    names = table[column].combine_chunks().dictionary.to_pylist()
    rows = np.bincount(code, minlength=len(names))
    if rule.by == "time":
        newest = np.zeros(len(names), np.int64)
        np.maximum.at(newest, code, table["logged_ns"].to_numpy())
        order = np.argsort(-newest, kind="stable")
    else:
        order = np.argsort([_hash(name, seed) for name in names], kind="stable")
    order = order[rows[order] > 0]
    if len(order) < 2:
        raise MixtureError(
            f"one {rule.by if rule.by == 'recording' else 'episode'} cannot be split"
            " into a panel and held-out data",
            remedy='ingest more, or set [held_out] by = "none" in a mixture of your own',
        )
    wanted = rule.share * len(table)
    # At least one group, never all, and no more than needed.
    count = int(np.searchsorted(np.cumsum(rows[order]), wanted)) + 1
    chosen = order[: min(count, len(order) - 1)]
    return np.isin(code, chosen)


def _hash(name: str, seed: int) -> int:
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=7).digest()
    return int.from_bytes(digest, "big")


def _codes(table: pa.Table, name: str) -> Ints:
    """Dictionary codes of a text column, (N,); -1 for null."""
    column = table[name].combine_chunks()
    return np.asarray(column.indices.fill_null(-1).to_numpy(), np.int64)


def _bools(table: pa.Table, name: str) -> Bools:
    return np.asarray(table[name].to_numpy(), np.bool_)
