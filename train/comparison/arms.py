"""The runs of one arm of a comparison: one method, several seeds; and what sets two arms apart.

What is compared is one thing (the mixture, the algorithm or the target rule); all else must be the
same, or the comparison says nothing about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from restock.arrays import F64
from restock.errors import ArgumentError, RunError
from restock.toml import by_path
from restock.train.comparison.comparability import Feed
from restock.train.run.run import Run

Treatment = Literal["algorithm", "target", "mixture", "practice", "data", "method"]
Kind = Literal[
    "algorithm",
    "target",
    "feed",
    "practice",
    "environment",
    "store",
    "evaluation",
    "task",
    "software",
    "free",
]

# What each treatment allows to differ, besides what decides nothing.
ALLOWED: Mapping[Treatment, frozenset[Kind]] = {
    "algorithm": frozenset({"algorithm"}),
    "target": frozenset({"target"}),
    "mixture": frozenset({"feed", "environment"}),
    "practice": frozenset({"practice"}),
    "data": frozenset({"feed", "environment", "practice"}),  # all that is learnt from
    # Off-policy and policy-gradient methods have no replay in common: what is held is the twin,
    # its conditions, the environment steps and the evaluation.
    "method": frozenset({"algorithm", "target", "feed"}),
}
_KINDS: dict[str, Kind] = {
    "config.seed": "free",
    "config.device": "free",
    "config.threads": "free",
    "config.record": "free",
    "config.env.overlap": "free",
    "config.profile": "free",  # a name or a file: `profile` says what it held
    "config.target": "target",
    "config.evaluation.off_policy": "free",
    "config.evaluation": "evaluation",
    "config.network": "algorithm",
    "config.loss": "algorithm",
    "config.optimizer": "algorithm",
    "config.teacher": "algorithm",
    "config.practice": "practice",
    "config.env.conditions": "practice",
    "config.env.perturbation": "environment",
    "config.env.layouts": "environment",
    "config.env.missions": "practice",
    "config.env.missions_share": "practice",
    "library.replay": "feed",
    "library.target": "target",
    "config": "feed",  # replay, schedule, env, epsilon: which rows there are and how often
    "panel.store": "store",
    "panel.store_version": "store",
    "panel.others": "store",
    "panel.labels_version": "store",
    "panel.path": "free",
    "panel": "feed",
    "task_hash": "task",
    "labels_version": "task",
    "profile": "task",
    "versions": "software",
}
_NO_SETTING = frozenset(  # or it follows from the config
    {"format", "created_ns", "target", "seeds", "update_path", "profile_toml"}
)


@dataclass(frozen=True)
class Difference:
    """A setting in which two arms (or two runs of one) differ."""

    setting: str
    kind: Kind
    first: Any
    second: Any


class Arm:
    """Runs of one method. Raises RunError where they are not, or have not learnt anything."""

    def __init__(self, name: str, paths: Sequence[Path | str]) -> None:
        if isinstance(paths, Path | str):  # a text is a sequence, too: of its letters
            what = f"{name} must be a list of runs, got {str(paths)!r}"
            raise ArgumentError(what, remedy=f"give [{str(paths)!r}]")
        self.name = name
        self.runs = [Run.open(path) for path in paths]
        for run in self.runs:
            fed = run.table("sampled_episodes")
            if not fed.num_rows or fed["condition"].null_count:
                raise RunError(
                    "has no record of the episodes it sampled by condition",
                    where=str(run.path),
                    remedy="it has made no update yet, or was written by an older Restock: train "
                    "it again",
                )
        refuse_dependent(self.runs)

    @cached_property
    def totals(self) -> dict[str, float]:
        """What a run of this arm did, in the mean: environment steps and updates."""
        for run in self.runs:
            if not run.table("progress").num_rows:
                raise RunError(
                    "is missing or has no rows, so the length of the run is not known",
                    where=str(run.path / "progress.parquet"),
                    remedy="restore the file from a copy, or train the run again",
                )
        last = [
            run.table("progress").slice(run.table("progress").num_rows - 1) for run in self.runs
        ]
        return {
            name: float(np.mean([row[name][0].as_py() for row in last]))
            for name in ("env_steps", "gradient_steps")
        }

    def fed(self) -> pa.Table:
        """Return draws by run, cell, tenth and episode."""
        import duckdb

        query = (
            files("restock.train.comparison").joinpath("fed_mix.sql").read_text(encoding="utf-8")
        )
        parts = []
        with duckdb.connect() as connection:
            for number, run in enumerate(self.runs):
                connection.register("fed", run.table("sampled_episodes"))
                table: pa.Table = connection.sql(query).to_arrow_table()
                runs = pa.array([number] * table.num_rows, pa.int64())
                parts.append(table.append_column("run", runs))
        return pa.concat_tables(parts)


def refuse_dependent(runs: Sequence[Run]) -> None:
    """Runs of one method are independent seeds of it, or their spread is too small.

    Raises:
        RunError: there is none, two are one run (or copies of it) or have one seed, or their
            settings differ.
    """
    if not runs:
        raise RunError("no run was given", remedy="give at least one of each method")
    by_seed: dict[Any, Run] = {}
    for run in runs:
        unlike = [
            difference
            for difference in differences(runs[0], run)
            if difference.kind not in ("free", "software")
        ]
        if unlike:
            raise RunError(
                f"differs from {runs[0].path} in {unlike[0].setting}"
                f" ({unlike[0].first!r} against {unlike[0].second!r}): the runs of one method "
                "may differ only in their seed",
                where=str(run.path),
                remedy="give runs of one method; `restock compare` takes those of another one "
                "after --against",
            )
        seed = run.document["config"].get("seed")
        other = by_seed.setdefault(seed, run)
        if other is run or seed is None:
            continue
        if other.path.resolve() == run.path.resolve():
            raise RunError("is given twice", where=str(run.path), remedy="leave one of them out")
        copied = same_run(other, run)
        raise RunError(
            f"is a copy of {other.path}" if copied else f"has the seed of {other.path}, {seed}",
            where=str(run.path),
            remedy="runs of one method count as independent seeds: leave one of them out"
            + ("" if copied else ", or train it again with another --set seed=N"),
        )


def same_run(first: Run, second: Run) -> bool:
    """Whether two directories hold one run: a copy has the same time of creation and settings."""
    return first.document == second.document


def feeds(first: Arm, second: Arm) -> tuple[Feed, Feed]:
    """Return what two arms were fed, over the cells of both."""
    tables = first.fed(), second.fed()
    cells = sorted({name for table in tables for name in table["cell"].unique().to_pylist()})
    a, b = (_feed(table, cells) for table in tables)
    return a, b


def _feed(table: pa.Table, cells: list[str]) -> Feed:
    run = np.asarray(table["run"], np.int64)
    names = table["episode"].to_numpy(zero_copy_only=False).astype(str)
    fresh = np.asarray(table["source"].to_numpy(zero_copy_only=False) == "fresh")
    # Every run has its own fresh episode 7; an episode of the logs is the same one in all runs.
    owner = np.where(fresh, run, -1)
    _, episode = np.unique(
        np.char.add(np.char.add(owner.astype(str), "/"), names), return_inverse=True
    )
    place = {name: index for index, name in enumerate(cells)}
    cell = np.array([place[name] for name in table["cell"].to_pylist()], np.int64)

    def column(name: str) -> F64:
        return np.asarray(table[name], np.float64)

    return Feed(
        cells,
        cell,
        np.asarray(table["tenth"], np.int64),
        episode,
        run,
        column("drawn"),
        column("weight"),
    )


def differences(first: Run, second: Run) -> list[Difference]:
    """The settings in which two runs differ, each with what kind of difference it is."""
    a, b = _settings(first), _settings(second)
    if a.get("panel.id") is None or b.get("panel.id") is None:
        # One was fed no logs at all: that is one difference of the feed, not one of the store.
        for settings in (a, b):
            has = settings.get("panel.id") is not None
            for name in [name for name in settings if name.split(".")[0] == "panel"]:
                if not (name == "panel.id" and has):
                    del settings[name]
    for settings in (a, b):  # what the natural rule does not read makes no difference
        if settings.setdefault("config.practice.rule", "natural") == "natural":
            for name in [n for n in settings if n.startswith("config.practice.")]:
                settings[name] = "natural" if name.endswith(".rule") else None
    return [
        Difference(name, kind_of(name), a.get(name), b.get(name))
        for name in dict.fromkeys([*a, *b])
        if a.get(name) != b.get(name)
    ]


def _settings(run: Run) -> dict[str, Any]:
    """Return what `config.json` says of a run, by dotted name.

    Shares of strata are left out: `panel.id` stands for them, and two of one name are not the same.
    """
    document = run.document
    settings = by_path({key: document[key] for key in document if key not in _NO_SETTING})
    shares = ("panel.strata.", "panel.forecast")
    return {name: value for name, value in settings if not name.startswith(shares)}


def kind_of(setting: str) -> Kind:
    """What kind of difference a setting makes; the longest known prefix decides."""
    parts = setting.split(".")
    for length in range(len(parts), 0, -1):
        if (kind := _KINDS.get(".".join(parts[:length]))) is not None:
            return kind
    return "algorithm"


__all__ = [
    "ALLOWED",
    "Arm",
    "Difference",
    "Treatment",
    "differences",
    "feeds",
    "kind_of",
    "refuse_dependent",
    "same_run",
]
