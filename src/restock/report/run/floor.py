"""Sections on the floor: where the logs have been, where the policy failed, and films of it."""

from __future__ import annotations

import base64
import math
from typing import Any

from markupsafe import Markup

from restock.errors import RestockError, counted, policy_words
from restock.files import read_json
from restock.report.look import blocks, charts, floor_map
from restock.report.look.blocks import (
    Drawing,
    Figure,
    Section,
    words,
)
from restock.report.look.charts import FONT
from restock.report.look.floor_map import SCALE, Box, FloorMap
from restock.report.run.facts import CELL_M, Facts
from restock.train.run.kept_evaluations import cell_name
from restock.train.twin.floors.floors import open_floors


def floor_section(facts: Facts) -> Section | None:
    """Show on the map where the logs have been, and where the agent failed."""
    layout = facts.floor
    if layout is None:
        return None
    racks = [(r.x_min, r.y_min, r.x_max, r.y_max) for r in layout.racks]
    plan = floor_map.FloorMap(layout.width_m, layout.depth_m, racks)
    failures = [
        row
        for row in facts.failures
        if row["perturbation"] == "none" and row["layout"] == layout.name
    ]
    conditions = {row["condition"] for row in [*facts.rare, *failures]}
    names = charts.ordered(
        [{"condition": name} for name in conditions], "condition", blocks.CONDITION_COLOURS
    )
    colours = blocks.palette(names)
    steps = sum(row["rows"] for row in facts.visited)
    return Section(
        "map",
        "Where did it happen?",
        figures=[
            Figure(
                floor_map.visited(plan, facts.visited, CELL_M),
                "Where the logs have been",
                f"{steps:,} logged steps in cells of {CELL_M} m, darker where there are more"
                f" (logarithmic); the bar is {floor_map.BAR_M} m. Drawn on the run's floor, "
                f"{layout.name}"
                + (f", the first of {facts.floors} with logs." if facts.floors > 1 else ".")
                + (
                    f" Not drawn: what was logged in other frames, "
                    f"{counted(facts.elsewhere, 'recording')}."
                    if facts.elsewhere
                    else ""
                )
                + (
                    f" Its missions start at {len(layout.starts_m)} places where the robot was in "
                    f"the logs, and go to {len(layout.goals)}."
                    if layout.starts_m
                    else ""
                ),
            ),
            Figure(
                floor_map.events(plan, facts.rare, failures, colours),
                "Rare conditions in the logs (dots), the agent's failures (crosses)",
                Markup(floor_map.legend(names, colours))
                + Markup("<br>")
                + f"{len(failures)} failed clean episodes there.",
            ),
        ],
        two=True,
    )


FOLDER, DOCUMENT = "eval/films", "films.json"
BODY_M = (0.62, 0.44)  # length and width of the robot as drawn
PALLET_M, FORKLIFT_M, PERSON_M = (1.2, 0.8), (1.6, 0.8), 0.22
GAP = 24  # SVG units between the frames


def films_section(facts: Facts) -> Section | None:
    """Return the section of films; None if none are of this policy (`--video` makes them)."""
    folder = facts.run / FOLDER
    if not (folder / DOCUMENT).is_file():
        return None
    try:
        films = read_json(folder / DOCUMENT)["films"]
        figures = [_film(facts, film) for film in films]
    except (RestockError, KeyError, TypeError, ValueError, OSError) as error:
        facts.missing.append(f"Films are not shown, since they could not be read: {error}")
        return None
    if not figures:
        return None
    return Section(
        "films",
        "What does it look like?",
        intro="Episodes of the evaluation, driven again with the same spec, policy and outcome. "
        "For each condition: the failure with the lowest return, and an episode in which the "
        "agent succeeded and another policy did not; the film shows that one to its left. Seen "
        "from above: the robot is orange, its path a line, its plan dashed, the goal green; people "
        "are blue, forklifts yellow, pallets brown, slippery floor light blue.",
        figures=figures,
        two=True,
    )


