"""Build a panel: pack a plan's rows into one file for memory-mapping, all or nothing."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from threading import Event

import duckdb
import msgspec
import numpy as np
import pyarrow as pa

from restock import __version__
from restock.errors import PanelError, RestockError, StoreError
from restock.files import building, expect_place, read_table
from restock.ingest.store.location import Location
from restock.ingest.task.conditions import (
    NOMINAL,
    Condition,
    Kind,
    Timing,
    labels_version,
    of_kind,
    shipped,
)
from restock.ingest.task.schema import transition_schema
from restock.ingest.task.task import Task
from restock.process import interrupts_raised
from restock.replay.mixture.mixture import Mixture, load_mixture
from restock.replay.panel.pack import Packer
from restock.replay.panel.panel import (
    EVALUATION_SPLIT,
    HEADER,
    META,
    ROWS,
    FileRecord,
    Header,
    Panel,
    seal,
)
from restock.replay.plan.plan import AllStores, PanelPlan, PinnedStore, all_stores, plan_panel
from restock.replay.sampling.packed_rows import PACKING_VERSION
from restock.replay.store.store import Store, StoredProfile, corrected_versions, profiles_of

# Columns that a table in the form of a store's `transitions` must have, whatever the mixture.
_NEEDED = (
    *("transition_id", "recording_id", "episode_id", "episode_index", "step_index"),
    *("observation", "action", "reward", "next_observation", "terminated", "truncated"),
    *("primary_condition", "conditions", "zone", "behaviour_policy", "behaviour_version"),
    *("action_probability", "stamp_ns", "pose_x_m", "pose_y_m", "task_hash"),
)
# Columns that a table of any task must have. A table without `episode_id` counts as such a table.
_OF_ANY_TASK = (
    "observation",
    "action",
    "reward",
    "terminated",
    "truncated",
    "episode",
    "condition",
)
# Error message -> SQL predicate that is true for rows of the table `filled` with this error.
_FAULTS = {
    "row {row} lacks its observation, reward, end or episode": (
        "NOT coalesce(len(observation) > 0, false) OR reward IS NULL OR episode IS NULL"
        " OR (terminated OR truncated) IS NULL"
    ),
    "the action of row {row} is not a whole number from 0 to 32,767": "NOT discrete",
    "the observation of row {row} has {width} entries, that of row 0 {size}": (
        "len(observation) <> size"
    ),
    "the next observation of row {row} does not have {size} entries": (
        "len(next_observation) <> size"
    ),
    "row {row} follows the end of its episode": "after_end",
    "no row ends an episode": "NOT (SELECT max(terminated OR truncated) FROM filled)",
}


@dataclass(frozen=True)
class TransitionSource:
    """A source of transitions: a connection with a view `transitions`, and its metadata."""

    connection: duckdb.DuckDBPyConnection
    name: str
    version: int
    task_json: Callable[[str], str]  # task hash -> the task as JSON; "" if unknown
    conditions: tuple[Condition, ...]  # conditions and exposures
    others: tuple[PinnedStore, ...] = ()  # other stores with rows in the view
    # task hash -> the profiles that read its rows, newest ingest first
    profiles: Callable[[str], list[StoredProfile]] = lambda task_hash: []
    corrected: tuple[str, ...] = ()  # versions of labels that people corrected
    # Reason -> number of rows that are not in the view.
    left_out: Mapping[str, int] = field(default_factory=dict)

    def plan(self, mixture: Mixture) -> PanelPlan:
        """Plan a mixture over these transitions; see `plan_panel`."""
        plan = plan_panel(self.connection, mixture, self.conditions, self.others)
        return replace(plan, left_out={**self.left_out, **plan.left_out})


@contextmanager
def open_source(
    transitions: pa.Table | Store | str | Path,
    mixture: Mixture | None = None,
    *,
    task: Task | None = None,
    conditions: Sequence[Condition] | None = None,
    folder: Path | None = None,
) -> Iterator[TransitionSource]:
    """Open transitions as the source of a panel; see `build_panel` for their forms.

    For a store, the mixture's other stores are opened too; their relative paths are resolved
    against `folder`. For a table without `conditions`, the conditions are those that its labels
    name, with their shipped definitions if there are any.

    Raises:
        StoreError: a file of a store is damaged (checksums are verified), or a table does not have
            the form that `build_panel` needs.
    """
    where = "the table of transitions"
    if isinstance(transitions, str | Path):
        if Path(transitions).suffix != ".parquet":
            with (
                Store(transitions) as store,
                open_source(store, mixture, conditions=conditions, folder=folder) as source,
            ):
                yield source
            return
        where = str(transitions)
        transitions = read_table(Path(transitions), error=StoreError)
    if isinstance(transitions, Store):
        transitions.verify()
        named = (
            (*transitions.conditions(), *transitions.exposures())
            if conditions is None
            else tuple(conditions)
        )
        with contextlib.ExitStack() as opened:
            stores = AllStores(transitions.connection, ())
            if mixture is not None:
                stores = opened.enter_context(all_stores(transitions, mixture, folder))
            yield TransitionSource(
                stores.connection,
                _address(str(transitions.path)),
                transitions.version,
                transitions.task_json,
                named,
                stores.others,
                lambda task_hash: profiles_of(stores.connection, task_hash),
                corrected_versions(stores.connection),
            )
        return
    with duckdb.connect() as connection:
        left_out = _register(connection, transitions, where)
        # A store's Parquet files call the column `condition`; views call it `primary_condition`.
        has = [*map(str.casefold, connection.table("given").columns)]
        renamed = "" if "primary_condition" in has else "RENAME (condition AS primary_condition)"
        known, logged = ("EXCLUDE (logged_ns)", "logged_ns, ") if "logged_ns" in has else ("", "")
        connection.execute(
            f"CREATE VIEW transitions AS SELECT * {known} {renamed},"
            f" coalesce({logged}stamp_ns) AS logged_ns FROM given"
        )
        if conditions is None:
            conditions = _named_conditions(connection)

        def task_json(task_hash: str) -> str:
            if task is None:
                return ""
            if task.hash != task_hash:
                raise StoreError(
                    f"its rows are of task {task_hash}, but the given task is {task.hash}"
                )
            return msgspec.json.encode(task).decode()

        ((content,),) = connection.sql("SELECT sum(hash(given)) FROM given").fetchall()
        name = f"table in memory, {int(content or 0) % 2**64:016x}"
        yield TransitionSource(
            connection, name, -1, task_json, tuple(conditions), left_out=left_out
        )


def _register(connection: duckdb.DuckDBPyConnection, given: pa.Table, where: str) -> dict[str, int]:
    """Register a table as `given`; a table of any task is converted to the columns of a store.

    Returns reason -> number of rows left out. Raises StoreError if columns are missing or have
    other types.
    """
    remedy = "give rows with the columns of Store(…).sql('FROM transitions')"
    try:
        connection.register("given", given)
    except duckdb.InvalidInputException as error:
        what = f"transitions must be a Store or a table, got {repr(given)[:80]}"
        raise StoreError(what, remedy=remedy) from error
    kinds = {name.casefold(): kind for name, kind in _kinds(connection.table("given")).items()}
    needed: tuple[str, ...] = _NEEDED
    if "episode_id" not in kinds:
        needed, remedy = _OF_ANY_TASK, f"give {', '.join(_OF_ANY_TASK)}: docs/panel.md"
    elif "condition" in kinds:
        kinds.setdefault("primary_condition", kinds["condition"])
    if lacking := [name for name in needed if name not in kinds]:
        raise StoreError(f"it has no {', '.join(lacking)}", where=where, remedy=remedy)
    fit = _kinds(connection.from_arrow(transition_schema(1).empty_table()))
    fit |= {"primary_condition": fit["condition"], "episode": kinds.get("episode", "")}
    for name in needed:
        if kinds[name] != fit[name] and not kinds[name].endswith("null"):
            what = f"{name} must be {fit[name]}, not {kinds[name]}"
            raise StoreError(what, where=where, remedy=remedy)
    return {} if needed == _NEEDED else _convert_any_task(connection, given, where, remedy)


def _convert_any_task(
    connection: duckdb.DuckDBPyConnection, table: pa.Table, where: str, remedy: str
) -> dict[str, int]:
    """Give `given` the columns of a store's rows; return reason -> number of rows left out."""
    if not isinstance(table, pa.Table):  # a data frame of pandas or Polars
        table = pa.table(table)
    connection.register("given", table.append_column("place", pa.array(np.arange(len(table)))))
    try:
        connection.execute((files("restock.replay.panel") / "any_table.sql").read_text("utf-8"))
    except duckdb.Error as error:
        what = f"it cannot be read as transitions: {str(error).splitlines()[0]}"
        raise StoreError(what, where=where, remedy=remedy) from error
    for what, test in _FAULTS.items():
        first = f"FROM filled WHERE {test} ORDER BY place LIMIT 1"
        for row, width, size in connection.sql(
            f"SELECT place, len(observation), size {first}"
        ).fetchall():
            message = what.format(row=row, width=width, size=size)
            raise StoreError(message, where=where, remedy=remedy)
    unknown = "next_observation IS NULL"
    ((lost,),) = connection.sql(f"SELECT count(*) FROM filled WHERE {unknown}").fetchall()
    connection.unregister("given")
    connection.execute(
        "CREATE VIEW given AS SELECT * EXCLUDE (place, size, after_end, discrete)"
        f" FROM filled WHERE NOT ({unknown})"
    )
    return {"last of an episode, without a next observation": lost} if lost else {}


