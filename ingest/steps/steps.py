"""Topics to steps: every signal at every tick of the control clock, causally held.

What makes a tick unusable (an input that is stale, a plan for another goal, a value that is not
finite) is kept beside it as a reason, so that everything left out can be counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import ClockReport
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.clocks import TopicClock, topic_clocks
from restock.ingest.steps.custom_columns import Custom, custom_signals
from restock.ingest.steps.filling import Filling
from restock.ingest.steps.routing import Routing
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
        aligned.clock,
        aligned.commands_between,
        custom,
        topic_clocks(topics, profile.clock.jump_s),
        [*aligned.notes, *custom.notes, *perturbed.notes],
    )


@dataclass(frozen=True)
class Filled:
    """The signals at T ticks, and what is asked about them afterwards."""

    filling: Filling
    signals: dict[str, NDArray[Any]]  # every signal, leading axis T
    follows: Bools  # (T,) comes directly after the tick before, and both are usable
    cut: list[str]  # (T,) why it does not follow, or ""


def fill_signals(aligned: AlignedInputs) -> Filled:
    """Every signal at every tick, from the latest messages at it."""
    filling = Filling(aligned)
    signals = filling.fill()
    follows, cut = filling.continuity()
    before = np.arange(len(follows)) - follows  # the tick before, or itself
    forward, lateral = localised_velocity(
        signals, {name: signals[name][before] for name in signals if name.startswith("pose_")}
    )
    signals |= {"localised_speed_mps": forward, "localised_lateral_mps": lateral}
    return Filled(filling, signals, follows, cut)
