"""Export the rows of a store or a panel as another library's data set.

Each format has a function `write_FORMAT(selection, trajectories, out, counts)`, which returns notes
for the user. It imports the library that it needs, so that only the requested format's library must
be installed.
"""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from restock.errors import StoreError
from restock.files import building, expect_place
from restock.process import expect_installed, interrupts_raised
from restock.replay.export import FORMATS
from restock.replay.export.selection import open_selection
from restock.replay.export.trajectory import (
    STATE,
    Counts,
    Trajectory,
    count_episodes,
    trajectories,
)

WITH_IMAGES = "lerobot"
# Free disk space that an export to HDF5 needs. The HDF5 library flushes its caches when it closes a
# file, and crashes if the disk is full then. The caches are smaller than this.
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
    """Write a data set, all or nothing.

    Args:
        source: a store or a panel.
        to: one of FORMATS.
        out: a file or directory that must not exist yet.
        query, panel, continuous: see `open_selection`.
        cameras: cameras whose frames are exported, for lerobot only; None: all of the store.
        advance: called with the number of steps just written.

    Returns `format`, `path`, the counts of `Counts`, `notes`, and the provenance that is also
    written into the data set.

    Raises:
        StoreError: an unknown format, something at `out`, no rows, or a disk too full for HDF5.
        ConfigError: a library is not installed.
        PanelError, QueryError: see `open_selection`.
    """
    module, needs, ending = FORMATS.get(to, ("", "", ""))
    if not module:
        raise StoreError(f"no format {to!r}", remedy=f"one of {', '.join(FORMATS)}")
    if needs:
        expect_installed(f"the format {to}", needs)
    if to != WITH_IMAGES:
        if cameras:
            raise StoreError(
                f"the format {to} holds no images",
                remedy=f"leave --cameras out, or export to {WITH_IMAGES}",
            )
        cameras = ()
    out = Path(out)
    if ending and out.suffix != ending:
        raise StoreError(f"the format {to} is a file that ends in {ending}", where=str(out))
    if out.exists():
        raise StoreError("already there", where=str(out), remedy="choose another name")
    expect_place(out, StoreError)
    counts = Counts()
    write = getattr(importlib.import_module(f"restock.replay.export.{module}"), f"write_{to}")
    with open_selection(
        source,
        query=query,
        panel=panel,
        continuous=continuous,
        cameras=cameras,
    ) as selection:
        if selection.by_name and to != WITH_IMAGES:
            raise StoreError(
                f"the format {to} holds the task's observation, and no {STATE}",
                remedy=f"leave it out of the query, or export to {WITH_IMAGES}",
            )
        counts.rows += sum(selection.left_out.values())
        counts.left_out.update(selection.left_out)
        found = trajectories(
            selection.batches, continuous=continuous, counts=counts, where=selection.where
        )
        episodes = _report_progress(count_episodes(found, counts), advance)
        if (first := next(episodes, None)) is None:
            raise StoreError("the rows contain no whole transition", where=selection.where)
        if first.observations.shape[1] != selection.observation_size:
            raise StoreError(
                f"observations have {first.observations.shape[1]} entries, those of its task"
                f" {selection.observation_size}",
                where=selection.where,
                remedy="export the observations as they are stored",
            )
        several: Iterator[Trajectory] = chain([first], episodes)
        if needs and to != WITH_IMAGES:
            several = _check_disk_space(several, out)
        with building(out) as folder:
            partial = folder / out.name
            notes = write(selection, several, partial, counts)
            partial.rename(out)
    return {
        "format": to,
        "path": str(out),
        **counts.describe(),
        "notes": notes,
        "provenance": selection.provenance,
    }


def _report_progress(
    episodes: Iterator[Trajectory], advance: Callable[[int], None]
) -> Iterator[Trajectory]:
    for trajectory in episodes:
        yield trajectory
        advance(len(trajectory))


def _check_disk_space(episodes: Iterator[Trajectory], out: Path) -> Iterator[Trajectory]:
    """Yield the trajectories, and raise StoreError before the disk is full."""
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
