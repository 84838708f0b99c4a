"""Topics to steps: every signal at every tick of the control clock, causally held.

What makes a tick unusable (an input that is stale, a plan for another goal, a value that is not
finite) is kept beside it as a reason, so that everything left out can be counted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from restock.ingest.containers.topic_reading import Fields
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import NS, ClockReport, LatestMessages, Samples
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.clearance import BEAMS, SECTORS, scan_reduction
from restock.ingest.steps.clocks import TopicClock, topic_clocks
from restock.ingest.steps.custom_columns import Custom, custom_signals
from restock.ingest.steps.routing import LARGEST, Routing, plan_ends, plan_problems, same_goals
from restock.ingest.task.perturbation_columns import Perturbed
from restock.ingest.task.signals import Signals, localised_velocity
from restock.ingest.task.task import nearest_action

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Steps:
    """Every tick of a recording (T of them), with all that is known at it."""

    signals: Signals  # every signal, leading axis T
    segment: Ints  # (T,) of the clock
    follows: Bools  # (T,) comes directly after the tick before, and both are usable
    break_reason: list[str]  # (T,) why it does not follow, or ""
    problem: list[str]  # (T,) why the tick is unusable whatever its route, or ""
    route_problem: list[str]  # (T,) why its route is unusable, or ""
    routing: Routing
    action: Ints  # (T,)
    residual: F64  # (T,) from the command to that action
    policy: list[str]  # (T,)
    policy_version: list[str | None]  # (T,)
    probability: list[float | None]  # (T,)
    truth: list[str | None]  # (T,) true condition, where a simulator said it
    perturbed: Perturbed  # (T,) a simulator's parameters in force
    clock: ClockReport
    commands_between: int  # commands that got no tick of their own
    custom: Custom  # the profile's own signals
    clocks: list[TopicClock] = field(default_factory=list)  # of each topic that was read
    notes: list[str] = field(default_factory=list)  # what else is worth saying

    def __len__(self) -> int:
        return len(self.segment)


def steps_of(profile: Profile, topics: Mapping[str, TopicColumns]) -> Steps:
    """All steps of a recording from its topics' columns (those `wanted_fields` asks for).

    Raises:
        RecordingError: the alignment clock is `header.stamp` and no topic has one, or a field is
            not what its input needs.
    """
    aligned = align_inputs(profile, topics)
    filled = fill_signals(aligned)
    filling, signals = filled.filling, filled.signals
    action, residual = nearest_action(
        profile.task, signals["command_speed_mps"], signals["command_yaw_rate_radps"]
    )
    policy, version, probability = filling.behaviour()
    perturbed = filling.perturbed()
    custom = custom_signals(aligned)
    return Steps(
        signals,
        filling.segment,
        filled.follows,
        filled.break_reason,
        list(filling.problem),
        list(filling.route_problem),
        filling.routing,
        action,
        residual,
        policy,
        version,
        probability,
        filling.truth(),
        perturbed,
        aligned.clock,
        aligned.commands_between,
        custom,
        topic_clocks(topics, profile.clock.jump_s),
        [*aligned.notes, *custom.notes, *perturbed.notes],
    )


class Filling:
    """Fills the signals of one recording. What is asked of it after `fill` is about its ticks."""

    def __init__(self, aligned: AlignedInputs) -> None:
        self.aligned, self.inputs = aligned, aligned.inputs
        self.profile, self.task = aligned.profile, aligned.profile.task
        self.tick_ns = np.concatenate(aligned.ticks)
        lengths = [len(stamps) for stamps in aligned.ticks]
        self.segment = np.repeat(np.arange(len(lengths)), lengths)
        self.problem = np.full(len(self.tick_ns), "", object)
        self.route_problem = np.full(len(self.tick_ns), "", object)
        self.signals: Signals = {"stamp_ns": self.tick_ns}
        self.routing = Routing.none(len(self.tick_ns))

    def fill(self) -> Signals:
        """Every signal but the localised velocity, which needs to know the tick before."""
        self._numbers(
            "command", speed_mps="command_speed_mps", yaw_rate_radps="command_yaw_rate_radps"
        )
        self._pose()
        self._numbers("wheels", speed_mps="wheel_speed_mps", yaw_rate_radps="wheel_yaw_rate_radps")
        if self.inputs.present("imu"):
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
        break_reason = np.full(count, "", object)
        if count:
            break_reason[0] = "start of the recording"
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
            break_reason[1:][bad & (break_reason[1:] == "")] = reason
        return np.asarray(break_reason == "", np.bool_), list(break_reason)

    def behaviour(self) -> tuple[list[str], list[str | None], list[float | None]]:
        """Who acted at each tick: policy, version, probability of the action."""
        count = len(self.tick_ns)
        default = self.profile.behaviour_policy
        if not self.inputs.present("behaviour_policy"):
            return [default] * count, [None] * count, [None] * count
        policies = [parse_policy(text) for text in self.inputs.texts("behaviour_policy")]
        latest = self.aligned.latest("behaviour_policy")
        rows = zip(latest.row, latest.fresh, strict=True)
        acted = [policies[row] if fresh else (default, None, None) for row, fresh in rows]
        return [a[0] for a in acted], [a[1] for a in acted], [a[2] for a in acted]

    def truth(self) -> list[str | None]:
        """The simulator's own condition at each tick: the message nearest to it."""
        if not self.inputs.present("true_condition"):
            return [None] * len(self.tick_ns)
        texts, latest = self.inputs.texts("true_condition"), self.aligned.latest("true_condition")
        rows = zip(latest.row, latest.fresh, strict=True)
        return [texts[row] if fresh else None for row, fresh in rows]

    def perturbed(self) -> Perturbed:
        """The simulator's parameters in force at each tick, and what could not be read."""
        if not self.inputs.present("perturbation"):
            return Perturbed.unknown(len(self.tick_ns))
        latest = self.aligned.latest("perturbation")
        row = np.where(latest.fresh, latest.row, -1).astype(np.int64)
        return Perturbed.read(self.inputs.texts("perturbation"), row)

    def _mark_invalid(self, bad: Bools, reason: str, *, route: bool = False) -> None:
        problems = self.route_problem if route else self.problem
        problems[bad & (problems == "")] = reason

    def _required(self, name: str, *, route: bool = False) -> LatestMessages:
        latest = self.aligned.latest(name)
        self._mark_invalid(~latest.known, f"{name}: not yet received", route=route)
        self._mark_invalid(~latest.fresh, f"{name}: stale", route=route)
        return latest

    def _numbers(self, name: str, **signal_of: str) -> None:
        """Fields of a required input straight into signals; 0 where the tick is unusable."""
        latest = self._required(name)
        for key, signal in signal_of.items():
            values = self.inputs.numbers(name, key)
            column = values[latest.row] if len(values) else np.zeros(len(latest.row))
            sane = np.abs(column) <= LARGEST  # False for NaN
            self._mark_invalid(~sane, f"{name}: not finite")
            self.signals[signal] = np.where(sane & latest.known, column, 0.0)

    def _pose(self) -> None:
        if self.inputs.present("pose"):
            self._numbers("pose", x_m="pose_x_m", y_m="pose_y_m", yaw_rad="pose_yaw_rad")
            self.signals["pose_stamp_ns"] = self.tick_ns - self.aligned.latest("pose").age_ns
            return
        tree = self.aligned.tree
        assert tree is not None  # the profile is refused otherwise
        at = tree.place(tree.frames.base, self.aligned.ticks)
        for reason in sorted(set(at.problem) - {""}):
            self._mark_invalid(at.problem == reason, f"pose: {reason}")
        x, y, _ = at.translation_m.T
        for signal, values in (("x_m", x), ("y_m", y), ("yaw_rad", at.yaw_rad)):
            sane = np.abs(values) <= LARGEST  # False for NaN
            self._mark_invalid(~sane, "pose: not finite")
            self.signals[f"pose_{signal}"] = np.where(sane & (at.problem == ""), values, 0.0)
        self.signals["pose_stamp_ns"] = at.stamp_ns

    def _scan(self) -> None:
        if not self.inputs.present("scan"):
            shape = len(self.tick_ns), self.task.sectors
            self.signals["sector_clearance_m"] = np.full(shape, float(self.task.range_max_m))
            self.signals["clearance_m"] = np.full(shape[0], float(self.task.range_max_m))
            return
        latest = self._required("scan")
        source = self.inputs.by_name["scan"]
        fields: Fields = self.inputs.topics[source.topic].fields
        if SECTORS not in fields:  # columns of whole scans, as no recording's reader gives them
            fields = scan_reduction(self.task, source.topic, source.fields).apply(fields)
        sectors = np.full((len(self.tick_ns), self.task.sectors), float(self.task.range_max_m))
        fresh = latest.fresh
        if fresh.any():
            rows = latest.row[fresh]
            beams = np.zeros(len(self.tick_ns), np.int64)
            beams[fresh] = np.asarray(fields[BEAMS])[rows]
            self._mark_invalid(fresh & (beams == 0), "scan: no beams")
            sectors[fresh] = np.asarray(fields[SECTORS])[rows]
        self.signals["sector_clearance_m"] = sectors
        self.signals["clearance_m"] = sectors.min(axis=1)

    def _bumper(self) -> None:
        bumped = [np.zeros(len(self.tick_ns), np.bool_)]
        source = self.inputs.present("bumper")
        if source is not None:
            self._required("bumper")
            pressed = self.inputs.numbers("bumper", "pressed") > 0
            bumped = [
                pressed_since(segment.topics[source.topic], pressed, ticks)
                for segment, ticks in zip(self.aligned.segments, self.aligned.ticks, strict=True)
            ]
        self.signals["bumped"] = np.concatenate(bumped)

    def _route(self) -> None:
        latest = {name: self._required(name, route=True) for name in ("goal", "plan")}
        goals, plans = self.inputs.goals, self.inputs.plans
        for name, one in latest.items():
            if name in self.inputs.placed:
                problems = np.where(one.known, self.inputs.placed[name].problem[one.row], "")
                for reason in sorted(set(problems) - {""}):
                    self._mark_invalid(problems == reason, f"{name}: {reason}", route=True)
        settings = self.profile.episodes
        goal, plan = (np.where(one.known, one.row, -1) for one in latest.values())
        if len(goals):
            goal = np.where(goal >= 0, same_goals(goals, settings.goal_moved_m)[goal], -1)
            sane = (np.abs(goals[goal]) <= LARGEST).all(axis=1)
            self._mark_invalid((goal >= 0) & ~sane, "goal: not finite", route=True)
        if len(plans):
            problems = np.array(plan_problems(plans), object)[plan]
            for reason in set(problems) - {""}:
                self._mark_invalid((plan >= 0) & (problems == reason), reason, route=True)
        usable = self.route_problem == ""
        if usable.any():
            away = np.linalg.norm(plan_ends(plans)[plan[usable]] - goals[goal[usable]], axis=-1)
            other = np.zeros(len(usable), np.bool_)
            other[usable] = away > settings.plan_goal_tolerance_m
            self._mark_invalid(other, "plan: for another goal", route=True)
        usable = self.route_problem == ""
        goal, plan = np.where(usable, goal, -1), np.where(usable, plan, -1)
        self.routing = Routing(goals, plans, goal, plan, latest["goal"].row.astype(np.int64))


