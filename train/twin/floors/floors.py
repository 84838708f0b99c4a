"""The twin's floors: generated from seeds, split into training, validation and test.

`open_floors` opens floors by what a user writes:

- `default`: the floor that comes with Restock;
- `generated:SEED`, `narrow:SEED`: one floor; a robot barely fits the aisles of a narrow one;
- `generated:train`, `…:validation`, `…:test`, optionally `:COUNT`: the first floors of a split;
- `FILE.toml` or `map.yaml`: a floor from a file (`restock.train.twin.floors.floor_files`);
- several of these, separated by commas.

A hash of the seed decides the split, so no floor is in two splits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from itertools import count, islice
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from restock.errors import ConfigError
from restock.train.twin.floors.layout import (
    DEFAULT,
    AisleSegment,
    Dock,
    Heading,
    OneWay,
    Rect,
    Warehouse,
    default_warehouse,
    strip_warehouse,
)

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
_TENTHS = {"train": 7, "validation": 1, "test": 2}  # tenths of all seeds, by split
FLOORS = 16  # number of floors of a split if no count is given
MAX_FLOORS = 256
MAX_SEED = 2**53 - 1

Range = tuple[float, float]


@dataclass(frozen=True)
class Recipe:
    """The ranges that a floor is drawn from. Lengths are rounded to .1 m."""

    aisle_m: Range = (1.5, 2.3)  # width
    cross_m: Range = (2.0, 2.6)  # width of a cross-aisle
    rack_m: Range = (2.4, 3.6)  # length of a rack along the aisle
    rack_deep_m: Range = (0.8, 1.4)
    aisles: tuple[int, int] = (3, 5)
    cross_aisles: tuple[int, int] = (3, 4)
    one_way: float = 0.4  # probability that inner aisles are one-way, in alternating directions
    gap: float = 0.1  # probability that a rack is missing
    turned: float = 0.5  # probability that aisles run north and south
    docks: tuple[int, int] = (2, 4)


RECIPES: dict[str, Recipe] = {
    "generated": Recipe(),
    "narrow": Recipe(aisle_m=(0.9, 1.2), aisles=(4, 6)),
}


def split_of(seed: int) -> Split:
    """Return the split that a seed's floor belongs to."""
    tenth = int.from_bytes(blake2b(str(seed).encode(), digest_size=8).digest()) % 10
    for split in SPLITS:
        tenth -= _TENTHS[split]
        if tenth < 0:
            return split
    raise AssertionError("the tenths sum to ten")


def seeds_of(split: Split) -> Iterator[int]:
    """Yield the seeds of a split in rising order, endlessly."""
    return (seed for seed in count() if split_of(seed) == split)


