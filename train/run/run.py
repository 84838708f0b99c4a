"""A run: one directory that holds everything about it, readable at any moment, even after a kill.

config.json            resolved config, panel, task and versions
progress.parquet …     the tables of `run_tables`, each replaced in one step at a flush
checkpoints/           latest.safetensors (all state) and best.safetensors (the policy kept)
tensorboard/           the same curves as events; tracking.json: ids of other trackers
eval/                  results of `restock eval`
.lock                  names the process that trains the run, while it does

The policy that drives is the best by the run's evaluations. If a run stopped before it evaluated
what it learned in the twin, these evaluations are only of the policy that it began with: then the
latest policy drives, that of the last checkpoint.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import pyarrow as pa
from safetensors import SafetensorError, safe_open

from restock.errors import RunError, quoted
from restock.files import (
    expect_place,
    read_json,
    read_table,
    remove_leftovers,
    write_table,
    write_text,
)
from restock.train.run.run_tables import TABLES

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel

FORMAT = "restock-run/3"
MEAN_OF = "mean_of"  # key of config.json: policies of other runs, whose mean is this run's policy
_EARLIER = ("restock-run/1", "restock-run/2")
_LONG_TABLE = 4096  # rows from which `flush` does not always write a table
_UNKNOWN = -1  # in place of the rows on disk if the file differs from memory: a flush rewrites it
_REMEDY = "restore the file from a copy, or train the run again"
Rows = Sequence[Mapping[str, Any]]


class _Document(dict[str, Any]):
    """The content of `config.json`; a missing key is an error that names the file."""

    def __init__(self, values: Mapping[str, Any], path: Path) -> None:
        super().__init__(values)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise RunError(f"does not contain {key!r}", where=str(self._path), remedy=_REMEDY)


class Run:
    """A run directory. `create` makes a new one, `open` takes an existing one."""

    def __init__(self, path: Path, document: dict[str, Any]) -> None:
        self.path = path
        self.document: dict[str, Any] = _Document(document, path / "config.json")
        self._written: dict[str, pa.Table] = {}
        self._pending: dict[str, list[pa.Table]] = {name: [] for name in TABLES}
        self._on_disk: dict[str, int] = {}  # rows per table

    @classmethod
    def create(cls, path: Path | str, document: Mapping[str, Any]) -> Run:
        """Create a directory with `config.json`.

        Raises:
            RunError: something is at `path` already.
        """
        path = Path(path)
        check_free(path)
        path.mkdir(parents=True, exist_ok=True)
        whole = {"format": FORMAT, **document}
        write_text(path / "config.json", json.dumps(whole, indent=1) + "\n")
        run = cls(path, whole)
        run._written = {name: schema.empty_table() for name, schema in TABLES.items()}
        run.flush()
        return run

    @classmethod
    def open(cls, path: Path | str) -> Run:
        """Open an existing run.

        Raises:
            RunError: there is no run at `path`, or one in a format that this version cannot read.
                A damaged table is only found when it is read.
        """
        path = Path(path)
        config = path / "config.json"
        if not config.exists():
            raise RunError(
                "is not a run directory: it has no config.json" if path.exists() else "no such run",
                where=str(path),
                remedy="give the directory that `restock train --out` wrote",
            )
        document = read_json(config, error=RunError, remedy=_REMEDY)
        form = document.get("format")
        if form in _EARLIER:
            raise RunError(
                f"was written by an earlier Restock ({form}, this one reads {FORMAT})",
                where=str(path),
                remedy="train again with `restock train`",
            )
        if form != FORMAT:
            raise RunError(f"has format {form!r}, this Restock reads {FORMAT!r}", where=str(config))
        return cls(path, document)

    def __repr__(self) -> str:
        return f"<Run {self.path}>"

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled run; the next flush rewrites all files, which may have later rows."""
        vars(self).update(state)
        self._on_disk = dict.fromkeys(TABLES, _UNKNOWN)

    @property
    def latest(self) -> Path:
        return self.path / "checkpoints" / "latest.safetensors"

    @property
    def best(self) -> Path:
        return self.path / "checkpoints" / "best.safetensors"

    @property
    def absent(self) -> list[str]:
        """Return the names of missing table files."""
        files = [f"{name}.parquet" for name in TABLES]
        return [file for file in files if not (self.path / file).exists()]

    def append(self, table: str, rows: Rows) -> None:
        """Add rows to a table; `flush` writes them. Every column must be given.

        Raises:
            KeyError: a row lacks a column or has one that the table does not.
        """
        if not rows:
            return
        schema = TABLES[table]
        for row in rows:
            if row.keys() != set(schema.names):
                raise KeyError(f"{table}: {sorted(row.keys() ^ set(schema.names))}")
        columns = {name: [row[name] for row in rows] for name in schema.names}
        self.append_columns(table, columns)

    def append_columns(self, table: str, columns: Mapping[str, Any]) -> None:
        """Add rows given as columns (arrays, lists, or one scalar for all rows)."""
        self._pending[table].append(_to_table(columns, TABLES[table]))

    def table(self, name: str) -> pa.Table:
        """Return a table with all rows appended so far, flushed or not.

        Raises:
            RunError: its file is damaged, or runs have no such table.
        """
        if name not in TABLES:
            has = ", ".join(TABLES)
            where = str(self.path)
            raise RunError(f"there is no table {name!r}", where=where, remedy=f"it has {has}")
        written = self._flushed(name)
        if self._pending[name]:
            self._written[name] = written = pa.concat_tables([written, *self._pending[name]])
            self._pending[name] = []
        return written

    def _flushed(self, name: str) -> pa.Table:
        """Return a table without the pending rows; read it from its file the first time."""
        if name not in self._written:
            file, schema = self.path / f"{name}.parquet", TABLES[name]
            self._written[name] = (
                read_table(file, schema, error=RunError, remedy=_REMEDY)
                if file.exists()
                else schema.empty_table()
            )
            self._on_disk[name] = self._written[name].num_rows
        return self._written[name]

    def flush(self, *, everything: bool = True) -> None:
        """Write every table that has new rows or no file yet, each in one step.

        Without `everything`, a long table is not written until it has grown by a sixteenth, so that
        a run of any length spends little on writing; a checkpoint always writes everything.
        """
        for name in TABLES:
            path = self.path / f"{name}.parquet"
            rows = self._flushed(name).num_rows + sum(part.num_rows for part in self._pending[name])
            on_disk = self._on_disk.get(name, 0)
            new = rows - on_disk
            due = new and (everything or on_disk < _LONG_TABLE or new >= on_disk / 16)
            if due or not path.exists():
                self._write(name)

    def _write(self, name: str) -> None:
        table = self.table(name)
        write_table(table, self.path / f"{name}.parquet")
        self._on_disk[name] = table.num_rows

    def remove_leftovers(self) -> None:
        """Remove partial tables and checkpoints that a killed process left."""
        for folder, pattern in (
            (self.path, "*.parquet"),
            (self.path, "*.json"),
            (self.latest.parent, "*.safetensors"),
        ):
            remove_leftovers(folder, pattern)

    def row_counts(self) -> dict[str, int]:
        """Return the rows per table, for a checkpoint."""
        return {name: self.table(name).num_rows for name in TABLES}

    def truncate(self, counts: Mapping[str, int]) -> None:
        """Drop each table's rows beyond `counts` from memory; `flush` drops them from the files.

        Raises:
            RunError: a table has fewer rows than `counts`, which a checkpoint recorded.
        """
        for name in TABLES:
            table, count = self.table(name), int(counts.get(name, 0))
            if table.num_rows < count:
                raise RunError(
                    f"has {table.num_rows} rows, the checkpoint was taken after {count}",
                    where=str(self.path / f"{name}.parquet"),
                    remedy="the run directory was changed by hand; start the run again",
                )
            self._written[name] = table.slice(0, count)
            if table.num_rows != count:
                self._on_disk[name] = _UNKNOWN