def _kinds(relation: duckdb.DuckDBPyRelation) -> dict[str, str]:
    """Return each column's kind of values ("numbers", "text", …), whatever their size in bits."""
    return dict(zip(relation.columns, map(_kind, map(str, relation.types)), strict=True))


def _kind(kind: str) -> str:
    if kind.endswith("]"):
        return f"lists of {_kind(kind.rpartition('[')[0])}"
    if kind == "BOOLEAN" or kind.endswith("INT") or kind in ("INTEGER", "FLOAT", "DOUBLE"):
        return "numbers"
    return "text" if kind.startswith(("VARCHAR", "ENUM")) else kind.strip('"').lower()


def _named_conditions(connection: duckdb.DuckDBPyConnection) -> list[Condition]:
    """Return the conditions and exposures that labels name, with shipped definitions if known."""
    found = []
    columns: dict[str, Kind] = {"conditions": "outcome", "exposures": "exposure"}
    for column in columns.keys() & set(connection.sql("FROM transitions LIMIT 0").columns):
        kind, known = columns[column], shipped(kind=columns[column])
        names = connection.sql(f"SELECT DISTINCT unnest({column}) FROM transitions").fetchall()
        timing: Timing = "post" if kind == "outcome" else "pre"
        found += [
            known.get(name) or Condition(name, timing, "false", kind=kind)
            for (name,) in sorted(names)
        ]
    return sorted(found, key=lambda condition: (condition.kind != "outcome", condition.name))