def _film(facts: Facts, film: dict[str, Any]) -> Figure:
    floor = next(f for f in open_floors(film["layouts"]) if f.name == film["layout"])
    racks = [(r.x_min, r.y_min, r.x_max, r.y_max) for r in floor.racks]
    plan = FloorMap(floor.width_m, floor.depth_m, racks)
    data = base64.b64encode((facts.run / FOLDER / str(film["file"])).read_bytes()).decode()
    other = film["rescued_from"]
    how = (
        f"arrived after {film['time_s']:.1f} s, where {policy_words([other])[other]} did not"
        f" ({film['other_failure']})"
        if film["success"]
        else f"{film['failure']} after {film['time_s']:.1f} s"
    )
    name = words(cell_name(film["condition"], film["block"]))
    times = ", ".join(f"{frame['time_s']:.1f}" for frame in film["strip"])
    return Figure(
        _strip(plan, film),
        f"{name}: {film['kind']}",
        f"Seed {film['episode_seed']}, policy {film['version']}: {how}; "
        f"{counted(film['bumps'], 'bump')}. The frames are at {times} s.",
        moving=f"data:image/webp;base64,{data}",
    )


def _strip(plan: FloorMap, film: dict[str, Any]) -> Drawing:
    """Put frames side by side, two or three in a line."""
    width, height = plan.width_m * SCALE + GAP, plan.depth_m * SCALE + GAP
    frames = [_frame(plan, frame, film["track"][: frame["step"] + 1]) for frame in film["strip"]]
    drawn: dict[int, str] = {}
    for pixels, columns in ((300, 2), (470, 3)):
        lines = math.ceil(len(frames) / columns)
        placed = "".join(
            f'<g transform="translate({i % columns * width:.0f} {i // columns * height:.0f})">'
            f"{frame}</g>"
            for i, frame in enumerate(frames)
        )
        box = columns * width - GAP + 4, lines * height - GAP + 4
        drawn[pixels] = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{pixels}"'
            f' height="{pixels * box[1] / box[0]:.0f}" viewBox="-2 -2 {box[0]:.0f} {box[1]:.0f}"'
            f' role="img" aria-label="frames of the episode" font-family="{FONT}">{placed}</svg>'
        )
    return Drawing(drawn)


def _frame(plan: FloorMap, frame: dict[str, Any], track: list[list[float]]) -> str:
    width, height = plan.width_m * SCALE, plan.depth_m * SCALE
    parts = [f'<rect width="{width:.0f}" height="{height:.0f}" fill="#f8fafc"/>']
    parts += [
        plan.box(_within(plan, x - hx, y - hy, x + hx, y + hy), 'fill="#56b4e9" fill-opacity="0.5"')
        for x, y, hx, hy in frame["patches"]
    ]
    parts += [plan.box(rack, 'fill="#cbd5e1" stroke="#94a3b8"') for rack in plan.racks]
    goal = plan.at(*frame["goal"])
    parts.append(f'<circle cx="{goal[0]:.1f}" cy="{goal[1]:.1f}" r="12" fill="#009e73"/>')
    dashed = 'stroke="#009e73" stroke-width="4" stroke-dasharray="10 8"'
    parts.append(_line(plan, frame["plan"], dashed))
    parts.append(_line(plan, track, 'stroke="#d55e00" stroke-width="6"'))
    parts += [_box(plan, p, PALLET_M, "#84643a") for p in frame["pallets"]]
    parts += [_box(plan, p, FORKLIFT_M, "#e69f00") for p in frame["forklifts"]]
    for x_m, y_m, _ in frame["people"]:
        x, y = plan.at(x_m, y_m)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{PERSON_M * SCALE}" fill="#0072b2"/>')
    parts.append(_box(plan, frame["robot"], BODY_M, "#d55e00"))
    parts.append(
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="none" stroke="#94a3b8"'
        ' stroke-width="3"/>'
    )
    return "".join(parts)


def _within(plan: FloorMap, x0: float, y0: float, x1: float, y1: float) -> Box:
    """Clip a box to the floor."""
    return max(x0, 0.0), max(y0, 0.0), min(x1, plan.width_m), min(y1, plan.depth_m)


def _line(plan: FloorMap, points: list[list[float]], style: str) -> str:
    path = " ".join("{:.1f},{:.1f}".format(*plan.at(x, y)) for x, y in points)
    return f'<polyline points="{path}" fill="none" {style}/>'


def _box(plan: FloorMap, pose: list[float], size_m: tuple[float, float], colour: str) -> str:
    x, y = plan.at(pose[0], pose[1])
    length, breadth = (side * SCALE for side in size_m)
    return (
        f'<rect x="{-length / 2:.1f}" y="{-breadth / 2:.1f}" width="{length:.1f}"'
        f' height="{breadth:.1f}" rx="4" fill="{colour}" stroke="#ffffff" stroke-width="2"'
        f' transform="translate({x:.1f} {y:.1f}) rotate({-math.degrees(pose[2]):.1f})"/>'
    )
