"""The steps of a recording, and their division into episodes.

A step is a tick of the recording's control clock, with all that is known at it. These events end an
episode:

- The goal is reached: **terminated**. Later steps belong to no episode, until there is another goal
  or the same goal is ordered again.
- A bump, if the task has `bump_terminates`: **terminated**, a protective stop. It lasts until the
  bumper has been free for RELEASE_S, and its steps belong to no episode. So a robot that scrapes
  along a rack has one bump there, and not an episode of one step for each touch.
- A new goal, a lost route, the time limit: **truncated** at the tick of the event. That tick ends
  the old episode, with the old goal and plan, and is the first of the next episode.
- A gap, a clock jump, a pose jump, an unusable tick, the end: **truncated** at the tick before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import BY_LOG_TIME, ClockReport
from restock.ingest.steps.aligned_inputs import align_inputs, fallbacks_used
from restock.ingest.steps.cameras import CameraFrames
from restock.ingest.steps.clocks import TopicClock, topic_clocks
from restock.ingest.steps.consistency import Finding, findings_of
from restock.ingest.steps.custom_columns import Custom, custom_signals
from restock.ingest.steps.filling import TOO_LARGE, Filling, Routing
from restock.ingest.task.schema import Perturbed
from restock.ingest.task.task import OBSERVED, Signals, Task, nearest_action, terminated
from restock.ingest.task.task_sql import observed_in_log


@dataclass(frozen=True)
class Steps:
    """The T ticks of a recording, with all that is known at them."""

    signals: Signals  # every signal, leading axis T
    segment: Ints  # (T,) index of the clock segment
    follows: Bools  # (T,) whether the tick directly follows the one before, and both are usable
    break_reason: list[str]  # (T,) why the tick does not follow, or ""
    problem: list[str]  # (T,) why the tick is unusable, apart from its route, or ""
    route_problem: list[str]  # (T,) why the tick's goal or plan is unusable, or ""
    routing: Routing
    action: Ints  # (T,) index of the action nearest to the command
    residual: F64  # (T,) distance of the command from `action`, scaled as in `nearest_action`
    policy: list[str]  # (T,) name of the behaviour policy, which drives
    policy_version: list[str | None]  # (T,) the policy's version; None: unknown
    probability: list[float | None]  # (T,) the policy's chance to choose the action; None: unknown
    truth: list[str | None]  # (T,) true conditions, if a simulator published them
    true_exposure: list[str | None]  # (T,) likewise for exposures
    perturbed: Perturbed  # (T,) a simulator's parameters in force
    logged_ns: Ints  # (T,) the tick's time as log time
    clock: ClockReport
    commands_between: int  # commands without a tick of their own
    custom: Custom  # the profile's custom signals
    cameras: dict[str, CameraFrames] = field(default_factory=dict)
    clocks: list[TopicClock] = field(default_factory=list)  # one per topic that was read
    findings: list[Finding] = field(default_factory=list)  # contradictions between topics
    notes: list[str] = field(default_factory=list)  # notes for the user
    stand_ins: dict[str, str] = field(default_factory=dict)  # what replaces missing inputs

    def __len__(self) -> int:
        return len(self.segment)


def steps_of(profile: Profile, topics: Mapping[str, TopicColumns]) -> Steps:
    """Compute all steps of a recording from its topics' columns (those of `wanted_fields`).

    Raises:
        RecordingError: as `align_inputs`, or a field does not have the type that its input needs.
    """
    clocks = topic_clocks(topics)
    aligned = align_inputs(profile, topics)
    filling = Filling(aligned)
    signals = filling.fill()
    action, residual = nearest_action(
        profile.task, signals["command_speed_mps"], signals["command_yaw_rate_radps"]
    )
    policies, perturbed = filling.behaviour(), filling.perturbed()
    custom = custom_signals(aligned)
    return Steps(
        signals,
        filling.segment,
        filling.follows,
        list(filling.break_reason),
        list(filling.problem),
        list(filling.route_problem),
        filling.routing,
        action,
        residual,
        [policy for policy, _, _ in policies],
        [version for _, version, _ in policies],
        [probability for _, _, probability in policies],
        filling.texts("true_condition"),
        filling.texts("true_exposure"),
        perturbed,
        np.concatenate(
            [
                segment.clock_map.logged(stamps)
                for segment, stamps in zip(aligned.segments, aligned.ticks, strict=True)
            ]
        ),
        aligned.clock,
        aligned.commands_between,
        custom,
        aligned.camera_frames(),
        clocks,
        findings_of(aligned, signals, filling.segment, list(filling.problem)),
        [*aligned.notes, *filling.notes, *custom.notes, *perturbed.notes],
        stand_ins=fallbacks_used(profile, topics) | filling.stand_ins,
    )


FAR = (
    "they may be UTM coordinates, which a store would round to decimetres: set `origin_m = [X, Y]` "
    "at the top of the profile, a point near the robot (`restock profile new` proposes one)"
)
RELEASE_S = 1.0  # how long the bumper must be free before the next episode


@dataclass(frozen=True)
class EpisodeSpan:
    """An episode: ticks `first` to `last`, both included; the last tick only ends it."""

    first: int
    last: int
    terminated: bool
    ended_by: str
    shared: bool  # whether the last tick counts again: it begins an episode, or is dropped


@dataclass(frozen=True)
class Split:
    """Episodes of a recording, and the number of ticks outside of them, by reason.

    ticks = transitions + episode ends that are not shared + dropped.
    """

    episodes: list[EpisodeSpan]
    dropped: dict[str, int]

    @property
    def transitions(self) -> int:
        return sum(episode.last - episode.first for episode in self.episodes)

    @property
    def ends(self) -> int:
        """Count the ticks that only end an episode."""
        return sum(not episode.shared for episode in self.episodes)


def split(task: Task, steps: Steps) -> Split:
    """Split a recording's steps into episodes."""
    changed, routing = changed_route(steps), steps.routing
    old_route = np.zeros(len(steps), np.bool_)
    if len(changed):  # these ticks may end an episode that has the route of the tick before
        goal, plan = routing.goal[changed - 1], routing.plan[changed - 1]
        old_route[changed] = terminated(task, with_route(task, steps, changed, goal, plan))
    return _Walk(task, steps, terminated(task, steps.signals), old_route).walk()


