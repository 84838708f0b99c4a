"""The warehouse from above, as SVG: where the logs have been, and where the agent failed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from restock.report.look.blocks import Drawing, words

Row = Mapping[str, Any]
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres
SCALE = 40  # SVG units a metre
BAR_M = 2  # the length of the bar below a map
MAP_PX = 470


@dataclass(frozen=True)
class FloorMap:
    """The extent of the map and what stands on it, in metres in the map frame."""

    width_m: float
    depth_m: float
    racks: Sequence[Box]

    def box(self, box: Box, style: str) -> str:
        x0, y0, x1, y1 = box
        return (
            f'<rect x="{x0 * SCALE:.1f}" y="{(self.depth_m - y1) * SCALE:.1f}"'
            f' width="{(x1 - x0) * SCALE:.1f}" height="{(y1 - y0) * SCALE:.1f}" {style}/>'
        )

    def at(self, x_m: float, y_m: float) -> tuple[float, float]:
        return x_m * SCALE, (self.depth_m - y_m) * SCALE

    def draw(self, marks: Sequence[str], label: str, above: Sequence[str] = ()) -> Drawing:
        """Draw the floor with marks above the ground and above the racks.

        It has no text, so that it may be of any width: the bar below it is `BAR_M` long.
        """
        height = self.depth_m * SCALE
        bar = (
            f'<path d="M2 {height + 10:.0f} v10 m0 -5 h{SCALE * BAR_M} m0 -5 v10" fill="none"'
            ' stroke="#475569" stroke-width="2.5"/>'
        )
        size = f'width="{self.width_m * SCALE:.0f}" height="{self.depth_m * SCALE:.0f}"'
        racks = [self.box(rack, 'fill="#cbd5e1" stroke="#94a3b8"') for rack in self.racks]
        frame = f'<rect {size} fill="none" stroke="#94a3b8" stroke-width="3"/>'
        ground = f'<rect {size} fill="#f8fafc"/>'
        body = "".join([ground, *marks, *racks, frame, *above, bar])
        box = self.width_m * SCALE + 4, height + 26
        svg = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{MAP_PX}"'
            f' height="{MAP_PX * box[1] / box[0]:.0f}" viewBox="-2 -2 {box[0]:.0f} {box[1]:.0f}"'
            f' role="img" aria-label="{escape(label)}">{body}</svg>'
        )
        return Drawing({MAP_PX: svg})


def visited(floor: FloorMap, cells: Sequence[Row], cell_m: float) -> Drawing:
    """Draw cells of x_m, y_m (their south-west corner) and rows, darker with more rows."""
    most = max((row["rows"] for row in cells), default=1)
    marks = []
    for row in cells:
        depth = 0.12 + 0.88 * math.log1p(row["rows"]) / math.log1p(most)
        box = (row["x_m"], row["y_m"], row["x_m"] + cell_m, row["y_m"] + cell_m)
        marks.append(floor.box(box, f'fill="#0f766e" fill-opacity="{depth:.2f}"'))
    return floor.draw(marks, "where the logs have been")


def events(
    floor: FloorMap, logged: Sequence[Row], failures: Sequence[Row], colours: Mapping[str, str]
) -> Drawing:
    """Draw dots for logged rare conditions, and crosses where the agent's episodes failed."""
    marks = []
    for row in logged:
        x, y = floor.at(row["x_m"], row["y_m"])
        marks.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill="{colours[row["condition"]]}"'
            ' fill-opacity="0.55"/>'
        )
    crosses = []
    for row in failures:
        x, y = floor.at(row["end_x_m"], row["end_y_m"])
        crosses.append(
            f'<path d="M{x - 7:.1f} {y - 7:.1f} l14 14 m0 -14 l-14 14" stroke="#ffffff"'
            ' stroke-width="7"/>'
            f'<path d="M{x - 7:.1f} {y - 7:.1f} l14 14 m0 -14 l-14 14"'
            f' stroke="{colours[row["condition"]]}" stroke-width="3.4"/>'
        )
    # Crosses lie above the racks: a robot may end right at their face.
    label = "rare conditions in the logs, and where the agent failed"
    return floor.draw(marks, label, above=crosses)


def legend(conditions: Sequence[str], colours: Mapping[str, str]) -> str:
    """Return swatches as HTML."""
    return " ".join(
        f'<span class="key"><span class="swatch"'
        f' style="background:{colours[name]}"></span>{escape(words(name))}</span>'
        for name in conditions
    )