def check_free(path: Path, remedy: str | None = None) -> None:
    """Raise RunError if `path` is taken, or no run can be made there.

    `remedy` replaces the usual advice if something is there.
    """
    expect_place(path, RunError)
    if path.exists() and (not path.is_dir() or any(file.name != LOCK for file in path.iterdir())):
        raise RunError(
            "already exists",
            where=str(path),
            remedy=remedy
            or f"choose another --out, remove it, or continue it with {resume_command(path)}",
        )


def resume_command(path: Path) -> str:
    """Return the command that continues a run, to paste into a shell."""
    return f"`restock train --resume {quoted(path)}`"


def software_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect a run's numbers."""
    from platform import python_version

    from restock import __version__

    names = ("torch", "mujoco", "gymnasium", "numpy", "duckdb", "pyarrow")
    return {
        "restock": __version__,
        "python": python_version(),
        **{name: version(name) for name in names},
    }


def panel_document(panel: Panel) -> dict[str, Any]:
    """Return what `config.json` has about the panel, in runs of Restock and of other libraries."""
    header = panel.header
    return {
        "path": str(panel.path.resolve()),
        "id": panel.id,
        "store": header.store,
        "store_version": panel.store_version,
        "others": [msgspec.structs.asdict(store) for store in header.others],
        "rows": len(panel),
        "newest_ns": header.newest_ns,
        "n_step": panel.n_step,
        "discount": panel.discount,
        "labels_version": header.labels_version,
        "blake3": {name: record.blake3 for name, record in header.files.items()},
    }


