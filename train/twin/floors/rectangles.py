"""Blocked cells as few rectangles: the racks of a floor that was known only as cells.

Rectangles may overlap, and only cells that border free ones need to be covered: what lies behind
them no robot meets and no lidar sees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Cells = NDArray[np.bool_]
Box = tuple[int, int, int, int]  # first and last (exclusive) column, first and last row


def cover(blocked: Cells, limit: int) -> list[Box] | None:
    """Rectangles of blocked cells (X, Y) over all that border free ones; None: over `limit`.

    Each grows from a cell not yet covered, along one axis first and then along the other, in
    whichever order covers more.
    """
    seen = ndimage.binary_dilation(~blocked, np.ones((3, 3), np.bool_)) & blocked
    total = np.zeros((blocked.shape[0] + 1, blocked.shape[1] + 1), np.int64)
    total[1:, 1:] = blocked.cumsum(axis=0).cumsum(axis=1)
    left = seen.copy()
    boxes: list[Box] = []
    for i, j in np.argwhere(seen):
        if not left[i, j]:
            continue
        if len(boxes) == limit:
            return None
        grown = [_grow(total, int(i), int(j), order) for order in ((0, 1), (1, 0))]
        best = max(grown, key=lambda b: int(left[b[0] : b[1], b[2] : b[3]].sum()))
        left[best[0] : best[1], best[2] : best[3]] = False
        boxes.append(best)
    return boxes


def _grow(total: NDArray[np.int64], i: int, j: int, order: tuple[int, int]) -> Box:
    """The rectangle of blocked cells around one, grown along the axes in this order."""
    box = [i, i + 1, j, j + 1]
    for axis in order:
        for side, step in ((2 * axis, -1), (2 * axis + 1, 1)):
            end = total.shape[axis] - 1
            # How far: doubling strides, then halving ones, each tried whole.
            stride = 1
            while stride:
                longer = box.copy()
                longer[side] += step * stride
                if 0 <= longer[side] <= end and _full(total, longer):
                    box = longer
                    stride *= 2
                else:
                    stride //= 2
    return box[0], box[1], box[2], box[3]


def _full(total: NDArray[np.int64], box: list[int]) -> bool:
    """Whether every cell of a rectangle is blocked."""
    a, b, c, d = box
    count = total[b, d] - total[a, d] - total[b, c] + total[a, c]
    return bool(count == (b - a) * (d - c))
