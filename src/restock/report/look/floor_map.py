"""A map of a floor, as SVG: where robots were logged, and where the agent failed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from restock.report.look.blocks import CONDITION_COLOURS, Drawing, palette, words

Row = Mapping[str, Any]
SCALE = 40  # SVG units per metre
BAR_M = 2  # length of the scale bar below a map
MAP_PX = 470


def draw(
    size_m: tuple[float, float],
    racks: Sequence[tuple[float, float, float, float]],
    cells: Sequence[Row] = (),
    cell_m: float = 0.0,
    logged: Sequence[Row] = (),
    failures: Sequence[Row] = (),
) -> tuple[Drawing, Markup]:
    """Draw where robots were logged, where rare conditions were logged and where the agent failed.

    The map has no text, so that it can have any width. The scale bar below it is `BAR_M` long.

    Args:
        size_m: extent of the floor along x and y.
        racks: x0, y0, x1, y1 of each rack, in metres.
        cells: x_m, y_m of each cell's south-west corner, and its rows: more rows, stronger colour.
        cell_m: side of a cell.
        logged: x_m, y_m and condition of each dot.
        failures: end_x_m, end_y_m and condition of each cross. Crosses are drawn above the racks,
            because a robot may end right at the face of a rack.

    Returns:
        The map, and its legend of conditions.
    """
    found = {row["condition"] for row in (*logged, *failures)}
    known = [name for name in CONDITION_COLOURS if name in found]
    colours = palette([*known, *sorted(found - set(known))])
    wide, high = (SCALE * size for size in size_m)

    def box(x0: float, y0: float, x1: float, y1: float, style: str) -> str:
        corner = f'x="{x0 * SCALE:.1f}" y="{high - y1 * SCALE:.1f}"'
        sides = f'width="{(x1 - x0) * SCALE:.1f}" height="{(y1 - y0) * SCALE:.1f}"'
        return f"<rect {corner} {sides} {style}/>"

    ground = f'<rect width="{wide:.0f}" height="{high:.0f}"'
    parts = [f'{ground} fill="#f8fafc"/>']
    most = max((row["rows"] for row in cells), default=1)
    for row in cells:
        depth = 0.1 + 0.6 * math.log1p(row["rows"]) / math.log1p(most)
        x, y, style = row["x_m"], row["y_m"], f'fill="#94a3b8" fill-opacity="{depth:.2f}"'
        parts.append(box(x, y, x + cell_m, y + cell_m, style))
    for row in logged:
        at = f'cx="{row["x_m"] * SCALE:.1f}" cy="{high - row["y_m"] * SCALE:.1f}"'
        fill = f'fill="{colours[row["condition"]]}" fill-opacity="0.6"'
        parts.append(f'<circle {at} r="3.2" {fill}/>')
    parts += [box(*rack, 'fill="#cbd5e1" stroke="#94a3b8"') for rack in racks]
    parts.append(f'{ground} fill="none" stroke="#94a3b8" stroke-width="3"/>')
    for row in failures:
        x, y = row["end_x_m"] * SCALE, high - row["end_y_m"] * SCALE
        cross = f'<path d="M{x - 7:.1f} {y - 7:.1f} l14 14 m0 -14 l-14 14"'
        parts.append(f'{cross} stroke="#ffffff" stroke-width="7"/>')
        parts.append(f'{cross} stroke="{colours[row["condition"]]}" stroke-width="3.4"/>')
    parts.append(
        f'<path d="M2 {high + 10:.0f} v10 m0 -5 h{SCALE * BAR_M} m0 -5 v10" fill="none"'
        ' stroke="#475569" stroke-width="2.5"/>'
    )
    wide, high = wide + 4, high + 26
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="map of the floor"'
        f' width="{MAP_PX}" height="{MAP_PX * high / wide:.0f}"'
        f' viewBox="-2 -2 {wide:.0f} {high:.0f}">{"".join(parts)}</svg>'
    )
    swatch = Markup('<span class="key"><span class="swatch" style="background:{}"></span>{}</span>')
    keys = [swatch.format(colour, words(name)) for name, colour in colours.items()]
    return Drawing({MAP_PX: svg}), Markup(" ").join(keys)
