"""A picture of a surveyed floor from above, with a scale.

It shows the map that the floor was made from, the twin's boxes, aisles and crossings, where the
robot drove and where missions go.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from restock.arrays import F64
from restock.errors import ConfigError
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.floors.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, into_frame
from restock.train.twin.survey.poses import JUMP_M
from restock.train.twin.survey.survey import Surveyed

Color = tuple[int, int, int, int]

LONG_SIDE = 1100  # pixels of the floor's longer side, before the frame around it
MARGIN, LEGEND = 36, 270  # pixels around it, and to its right
SMOOTH = 2  # drawn so many times larger, and shrunk
UNKNOWN_GREY, WALL_DARK, FREE_WHITE = (214, 216, 219), (38, 42, 48), (252, 252, 250)
BOX = (80, 105, 140, 90)
BOX_EDGE = (60, 84, 120, 170)
AISLE, AISLE_EDGE = (120, 190, 120, 90), (60, 140, 70, 255)
CROSSING, CROSSING_EDGE = (245, 190, 80, 90), (200, 130, 20, 255)
ZONE_EDGE = (150, 110, 180, 220)
WAY = (20, 130, 150, 255)
PLACE, ELSEWHERE = (205, 60, 50, 255), (235, 140, 120, 255)
INK: Color = (40, 44, 50, 255)


def draw_survey(surveyed: Surveyed) -> Image.Image:
    """Draw the picture, north up along the floor's own axes."""
    return _Picture(surveyed).image()


def write_picture(surveyed: Surveyed, path: Path) -> None:
    """Write the picture as PNG. Raises ConfigError if it cannot be written."""
    image = draw_survey(surveyed)
    try:
        image.save(path, format="PNG")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error


