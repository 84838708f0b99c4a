"""`restock twin`: one module a job, beside this one; `restock twin layout` is here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from restock.cli.twin.fit import FitCommand
from restock.cli.twin.gap import GapCommand
from restock.errors import RestockError


@dataclass
class LayoutCommand:
    """Describe a floor: its size, aisles and goals, and which episodes fit on it.

    A floor is `default`, `generated:SEED`, `narrow:SEED`, a TOML file, or the map.yaml of a ROS
    occupancy map. --out writes it as TOML, or as map.yaml with a PGM. See docs/layouts.md.

    Example: `restock twin layout map.yaml --out hall.toml --png hall.png`
    """

    floor: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FLOOR")]
    """The floor."""
    out: Path | None = None
    """Write it here: FILE.toml, or map.yaml (and map.pgm beside it). Nothing is overwritten."""
    png: Path | None = None
    """Draw it here, from above."""
    json: bool = False
    """Print the description as JSON."""

    def run(self) -> int:
        """Print, and write what was asked for."""
        from restock.cli import output
        from restock.train.twin.env.draw import draw_floor, write_png
        from restock.train.twin.env.floor_report import describe_floor
        from restock.train.twin.floors.floor_file import write_floor
        from restock.train.twin.floors.floors import open_floor
        from restock.train.twin.floors.occupancy_map import write_map

        floor = open_floor(self.floor)
        maps = self.out is not None and self.out.suffix in (".yaml", ".yml")
        if self.out is not None and not maps and self.out.suffix != ".toml":
            raise RestockError(f"{self.out.name!r} ends in neither .toml nor .yaml", where="--out")
        written = [path for path in (self.out, self.png) if path is not None]
        if maps and self.out is not None:
            written.append(self.out.with_suffix(".pgm"))
        for path in written:
            if path.exists():
                raise RestockError(
                    "already exists", where=str(path), remedy="give another name, or remove it"
                )
        facts = describe_floor(floor)
        if self.out is not None:
            write_map(floor, self.out) if maps else write_floor(floor, self.out)
        if self.png is not None:
            write_png(self.png, draw_floor(floor))
        if self.json:
            output.print_json({**facts, "written": [str(path) for path in written]})
            return 0
        output.print_table([{"": key, floor.name: str(value)} for key, value in facts.items()])
        if written:
            output.say(f"written: {', '.join(map(str, written))}")
        return 0


@dataclass
class TwinCommand:
    """Fit the twin's robot to logs, measure its gap to them, and describe the floors it drives
    on.

    See docs/calibration.md and docs/layouts.md. `restock twin JOB --help` explains one job.
    """

    job: tyro.conf.OmitArgPrefixes[
        Annotated[FitCommand, tyro.conf.subcommand("fit", prefix_name=False)]
        | Annotated[GapCommand, tyro.conf.subcommand("gap", prefix_name=False)]
        | Annotated[LayoutCommand, tyro.conf.subcommand("layout", prefix_name=False)]
    ]

    def run(self) -> int:
        """Do the job."""
        return self.job.run()