def explain_no_transitions(steps: Steps, episodes: Split) -> tuple[str, str | None]:
    """Return why a recording has no transition, and the remedy if one is known."""
    reasons = sorted(episodes.dropped.items(), key=lambda item: -item[1])
    why = [f"{reason}: {count} of {len(steps)} ticks" for reason, count in reasons]
    off = steps.clock.off_clock
    mostly = [one for one in steps.clocks if off.get(one.topic, 0) > one.messages / 2]
    if not len(steps):
        command = "no command whose time is usable" if mostly else "no command"
        why = [f"it contains {command}, so there are no steps"]
    for one in mostly:
        zero = f", {one.zero_stamps:,} are zero" if one.zero_stamps else ""
        why.append(
            f"{off[one.topic]:,} of {one.messages:,} messages of {one.topic} were left out: their "
            f"header stamps do not fit the clock{zero}"
        )
    remedy = FAR if reasons and reasons[0][0] == f"pose: {TOO_LARGE}" else None
    return "; ".join(why), BY_LOG_TIME if mostly else remedy


def changed_route(steps: Steps) -> Ints:
    """Return the ticks at which the goal of the tick before is replaced or lost."""
    goal = steps.routing.goal
    changed = np.flatnonzero(steps.follows[1:] & (goal[1:] != goal[:-1])) + 1
    return changed[goal[changed - 1] >= 0]


def with_route(task: Task, steps: Steps, ticks: Ints, goal: Ints, plan: Ints) -> Signals:
    """Return the signals at ticks (n,) as if `goal` and `plan` (n,) were in force."""
    now = {name: column[ticks] for name, column in steps.signals.items()}
    now |= steps.routing.signals(task, goal, plan, now)
    if task.observed:
        now[OBSERVED] = observed_in_log(task, steps.signals, steps.follows, ticks, now)
    return now