class _Picture:
    def __init__(self, surveyed: Surveyed) -> None:
        self.surveyed, self.floor = surveyed, surveyed.floor
        self.scale = LONG_SIDE * SMOOTH / max(self.floor.width_m, self.floor.depth_m)
        self.margin = MARGIN * SMOOTH
        self.width = round(self.floor.width_m * self.scale)
        self.height = round(self.floor.depth_m * self.scale)
        top = 64 * SMOOTH
        size = (self.width + 2 * self.margin + LEGEND * SMOOTH, self.height + self.margin + top)
        self.size = (size[0], max(size[1] + 60 * SMOOTH, 520 * SMOOTH))
        self.top = top

    def image(self) -> Image.Image:
        canvas = Image.new("RGBA", self.size, (255, 255, 255, 255))
        canvas.paste(self._occupancy(), (self.margin, self.top))
        layer = Image.new("RGBA", self.size, (0, 0, 0, 0))
        draw = ImageDraw.Draw(layer)
        for segment in self.floor.segments:
            self._box(draw, segment.area, AISLE, AISLE_EDGE)
        for crossing in self.floor.crossings:
            self._box(draw, crossing, CROSSING, CROSSING_EDGE)
        for rack in self.floor.racks:
            self._box(draw, rack, BOX, BOX_EDGE, width=1)
        if not self.floor.segments:
            for _, zone in self.floor.cross_zones:
                self._box(draw, zone, None, ZONE_EDGE)
        canvas = Image.alpha_composite(canvas, layer)
        draw = ImageDraw.Draw(canvas)
        self._way(draw)
        self._places(draw)
        self._names(draw)
        self._frame(draw)
        self._legend(draw)
        small = canvas.resize(
            (self.size[0] // SMOOTH, self.size[1] // SMOOTH), Image.Resampling.LANCZOS
        )
        return small.convert("RGB")

    def _at(self, x_m: float, y_m: float) -> tuple[float, float]:
        return self.margin + x_m * self.scale, self.top + self.height - y_m * self.scale

    def _occupancy(self) -> Image.Image:
        """Return the grid that the floor was made from, on the floor's extent."""
        grid: OccupancyGrid = self.surveyed.grid
        colors = np.full((*grid.occupancy.shape, 3), UNKNOWN_GREY, np.uint8)
        colors[grid.occupancy == FREE] = FREE_WHITE
        colors[grid.occupancy == OCCUPIED] = WALL_DARK
        image = Image.fromarray(np.ascontiguousarray(colors.transpose(1, 0, 2)[::-1]))
        pixels = (round(side * grid.cell_m * self.scale) for side in grid.occupancy.shape)
        image = image.resize(tuple(pixels), Image.Resampling.NEAREST)
        whole = Image.new("RGB", (self.width, self.height), UNKNOWN_GREY)
        whole.paste(image, (0, self.height - image.height))  # their south-west corners agree
        return whole

    def _box(
        self,
        draw: ImageDraw.ImageDraw,
        area: Rect,
        fill: Color | None,
        edge: Color,
        width: int = 2,
    ) -> None:
        left, low = self._at(area.x_min, area.y_min)
        right, high = self._at(area.x_max, area.y_max)
        draw.rectangle((left, high, right, low), fill=fill, outline=edge, width=width * SMOOTH // 2)

    def _way(self, draw: ImageDraw.ImageDraw) -> None:
        poses = self.surveyed.poses
        if poses is None:
            return
        places: F64 = into_frame(poses.places_m, self.floor.map_origin)
        cuts = np.flatnonzero(np.hypot(*np.diff(places, axis=0).T) > JUMP_M) + 1
        for part in np.split(places, cuts):
            points = [self._at(x, y) for x, y in part.tolist()]
            if len(points) > 1:
                draw.line(points, fill=WAY, width=2 * SMOOTH, joint="curve")
            else:
                self._dot(draw, points[0], 2, WAY)

    def _places(self, draw: ImageDraw.ImageDraw) -> None:
        starts = set(self.floor.starts_m)
        for place in self.floor.goals_m:
            self._dot(draw, self._at(*place), 5, PLACE if place in starts else ELSEWHERE)

    def _dot(
        self, draw: ImageDraw.ImageDraw, at: tuple[float, float], radius: int, color: Color
    ) -> None:
        draw.circle(at, radius * SMOOTH, fill=color, outline=(255, 255, 255, 255), width=SMOOTH)

    def _names(self, draw: ImageDraw.ImageDraw) -> None:
        font = ImageFont.load_default(13 * SMOOTH)
        zones = self.floor.zones
        texts = [name.replace("_", " ") for name in zones]
        centres = [self._at(*area.center) for area in zones.values()]
        boxes = [
            draw.textbbox(at, text, font, anchor="mm", stroke_width=2 * SMOOTH)
            for at, text in zip(centres, texts, strict=True)
        ]
        for (x, y), text, down in zip(centres, texts, moved_apart(boxes), strict=True):
            draw.text(
                (x, y + down),
                text,
                fill=INK,
                font=font,
                anchor="mm",
                stroke_width=2 * SMOOTH,
                stroke_fill=(255, 255, 255, 230),
            )

    def _frame(self, draw: ImageDraw.ImageDraw) -> None:
        corner, other = self._at(0, 0), self._at(self.floor.width_m, self.floor.depth_m)
        draw.rectangle((corner[0], other[1], other[0], corner[1]), outline=INK, width=SMOOTH)
        title, small = (ImageFont.load_default(size * SMOOTH) for size in (20, 13))
        draw.text((self.margin, 12 * SMOOTH), self.floor.name, fill=INK, font=title)
        made = f"{self.surveyed.by}: {self.surveyed.source}"
        draw.text((self.margin, 38 * SMOOTH), made, fill=(90, 96, 104, 255), font=small)
        bar_m = _round_length(self.floor)
        y = corner[1] + 22 * SMOOTH
        draw.line(
            [(self.margin, y), (self.margin + bar_m * self.scale, y)], fill=INK, width=3 * SMOOTH
        )
        draw.text((self.margin, y + 6 * SMOOTH), f"{bar_m:g} m", fill=INK, font=small)

    def _legend(self, draw: ImageDraw.ImageDraw) -> None:
        font = ImageFont.load_default(13 * SMOOTH)
        x, y = self.margin * 2 + self.width, self.top
        floor, poses = self.floor, self.surveyed.poses
        visited, others = len(floor.starts_m), len(floor.goals_m) - len(floor.starts_m)
        rows: list[tuple[Color | None, str]] = [
            ((*FREE_WHITE, 255), "free"),
            ((*WALL_DARK, 255), "occupied"),
            ((*UNKNOWN_GREY, 255), "unknown: a wall to the twin"),
            (BOX_EDGE, f"boxes of the twin: {len(floor.racks)}"),
            (AISLE_EDGE, f"aisles: {len(floor.segments)}"),
            (CROSSING_EDGE, f"crossings: {len(floor.crossings)}"),
        ]
        if not floor.segments and floor.cross_zones:
            rows.append((ZONE_EDGE, "zones: quarters"))
        if poses is not None:
            rows.append((WAY, f"driven, {poses.driven_m:.1f} m"))
        if visited:
            rows.append((PLACE, f"places visited: {visited}"))
        if others:
            rows.append((ELSEWHERE, f"other goals: {others}"))
        rows.append((None, f"{floor.width_m:.1f} x {floor.depth_m:.1f} m"))
        body = self.surveyed.footprint
        rows.append((None, f"robot {body.length_m:.2f} x {body.width_m:.2f} m"))
        rows.append((None, f"missions of {floor.way_m[0]:g} to {floor.way_m[1]:g} m"))
        for color, text in rows:
            if color is not None:
                square = (x, y, x + 14 * SMOOTH, y + 14 * SMOOTH)
                draw.rectangle(square, fill=color, outline=(120, 124, 130, 255), width=SMOOTH)
            draw.text((x + 22 * SMOOTH, y + 7 * SMOOTH), text, fill=INK, font=font, anchor="lm")
            y += 24 * SMOOTH


def moved_apart(boxes: Sequence[tuple[float, float, float, float]]) -> list[float]:
    """Return how far down each label must move to be below those that it covers.

    Boxes are (left, top, right, bottom). Zones that overlap, such as the ends of two aisles, have
    nearly the same centre, and so have their names.
    """
    placed: list[tuple[float, float, float, float]] = []
    found = []
    for left, top, right, bottom in boxes:
        down = 0.0
        while below := [
            other[3] - top
            for other in placed
            if left < other[2]
            and other[0] < right
            and top + down < other[3]
            and other[1] < bottom + down
        ]:
            down = max(below)
        placed.append((left, top + down, right, bottom + down))
        found.append(down)
    return found


def _round_length(floor: Warehouse) -> float:
    """Return about a fifth of the floor's width: 1, 2 or 5 times a power of ten."""
    wanted = floor.width_m / 5
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted))
