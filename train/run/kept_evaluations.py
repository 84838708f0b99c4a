"""Episodes that `restock eval` drove, collected in `RUN/eval/episodes.parquet`.

An episode is identified by its policy, floor, perturbation and seed. If it is driven again, it
replaces the earlier one; all others are kept. Pages show the newest floors, the newest version of
the run's own policy, and the newest limits of a limited one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from restock.errors import RunError
from restock.files import read_table, write_table
from restock.train.run.run_tables import EVAL_CLONES, EVAL_EPISODES
from restock.words import counted, quoted

Mission = tuple[str | None, str, int, str]
FILE = Path("eval") / "episodes.parquet"  # in a run
WAYS = ", ways of the logs"  # after the floors: missions from logged episodes
LIMITED = "limited:"  # a policy with the limiter in front of it
_NAME = ("policy", "version", "layouts", "perturbation", "perturbation_values", "condition")


def read_evaluations(run: Path) -> pa.Table:
    """Read all episodes that a run's evaluations drove; no rows if there are none.

    Raises:
        RunError: the file is damaged.
    """
    file = run / FILE
    if not file.is_file():
        return EVAL_EPISODES.empty_table()
    return read_table(
        file,
        EVAL_EPISODES,
        error=RunError,
        remedy=f"remove it, then `restock eval {quoted(run)}` again",
    )


def add_evaluation(run: Path, driven: pa.Table) -> pa.Table:
    """Put an evaluation beside the earlier ones; episodes that were driven again are replaced.

    Time lost is against the planner as it last drove the mission, of all that was ever driven.
    Returns what was added, with it.
    """
    earlier, new = read_evaluations(run), set(_names(driven))
    kept = [name not in new for name in _names(earlier)]
    whole = pa.concat_tables([earlier.filter(pa.array(kept, pa.bool_())), driven])
    rows = whole.to_pylist()
    planner_s = planner_times(rows)
    lost = [
        row["time_s"] - planner_s[mission_of(row)]
        if row["success"] and mission_of(row) in planner_s
        else None
        for row in rows
    ]
    place = whole.schema.get_field_index("time_lost_s")
    column = pa.array(lost, pa.float64())
    whole = whole.set_column(place, whole.schema.field(place), column)
    write_table(whole, run / FILE)
    return whole.slice(whole.num_rows - driven.num_rows)


def planner_times(rows: Iterable[Mapping[str, Any]]) -> dict[Mission, float]:
    """Return how long the planner took on each mission in which it arrived."""
    return {
        mission_of(row): row["time_s"]
        for row in rows
        if row["policy"] == "planner" and row["success"]
    }


def mission_of(row: Mapping[str, Any]) -> Mission:
    """Return what identifies a mission: floors, condition, seed, and parameters in force."""
    values = str(sorted(row["perturbation_values"] or ()))
    return row["layouts"], row["condition"], row["episode_seed"], values


def shown_evaluation(run: Path, *, ways: bool = False) -> tuple[pa.Table, str]:
    """Return the episodes to show and compare, and a text that says which of how many they are.

    With `ways` only those on the ways of logs are looked at; without, the others, if there are any.

    Raises:
        RunError: the file is damaged.
    """
    table = read_evaluations(run)
    every = table.num_rows
    requested = pa.array(
        [str(on).endswith(WAYS) == ways for on in table["layouts"].to_pylist()], pa.bool_()
    )
    some = table.filter(requested)
    if some.num_rows or ways:
        table = some
    if not table.num_rows:
        return table, ""
    last = table.slice(table.num_rows - 1).to_pylist()[0]
    policies, versions, layouts = (
        table[name].to_pylist() for name in ("policy", "version", "layouts")
    )
    newest = dict(zip(policies, versions, strict=True))
    version = newest.get("agent")
    mask = [
        on == last["layouts"] and (not _changes(policy) or of == newest[policy])
        for policy, of, on in zip(policies, versions, layouts, strict=True)
    ]
    shown = table.filter(pa.array(mask, pa.bool_()))
    seeds = shown["episode_seed"]
    text = f"{shown.num_rows:,} of {every:,} episodes that `restock eval` drove: "
    text += f"floors {_floors(last['layouts'] or 'not named')}, policy {version or 'not named'}"
    if (step := trained_step(shown)) is not None:
        text += f" of step {step:,}"
    return shown, text + f", seeds {pc.min(seeds).as_py()} to {pc.max(seeds).as_py()}."


def trained_step(shown: pa.Table) -> int | None:
    """After how many environment steps of training the run's own policy was taken."""
    own = shown.filter(pc.equal(shown["policy"], "agent"))
    step: int | None = own["trained_env_steps"][-1].as_py() if own.num_rows else None
    return step


