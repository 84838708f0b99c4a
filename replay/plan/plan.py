"""Plan a panel from a mixture and a store: which rows, in which stratum, with which weight.

DuckDB evaluates the predicates of each row. Everything that must be the same on every machine and
version (caps, evaluation split) is computed here from transition ids, with hash functions of our
own. The rows of a mixture's other stores are in the same view as those of the first (`all_stores`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import MixtureError, StoreError
from restock.ingest.task.conditions import NOMINAL, Condition
from restock.replay.mixture.mixture import Mixture, OtherStore, nanoseconds
from restock.replay.mixture.shares import look_for_archives, represented_shares
from restock.replay.plan.candidates import (
    META_COLUMNS,
    STORE_COLUMN,
    Places,
    bools,
    codes,
    episodes_met,
    find_task_hash,
    read_candidates,
    stretches,
    uncertain_labels,
    unknown_conditions,
    without_measured_actions,
)
from restock.replay.plan.exclusions import (
    EvaluationRows,
    LeftOut,
    leave_out,
    leave_out_of_strata,
    repeats_installed,
    repeats_of,
    split_for_evaluation,
)
from restock.replay.plan.source_plan import (
    SourcePlan,
    SourceRows,
    plan_source,
)
from restock.replay.plan.strata import (
    NO_STRATUM,
    ResolvedStratum,
    Stratum,
    assign,
    deal_episodes,
    replace_dealt,
    required_steps,
    resolve_strata,
)
from restock.replay.plan.weights import RatioFit
from restock.replay.store.definitions import definitions
from restock.replay.store.parquet_views import parquet_view
from restock.replay.store.store import Store


class PinnedStore(msgspec.Struct, frozen=True):
    """Another store of a panel, at the version that was read."""

    name: str
    path: str  # resolved path
    version: int
    repeated_rows: int  # rows not taken from it, as an earlier store also has their recordings


@dataclass(frozen=True)
class AllStores:
    """A connection over all stores of a mixture; its view `transitions` contains their rows."""

    connection: duckdb.DuckDBPyConnection
    others: tuple[PinnedStore, ...]


@contextmanager
def all_stores(first: Store, mixture: Mixture, folder: Path | None = None) -> Iterator[AllStores]:
    """Open the mixture's other stores, and yield one view over them and the first store.

    Relative paths are resolved against `folder` (of the mixture's file), or against the working
    directory if `folder` is None. The first store's own views do not change.

    Raises:
        StoreError: a store cannot be opened, lacks the requested version, or has no rows.
        MixtureError: earlier stores contain all rows of a store.
    """
    if not mixture.sources.stores:
        yield AllStores(first.connection, ())
        return
    with ExitStack() as opened:
        others = [
            (wanted, opened.enter_context(_open(wanted, folder)))
            for wanted in mixture.sources.stores
        ]
        connection = opened.enter_context(duckdb.connect())
        repeated_rows = _create_views(connection, first, others)
        pinned = tuple(
            PinnedStore(wanted.name, str(store.path), store.version, repeated)
            for (wanted, store), repeated in zip(others, repeated_rows, strict=True)
        )
        yield AllStores(connection, pinned)


def _open(wanted: OtherStore, folder: Path | None) -> Store:
    path: str | Path = wanted.path
    if "://" not in wanted.path:
        path = Path(wanted.path).expanduser()
        if not path.is_absolute() and folder is not None:
            path = folder / path
    try:
        store = Store(path)
        store.verify()
        return store
    except StoreError as error:
        raise StoreError(
            f"the mixture's store {wanted.name!r}: {error.what}",
            where=error.where,
            remedy=error.remedy,
        ) from error


def _create_views(
    connection: duckdb.DuckDBPyConnection, first: Store, others: Sequence[tuple[OtherStore, Store]]
) -> list[int]:
    """Create views over all stores; return the `repeated_rows` of each store but the first."""
    tables: dict[str, list[str]] = {"stored_transitions": [], "stored_recordings": []}
    repeated = []
    for number, store in enumerate([first, *(store for _, store in others)]):
        schema = f'"store_{number}"'
        connection.execute(f"CREATE SCHEMA {schema}")
        for table in tables:
            if not store.files[table]:
                raise StoreError("it holds no transitions", where=str(store.path))
            connection.execute(parquet_view(table, store.files[table], schema=f"store_{number}"))
        connection.execute(
            f"CREATE TABLE {schema}.mine AS SELECT DISTINCT recording_id"
            f" FROM {schema}.stored_transitions"
        )
        before = " UNION ALL ".join(f'FROM "store_{i}".mine' for i in range(number))
        known = f"recording_id IN ({before})" if before else "false"
        if number:
            count = f"SELECT countif({known}), count(*) FROM {schema}.stored_transitions"
            [(repeats, rows)] = connection.sql(count).fetchall()
            if repeats == rows:
                raise _all_repeated(others[number - 1][0].name, rows, number)
            repeated.append(int(repeats))
        for table in tables:
            tables[table].append(
                f"SELECT *, {number} AS {STORE_COLUMN} FROM {schema}.{table} WHERE NOT ({known})"
            )
    for table, parts in tables.items():
        connection.execute(f"CREATE VIEW {table} AS " + " UNION ALL BY NAME ".join(parts))
    connection.execute(definitions(names=["rows.sql"]))
    return repeated


def _all_repeated(name: str, rows: int, number: int) -> MixtureError:
    where = "the main store" if number == 1 else "the stores before it"
    return MixtureError(
        f"all {rows:,} rows of {name!r} are also in {where}, and are drawn from there",
        remedy="leave this store out of the mixture: a stratum with a larger `share` draws them"
        " more often, and its `where` may name their recordings (recording_id IN (…))",
    )


LOGS = "logs"  # the name of the first store as a source


@dataclass(frozen=True)
class PanelPlan:
    """The plan of a panel. Arrays (N,) are over all rows of the stores, (n,) over the panel's."""

    mixture: Mixture
    rows: pa.Table  # META_COLUMNS of all N rows, sorted by recording, episode, step
    task_hash: str
    stratum: NDArray[np.int16]  # (N,) -1: not in the panel
    weight: F32  # (n,) importance weights
    beside: dict[str, NDArray[Any]]  # (n,) columns for computing weights again when shares change
    evaluation_split: Bools  # (N,) rows held out for evaluation
    split_by: str  # how they were chosen, as in `EvaluationSplit.by`; may differ from the mixture's
    split_note: str  # what was held out instead of whole groups, or why nothing was
    strata: tuple[Stratum, ...]
    found: dict[str, F64]  # stratum that lacks rows -> its rows in each episode of `rows`
    logs_share: float  # share of logged rows in a batch, over all stores
    logs_share_wanted: float  # the value of `logs_share` if all strata had enough rows
    left_out: dict[str, int]  # reason -> number of rows not in the panel
    effective_rows: float  # effective sample size of the weighted draws
    newest_ns: int  # when the newest row was logged
    as_of_ns: int | None  # moment that ages count back from; None without `max_age_days`
    others: tuple[PinnedStore, ...] = ()  # stores besides the first
    uncertain_rows: int = 0  # admitted rows with an uncertain condition
    ratios: tuple[RatioFit, ...] = ()  # fits of corrections by density ratio
    warnings: tuple[str, ...] = ()

    @property
    def panel_rows(self) -> Ints:
        """Return the numbers (n,) of the rows that are in the panel."""
        return np.flatnonzero(self.stratum != NO_STRATUM)


def plan_panel(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    conditions: Sequence[Condition],
    others: Sequence[PinnedStore] = (),
) -> PanelPlan:
    """Plan a mixture over the connection's `transitions`.

    `others` are the mixture's other stores, whose rows the view contains too (`all_stores`).

    Raises:
        ConfigError: a predicate does not run.
        MixtureError: the mixture refuses something it finds: too few rows, weights that take a
            stratum below its natural share, rows outside all strata.
        StoreError: no rows, rows of several tasks, or ids that are not unique.
    """
    wanted = [store.name for store in mixture.sources.stores]
    if wanted != [store.name for store in others]:
        raise MixtureError(
            f"the mixture also draws from other stores ({', '.join(wanted)})",
            remedy="`restock mix STORE --mixture FILE` opens them; from Python, `all_stores`",
        )
    strata = resolve_strata(mixture, conditions)
    table = read_candidates(connection, mixture, strata, several_stores=bool(others))
    if not len(table):
        raise StoreError("it holds no transitions", remedy="`restock ingest` recordings first")
    measured = 0
    if not mixture.odometry_as_command:
        table, measured = without_measured_actions(connection, table)
    task_hash = find_task_hash(table)
    with repeats_installed(connection, mixture):  # meanwhile a thread reads manifests
        places = Places(table["transition_id"].to_numpy())
        if repeats := places.repeats:
            raise StoreError(
                f"{repeats} transition ids occur twice",
                remedy="`restock audit` names them; ingest those recordings again",
            )
        member = _find_members(table, strata)
        state = _find_members(table, strata, of_state=True)
        if mixture.unlabelled == "nominal":
            for index, named in enumerate(strata):
                if named.name == NOMINAL and named.rule.where is None:
                    member[:, index] |= ~bools(table, "labelled")
                    state[:, index] |= ~bools(table, "labelled")
        stratum, state_code = assign(member, strata), assign(state, strata, only_pre=True)
        del state
        split = split_for_evaluation(table, mixture)
    as_of_ns = (
        time.time_ns() // 10**9 * 10**9  # whole seconds can be written as `as_of`
        if mixture.as_of is None
        else nanoseconds(mixture.as_of)
    )
    out = leave_out(table, mixture, split, as_of_ns)
    out.add("same steps as the evaluation split", repeats_of(connection, table, places, split.held))
    if measured:
        out.reasons["odometry in place of a command"] = measured
    for other in others:
        if other.repeated_rows:
            out.reasons[f"of {other.name!r}, also in an earlier store"] = other.repeated_rows
    stratum, state_code = _deal_by_store(table, strata, member, stratum, state_code, ~out.gone)
    warnings: tuple[str, ...] = (split.warning,) if split.warning else ()
    del member
    beyond_cap = leave_out_of_strata(table, mixture, stratum, out)
    if out.gone.all():
        reasons = ", ".join(f"{rows:,} {reason}" for reason, rows in out.reasons.items())
        raise MixtureError(
            f"no row is left: {reasons}",
            remedy="loosen the mixture's limits that leave out too many rows",
        )
    stratum[out.gone & ~beyond_cap] = NO_STRATUM
    sources = _collect_sources(
        mixture, table, stratum, state_code, beyond_cap, out.admitted, len(strata)
    )
    names = [named.name for named in strata]
    warnings += uncertain_labels(connection, names)
    if others:
        observed = episodes_met(connection, mixture, conditions)
        warnings += look_for_archives(mixture.sources.represented, observed, names)
    occurs = represented_shares(mixture, strata, sources)
    unknown = unknown_conditions(connection)
    plans = [
        plan_source(connection, mixture, strata, source, natural, unknown)
        for source, natural in zip(sources, occurs, strict=True)
    ]
    for source, plan in zip(sources, plans, strict=True):
        warnings += tuple(f"{_prefix(source)}{text}" for text in plan.warnings)
    return _merge_sources(
        mixture,
        strata,
        table,
        task_hash,
        split,
        out,
        sources,
        plans,
        others,
        as_of_ns,
        warnings,
    )


def _find_members(
    table: pa.Table, strata: Sequence[ResolvedStratum], *, of_state: bool = False
) -> Bools:
    """Return which rows may be in each stratum, (N, S), by the stratum's predicate and unit.

    With `of_state`, use the predicate of the state alone for strata that have one.
    """
    member = np.empty((len(table), len(strata)), np.bool_, order="F")
    episode = codes(table, "episode_id")
    for index, stratum in enumerate(strata):
        own_state = of_state and stratum.state_predicate is not None
        holds = bools(table, f"state_{index}" if own_state else f"stratum_{index}")
        if stratum.steps_of_episode:
            steps = np.bincount(episode[holds], minlength=int(episode.max()) + 1)
            holds = (steps >= required_steps(stratum.rule, steps))[episode]
        member[:, index] = holds
    return member


def _deal_by_store(
    table: pa.Table,
    strata: Sequence[ResolvedStratum],
    member: Bools,
    stratum: NDArray[np.int16],
    state_code: NDArray[np.int16],
    counted: Bools,
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Deal the episodes of each store to strata; return the new `stratum` and `state_code`."""
    store, episode = table["store"].to_numpy(), codes(table, "episode_id")
    stratum, state_code = stratum.copy(), state_code.copy()
    numbers = pc.unique(table["store"]).to_pylist()
    for number in numbers:
        at = np.flatnonzero(store == number) if len(numbers) > 1 else slice(None)  # no copies
        dealt = deal_episodes(stratum[at], member[at], episode[at], strata, counted[at])
        stratum[at] = replace_dealt(stratum[at], dealt, episode[at], strata)
        state_code[at] = replace_dealt(state_code[at], dealt, episode[at], strata)
    return stratum, state_code


def _collect_sources(
    mixture: Mixture,
    table: pa.Table,
    stratum: NDArray[np.int16],
    state_code: NDArray[np.int16],
    beyond_cap: Bools,
    logged: Bools,
    size: int,
) -> list[SourceRows]:
    """Return the rows of each store that may be drawn, and its share of a batch.

    `logged` (N,) are rows that the mixture admits; episodes of recordings without such rows do not
    count in `SourceRows.logged`.
    `size` is the number of strata.
    """
    store, episode = table["store"].to_numpy(), codes(table, "episode_id")
    recording = codes(table, "recording_id")
    logged = np.isin(recording, np.unique(recording[logged]))
    episodes = len(table["episode_id"].combine_chunks().dictionary)
    sources = []
    for number, (name, part) in enumerate(mixture.sources.parts.items()):
        admitted = (stratum != NO_STRATUM) & (store == number)
        seen = np.bincount(episode[logged & (store == number)], minlength=episodes) > 0
        at = np.flatnonzero(admitted & ~beyond_cap)
        sources.append(
            SourceRows(
                name,
                part,
                table,
                at,
                stratum[at],
                state_code[at],
                episode[at],
                seen,
                np.bincount(stratum[admitted], minlength=size),
            )
        )
    return sources


def _merge_sources(
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    table: pa.Table,
    task_hash: str,
    split: EvaluationRows,
    out: LeftOut,
    sources: Sequence[SourceRows],
    plans: Sequence[SourcePlan],
    others: Sequence[PinnedStore],
    as_of_ns: int,
    warnings: tuple[str, ...],
) -> PanelPlan:
    """Merge the plans of all sources; the strata of source k begin at index k * S."""
    size = len(strata)
    code = np.full(len(table), NO_STRATUM, np.int16)
    state = np.full(len(table), NO_STRATUM, np.int16)
    weight = np.zeros(len(table), np.float32)
    outcome: dict[str, F32] = {}
    filled = np.array([s.part * p.drawn for s, p in zip(sources, plans, strict=True)])
    part_of_logs = filled / filled.sum()
    lines: list[Stratum] = []
    found: dict[str, F64] = {}
    never = 0
    for number, (source, plan) in enumerate(zip(sources, plans, strict=True)):
        at = source.at[plan.kept]
        never += len(source.at) - len(at)
        code[at] = source.code[plan.kept] + number * size
        state[at], weight[at] = source.state_code[plan.kept], plan.weight
        estimated = (
            [] if plan.outcome is None else np.flatnonzero(plan.outcome.any(axis=0)).tolist()
        )
        for index in estimated:
            column = outcome.setdefault(
                outcome_column(strata[index].name), np.zeros(len(table), np.float32)
            )
            column[at] = plan.outcome[:, index] if plan.outcome is not None else 0
        of_logs = float(part_of_logs[number])
        prefix = _prefix(source)
        found |= {f"{prefix}{name}": rows for name, rows in plan.found.items()}
        lines += [
            msgspec.structs.replace(
                line,
                name=f"{prefix}{line.name}",
                wanted_share=line.wanted_share * of_logs,
                share=line.share * of_logs,
                effective_share=line.effective_share * of_logs,
            )
            for line in plan.lines
        ]
    # Rows of a stratum that is never drawn are not in the panel.
    left_out = out.reasons | ({"in a stratum of share 0": never} if never else {})
    chosen = np.flatnonzero(code != NO_STRATUM)
    rows = np.array([line.rows for line in lines])
    drawn = np.array([line.share for line in lines]) / np.maximum(rows, 1)
    weight, code_of_chosen = weight[chosen], code[chosen]
    return PanelPlan(
        mixture=mixture,
        rows=table.select(META_COLUMNS),
        task_hash=task_hash,
        stratum=code,
        weight=weight,
        beside={"state_code": state[chosen]} | {k: v[chosen] for k, v in outcome.items()},
        evaluation_split=split.held,
        split_by=split.by,
        split_note=split.note,
        strata=tuple(lines),
        found=found,
        logs_share=float(filled.sum()),
        logs_share_wanted=sum(source.part for source in sources),
        left_out=left_out,
        effective_rows=_effective_rows(drawn, code_of_chosen, weight),
        newest_ns=int(table["logged_ns"].to_numpy().max()),
        as_of_ns=None if mixture.max_age_days is None else as_of_ns,
        others=tuple(others),
        uncertain_rows=int((bools(table, "uncertain") & out.admitted).sum()),
        ratios=tuple(plan.fit for plan in plans if plan.fit is not None),
        warnings=warnings,
    )


def _prefix(source: SourceRows) -> str:
    """Return the prefix of the names of a source's strata."""
    return "" if source.name == LOGS else f"{source.name}/"


def _effective_rows(drawn: F64, code: NDArray[np.int16], weight: F32) -> float:
    """Return the effective number of rows; a row counts by its share of the draws x weight (n,)."""
    total = squares = 0.0
    for begin, end in stretches(len(code)):
        sizes = drawn[code[begin:end]] * weight[begin:end]
        total, squares = total + float(sizes.sum()), squares + float((sizes**2).sum())
    return total**2 / squares if squares > 0 else 0.0


def outcome_column(stratum: str) -> str:
    """Return the name of the column of a panel's metadata with P(stratum | state, action)."""
    return f"probability_of_{stratum}"
