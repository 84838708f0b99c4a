"""An occupancy grid from scans by ray tracing: each scan makes the cells that its beams pass less
likely occupied, and those they end in more (log-odds, Elfes 1989).

A cell counts once a scan. Poses are taken as they are: nothing is matched, loops are not closed.
How well scans agree with each other is measured and said: the share of beams that end within one
cell of a wall of the map that all of them made.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from restock.arrays import F64, Bools, Ints
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    into_frame,
    out_of_frame,
)
from restock.train.twin.survey.directions import main_direction
from restock.train.twin.survey.driven_corridor import way_between
from restock.train.twin.survey.scans import PlacedScans

CELL_M = 0.05
REACH_M = 8.0  # of a beam: what is further is less well known than a cell
HIT, MISS = 0.9, -0.5  # log-odds
MOST = 4.0  # of the log-odds either way
FREE_BELOW, OCCUPIED_ABOVE = -0.9, 0.6
_APART = 4  # beams, of two whose ends show which way a wall runs: neighbours' are mostly noise
_WALL_STEP_M = 0.6  # between their ends, on one wall


def scan_map(
    scans: PlacedScans, driven_m: F64, room_m: float, frame: str, notes: list[str]
) -> tuple[OccupancyGrid, float]:
    """The map that scans show, its axes along the walls, and how well they agree on it (a share).

    `driven_m` (N, 2) are the robot's places, which are free, `room_m` is how far around them.
    """
    yaw = main_direction(*_walls(scans))
    turned = (0.0, 0.0, yaw)
    origins = into_frame(scans.origin_m, turned)
    hits = [into_frame(hit, turned) for hit in scans.hit_m]
    driven = into_frame(way_between(driven_m), turned)
    ends = [_cut(origin, hit)[0] for origin, hit in zip(origins, hits, strict=True)]
    every = np.concatenate([origins, driven, *ends])
    low = every.min(axis=0) - 3 * CELL_M
    shape = tuple(np.ceil((every.max(axis=0) - low) / CELL_M).astype(int) + 3)
    odds, ended = _traced(origins, hits, low, shape)
    occupancy = np.full(shape, UNKNOWN, np.int8)
    occupancy[odds <= FREE_BELOW] = FREE
    walls = odds >= OCCUPIED_ABOVE
    walls &= ~_speckles(walls, occupancy, notes)
    occupancy[walls] = OCCUPIED
    way = np.zeros(shape, np.bool_)
    way[tuple(_cells(driven, low).T)] = True
    occupancy[ndimage.distance_transform_edt(~way) * CELL_M <= room_m + CELL_M] = FREE
    wide = ndimage.binary_dilation(occupancy == OCCUPIED, np.ones((3, 3), np.bool_))
    share = float(ended[wide].sum() / max(ended.sum(), 1))
    corner = out_of_frame(low[None], turned)[0]
    origin = (float(corner[0]), float(corner[1]), yaw)
    return OccupancyGrid(occupancy, CELL_M, origin, frame), share


def _walls(scans: PlacedScans) -> tuple[F64, F64]:
    """Directions and lengths of the pieces of wall between the ends of beams."""
    steps = []
    for hit, beam in zip(scans.hit_m, scans.order, strict=True):
        if len(hit) > _APART:
            beams = beam[_APART:] - beam[:-_APART]
            steps.append((hit[_APART:] - hit[:-_APART])[beams == beams.min()])
    step = np.concatenate([np.zeros((0, 2)), *steps])
    length = np.hypot(*step.T)
    on_wall = (length > 0) & (length < _WALL_STEP_M)
    return np.arctan2(step[on_wall, 1], step[on_wall, 0]), length[on_wall]


def _cut(origin: F64, hit: F64) -> tuple[F64, F64, Bools]:
    """The ends of beams (B, 2) within REACH_M, their lengths (B,), and which are hits (B,)."""
    along = hit - origin
    length = np.hypot(*along.T)
    share = np.minimum(1.0, REACH_M / np.maximum(length, 1e-9))
    return origin + along * share[:, None], length * share, np.asarray(length <= REACH_M)


def _cells(places: F64, low: F64) -> Ints:
    return np.floor((places - low) / CELL_M).astype(np.int64)


def _traced(origins: F64, hits: list[F64], low: F64, shape: tuple[int, ...]) -> tuple[F64, Ints]:
    """Log-odds (X, Y) of being occupied, and how many scans ended in each cell (X, Y)."""
    odds = np.zeros(shape)
    flat, ended = odds.reshape(-1), np.zeros(odds.size, np.int64)
    passed, stopped = np.zeros((2, odds.size), np.bool_)  # of one scan
    for origin, hit in zip(origins, hits, strict=True):
        if not len(hit):
            continue
        ends, length, stops = _cut(origin, hit)
        at = np.arange(0.0, float(length.max()), 0.7 * CELL_M)
        beam, step = np.nonzero(at[None, :] < length[:, None] - CELL_M / 2)
        way = origin + (ends - origin)[beam] * (at[step] / length[beam])[:, None]
        stopped[np.ravel_multi_index(tuple(_cells(ends[stops], low).T), shape)] = True
        passed[np.ravel_multi_index(tuple(_cells(way, low).T), shape)] = True
        stop = np.flatnonzero(stopped)
        passed[stop] = False
        pass_ = np.flatnonzero(passed)
        flat[pass_] = np.maximum(flat[pass_] + MISS, -MOST)
        flat[stop] = np.minimum(flat[stop] + HIT, MOST)
        ended[stop] += 1
        stopped[stop] = passed[pass_] = False
    return odds, ended.reshape(shape)


def _speckles(walls: Bools, occupancy: np.ndarray, notes: list[str]) -> Bools:
    """Single cells of wall within free floor: a person's legs, or one beam gone wrong. Free."""
    neighbours = ndimage.convolve(walls.astype(np.int8), np.ones((3, 3), np.int8), mode="constant")
    alone = walls & (neighbours == 1)
    surrounded = ndimage.convolve(
        (occupancy == FREE).astype(np.int8), np.ones((3, 3), np.int8), mode="constant"
    )
    alone &= surrounded >= 7
    if alone.any():
        occupancy[alone] = FREE
        notes.append(f"{int(alone.sum()):,} single cells of wall on free floor: left out")
    return np.asarray(alone, np.bool_)