def _floors(layouts: str) -> str:
    """Floors as a run names them, in few words: files by name, of many the first and last."""
    ways = WAYS if layouts.endswith(WAYS) else ""
    names = [part.rpartition("/")[2].strip() for part in layouts.removesuffix(ways).split(",")]
    some = names if len(names) <= 3 else [f"{names[0]} to {names[-1]} ({len(names)})"]
    return ", ".join(some) + ways


def _changes(policy: str) -> bool:
    """Tell whether a policy of this name changes with the run, or with the limiter's settings."""
    return policy == "agent" or policy.startswith(LIMITED)


def _names(table: pa.Table) -> list[tuple[str, ...]]:
    columns = [list(map(str, table[name].to_pylist())) for name in _NAME]
    return list(zip(*columns, map(str, table["episode_seed"].to_pylist()), strict=True))


CLONES = Path("eval") / "clones.parquet"  # in a run


@dataclass(frozen=True)
class CloneQuality:
    """How good a clone is: a row of `RUN/eval/clones.parquet`, whose columns say what each is."""

    policy: str
    drivers: list[str]
    rows: int
    episodes: int
    updates: int
    training_log_likelihood: float
    held_out_rows: int
    log_likelihood: float | None
    frequencies_log_likelihood: float | None
    agreement: float | None
    repeating: float | None
    changed_agreement: float | None
    note: str | None

    @property
    def poor(self) -> str | None:
        """Why it is no good stand-in for the drivers; None where nothing says so."""
        if self.log_likelihood is None or self.agreement is None:
            return "the quality of the clone is not known: no row of its drivers is held out"
        if self.log_likelihood <= (self.frequencies_log_likelihood or 0.0):
            return (
                "a poor clone: held-out actions are not more likely under it than under the "
                "frequency of each action"
            )
        if self.agreement <= (self.repeating or 0.0):
            return "a poor clone: repeating the last action agrees as often with held-out rows"
        return None

    @property
    def text(self) -> str:
        """The warning to the reader, in a sentence or two."""
        said = (
            f"{self.policy} is behaviour cloning of {', '.join(self.drivers) or 'unnamed drivers'}"
            f" ({counted(self.rows, 'row')} of"
            f" {counted(self.episodes, 'episode')})"
        )
        if self.agreement is not None:
            said += (
                f"; in {self.held_out_rows:,} held-out rows it finds the drivers' action likeliest"
                f" in {self.agreement:.0%} (repeating the last one: {self.repeating:.0%}"
            )
            if self.changed_agreement is not None:
                said += f"; where they changed it: {self.changed_agreement:.0%}"
            said += ")"
        return ". ".join(part for part in (said, self.poor, self.note) if part)


def read_clones(run: Path) -> list[CloneQuality]:
    """Read the clones' qualities, one per policy; raise RunError if the file is damaged."""
    if not (run / CLONES).is_file():
        return []
    table = read_table(run / CLONES, EVAL_CLONES, error=RunError, remedy="remove it")
    return [CloneQuality(**row) for row in table.to_pylist()]


def keep_clone(run: Path, quality: CloneQuality) -> None:
    """Put one beside the others; one of its name is replaced."""
    others = [row for row in read_clones(run) if row.policy != quality.policy]
    rows = [asdict(row) for row in (*others, quality)]
    write_table(pa.Table.from_pylist(rows, schema=EVAL_CLONES), run / CLONES)


__all__ = [
    "CloneQuality",
    "FILE",
    "LIMITED",
    "Mission",
    "WAYS",
    "add_evaluation",
    "keep_clone",
    "mission_of",
    "planner_times",
    "read_clones",
    "read_evaluations",
    "shown_evaluation",
    "trained_step",
]
