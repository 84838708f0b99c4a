"""The steps of a recording: every tick of its control clock, with all that is known at it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.camera.frames import CameraFrames
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import ClockReport
from restock.ingest.steps.aligned_inputs import align_inputs
from restock.ingest.steps.clocks import TopicClock, topic_clocks
from restock.ingest.steps.consistency import Finding, findings_of
from restock.ingest.steps.custom_columns import Custom, custom_signals
from restock.ingest.steps.filling import Filling
from restock.ingest.steps.routing import Routing
from restock.ingest.task.perturbation_columns import Perturbed
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import nearest_action


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
    truth: list[str | None]  # (T,) true condition, where a simulator published it
    true_exposure: list[str | None]  # (T,) the same of exposures
    perturbed: Perturbed  # (T,) a simulator's parameters in force
    logged_ns: Ints  # (T,) log time
    clock: ClockReport
    commands_between: int  # commands that got no tick of their own
    custom: Custom  # the profile's own signals
    cameras: dict[str, CameraFrames] = field(default_factory=dict)
    clocks: list[TopicClock] = field(default_factory=list)  # of each topic that was read
    findings: list[Finding] = field(default_factory=list)  # what contradicts itself
    notes: list[str] = field(default_factory=list)  # for people
    stand_ins: dict[str, str] = field(default_factory=dict)  # of inputs that measured nothing

    def __len__(self) -> int:
        return len(self.segment)

    def without_values(self) -> Steps:
        """Keep what is known of the whole recording, and free what is known per tick."""
        ticks, flags = np.zeros(0, np.int64), np.zeros(0, np.bool_)
        return replace(
            self,
            signals={},
            segment=ticks,
            follows=flags,
            break_reason=[],
            problem=[],
            route_problem=[],
            routing=Routing.none(0),
            action=ticks,
            residual=np.zeros(0),
            policy=[],
            policy_version=[],
            probability=[],
            truth=[],
            true_exposure=[],
            perturbed=Perturbed.unknown(0),
            logged_ns=ticks,
        )


def steps_of(profile: Profile, topics: Mapping[str, TopicColumns]) -> Steps:
    """Make all steps of a recording from its topics' columns (those `wanted_fields` asks for).

    Raises:
        RecordingError: the alignment clock is `header.stamp` and no topic has one, or a field is
            not what its input needs.
    """
    clocks = topic_clocks(topics, profile.clock.jump_s)
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
        stand_ins=filling.stand_ins,
    )