def protective_stop(task: Task, steps: Steps) -> Bools:
    """Return which ticks (T,) are within RELEASE_S after a bump, if bumps terminate episodes."""
    pressed = steps.signals["bumped"].astype(np.bool_) & task.bump_terminates
    latest = np.maximum.accumulate(np.where(pressed, np.arange(len(steps)), -1))
    stamp_ns = steps.signals["stamp_ns"]
    since_s = (stamp_ns - stamp_ns[latest]) * 1e-9
    until_s = RELEASE_S - task.control_period_s / 2  # half a period less, as stamps jitter
    return (latest >= 0) & (since_s >= 0) & (since_s < until_s)


class _Walk:
    """One pass over the ticks in order, which opens and closes episodes."""

    def __init__(self, task: Task, steps: Steps, terminated: Bools, old_route: Bools) -> None:
        self.task, self.steps = task, steps
        self.terminated = terminated  # (T,) whether an episode terminates at the tick
        self.old_route_terminated = old_route  # (T,) likewise, for the route of the tick before
        self.goal = steps.routing.goal.tolist()
        self.order = steps.routing.order.tolist()
        self.episodes: list[EpisodeSpan] = []
        self.dropped: Counter[str] = Counter()
        self.stopped = protective_stop(task, steps).tolist()
        self.first: int | None = None  # first tick of the open episode
        self.done_with: tuple[int, int] | None = None  # goal reached last, and its message

    def walk(self) -> Split:
        follows = self.steps.follows.tolist()
        for tick in range(len(self.steps)):
            if self.first is None or not self._continues(tick, self.first, follows[tick]):
                self._begin(tick)
        if self.first is not None:
            self._close(len(self.steps) - 1, "end of the recording")
        return Split(self.episodes, dict(self.dropped))

    def _continues(self, tick: int, first: int, follows: bool) -> bool:
        """Return whether the open episode takes this tick; close the episode if it ends here."""
        if not follows:
            self._close(tick - 1, self.steps.problem[tick] or self.steps.break_reason[tick])
            return False
        if self.goal[tick] != self.goal[first]:
            terminated = bool(self.old_route_terminated[tick])
            bump = self.task.bump_terminates and self.steps.signals["bumped"][tick]
            if terminated:
                reason = "bump" if bump else "goal"
            else:
                reason = "new goal" if self.goal[tick] >= 0 else "no route"
            self._close(tick, reason, terminated=terminated, shared=True)
            return False
        if self.terminated[tick]:
            reached = self._at_goal(tick)
            self.done_with = (self.goal[tick], self.order[tick]) if reached else None
            self._close(tick, "goal" if reached else "bump", terminated=True)
            return True
        if tick - first >= self.task.time_limit_steps:
            self._close(tick, "time limit", shared=True)
            return False
        return True

    def _begin(self, tick: int) -> None:
        """Open an episode at this tick, or drop the tick."""
        goal = self.goal[tick]
        problem = self.steps.problem[tick] or self.steps.route_problem[tick]
        if problem:
            self.dropped[problem] += 1
            return
        if self.stopped[tick]:
            self.dropped[f"bumper: pressed within the last {RELEASE_S:g} s"] += 1
            return
        wanted = (goal, self.order[tick])
        if goal >= 0 and (wanted == self.done_with or self._at_goal(tick)):
            self.done_with = wanted
            self.dropped["goal already reached"] += 1
            return
        self.done_with, self.first = None, tick

    def _at_goal(self, tick: int) -> bool:
        distance = self.steps.signals["goal_distance_m"][tick]
        return self.goal[tick] >= 0 and bool(distance <= self.task.goal_radius_m)

    def _close(
        self, last: int, ended_by: str, *, terminated: bool = False, shared: bool = False
    ) -> None:
        assert self.first is not None
        if last == self.first:
            self.dropped["a single step between two cuts"] += 1
        else:
            self.episodes.append(EpisodeSpan(self.first, last, terminated, ended_by, shared))
        self.first = None
