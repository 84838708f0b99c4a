"""The signals at the ticks of a recording, filled input by input; a tick's first problem stays."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.containers.topic_reading import Fields
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import NS, Held, Samples, Segment
from restock.ingest.steps.clearance import BEAMS, SECTORS, scan_reduction
from restock.ingest.steps.frames import Tree
from restock.ingest.steps.routing import LARGEST, Routing, plan_ends, plan_problems, same_goals
from restock.ingest.steps.sources import Sources
from restock.ingest.task.perturbation_columns import Perturbed

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

# A handover is said on the tick it takes force; its message may arrive a moment later. Used for
# provenance alone, never for what the robot knew.
PROVENANCE_LEAD_S = 0.1


class Filling:
    """Fills the signals of one recording. What is asked of it after `fill` is about its ticks."""

    def __init__(
        self,
        profile: Profile,
        sources: Sources,
        segments: Sequence[Segment],
        ticks: Sequence[Ints],
        tree: Tree | None,
    ) -> None:
        self.tree = tree
        self.profile, self.task, self.sources = profile, profile.task, sources
        self.segments, self.ticks = segments, ticks
        self.tick_ns = np.concatenate(ticks)
        self.segment = np.repeat(np.arange(len(ticks)), [len(stamps) for stamps in ticks])
        self.problem = np.full(len(self.tick_ns), "", object)
        self.route_problem = np.full(len(self.tick_ns), "", object)
        self.signals: dict[str, NDArray[Any]] = {"stamp_ns": self.tick_ns}
        self.routing = Routing.none(len(self.tick_ns))

    def fill(self) -> dict[str, NDArray[Any]]:
        """Every signal but the localised velocity, which needs to know the tick before."""
        self._command()
        self._pose()
        self._numbers("wheels", speed_mps="wheel_speed_mps", yaw_rate_radps="wheel_yaw_rate_radps")
        if self.sources.present("imu"):
            self._numbers("imu", yaw_rate_radps="gyro_yaw_rate_radps", accel_x_mps2="accel_x_mps2")
        else:
            self.signals["gyro_yaw_rate_radps"] = self.signals["wheel_yaw_rate_radps"].copy()
            self.signals["accel_x_mps2"] = np.zeros(len(self.tick_ns))
        self._scan()
        self._bumper()
        if self.task.goal == "route":
            self._route()
        routing = self.routing
        self.signals |= routing.signals(self.task, routing.goal, routing.plan, self.signals)
        return self.signals

    def continuity(self) -> tuple[Bools, list[str]]:
        """Whether each tick follows the one before, and why not."""
        count = len(self.tick_ns)
        cut = np.full(count, "", object)
        if count:
            cut[0] = "start of the recording"
        x, y = self.signals["pose_x_m"], self.signals["pose_y_m"]
        jump = np.hypot(np.diff(x), np.diff(y)) > self.profile.episodes.max_pose_jump_m
        gap = np.diff(self.tick_ns) > round(self.profile.clock.max_gap_s * NS)
        unusable = (self.problem[1:] != "") | (self.problem[:-1] != "")
        for bad, reason in (
            (np.diff(self.segment) != 0, "clock jump"),
            (gap, "gap"),
            (unusable, "unusable step"),
            (jump, "pose jump"),
        ):
            cut[1:][bad & (cut[1:] == "")] = reason
        return np.asarray(cut == "", np.bool_), list(cut)

    def behaviour(self) -> tuple[list[str], list[str | None], list[float | None]]:
        """Who acted at each tick: policy, version, probability of the action."""
        count = len(self.tick_ns)
        default = self.profile.behaviour_policy
        if not self.sources.present("behaviour_policy"):
            return [default] * count, [None] * count, [None] * count
        said = [parse_policy(text) for text in self.sources.texts("behaviour_policy")]
        held = self._hold("behaviour_policy", lead_s=PROVENANCE_LEAD_S)
        rows = zip(held.row, held.fresh, strict=True)
        acted = [said[row] if known else (default, None, None) for row, known in rows]
        return [a[0] for a in acted], [a[1] for a in acted], [a[2] for a in acted]

    def truth(self) -> list[str | None]:
        """The simulator's own condition at each tick: the message nearest to it."""
        if not self.sources.present("true_condition"):
            return [None] * len(self.tick_ns)
        said = self.sources.texts("true_condition")
        held = self._hold("true_condition", lead_s=self.task.control_period_s / 2)
        rows = zip(held.row, held.fresh, strict=True)
        return [said[row] if known else None for row, known in rows]

    def perturbed(self) -> Perturbed:
        """The simulator's parameters in force at each tick, and what could not be read."""
        if not self.sources.present("perturbation"):
            return Perturbed.unknown(len(self.tick_ns))
        held = self._hold("perturbation", lead_s=PROVENANCE_LEAD_S)
        row = np.where(held.fresh, held.row, -1).astype(np.int64)
        return Perturbed.read(self.sources.texts("perturbation"), row)

    def _hold(self, name: str, *, lead_s: float = 0.0) -> Held:
        """An input's latest message at every tick (or a lead after it), segment by segment."""
        source = self.sources.inputs[name]
        lead_ns = round(lead_s * NS)
        parts = [
            segment.topics[source.topic].hold(ticks + lead_ns, source.max_age_s)
            for segment, ticks in zip(self.segments, self.ticks, strict=True)
        ]
        return Held(
            np.concatenate([part.row for part in parts]),
            np.concatenate([part.age_ns for part in parts]),
            np.concatenate([part.known for part in parts]),
            np.concatenate([part.fresh for part in parts]),
        )

    def _blame(self, bad: Bools, reason: str, *, route: bool = False) -> None:
        problems = self.route_problem if route else self.problem
        problems[bad & (problems == "")] = reason

    def _required(self, name: str, *, lead_s: float = 0.0, route: bool = False) -> Held:
        held = self._hold(name, lead_s=lead_s)
        self._blame(~held.known, f"{name}: not yet received", route=route)
        self._blame(~held.fresh, f"{name}: stale", route=route)
        return held

    def _numbers(self, name: str, *, lead_s: float = 0.0, **signal_of: str) -> None:
        """Fields of a required input straight into signals; 0 where the tick is unusable."""
        held = self._required(name, lead_s=lead_s)
        for key, signal in signal_of.items():
            values = self.sources.numbers(name, key)
            column = values[held.row] if len(values) else np.zeros(len(held.row))
            sane = np.abs(column) <= LARGEST  # False for NaN
            self._blame(~sane, f"{name}: not finite")
            self.signals[signal] = np.where(sane & held.known, column, 0.0)

    def _pose(self) -> None:
        if self.sources.present("pose"):
            self._numbers("pose", x_m="pose_x_m", y_m="pose_y_m", yaw_rad="pose_yaw_rad")
            self.signals["pose_stamp_ns"] = self.tick_ns - self._hold("pose").age_ns
            return
        assert self.tree is not None  # the profile is refused otherwise
        at = self.tree.place(self.tree.frames.base, self.ticks)
        for reason in sorted(set(at.problem) - {""}):
            self._blame(at.problem == reason, f"pose: {reason}")
        x, y, _ = at.translation_m.T
        for signal, values in (("x_m", x), ("y_m", y), ("yaw_rad", at.yaw_rad)):
            sane = np.abs(values) <= LARGEST  # False for NaN
            self._blame(~sane, "pose: not finite")
            self.signals[f"pose_{signal}"] = np.where(sane & (at.problem == ""), values, 0.0)
        self.signals["pose_stamp_ns"] = at.stamp_ns

    def _command(self) -> None:
        # At a fixed rate a command lands anywhere in the interval: the one in force for most of
        # it is the one in force at its middle. On the command clock it opens the interval.
        middle = self.task.control_period_s / 2 if self.profile.clock.steps == "rate" else 0.0
        self._numbers(
            "command",
            lead_s=middle,
            speed_mps="command_speed_mps",
            yaw_rate_radps="command_yaw_rate_radps",
        )

    def _scan(self) -> None:
        if not self.sources.present("scan"):
            shape = len(self.tick_ns), self.task.sectors
            self.signals["sector_clearance_m"] = np.full(shape, float(self.task.range_max_m))
            self.signals["clearance_m"] = np.full(shape[0], float(self.task.range_max_m))
            return
        held = self._required("scan")
        source = self.sources.inputs["scan"]
        fields: Fields = self.sources.topics[source.topic].fields
        if SECTORS not in fields:  # columns of whole scans, as no recording's reader gives them
            fields = scan_reduction(self.task, source.topic, source.fields).apply(fields)
        sectors = np.full((len(self.tick_ns), self.task.sectors), float(self.task.range_max_m))
        fresh = held.fresh
        if fresh.any():
            rows = held.row[fresh]
            beams = np.zeros(len(self.tick_ns), np.int64)
            beams[fresh] = np.asarray(fields[BEAMS])[rows]
            self._blame(fresh & (beams == 0), "scan: no beams")
            sectors[fresh] = np.asarray(fields[SECTORS])[rows]
        self.signals["sector_clearance_m"] = sectors
        self.signals["clearance_m"] = sectors.min(axis=1)

    def _bumper(self) -> None:
        bumped = [np.zeros(len(self.tick_ns), np.bool_)]
        source = self.sources.present("bumper")
        if source is not None:
            self._required("bumper")
            pressed = self.sources.numbers("bumper", "pressed") > 0
            bumped = [
                pressed_since(segment.topics[source.topic], pressed, ticks)
                for segment, ticks in zip(self.segments, self.ticks, strict=True)
            ]
        self.signals["bumped"] = np.concatenate(bumped)

    def _route(self) -> None:
        held_goal = self._required("goal", route=True)
        held_plan = self._required("plan", route=True)
        goals, plans = self.sources.goals, self.sources.plans
        for name, held in (("goal", held_goal), ("plan", held_plan)):
            if name in self.sources.placed:
                problems = np.where(held.known, self.sources.placed[name].problem[held.row], "")
                for reason in sorted(set(problems) - {""}):
                    self._blame(problems == reason, f"{name}: {reason}", route=True)
        settings = self.profile.episodes
        goal, plan = (np.where(held.known, held.row, -1) for held in (held_goal, held_plan))
        if len(goals):
            goal = np.where(goal >= 0, same_goals(goals, settings.goal_moved_m)[goal], -1)
            sane = (np.abs(goals[goal]) <= LARGEST).all(axis=1)
            self._blame((goal >= 0) & ~sane, "goal: not finite", route=True)
        if len(plans):
            problems = np.array(plan_problems(plans), object)[plan]
            for reason in set(problems) - {""}:
                self._blame((plan >= 0) & (problems == reason), reason, route=True)
        usable = self.route_problem == ""
        if usable.any():
            away = np.linalg.norm(plan_ends(plans)[plan[usable]] - goals[goal[usable]], axis=-1)
            other = np.zeros(len(usable), np.bool_)
            other[usable] = away > settings.plan_goal_tolerance_m
            self._blame(other, "plan: for another goal", route=True)
        usable = self.route_problem == ""
        goal, plan = np.where(usable, goal, -1), np.where(usable, plan, -1)
        self.routing = Routing(goals, plans, goal, plan, held_goal.row.astype(np.int64))


def pressed_since(bumper: Samples, pressed: Bools, tick_ns: Ints) -> Bools:
    """Whether the bumper was pressed since the tick before (or is), (T,)."""
    if not len(bumper.row) or not len(tick_ns):
        return np.zeros(len(tick_ns), np.bool_)
    counts = np.concatenate([[0], np.cumsum(pressed[bumper.row])])
    upto = counts[np.searchsorted(bumper.stamp_ns, tick_ns, "right")]
    since = np.diff(upto, prepend=upto[:1])
    held = bumper.hold(tick_ns, None)
    return (since > 0) | (pressed[held.row] & held.known)


def parse_policy(text: str) -> tuple[str, str | None, float | None]:
    """`{"policy": …, "version": …, "probability": …}`, or a bare name, to the three."""
    try:
        said = json.loads(text)
    except json.JSONDecodeError:
        return text.strip() or "unknown", None, None
    if not isinstance(said, dict):
        return str(said), None, None
    version, probability = said.get("version"), said.get("probability")
    return (
        str(said.get("policy", "unknown")),
        None if version is None else str(version),
        float(probability) if isinstance(probability, int | float) else None,
    )