@interrupts_raised
def build_panel(
    transitions: pa.Table | Store | str | Path,
    mixture: Mixture,
    out: str | Path,
    *,
    task: Task | None = None,
    conditions: Sequence[Condition] | None = None,
    force: bool = False,
    advance: Callable[[int], None] = lambda rows: None,
) -> Panel:
    """Plan, pack and open a panel. Its `warnings` are those of `restock mix`.

    Args:
        transitions: a store or its path; a table with the columns of a store's `transitions`; or a
            table of any task, also as a `.parquet` file, with columns observation (a list), action
            (from 0), reward, terminated, truncated, episode and condition ("nominal" for none).
        mixture: which rows to take, in which shares.
        out: the panel's directory, which must not exist yet.
        task: for a table, the task that defines its rows.
        conditions: for a table, the definitions of its conditions.
        force: replace a panel that is already at `out`.
        advance: called repeatedly with the number of source rows just read.

    Raises:
        ConfigError, MixtureError, StoreError: see `plan_panel`.
        PanelError: `out` already exists.
    """
    check_free(Path(out), force)
    with open_source(transitions, mixture, task=task, conditions=conditions) as source:
        return write_panel(source, source.plan(mixture), out, force=force, advance=advance)


def plan_only(store: str, name: str) -> PanelPlan:
    """Plan a panel from a mixture's name or file without writing anything.

    Raises:
        StoreError, ConfigError, MixtureError: see `plan_panel`; the message names the mixture.
    """
    mixture = load_mixture(name)
    with Store(store) as opened:
        try:
            with open_source(opened, mixture, folder=Path(name).parent) as source:
                return source.plan(mixture)
        except RestockError as error:
            where = name if error.where is None else f"{name}: {error.where}"
            raise type(error)(error.what, where=where, remedy=error.remedy) from error


