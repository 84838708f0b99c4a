"""Decisions that `restock start` makes between stages, from what the stages printed."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.cli.start.outcomes import Document, nominal_verdict
from restock.cli.start.stages import Settings
from restock.cli.start.work import FOLDER, StageResult
from restock.errors import counted
from restock.files import read_json

if TYPE_CHECKING:
    from restock.ingest.task.task import Task

STEPS_A_SECOND = 500  # steps of the twin on a free core, to plan the draws of a run
WARM_UP_PART = 0.5  # if rows are few: share of the allowed draws for offline updates
UPDATES_A_MINUTE = 400  # for logs alone: 2,000 updates take five minutes with all other stages
INTERVALS = 20  # a run without a twin records metrics at least this often
DRIVERS = "behaviour_policies"  # key of a coverage row: who drove
INSIDE = 0.5  # an outline with lidar returns inside it at more than this share of ticks is wrong


class Stop(Exception):
    """Raised if a person must decide; contains the reason, and what to type or to edit."""

    def __init__(self, why: str, *remedies: str) -> None:
        super().__init__(why)
        self.why, self.remedies = why, remedies


def edited(profile: Path | str | None, out: Path) -> bool:
    """Return whether a person edited the profile in the folder since it was proposed."""
    path, proposed = Path(str(profile)), out / FOLDER / "propose.json"
    if not path.is_file():
        return False
    return not proposed.is_file() or read_json(proposed)["toml"] != path.read_text("utf-8")


def several_kinds(kinds: list[Any], out: Path) -> Stop:
    """Build the `Stop` for recordings of several kinds of robots, with a command for each kind."""
    folders = [out, *(out.with_name(f"{out.name}-{n}") for n in range(2, len(kinds) + 1))]
    reported = [
        f"{counted(len(kind['recordings']), 'recording')} ({kind['robot']})" for kind in kinds
    ]
    calls = [
        f"restock start {shlex.join([*kind['recordings'], '--out', str(folder)])}"
        for kind, folder in zip(kinds, folders, strict=True)
    ]
    return Stop(
        f"these are recordings of {len(kinds)} kinds of robots, but a profile describes one kind: "
        f"{' | '.join(reported)}",
        *calls,
        f"or add --accept: recordings of the other kinds are left out of {out}",
    )


def proposal(out: Path) -> tuple[list[str], str | None]:
    """Return the recordings that a proposed profile leaves out, and the recording it is based on.

    Left out are recordings of other kinds of robots, and recordings that could not be read.
    """
    proposed = out / FOLDER / "propose.json"
    found = read_json(proposed) if proposed.is_file() else {}
    others = [path for kind in found.get("kinds", [])[1:] for path in kind["recordings"]]
    return [*others, *found.get("unreadable", [])], next(iter(found.get("read", [])), None)


def stop_for_outline(checked: Document, profile: Path | str | None) -> Stop | None:
    """Return a `Stop` if the lidar sees something inside the robot's outline most of the time."""
    inside, task = checked.get("inside_outline"), _task(profile)
    if task is None or inside is None or inside <= INSIDE:
        return None
    body = task.body
    size = f"{body.length_m:g} x {body.width_m:g} m"
    return Stop(
        f"the robot's outline ({size}) is wrong: the lidar sees something inside it at "
        f"{inside:.0%} of the ticks",
        f"measure the robot, edit length_m and width_m of [task.body] in {profile}, and run the"
        " same command again",
        "or add --accept to it, if the outline is right",
    )


def horizon(profile: Path | str | None) -> float:
    """Return the horizon for the twin's gap, in s: about 3 s, in whole control periods."""
    if (task := _task(profile)) is None:
        return 3.0
    period_s = task.control_period_s
    return round(max(round(3.0 / period_s), 1) * period_s, 6)


def has_goal(profile: Path | str | None) -> bool:
    """Return whether the task has a goal; without one, there is no success to compare."""
    task = _task(profile)
    return task is None or task.goal != "none"


