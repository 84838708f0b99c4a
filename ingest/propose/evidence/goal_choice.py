"""Where a proposed profile takes its goals from: topics, hindsight, or nowhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from restock.ingest.profile.inputs import HINDSIGHT
from restock.ingest.task.hindsight import NO_MISSION, GoalSource

RADIUS_M = (0.1, 0.4)  # the least and the most of a goal
MIN_ROWS = 100  # with a goal in hindsight, where these are wanted and the rest is left out


@dataclass(frozen=True)
class GoalChoice:
    """The goal of a proposal; `source` None: the task has none."""

    source: GoalSource | None
    why: str = ""  # there is none
    hindsight_wanted: bool = False  # also where most of the drive has none

    @classmethod
    def of(cls, *, logged: bool, hindsight_wanted: bool = False) -> GoalChoice:
        """Where goals and plans were not recorded, they come in hindsight."""
        return cls("logged" if logged else "hindsight", hindsight_wanted=hindsight_wanted)

    def tried(self, transitions: int, dropped: Mapping[str, int]) -> GoalChoice:
        """The choice after a trial: no goal where hindsight finds none for most of the drive, or,
        where it is wanted, for all but a few rows."""
        without = sum(count for why, count in dropped.items() if why.startswith(NO_MISSION))
        enough = self.hindsight_wanted and transitions >= MIN_ROWS
        if self.source != "hindsight" or without <= transitions or enough:
            return self
        return GoalChoice(
            None, f"in hindsight, {without:,} ticks have no goal and {transitions:,} have one"
        )

    def task_lines(self, length_m: float) -> list[str]:
        """What [task] says of it, for a robot of this length."""
        if self.source is None:
            why = f"; {self.why}" if self.why else ""
            progress = "progress is forward displacement"
            return [f'goal = "none"  # no goal and plan seen{why}: {progress}']
        lines = ['goal = "route"']
        if self.source == "hindsight":
            radius_m = min(max(length_m / 3, RADIUS_M[0]), RADIUS_M[1])
            lines.append(f"goal_radius_m = {round(radius_m, 2):g}  # a third of a robot's length")
        return lines

    def fallback(self, role: str) -> str:
        """What there is instead of `goal` or `plan`."""
        return HINDSIGHT[role] if self.source == "hindsight" else "progress without a goal"

    def table_lines(self) -> list[str]:
        """The [goal] of the profile, where it needs one."""
        if self.source != "hindsight":
            return []
        return [
            "[goal]  # no goal and plan seen",
            'source = "hindsight"  # where a drive stopped, turned back or passed often',
            "",
        ]
