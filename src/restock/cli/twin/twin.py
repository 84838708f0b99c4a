"""`restock twin`: one module a job, beside this one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from restock.cli.twin.fit import FitCommand
from restock.cli.twin.gap import GapCommand
from restock.cli.twin.layout import LayoutCommand
from restock.cli.twin.robot import RobotCommand


@dataclass
class TwinCommand:
    """Fit the twin to logs, measure its gap to them, test its robot, and describe its floors.

    See docs/robot.md, docs/robot.md and docs/layouts.md. `restock twin JOB --help` explains
    one job.
    """

    job: tyro.conf.OmitArgPrefixes[
        Annotated[FitCommand, tyro.conf.subcommand("fit", prefix_name=False)]
        | Annotated[GapCommand, tyro.conf.subcommand("gap", prefix_name=False)]
        | Annotated[LayoutCommand, tyro.conf.subcommand("layout", prefix_name=False)]
        | Annotated[RobotCommand, tyro.conf.subcommand("robot", prefix_name=False)]
    ]
