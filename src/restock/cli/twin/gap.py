"""`restock twin gap`: measures how far the twin is from the logs, and where not to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ExitCode


@dataclass
class GapCommand:
    """Measure the gap between the twin and a store's logs, by driving the logged commands again.

    For each condition, it measures the error of pose and signals after 1, 3 and 6 s, open loop, and
    of observation and reward after one step from each logged state: for the nominal twin and, with
    --perturbation, for a calibrated one. For comparison it shows dead-reckoned odometry. It lists
    the conditions in which the twin should not be trusted, by the limits below, with 95 %
    confidence over episodes. See docs/robot.md.

    The exit code is 0 whatever the gap. With --check, it is 1 if a condition is untrusted.

    Example: `restock twin gap store/ --perturbation fitted.toml --out store/gap`
    """

    store: Annotated[str, Positional("STORE")]
    """The store."""
    perturbation: Path | None = None
    """A perturbation that calibrates the twin, e.g. written by `restock twin fit`."""
    out: Path | None = None
    """A folder for gap.json, Parquet tables and a page (index.html). `restock report` shows a gap
    in RUN/gap or STORE/gap. An earlier gap in the folder is replaced."""
    horizon_s: float | None = None
    """Drive open loop for this many seconds, and judge by it. Default: 1, 3 and 6 s, judged at 3 s.
    """
    trust_position_m: float = 0.2
    """A condition is trusted if nine in ten segments end within this distance (m) of the log."""
    segments: int = 400
    """The largest number of segments per condition and horizon, spread evenly; for single steps,
    five times as many.
    """
    task: str | None = None
    """Hash of the task whose rows are used, if the store has several tasks."""
    check: bool = False
    """Exit 1 if a condition is untrusted."""
    json: bool = False
    """Print one JSON document: {"untrusted", "verdicts", "paths", "observations", "rewards",
    "not_done", "about"}."""

    def run(self) -> int:
        """Measure the gap, print and write it."""
        from restock.replay.store.store import Store
        from restock.report import gap_page, write_page
        from restock.train.twin.calibration.gap import measure_gap
        from restock.train.twin.calibration.twin_gap import (
            GapConfig,
            TrustLimits,
            check_place,
            write_gap,
        )
        from restock.train.twin.physics.perturbation import load_perturbation

        calibrated = None if self.perturbation is None else load_perturbation(self.perturbation)
        limits = TrustLimits(
            horizon_s=3.0 if self.horizon_s is None else self.horizon_s,
            position_m=self.trust_position_m,
        )
        config = GapConfig(
            horizons_s=(1.0, 3.0, 6.0) if self.horizon_s is None else (self.horizon_s,),
            max_segments=self.segments,
            limits=limits,
            timestep_s=0.01 if calibrated is None else calibrated.timestep_s,
            nthread=0,
        )
        if self.out is not None:
            check_place(self.out)
        with Store(self.store) as store:
            gap = measure_gap(
                *(store, calibrated, config),
                task_hash=self.task,
                on_progress=output.say,
            )
        if self.out is not None:
            write_gap(gap, self.out)
            output.say(f"wrote {write_page(gap_page(gap), self.out / 'index.html')}")
        if self.json:
            output.print_json(gap.document())
        else:
            page = gap_page(gap)
            output.print_sections(page["sections"])
            output.print_text(page["headline"])
        return int(ExitCode.FAILED if self.check and gap.untrusted else ExitCode.OK)
