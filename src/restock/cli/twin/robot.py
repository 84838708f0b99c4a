"""`restock twin robot`: builds the robot of a profile in the twin, and tests how it drives."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated

from restock.cli import output
from restock.cli.words import Positional

FRICTION = 0.8  # coefficient of the floor


@dataclass
class RobotCommand:
    """Build the robot of a profile's [robot] in the twin, and test how it drives each action.

    See docs/robot.md.

    Example: `restock twin robot my_robot.toml`
    """

    profile: Annotated[str, Positional("PROFILE")]
    """A profile: a TOML file, or the name of a shipped profile."""
    json: bool = False
    """Print JSON: {"robot": {drive, wheel_radius_m, …}, "driven": [{action, friction,
    speed_mps, yaw_rate_radps, driven_mps, driven_radps}], "lidar_passes_over": […], "outside": […]
    (parts outside the outline)}."""

    def run(self) -> int:
        """Build the robot, drive every action and print the results."""
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.task.robot import refuse_beyond_steering
        from restock.train.twin.physics.model import (
            TIMESTEP_S,
            describe_model,
            describe_outline,
            drive_actions,
            find_overhangs,
            passed_over,
            robot_model,
        )
        from restock.train.twin.physics.simulation import blocks_of

        profile = load_profile(self.profile)
        refuse_beyond_steering(profile.robot, profile.task.actions, where=self.profile)
        blocks_of(profile.task, TIMESTEP_S)  # refuses a period that the twin cannot simulate
        model = robot_model(profile.robot, profile.task.body)
        facts = describe_outline(profile.task.body) + describe_model(model, profile.robot)
        beyond = find_overhangs(model, profile.task.body)
        driven = [
            {"action": name, "friction": FRICTION, **row}
            for name, row in zip(
                profile.task.action_names,
                drive_actions(model, profile.task.actions, FRICTION),
                strict=True,
            )
        ]
        unseen = passed_over(model.lidar_z_m) if profile.task.lidar else []
        if self.json:
            values = {name: value for name, value, _ in facts}
            document = {"robot": values, "driven": driven, "lidar_passes_over": unseen}
            output.print_json(document | {"outside": beyond})
            return 0
        rows = [{"": n, "value": value, "from": origin} for n, value, origin in facts]
        output.print_table(rows, title=f"{self.profile}: the robot in the twin")
        sys.stdout.write("\n")
        output.print_table(driven, title="Steady motion for each action")
        for line in beyond:
            sys.stdout.write(f"\nCHECK: {line}\n")
        if unseen:
            over = ", ".join(unseen)
            sys.stdout.write(
                f"\nIts lidar, {model.lidar_z_m:g} m above the floor, passes over {over}: the robot"
                " never sees them\n"
            )
        return 0
