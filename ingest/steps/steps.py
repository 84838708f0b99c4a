"""Topics to steps: every signal at every tick of the control clock, causally held.

What makes a tick unusable (an input that is stale, a plan for another goal, a value that is not
finite) is kept beside it as a reason, so that everything left out can be counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import ClockReport, Segment, align, ticks_of
from restock.ingest.steps.clocks import TopicClock, topic_clocks
from restock.ingest.steps.custom_columns import Custom, custom_signals
from restock.ingest.steps.filling import Filling
from restock.ingest.steps.frames import Tree
from restock.ingest.steps.routing import Routing
from restock.ingest.steps.sources import Sources, frame_notes, place_messages, transforms_of
from restock.ingest.task.perturbation_columns import Perturbed
from restock.ingest.task.signals import localised_velocity
from restock.ingest.task.task import nearest_action

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Steps:
    """Every tick of a recording (T of them), with all that is known at it."""

    signals: dict[str, NDArray[Any]]  # every signal, leading axis T
    segment: Ints  # (T,) of the clock
    follows: Bools  # (T,) comes directly after the tick before, and both are usable
    cut: list[str]  # (T,) why it does not follow, or ""
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
    sources = Sources(profile, topics)
    edges = transforms_of(profile, sources)
    ages = [(source.topic, source.max_age_s) for source in sources.inputs.values()]
    ages += [(signal.topic, signal.max_age_s) for signal in profile.signals.values()]
    latched = {topic for topic, age in ages if age is None}
    latched -= {topic for topic, age in ages if age is not None}
    segments, report = align(
        {**topics, **edges.topics},
        profile.clock,
        edges.static.union(latched),
        frozenset(edges.topics),
    )
    ticks, between = [], 0
    for segment in segments:
        end = max((int(s.stamp_ns[-1]) for s in segment.topics.values() if len(s.row)), default=0)
        command = segment.topics[profile.inputs.command.topic]
        stamps, extra = ticks_of(command, profile.clock, profile.task.control_period_s, end)
        ticks.append(stamps)
        between += extra
    tree = Tree(profile.frames, edges, segments) if profile.frames else None
    if tree is not None:
        place_messages(sources, tree, segments)
    filled = fill_signals(profile, sources, segments, ticks, tree)
    filling, signals = filled.filling, filled.signals
    action, residual = nearest_action(
        profile.task, signals["command_speed_mps"], signals["command_yaw_rate_radps"]
    )
    policy, version, probability = filling.behaviour()
    perturbed = filling.perturbed()
    custom = custom_signals(profile.signals, topics, segments, ticks)
    return Steps(
        signals,
        filling.segment,
        filled.follows,
        filled.cut,
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
        report,
        between,
        custom,
        topic_clocks(topics, profile.clock.jump_s),
        frame_notes(profile, sources, edges) + custom.notes + perturbed.notes,
    )


@dataclass(frozen=True)
class Filled:
    """The signals at T ticks, and what is asked about them afterwards."""

    filling: Filling
    signals: dict[str, NDArray[Any]]  # every signal, leading axis T
    follows: Bools  # (T,) comes directly after the tick before, and both are usable
    cut: list[str]  # (T,) why it does not follow, or ""


def fill_signals(
    profile: Profile,
    sources: Sources,
    segments: Sequence[Segment],
    ticks: Sequence[Ints],
    tree: Tree | None,
) -> Filled:
    """Every signal at the ticks of each segment, from the messages held at them."""
    filling = Filling(profile, sources, segments, ticks, tree)
    signals = filling.fill()
    follows, cut = filling.continuity()
    before = np.arange(len(follows)) - follows  # the tick before, or itself
    forward, lateral = localised_velocity(
        signals, {name: signals[name][before] for name in signals if name.startswith("pose_")}
    )
    signals |= {"localised_speed_mps": forward, "localised_lateral_mps": lateral}
    return Filled(filling, signals, follows, cut)