def write_panel(
    source: TransitionSource,
    plan: PanelPlan,
    out: str | Path,
    *,
    force: bool = False,
    advance: Callable[[int], None] = lambda rows: None,
) -> Panel:
    """Pack a plan's rows into `out`. If interrupted, it leaves nothing there.

    Raises PanelError if something at `out` may not be replaced, or a row cannot be packed.
    """
    out = Path(out)
    check_free(out, force)
    with building(out) as partial, _report_out_of_memory():
        scratch = partial / "scratch"
        scratch.mkdir()
        task_json = source.task_json(plan.task_hash)
        packer = Packer(
            source.connection, plan, scratch, random_probability=_random_probability(task_json)
        )
        size, record = _write_all(packer, partial, advance)
        identity = panel_id(source, plan, packer.digest())
        shutil.rmtree(scratch)
        files = {ROWS: record} | {
            name: FileRecord.of(partial / name) for name in (META, EVALUATION_SPLIT)
        }
        header = _header(source, plan, identity, task_json, size, files)
        (partial / HEADER).write_bytes(seal(header))
        for name in (HEADER, *header.files):
            _finish_file(partial / name)
        _move_into_place(partial, out, force)
    return Panel.open(out)


def _write_all(
    packer: Packer, folder: Path, advance: Callable[[int], None]
) -> tuple[int, FileRecord]:
    """Write the packed rows, and meanwhile their metadata; return what `write_rows` returns."""
    stop = Event()
    with ThreadPoolExecutor(1, "restock-meta") as beside:
        meta = beside.submit(packer.write_meta, folder / META, folder / EVALUATION_SPLIT, stop)
        try:
            written = packer.write_rows(folder / ROWS, advance)
            meta.result()
        finally:
            stop.set()  # if packing rows failed, stop writing metadata
    return written


@contextmanager
def _report_out_of_memory() -> Iterator[None]:
    """Raise PanelError if DuckDB runs out of memory while the block runs."""
    try:
        yield
    except (duckdb.OutOfMemoryException, OSError) as error:
        if isinstance(error, OSError) and "Out of Memory" not in str(error):
            raise
        raise PanelError(
            f"DuckDB ran out of memory: {str(error).splitlines()[0]}",
            remedy="give it more: RESTOCK_MEMORY_LIMIT, or Store(memory_limit=…)",
        ) from error


def _address(store: str) -> str:
    """Return a store's absolute path or URL, so that `restock trace` finds it from any folder."""
    place = Location.of(store)
    return str(place if place.folder is None else place.folder.resolve())