def now_ns() -> int:
    """Return the wall time in ns; a run keeps that of its start, to count ages of logged rows."""
    return time.time_ns()


def _to_table(columns: Mapping[str, Any], schema: pa.Schema) -> pa.Table:
    missing = set(schema.names) ^ set(columns)
    if missing:
        raise KeyError(f"columns {sorted(missing)}")
    lengths = {len(value) for value in columns.values() if _is_column(value)}
    if len(lengths) != 1:
        raise ValueError(f"columns of lengths {sorted(lengths)}")
    (length,) = lengths
    arrays = []
    for field in schema:
        value = columns[field.name]
        if _is_column(value):
            arrays.append(pa.array(value, field.type, from_pandas=False))
        elif value is None:
            arrays.append(pa.nulls(length, field.type))
        else:
            arrays.append(pa.repeat(pa.scalar(value, field.type), length))
    return pa.Table.from_arrays(arrays, schema=schema)


def _is_column(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | bytes)


LOCK = ".lock"  # file in a run with the process and the machine that train it


class RunLock:
    """The lock of a run, held from its construction until `release`."""

    def __init__(self, run: Path) -> None:
        """Take the lock; raise RunError if another process trains this run."""
        run.mkdir(parents=True, exist_ok=True)
        self._path = run / LOCK
        self._file: int | None = None
        while self._file is None:
            file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                holder = os.read(file, 256).decode("utf-8", "replace")
                os.close(file)
                raise _lock_error(run, holder) from error
            except OSError:  # the file system has no locks: go on without one
                os.close(file)
                self._path.unlink(missing_ok=True)
                return
            if _is_same_file(file, self._path):
                self._file = file
            else:  # the last holder removed the file after it was opened here: try again
                os.close(file)
        os.ftruncate(self._file, 0)
        os.write(self._file, f"{os.getpid()} {platform.node()}".encode())

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = None


