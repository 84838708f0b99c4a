"""`restock twin layout`: describes a floor from a name, file or map, or made from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from restock.cli import output
from restock.cli.output import cell
from restock.cli.words import Option, Positional, Repeated, refuse
from restock.errors import ConfigError, RestockError

if TYPE_CHECKING:
    from restock.train.twin.floors.layout import Warehouse
    from restock.train.twin.survey.survey import Surveyed


@dataclass
class LayoutCommand:
    """Describe a floor: its size, aisles and goals, and which episodes fit on it.

    A floor is `default`, `generated:SEED`, `narrow:SEED`, a TOML file, or the map.yaml of a ROS
    occupancy map. With --from, the floor is made from a recording instead: from its map (or --map),
    or its scans, or the path that was driven. Missions then start and end where the robot was in
    the recording. --out writes the floor as TOML, for `restock train --set env.layouts=FILE.toml`,
    or draws it. See docs/layouts.md.

        restock twin layout map.yaml --out hall.toml --out hall.png
        restock twin layout --from drive.mcap --out floor.toml --out floor.png
    """

    floor: Annotated[str | None, Positional("FLOOR")] = None
    """The floor."""
    source: Annotated[str | None, Option("STORE|BAG", name="from")] = None
    """Make the floor from this recording or store."""
    recording: str | None = None
    """With --from STORE: the recording to make the floor from, by its path, the end of its path, or
    its id. Default: the one with the most rows. If recordings each have a frame of their own, as
    with odometry, each needs a floor of its own."""
    map: Path | None = None
    """With --from: the map.yaml in which the robot was localised. It replaces a map in the
    recording."""
    by: Literal["map", "scans", "corridor"] | None = None
    """With --from: what to make the floor from. Default: the first of these that the recording
    has."""
    profile: str | None = None
    """With --from: the profile of the robot, a name or a TOML file. It gives the topics of pose and
    scan, and the robot's size. Default: that of the store, else a proposal from the topics."""
    footprint: Annotated[str | None, Option("LxW")] = None
    """With --from: the robot's length and width in metres. It overrides all other sources."""
    definitions: Annotated[str | None, Option("DISTRO|PATH")] = None
    """Message definitions for recordings without their own: a ROS distribution (default: humble),
    or a folder (PACKAGE/msg/NAME.msg or .idl) or file that defines a robot's own types."""
    out: Annotated[tuple[Path, ...], Repeated("FILE")] = ()
    """Write the floor to FILE.toml, or draw it from above as FILE.png. May be given several times.
    Existing files are not overwritten."""
    zones: Path | None = None
    """With --from: write the zones of the floor to this file, as [[zone]] tables for a profile, in
    the map frame."""
    json: bool = False
    """Print the description as JSON."""

    def run(self) -> int:
        """Print the floor's description, and write the requested files."""
        from restock.files import write_text
        from restock.train.twin.env.render import draw_floor, write_png
        from restock.train.twin.floors.floor_files import write_floor
        from restock.train.twin.physics.episode import describe_floor
        from restock.train.twin.survey.survey import profile_zones

        written = self._to_write()
        floor, surveyed = self._floor()
        facts = describe_floor(floor)
        remarks: list[str] = []
        drawn: tuple[Any, ...] = ()
        if surveyed is not None:
            if not facts["episodes"]:
                surveyed.notes.append("no mission fits on this floor: the robot moved too little")
            facts = {**surveyed.facts(), **facts, "notes": surveyed.notes}
            remarks = [f"made from {surveyed.source}", *surveyed.notes]
            poses = surveyed.poses
            drawn = surveyed.grid, None if poses is None else poses.places_m
        for path in self.out:
            if path.suffix == ".toml":
                write_floor(floor, path, remarks)
            else:
                write_png(path, draw_floor(floor, *drawn))
        if self.zones is not None:
            write_text(self.zones, profile_zones(floor), exclusive=True)
        if self.json:
            output.print_json({**facts, "written": [str(path) for path in written]})
            return 0
        _show(floor.name, facts)
        if written:
            output.say(f"written: {', '.join(map(str, written))}")
        return 0

    def _to_write(self) -> list[Path]:
        from restock.files import expect_file_place

        for path in self.out:
            if path.suffix not in (".toml", ".png"):
                what = f"{path.name!r} does not end in .toml or .png"
                raise RestockError(what, where="--out")
            expect_file_place(path, "--out")
        expect_file_place(self.zones, "--zones")
        written = [*self.out, *([self.zones] if self.zones is not None else [])]
        for path in written:
            if path.exists():
                raise RestockError(
                    "already exists",
                    where=str(path),
                    remedy="choose another name, or remove the file",
                )
            if not path.parent.is_dir():
                raise RestockError(
                    "no such folder", where=str(path.parent), remedy="create it first"
                )
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
            given = ("recording", "map", "by", "profile", "footprint", "definitions", "zones")
            refuse(self, given, "applies only with --from", remedy="give --from, too")
            return open_floor(self.floor), None
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.propose.footprint import parse_footprint
        from restock.train.twin.survey.survey import survey

        surveyed = survey(
            Path(str(self.source)),
            recording=self.recording,
            map_yaml=self.map,
            by=self.by,
            profile=None if self.profile is None else load_profile(self.profile),
            footprint=None if self.footprint is None else parse_footprint(self.footprint),
            definitions=self.definitions,
        )
        return surveyed.floor, surveyed


def _show(name: str, facts: dict[str, Any]) -> None:
    notes = facts.get("notes", [])
    rows = {key: value for key, value in facts.items() if key != "notes"}
    texts = {key: value if isinstance(value, str) else cell(value) for key, value in rows.items()}
    output.print_table([{"": key, name: text} for key, text in texts.items()])  # text: left-aligned
    for note in notes:
        output.print_text(f"- {note}")