def check_free(out: Path, force: bool) -> None:
    """Raise PanelError if `out` exists and may not be replaced, or cannot be a directory."""
    expect_place(out, PanelError)
    is_panel = (out / HEADER).is_file()
    if out.exists() and not (force and is_panel):
        raise PanelError(
            "already there",
            where=str(out),
            remedy="choose another --out" + ("; --force replaces a panel" if is_panel else ""),
        )
    own = {HEADER, ROWS, META, EVALUATION_SPLIT}
    if is_panel and (foreign := sorted({item.name for item in out.iterdir()} - own)):
        raise PanelError(
            f"replacing it would delete other files in it: {', '.join(foreign[:3])}"
            + (" …" if len(foreign) > 3 else ""),
            where=str(out),
            remedy="move them away, or choose another --out",
        )


def _finish_file(path: Path) -> None:
    """Flush a file to disk, and make it read-only: a panel never changes."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
    path.chmod(0o444)


def _move_into_place(partial: Path, out: Path, force: bool) -> None:
    """Rename the finished panel to `out`; with `force`, an old panel is moved away first."""
    partial.chmod(0o755)  # mkdtemp created it for the owner only
    old = partial.with_name(partial.name + "-old")
    if force and (out / HEADER).is_file():
        with contextlib.suppress(FileNotFoundError):  # another process removed it
            out.rename(old)
    try:
        partial.rename(out)
    except OSError as error:
        if not out.exists():
            if old.exists():
                old.rename(out)
            raise
        raise PanelError(
            "another process built it first", where=str(out), remedy="use that panel"
        ) from error
    finally:
        shutil.rmtree(old, ignore_errors=True)


def _random_probability(task_json: str) -> float:
    """Return 1 / number of actions: an action's probability at random; 0 if the task is unknown."""
    if not task_json:
        return 0.0
    return 1.0 / len(msgspec.json.decode(task_json, type=Task).actions)


def panel_id(source: TransitionSource, plan: PanelPlan, digest: str) -> str:
    """Return a panel's id: a hash of store versions, mixture, task, rows and packing version.

    `digest` is a hash of the rows.
    """
    own = source.name if source.version < 0 else source.version  # a table's name contains its hash
    versions = [own, *(store.version for store in source.others)]
    named = [PACKING_VERSION, versions, plan.mixture, plan.task_hash, digest]
    return hashlib.blake2b(msgspec.json.encode(named), digest_size=8).hexdigest()


def _labels_version(source: TransitionSource) -> str:
    """Return the version of the label rules, with a hash of the corrections if there are any."""
    rules = labels_version(source.conditions)
    if not source.corrected:
        return rules
    content = msgspec.json.encode(source.corrected)
    return f"{rules}+{hashlib.blake2b(content, digest_size=4).hexdigest()}"


def _header(
    source: TransitionSource,
    plan: PanelPlan,
    identity: str,
    task_json: str,
    observation_size: int,
    files: dict[str, FileRecord],
) -> Header:
    read_by = (*source.profiles(plan.task_hash), StoredProfile("", "", ""))[0]
    outcomes = of_kind(source.conditions, "outcome")
    by_priority = sorted(outcomes, key=lambda c: (c.priority, c.name))
    return Header(
        id=identity,
        store=source.name,
        store_version=source.version,
        task_hash=plan.task_hash,
        task_json=task_json,
        profile=read_by.name,
        profile_toml=read_by.toml,
        labels_version=_labels_version(source),
        observation_size=observation_size,
        rows=len(plan.panel_rows),
        discount=plan.mixture.discount,
        n_step=plan.mixture.n_step,
        packing_version=PACKING_VERSION,
        restock_version=__version__,
        newest_ns=plan.newest_ns,
        as_of_ns=plan.as_of_ns,
        split_by=plan.split_by,
        split_note=plan.split_note,
        warnings=list(plan.warnings),
        logs_share=plan.logs_share,
        conditions=[*(c.name for c in by_priority), NOMINAL],
        left_out=plan.left_out,
        effective_rows=plan.effective_rows,
        strata=list(plan.strata),
        mixture=plan.mixture,
        others=[msgspec.structs.replace(o, path=_address(o.path)) for o in plan.others],
        ratios=list(plan.ratios),
        files=files,
    )