def _task(profile: Path | str | None) -> Task | None:
    """Return the task of a profile; None if there is no profile yet."""
    from restock.ingest.profile.profile import load_profile

    if profile is None or (isinstance(profile, Path) and not profile.is_file()):
        return None
    return load_profile(str(profile)).task


NO_ROOM = "no mission fits on the floor that the recordings show"


def explain_mistrust(floor: StageResult, gap: StageResult) -> str | None:
    """Explain why the twin cannot be trusted in nominal driving; None if it can."""
    if not floor.good:
        return f"there is no floor to drive on: {'; '.join(floor.errors)}"
    if "nominal" not in floor.document["episodes"]:
        return NO_ROOM
    if not gap.good:
        return f"its gap to the logs cannot be measured: {'; '.join(gap.errors)}"
    verdict = nominal_verdict(gap.document)
    if verdict is None:
        return "these logs show no nominal driving"
    if verdict["verdict"] == "trusted":
        return None
    return f"in nominal driving it is {verdict['verdict']}: {'; '.join(verdict['reasons'])}"


def floor_settings(to: Settings, kinds: Collection[str]) -> list[str]:
    """Return settings to train on the floor with these kinds of missions; if empty, with all."""
    from restock.toml import toml_value
    from restock.train.twin.missions import DEFAULT_CONDITIONS

    settings = [f"env.layouts={to.floor}"]
    shares = {name: share for name, share in DEFAULT_CONDITIONS.items() if name in kinds}
    if kinds and len(shares) < len(DEFAULT_CONDITIONS):
        settings.append(f"env.conditions={toml_value(shares)}")
    return settings


def split_kinds(to: Settings, floor: Document) -> tuple[list[str], list[str]]:
    """Return the kinds of missions that fit on the floor: those to drive, and those to leave out.

    Without a lidar, some kinds are left out: the robot would find a block only by driving into it.
    """
    from restock.train.twin.missions import MISSIONS

    task, kinds = _task(to.profile), list(floor.get("episodes", []))
    if task is None or task.lidar:
        return kinds, []
    unseen = [kind for kind in kinds if MISSIONS[kind].needs_lidar]
    return [kind for kind in kinds if kind not in unseen], unseen


def logs_alone_settings(coverage: Document) -> list[str]:
    """Return settings to train without a twin, on actions that the logs' drivers may take."""
    from restock.toml import toml_value

    drivers = sorted({name for row in coverage.get("rows", []) for name in row[DRIVERS] or ()})
    return ["env.twin=false", "teacher.source=logs", f"teacher.policies={toml_value(drivers)}"]


def updates_settings(
    mix: Document, minutes: float, *, twin: bool, seconds: float = math.inf
) -> list[str]:
    """Return settings for as many offline updates as the panel's rows and the budget allow.

    `max_replays_per_row` limits the draws of a row. If rows are few, half of the draws are kept for
    training in the twin, and `env_steps` is the number of steps that fit into `seconds`. Without
    a twin, metrics are recorded often enough for `INTERVALS` points in each curve.
    """
    from restock.train.dqn.config import TrainConfig

    usual = TrainConfig()
    updates = usual.schedule.offline_updates
    settings = []
    if not twin:
        updates = max(round(UPDATES_A_MINUTE * minutes), INTERVALS)
    if (most := mix.get("max_replays_per_row")) is not None:
        allowed = mix["rows"] * most / usual.replay.batch_size
        plan = usual.schedule
        if twin and allowed < updates + plan.env_steps * plan.updates_per_env_step / 2:
            updates = min(updates, max(int(allowed * WARM_UP_PART), 1))
            steps = max(round(STEPS_A_SECOND * seconds), plan.warmup_env_steps)
            if steps < plan.env_steps:
                settings.append(f"schedule.env_steps={steps}")
        updates = min(updates, int(allowed))
    if updates != usual.schedule.offline_updates:
        settings.append(f"schedule.offline_updates={updates}")
    if not twin and updates < INTERVALS * usual.record.every_updates:
        settings.append(f"record.every_updates={max(updates // INTERVALS, 1)}")
    return settings
