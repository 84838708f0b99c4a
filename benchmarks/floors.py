"""Show what the floors of recordings are made from, and whether missions arrive on them.

    python benchmarks/floors.py RECORDING... [--missions N] [--json] [--check]

Each recording's floor is made by `survey`, as `restock twin layout --from` does. On it, N nominal
episodes of the seeds from 0 are driven by `PlannerFollower` without exploration: the stand-in's
drive under a body of the recording's robot. Where the recording has a map and scans, a map is also
made of the scans, and their occupied cells compared within one cell. `--check` exits 1 where fewer
than half of all missions arrive.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from harness import finish, markdown, option_parser
from scipy import ndimage
from scipy.spatial import cKDTree

from restock.errors import RestockError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Body
from restock.train.twin.floors.occupancy_grid import (
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    out_of_frame,
)
from restock.train.twin.survey.evidence import recorded_map
from restock.train.twin.survey.survey import Surveyed, survey
from restock.twin import EpisodeSpec, PlannerFollower, WarehouseVectorEnv

MIN_ARRIVING = 0.5


def walls_agreement(made: OccupancyGrid, known: OccupancyGrid) -> float | None:
    """Return the intersection over union of two maps' occupied cells, within one cell.

    A cell counts as shared where the other map has an occupied cell within one cell (of the coarser
    of both, diagonals too). Of `known` only what lies where `made` knows something, or next to it,
    counts. None where one of them has no walls there.
    """
    near_m = 1.5 * max(made.cell_m, known.cell_m)
    mine, theirs = _walls(made), _walls(known)
    seen = ndimage.binary_dilation(made.occupancy != UNKNOWN, np.ones((3, 3), np.bool_))
    cells, inside = made.cells_at(theirs)
    inside[inside] = seen[tuple(cells[inside].T)]
    theirs = theirs[inside]
    if not len(mine) or not len(theirs):
        return None
    # Cells may differ in size, and walls are lines: each counts by its length.
    a, b = made.cell_m, known.cell_m
    shared_mine = float((cKDTree(theirs).query(mine)[0] <= near_m).sum()) * a
    shared_theirs = float((cKDTree(mine).query(theirs)[0] <= near_m).sum()) * b
    shared = (shared_mine + shared_theirs) / 2
    alone = len(mine) * a - shared_mine + len(theirs) * b - shared_theirs
    return shared / (shared + alone)


def _walls(grid: OccupancyGrid) -> np.ndarray:
    """Return the centres (N, 2) of the occupied cells, in the map's frame."""
    cells = np.argwhere(grid.occupancy == OCCUPIED)
    return out_of_frame((cells + 0.5) * grid.cell_m, grid.origin)


def drive(made: Surveyed, missions: int) -> Counter[str]:
    """Return how the missions end: success, bump, or time limit."""
    size = made.footprint
    body = Body(length_m=size.length_m, width_m=size.width_m)
    task = msgspec.structs.replace(load_profile("warehouse_amr").task, body=body)
    env = WarehouseVectorEnv(missions, layouts=[made.floor], task=task, conditions={"nominal": 1.0})
    env.set_episodes([EpisodeSpec("nominal", seed) for seed in range(missions)])
    observation, _ = env.reset()
    driver, done, ends = PlannerFollower(epsilon=0.0), np.zeros(missions, np.bool_), Counter[str]()
    while not done.all():
        action, _ = driver.act(env, observation)
        observation, _, terminated, truncated, info = env.step(action)
        for index in np.flatnonzero((terminated | truncated) & ~done).tolist():
            bumped = "bump" if info["bumps"][index] else "time limit"
            ends["success" if info["success"][index] else bumped] += 1
        done |= terminated | truncated
    return ends


def measure(path: Path, missions: int) -> dict[str, Any]:
    """Measure the floor of one recording, as plain values."""
    try:
        made = survey(path)
        ends = drive(made, missions)
    except RestockError as error:
        return {"recording": path.stem, "made from": f"refused: {error.what}"}
    agreement = None
    if made.by == "map":
        try:
            with open_recording(path) as recording:
                known = recorded_map(recording)
            if known is not None:
                agreement = walls_agreement(survey(path, by="scans").grid, known[0])
        except RestockError:
            pass  # no scans, or none that can be placed
    low, high = made.floor.way_m
    return {
        "recording": path.stem,
        "made from": made.by,
        "boxes": len(made.floor.racks),
        "walls, IoU": "" if agreement is None else round(agreement, 3),
        "missions": f"{low:g} to {high:g} m",
        "at the goal": ends["success"],
        "bump": ends["bump"],
        "time limit": ends["time limit"],
    }


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--missions", type=int, default=20)
    options = parser.parse_args()
    rows = [measure(path, options.missions) for path in options.recordings]
    driven = [row for row in rows if "at the goal" in row]
    arriving = sum(row["at the goal"] for row in driven) / max(len(driven) * options.missions, 1)
    missed = [] if arriving >= MIN_ARRIVING else [f"{arriving:.0%} of the missions arrive"]
    header = list(driven[0] if driven else rows[0])
    table = markdown(header, ([row.get(key, "") for key in header] for row in rows))
    return finish(options, {"floors": rows, "arriving": arriving}, missed, [table])


if __name__ == "__main__":
    sys.exit(main())