def generate(seed: int, recipe: Recipe | None = None, *, name: str | None = None) -> Warehouse:
    """Generate the floor of a seed; the same seed and recipe always give the same floor.

    Raises:
        ConfigError: the seed is out of range, or the recipe's floors would be too large.
    """
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"a seed must be 0 to {MAX_SEED}, got {seed}", where="layouts")
    recipe = recipe or RECIPES["generated"]
    name = name or f"generated:{seed}"
    rng = np.random.Generator(np.random.PCG64([seed, 0x666C6F6F]))

    def metres(span: Range) -> float:
        return round(float(rng.uniform(*span)), 1)

    aisles = int(rng.integers(recipe.aisles[0], recipe.aisles[1] + 1))
    crosses = int(rng.integers(recipe.cross_aisles[0], recipe.cross_aisles[1] + 1))
    aisle_y, depth = _strips([metres(recipe.aisle_m) for _ in range(aisles)], recipe, rng, "deep")
    cross_x, width = _strips([metres(recipe.cross_m) for _ in range(crosses)], recipe, rng, "long")
    racks = (aisles - 1) * (crosses - 1)
    missing = frozenset(np.flatnonzero(rng.random(racks) < recipe.gap).tolist()[: racks // 4])
    wanted = int(rng.integers(recipe.docks[0], recipe.docks[1] + 1))
    rows = rng.permutation(aisles - 1)[:wanted]
    between = [(aisle_y[row][1] + aisle_y[row + 1][0]) / 2 for row in sorted(rows.tolist())]
    docks = tuple(
        Dock(f"dock_{index + 1}", Rect(0.0, round(y - 0.4, 3), 1.2, round(y + 0.4, 3)))
        for index, y in enumerate(between)
    )
    has_rules = rng.random() < recipe.one_way
    first = int(rng.integers(2))
    floor = strip_warehouse(
        width, depth, aisle_y, cross_x, name=name, docks=docks, open_racks=missing
    )
    if has_rules:
        ways: tuple[Heading, Heading] = ("east", "west")
        floor = replace(
            floor,
            one_way=tuple(
                OneWay(segment.area, ways[(segment.aisle + first) % 2])
                for segment in floor.segments
                if 0 < segment.aisle < aisles - 1
            ),
        )
    return transposed(floor) if rng.random() < recipe.turned else floor


def _strips(
    widths: list[float], recipe: Recipe, rng: np.random.Generator, way: Literal["deep", "long"]
) -> tuple[tuple[Range, ...], float]:
    """Return free strips (start, end) with racks of drawn sizes between, and the last one's end."""
    span = recipe.rack_deep_m if way == "deep" else recipe.rack_m
    strips, at = [], 0.0
    for width in widths:
        strips.append((round(at, 3), round(at + width, 3)))
        at = round(at + width + round(float(rng.uniform(*span)), 1), 3)
    return tuple(strips), strips[-1][1]


_TRANSPOSED: dict[Heading, Heading] = {
    "east": "north",
    "north": "east",
    "west": "south",
    "south": "west",
}


def transposed(floor: Warehouse) -> Warehouse:
    """Exchange x and y of a floor: aisles that ran east run north."""
    return replace(
        floor,
        width_m=floor.depth_m,
        depth_m=floor.width_m,
        racks=tuple(rack.transposed for rack in floor.racks),
        segments=tuple(
            AisleSegment(s.name, s.aisle, s.area.transposed, "y" if s.along == "x" else "x")
            for s in floor.segments
        ),
        goals_m=tuple((y, x) for x, y in floor.goals_m),
        crossings=tuple(crossing.transposed for crossing in floor.crossings),
        cross_zones=tuple((name, zone.transposed) for name, zone in floor.cross_zones),
        docks=tuple(Dock(dock.name, dock.area.transposed) for dock in floor.docks),
        one_way=tuple(OneWay(r.area.transposed, _TRANSPOSED[r.heading]) for r in floor.one_way),
    )


def open_floors(layouts: str | Sequence[Warehouse | str]) -> tuple[Warehouse, ...]:
    """Open floors by name, file or comma-separated list; `docs/layouts.md` lists the names.

    Raises:
        ConfigError: a floor does not exist, a file is not a floor, no floor is given, or two have
            the same name.
    """
    floors: list[Warehouse] = []
    for part in [layouts] if isinstance(layouts, str) else layouts:
        if isinstance(part, Warehouse):
            floors.append(part)
        else:
            floors += [floor for text in part.split(",") for floor in _open(text.strip())]
    names = [floor.name for floor in floors]
    if not floors or len(set(names)) < len(names):
        raise ConfigError(
            f"layout names must be unique, got {', '.join(names)}"
            if floors
            else "there must be a layout",
            where="layouts",
            remedy="give floors that differ in their name",
        )
    return tuple(floors)


def layouts_of_split(text: str, split: Split) -> str:
    """Replace the training floors in a text for `open_floors` by the floors of another split."""
    parts = [part.strip() for part in text.split(",")]
    return ",".join(
        f"{kind}:{split}" if kind in RECIPES and rest.partition(":")[0] == "train" else part
        for part in parts
        for kind, _, rest in [part.partition(":")]
    )


def open_floor(text: str) -> Warehouse:
    """Open one floor. Raises ConfigError if `text` names several, or an unknown one."""
    floors = open_floors(text)
    if len(floors) > 1:
        raise ConfigError(
            f"{text!r} means {len(floors)} floors",
            where="layout",
            remedy=f"give one of them, such as {floors[0].name}",
        )
    return floors[0]


def _open(text: str) -> list[Warehouse]:
    if text == DEFAULT:
        return [default_warehouse()]
    kind, _, rest = text.partition(":")
    if kind in RECIPES:
        return [_generated(kind, seed) for seed in _parse_seeds(text, rest)]
    suffix = Path(text).suffix.lower()
    if suffix == ".toml":
        from restock.train.twin.floors.floor_files import read_floor

        return [read_floor(Path(text))]
    if suffix in (".yaml", ".yml"):
        from restock.train.twin.floors.floor_files import read_map

        return [read_map(Path(text))]
    raise ConfigError(
        f"there is no layout {text!r}",
        where="layouts",
        remedy=f"write default, {', '.join(f'{kind}:SEED' for kind in RECIPES)},"
        f" generated:{'|'.join(SPLITS)}, FILE.toml or map.yaml",
    )


def _parse_seeds(text: str, rest: str) -> list[int]:
    first, _, last = rest.partition(":")
    if first in SPLITS:
        size = int(last) if last.isdecimal() and len(last) < 6 else (0 if last else FLOORS)
        if not 1 <= size <= MAX_FLOORS:
            raise ConfigError(
                f"{last!r} is not a number of floors",
                where=f"layouts {text!r}",
                remedy=f"1 to {MAX_FLOORS}, such as generated:{first}:{FLOORS}",
            )
        split: Split = next(known for known in SPLITS if known == first)
        return list(islice(seeds_of(split), size))
    if not (first.isdecimal() and not last and len(first) <= 16):
        raise ConfigError(
            f"{rest!r} is not a seed or a split",
            where=f"layouts {text!r}",
            remedy=f"such as generated:17, or generated:{'|'.join(SPLITS)}",
        )
    return [int(first)]


@lru_cache(maxsize=2 * MAX_FLOORS)
def _generated(kind: str, seed: int) -> Warehouse:
    return generate(seed, RECIPES[kind], name=f"{kind}:{seed}")
