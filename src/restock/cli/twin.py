"""`restock twin`: the twin against the logs. One module a job: `restock.cli.twin_<job>`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from restock.cli.twin_fit import Fit
from restock.cli.twin_gap import Gap
from restock.cli.twin_layout import Layout


@dataclass
class Twin:
    """The twin against the logs, how its robot is fitted to them and how far it is from them; and
    the floors it drives on.

    See docs/calibration.md and docs/layouts.md. `restock twin JOB --help` explains one job.
    """

    job: tyro.conf.OmitArgPrefixes[
        Annotated[Fit, tyro.conf.subcommand("fit", prefix_name=False)]
        | Annotated[Gap, tyro.conf.subcommand("gap", prefix_name=False)]
        | Annotated[Layout, tyro.conf.subcommand("layout", prefix_name=False)]
    ]

    def run(self) -> int:
        """Do the job."""
        return self.job.run()
