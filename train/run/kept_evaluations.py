"""What `restock eval` drove, kept by its settings in `RUN/eval/episodes.parquet`: it adds up.

An episode is named by who drove it, where, under what and from which seed. One that is driven again
replaces itself; any other stands beside those that were there. What is shown of them is the newest
floors, and of the run's own policy its newest version.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from restock.errors import RunError
from restock.files import read_table, write_table
from restock.train.run.run_tables import EVAL_EPISODES

FILE = Path("eval") / "episodes.parquet"  # in a run
_NAME = ("policy", "version", "layouts", "perturbation", "perturbation_values", "condition")


def read_evaluations(run: Path) -> pa.Table:
    """All that was driven of a run; no rows where nothing was.

    Raises:
        RunError: the file is damaged.
    """
    file = run / FILE
    if not file.is_file():
        return EVAL_EPISODES.empty_table()
    return read_table(
        file, EVAL_EPISODES, error=RunError, remedy=f"remove it, then `restock eval {run}` again"
    )


def add_evaluation(run: Path, driven: pa.Table) -> None:
    """Put an evaluation beside the earlier ones; episodes that were driven again are replaced."""
    earlier, new = read_evaluations(run), set(_names(driven))
    kept = [name not in new for name in _names(earlier)]
    write_table(pa.concat_tables([earlier.filter(pa.array(kept, pa.bool_())), driven]), run / FILE)


def shown_evaluation(run: Path) -> tuple[pa.Table, str]:
    """The episodes to show and to compare, and in words which they are of how many.

    Raises:
        RunError: the file is damaged.
    """
    table = read_evaluations(run)
    if not table.num_rows:
        return table, ""
    last = table.slice(table.num_rows - 1).to_pylist()[0]
    agents = table.filter(pc.equal(table["policy"], "agent"))
    version = agents["version"][-1].as_py() if agents.num_rows else None
    mask = [
        layouts == last["layouts"] and (policy != "agent" or of == version)
        for policy, of, layouts in zip(
            *(table[name].to_pylist() for name in ("policy", "version", "layouts")), strict=True
        )
    ]
    shown = table.filter(pa.array(mask, pa.bool_()))
    seeds = shown["episode_seed"]
    text = f"{shown.num_rows:,} of {table.num_rows:,} episodes that `restock eval` drove: "
    text += f"floors {last['layouts'] or 'not named'}, policy {version or 'not named'}, "
    return shown, text + f"seeds {pc.min(seeds).as_py()} to {pc.max(seeds).as_py()}."


def _names(table: pa.Table) -> list[tuple[str, ...]]:
    columns = [list(map(str, table[name].to_pylist())) for name in _NAME]
    return list(zip(*columns, map(str, table["episode_seed"].to_pylist()), strict=True))


__all__ = ["FILE", "add_evaluation", "read_evaluations", "shown_evaluation"]
