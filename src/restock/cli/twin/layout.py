"""`restock twin layout`: what a floor is, from a name, a file, a map, or what recordings show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from restock.errors import ConfigError, RestockError

if TYPE_CHECKING:
    from restock.train.twin.floors.layout import Warehouse
    from restock.train.twin.survey.survey import Surveyed


@dataclass
class LayoutCommand:
    """Describe a floor: its size, aisles and goals, and which episodes fit on it.

    A floor is `default`, `generated:SEED`, `narrow:SEED`, a TOML file, or the map.yaml of a ROS
    occupancy map. --from makes it from what a recording shows instead: from its map (or --map), or
    its scans, or the way that was driven; missions start and end where the robot really was. --out
    writes it as TOML, which `restock train --set env.layouts=FILE.toml` drives on, or as map.yaml
    with a PGM. See docs/layouts.md.

        restock twin layout map.yaml --out hall.toml --png hall.png
        restock twin layout --from drive.mcap --out floor.toml --png floor.png
    """

    floor: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[FLOOR]")] = None
    """The floor."""
    source: Annotated[str | None, tyro.conf.arg(name="from", metavar="STORE|BAG")] = None
    """A recording, or a store: make the floor from what it shows."""
    map: Path | None = None
    """The map.yaml that the robot of --from localised in, in place of a map in the recording."""
    by: Literal["map", "scans", "corridor"] | None = None
    """What to make it from (default: the first of these that --from has)."""
    profile: str | None = None
    """The robot of --from: a profile by name or TOML file. Says what its pose and its scan are,
    and how large it is (default: that of the store, else guessed by the topics)."""
    footprint: Annotated[str | None, tyro.conf.arg(metavar="LxW")] = None
    """How large it is, in metres, before anything else that says it."""
    typestore: str | None = None
    """Message definitions for bags that carry none, e.g. humble, jazzy (default humble)."""
    definitions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of .msg and .idl files: definitions of a robot's own types, for bags that carry
    none."""
    out: Path | None = None
    """Write it here: FILE.toml, or map.yaml (and map.pgm beside it). Nothing is overwritten."""
    png: Path | None = None
    """Draw it here, from above."""
    zones: Path | None = None
    """Write the parts of --from's floor here, as [[zone]] of a profile in the map's frame."""
    json: bool = False
    """Print the description as JSON."""

    def run(self) -> int:
        """Print, and write what was asked for."""
        from restock.cli import output
        from restock.files import write_text
        from restock.train.twin.env.draw import draw_floor, write_png
        from restock.train.twin.env.floor_report import describe_floor
        from restock.train.twin.floors.floor_file import write_floor
        from restock.train.twin.floors.occupancy_map import write_map
        from restock.train.twin.survey.picture import write_picture
        from restock.train.twin.survey.zones import profile_zones

        maps = self.out is not None and self.out.suffix in (".yaml", ".yml")
        written = self._to_write(maps)
        floor, surveyed = self._floor()
        facts = describe_floor(floor)
        remarks: list[str] = []
        if surveyed is not None:
            if not facts["episodes"]:
                surveyed.notes.append("no mission fits on it: the robot moved too little")
            facts = {**surveyed.facts(), **facts, "notes": surveyed.notes}
            remarks = [f"made from {surveyed.source}", *surveyed.notes]
        if self.out is not None:
            write_map(floor, self.out) if maps else write_floor(floor, self.out, remarks)
        if self.png is not None and surveyed is not None:
            write_picture(surveyed, self.png)
        elif self.png is not None:
            write_png(self.png, draw_floor(floor))
        if self.zones is not None:
            write_text(self.zones, profile_zones(floor), exclusive=True)
        if self.json:
            output.print_json({**facts, "written": [str(path) for path in written]})
            return 0
        _show(floor.name, facts)
        if written:
            output.say(f"written: {', '.join(map(str, written))}")
        return 0

    def _to_write(self, maps: bool) -> list[Path]:
        if self.out is not None and not maps and self.out.suffix != ".toml":
            raise RestockError(f"{self.out.name!r} ends in neither .toml nor .yaml", where="--out")
        written = [path for path in (self.out, self.png, self.zones) if path is not None]
        if maps and self.out is not None:
            written.append(self.out.with_suffix(".pgm"))
        for path in written:
            if path.exists():
                raise RestockError(
                    "already exists", where=str(path), remedy="give another name, or remove it"
                )
            if not path.parent.is_dir():
                raise RestockError("no such folder", where=str(path.parent), remedy="make it first")
        return written

    def _floor(self) -> tuple[Warehouse, Surveyed | None]:
        from restock.train.twin.floors.floors import open_floor

        if (self.floor is None) == (self.source is None):
            raise ConfigError(
                "give a floor, or --from a recording or store, and not both",
                where="restock twin layout",
                remedy="such as `restock twin layout default`, or `restock twin layout --from BAG`",
            )
        if self.floor is not None:
            self._refuse_without_from()
            return open_floor(self.floor), None
        from restock.ingest.containers.open_recording import with_definitions
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.propose.evidence.footprint import parse_footprint
        from restock.train.twin.survey.survey import survey

        surveyed = survey(
            Path(str(self.source)),
            map_yaml=self.map,
            by=self.by,
            profile=None if self.profile is None else load_profile(self.profile),
            footprint=None if self.footprint is None else parse_footprint(self.footprint),
            typestore=with_definitions(self.typestore, self.definitions),
        )
        return surveyed.floor, surveyed

    def _refuse_without_from(self) -> None:
        for name in ("map", "by", "profile", "footprint", "typestore", "definitions", "zones"):
            if getattr(self, name) is not None:
                raise ConfigError(
                    f"--{name} is about the recording that --from names",
                    where="restock twin layout",
                    remedy=f"leave out --{name}, or give --from STORE or BAG",
                )


def _show(name: str, facts: dict[str, Any]) -> None:
    from restock.cli import output

    notes = facts.get("notes", [])
    rows = {key: value for key, value in facts.items() if key != "notes"}
    output.print_table([{"": key, name: str(value)} for key, value in rows.items()])
    for note in notes:
        output.stdout().print(f"- {note}", markup=False, soft_wrap=True)