def pressed_since(bumper: Samples, pressed: Bools, tick_ns: Ints) -> Bools:
    """Whether the bumper was pressed since the tick before (or is), (T,)."""
    if not len(bumper.row) or not len(tick_ns):
        return np.zeros(len(tick_ns), np.bool_)
    counts = np.concatenate([[0], np.cumsum(pressed[bumper.row])])
    upto = counts[np.searchsorted(bumper.stamp_ns, tick_ns, "right")]
    since = np.diff(upto, prepend=upto[:1])
    latest = bumper.hold(tick_ns, None)
    return (since > 0) | (pressed[latest.row] & latest.known)


def parse_policy(text: str) -> tuple[str, str | None, float | None]:
    """`{"policy": …, "version": …, "probability": …}`, or a bare name, to the three."""
    try:
        message = json.loads(text)
    except json.JSONDecodeError:
        return text.strip() or "unknown", None, None
    if not isinstance(message, dict):
        return str(message), None, None
    version, probability = message.get("version"), message.get("probability")
    return (
        str(message.get("policy", "unknown")),
        None if version is None else str(version),
        float(probability) if isinstance(probability, int | float) else None,
    )


@dataclass(frozen=True)
class Filled:
    """The signals at T ticks, and what is asked about them afterwards."""

    filling: Filling
    signals: Signals  # every signal, leading axis T
    follows: Bools  # (T,) comes directly after the tick before, and both are usable
    break_reason: list[str]  # (T,) why it does not follow, or ""


def fill_signals(aligned: AlignedInputs) -> Filled:
    """Every signal at every tick, from the latest messages at it."""
    filling = Filling(aligned)
    signals = filling.fill()
    follows, break_reason = filling.continuity()
    before = np.arange(len(follows)) - follows  # the tick before, or itself
    forward, lateral = localised_velocity(
        signals, {name: signals[name][before] for name in signals if name.startswith("pose_")}
    )
    signals |= {"localised_speed_mps": forward, "localised_lateral_mps": lateral}
    return Filled(filling, signals, follows, break_reason)
