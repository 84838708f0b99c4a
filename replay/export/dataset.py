"""The rows of a store or a panel as another library's data set.

Each format is a function `write_FORMAT(selection, trajectories, out, counts)`, which returns notes
for the user; what it needs from elsewhere is imported there, so that only the format asked for must
be installed. A data set that is a directory has a card (`README.md`), with the metadata that a hub
of data sets asks for. The card gives counts: the contents, who drove and in which conditions, what
was left out, and how good the labels are. Paths of this machine are only in the provenance.
"""

from __future__ import annotations

import importlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from restock.errors import StoreError
from restock.files import building, expect_place
from restock.process import expect_installed, interrupts_raised
from restock.replay.export import FORMATS
from restock.replay.export.selection import Selection, open_selection
from restock.replay.export.trajectory import (
    STATE,
    Counts,
    Trajectory,
    count_episodes,
    trajectories,
)
from restock.replay.panel.panel import HEADER

WITH_IMAGES = ("lerobot", "lerobot-video")
READ = {
    **dict.fromkeys(WITH_IMAGES, 'LeRobotDataset("restock/logs", root=FOLDER)'),
    "minari": "minari.MinariDataset(FOLDER)",
}
_HUB_TAG = {**dict.fromkeys(WITH_IMAGES, "LeRobot"), "minari": "minari"}
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


class Contents:
    """Counts what is written, as it goes by."""

    def __init__(self) -> None:
        self.conditions, self.policies = Counter[str](), Counter[str]()

    def counted(self, trajectories: Iterator[Trajectory]) -> Iterator[Trajectory]:
        for trajectory in trajectories:
            for name, counts in (
                ("condition", self.conditions),
                ("behaviour_policy", self.policies),
            ):
                if (column := trajectory.carried.get(name)) is not None:
                    counts.update(str(value) for value in column if value is not None)
            yield trajectory


def card(selection: Selection, counts: Counts, contents: Contents, to: str) -> str:
    """Return the text of the card; it says that no licence was given."""
    reported, task = counts.describe(), selection.task
    size = next((name for most, name in _SIZES if reported["transitions"] < most), "1M<n<10M")
    observed = selection.provenance["observation_names"]
    front = [
        "task_categories: [robotics, reinforcement-learning]",
        f"tags: [{_HUB_TAG[to]}, robotics, offline-rl, mobile-robots, restock]",
        f"size_categories: [{size}]",
    ]
    if to in WITH_IMAGES:
        front += ["configs:", "  - config_name: default", "    data_files: data/*/*.parquet"]
    action = (
        "the logged command, m/s ahead and rad/s to the left"
        if selection.continuous
        else f"one of {len(task.actions)}: " + ", ".join(task.action_names)
    )
    made = {
        "store version": selection.provenance.get("store_version"),
        "query": selection.provenance.get("query"),
        "panel": selection.provenance.get("panel"),
        "task": task.hash,
    }
    lines = [
        *("---", *front, "---", "", "# A mobile robot's transitions", ""),
        f"{reported['transitions']:,} transitions of {task.control_period_s:g} s in"
        f" {reported['trajectories']:,} trajectories, made from recordings by Restock:"
        f" {reported['terminated']:,} terminated, {reported['truncated']:,} truncated,"
        f" {reported['cut']:,} cut if rows were left out.",
        "",
        f"Read it with `{READ[to]}`.",
        "",
        *("## Contents", ""),
        f"- Action: {action}.",
        f"- Observation: {len(observed)} numbers, by name: "
        + ", ".join(f"`{name}`" for name in observed)
        + ".",
        "- Reward: the task's, recomputed from the logged signals.",
        *(
            f"- `observation.images.{camera}`: at each step the last frame of the camera"
            f" `{camera}`, as far as it can be as recorded."
            for camera in selection.cameras
        ),
        *_table("condition", contents.conditions),
        *_table("behaviour policy", contents.policies),
        *("## How it was made", ""),
        *(f"- {name}: `{value}`" for name, value in made.items() if value is not None),
        *(f"- left out: {count:,}, {why}" for why, count in reported["left_out"].items()),
        "",
        *("## Before it is used", ""),
        "- Conditions are labels by rules over the signals, not the truth.",
        "- It is what somebody logged: a condition may be more or less frequent here than in the "
        "field.",
        "- A trajectory that was cut did not end there: bootstrap.",
        "",
        "No licence was given: without one, nobody else may use it. Write `license:` above.",
    ]
    return "\n".join(lines) + "\n"


def _table(name: str, counts: Counter[str]) -> list[str]:
    if not counts:
        return []
    whole = sum(counts.values())
    rows = [f"| {key} | {count:,} | {count / whole:.1%} |" for key, count in counts.most_common()]
    return ["", f"| {name} | transitions | share |", "| --- | ---: | ---: |", *rows, ""]