def _is_same_file(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False


def _lock_error(run: Path, holder: str) -> RunError:
    process, _, machine = holder.partition(" ")
    is_local = machine == platform.node()
    kill, trainer = "", "another process"
    if process:
        trainer = f"process {process}" + ("" if is_local else f" on {machine}")
        kill = f" (Ctrl-C, or `kill {process}`{'' if is_local else ' there'})"
    return RunError(
        f"is being trained by {trainer}",
        where=str(run),
        remedy=f"wait until it has ended, or stop it{kill}; then run the same command again",
    )


@dataclass(frozen=True)
class PolicyOrigin:
    """The training step of the policy that drives, and why this policy was chosen."""

    chosen: Literal["best", "latest", "mean"]
    env_steps: int  # for a mean of runs, the sum over the runs
    gradient_steps: int
    run_env_steps: int  # environment steps of the run so far; 0: the run never drove

    @property
    def text(self) -> str:
        """Describe the origin: `policy of step 120,000 of 192,000, the best in training`."""
        if self.chosen == "mean":
            return f"mean of runs of {self.env_steps:,} steps together"
        if not self.run_env_steps:
            return f"policy of update {self.gradient_steps:,}, from the logs alone"
        of = "" if self.env_steps == self.run_env_steps else f" of {self.run_env_steps:,}"
        best = self.chosen == "best"
        why = "the best in training" if best else "the latest; not evaluated in training"
        return f"policy of step {self.env_steps:,}{of}, {why}"

    @property
    def document(self) -> dict[str, Any]:
        """Return the fields and the text as JSON values."""
        return {**asdict(self), "text": self.text}


def kept_policy(run: Run) -> PolicyOrigin | None:
    """Return the policy that would drive now; None without checkpoint and evaluation."""
    chosen = chosen_policy(run)
    clocks = run_clocks(run) if chosen == "latest" else _read_state(run.best)
    if not clocks:
        best = [row for row in run.table("evaluations").to_pylist() if row["best"]]
        if not best:
            return None
        clocks = best[-1]
    return PolicyOrigin(chosen, clocks["env_steps"], clocks["gradient_steps"], env_steps_of(run))


def chosen_policy(run: Run) -> Literal["best", "latest", "mean"]:
    """Return which of its policies a run drives with."""
    if MEAN_OF in run.document:
        return "mean"
    return "latest" if latest_drives(run) else "best"


def latest_drives(run: Run) -> bool:
    """Return whether the latest policy drives, as what the run learned was never evaluated."""
    latest, best = _read_state(run.latest), _read_state(run.best)
    if not latest:
        return False
    progress = latest["progress"]
    evaluated_at = max(progress["evaluated_at"], best.get("env_steps", -1))
    if evaluated_at < 0:
        return bool(latest["learner"]["gradient_steps"])
    return bool(progress["online_updates"]) and evaluated_at <= progress["online_from"]


def run_clocks(run: Run) -> dict[str, Any]:
    """Return the last checkpoint's clocks: steps, updates and seconds; empty without one."""
    latest = _read_state(run.latest)
    if not latest:
        return {}
    progress = latest["progress"]
    return {
        "env_steps": progress["env_steps"],
        "gradient_steps": latest["learner"]["gradient_steps"],
        "wall_s": progress["wall_s"],
        "updated_online": progress["online_updates"] > 0,
    }


def env_steps_of(run: Run) -> int:
    """Return the environment steps of a run so far: the largest in its checkpoint and tables."""
    steps: list[int] = [run_clocks(run).get("env_steps", 0)]
    for name in ("progress", "evaluations"):
        steps += run.table(name)["env_steps"].to_pylist()
    return max(steps)


def _read_state(path: Path) -> dict[str, Any]:
    """Return a checkpoint's state without loading arrays; empty if it cannot be read."""
    try:
        with safe_open(path, framework="numpy") as opened:
            values = json.loads((opened.metadata() or {})["state"])
    except (SafetensorError, OSError, ValueError, LookupError):
        return {}
    return values if isinstance(values, dict) else {}