# The HDF5 library crashes where it cannot write what it holds back when a file is closed. That is
# less than this: its caches of metadata, and of chunks.
ROOM_BYTES = 64 << 20


@interrupts_raised
def export_dataset(
    source: str | Path,
    to: str,
    out: str | Path,
    *,
    query: str | None = None,
    panel: str | Path | None = None,
    continuous: bool = False,
    cameras: Sequence[str] | None = None,
    advance: Callable[[int], None] = lambda steps: None,
) -> dict[str, Any]:
    """Write a data set; all or nothing.

    Args:
        source: a store or a panel. to: one of FORMATS. out: a file or directory that must not exist
        yet. query, panel, continuous: see `open_selection`. cameras: whose frames go with the
        steps, of a store to lerobot; None: all that it has. advance: called with the number of
        steps written so far.

    Returns what was written: the counts of `Counts`, `notes`, and the provenance that the data
    set carries.

    Raises:
        StoreError: an unknown format, something at `out`, no rows, a disk too full for HDF5.
        ConfigError: a library that is not installed.
        PanelError, QueryError: see `open_selection`.
    """
    module, needs, ending = FORMATS.get(to, ("", "", ""))
    if not module:
        raise StoreError(f"no format {to!r}", remedy=f"one of {', '.join(FORMATS)}")
    if needs:
        expect_installed(f"the format {to}", needs)
    if cameras and to not in WITH_IMAGES:
        raise StoreError(
            f"the format {to} holds no images",
            remedy=f"leave --cameras out, or export to {', '.join(WITH_IMAGES)}",
        )
    panelled = (Path(source) / HEADER).is_file()
    if to not in WITH_IMAGES or (cameras is None and panelled):
        cameras = ()
    out = Path(out)
    if ending and out.suffix != ending:
        raise StoreError(f"the format {to} is a file that ends in {ending}", where=str(out))
    if out.exists():
        raise StoreError("already there", where=str(out), remedy="choose another name")
    expect_place(out, StoreError)
    counts = Counts()
    write = getattr(
        importlib.import_module(f"restock.replay.export.{module}"), f"write_{to.replace('-', '_')}"
    )
    with open_selection(
        source,
        query=query,
        panel=panel,
        continuous=continuous,
        cameras=cameras,
    ) as selection:
        if selection.by_name and to not in WITH_IMAGES:
            raise StoreError(
                f"the format {to} holds the task's observation, and no {STATE}",
                remedy=f"leave it out of the query, or export to {', '.join(WITH_IMAGES)}",
            )
        counts.rows += sum(selection.left_out.values())
        counts.left_out.update(selection.left_out)
        contents = Contents()
        found = trajectories(
            selection.batches, continuous=continuous, counts=counts, where=selection.where
        )
        episodes = _advancing(contents.counted(count_episodes(found, counts)), advance)
        if (first := next(episodes, None)) is None:
            raise StoreError("no whole transition is left of the rows", where=selection.where)
        if first.observations.shape[1] != selection.observation_size:
            raise StoreError(
                f"observations have {first.observations.shape[1]} entries, those of its task"
                f" {selection.observation_size}",
                where=selection.where,
                remedy="export the observations as they are stored",
            )
        several: Iterator[Trajectory] = chain([first], episodes)
        if needs and to not in WITH_IMAGES:
            several = _while_there_is_room(several, out)
        with building(out) as folder:
            partial = folder / out.name
            notes = write(selection, several, partial, counts)
            if not ending:
                text = card(selection, counts, contents, to)
                (partial / "README.md").write_text(text, encoding="utf-8")
            partial.rename(out)
    return {
        "format": to,
        "path": str(out),
        **counts.describe(),
        "notes": notes,
        "provenance": selection.provenance,
    }


def _advancing(
    episodes: Iterator[Trajectory], advance: Callable[[int], None]
) -> Iterator[Trajectory]:
    for trajectory in episodes:
        yield trajectory
        advance(len(trajectory))


def _while_there_is_room(episodes: Iterator[Trajectory], out: Path) -> Iterator[Trajectory]:
    """Raise StoreError before the disk is full."""
    for trajectory in episodes:
        free = shutil.disk_usage(out.parent).free
        if free < ROOM_BYTES + 2 * trajectory.observations.nbytes:
            raise StoreError(
                f"its disk is nearly full: {free / 2**20:,.0f} MiB are free, and HDF5 needs"
                f" {ROOM_BYTES >> 20} MiB to spare",
                where=str(out),
                remedy="free some space, choose another place, or export to parquet",
            )
        yield trajectory
