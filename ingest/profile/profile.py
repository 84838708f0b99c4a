"""Profiles: how one kind of robot's topics fill the signals, and the task that is learnt on them.

A profile is a TOML file: `name`, the shipped `conditions` and `exposures` it uses, `[[condition]]`
of its own, `[task]`, `[goal]` (logged, or in hindsight), `[clock]`, `[episodes]`, `[inputs.*]`
(which topic fills what), `[command_sources.*]` (whose command it may be), `[frames]` (poses from
transforms), `origin_m` (of positions), `[motion]` (speeds from poses), `[signals.*]` (custom
columns), `[cameras.*]` (frames that are kept), `[tags]` (whose drive it is), `[robot]` (what the
twin builds), `[limiter]` (of a policy's commands) and `[[zone]]` (named rectangles of the map).
`load_profile("warehouse_amr")` reads one that comes with Restock, `load_profile("my_robot.toml")`
one of yours.

Stores, panels and runs carry a profile as one TOML text that needs no other file (`profile_toml`):
the SQL of each `[[condition]]` that was a file is in it, and shipped conditions stay names. The
text may come from a stranger, and is read as a profile file is: values are checked by type, SQL
runs in the same sandbox, and no file is opened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.profile.checks import check_profile
from restock.ingest.profile.custom_signal import CustomSignal
from restock.ingest.profile.inputs import (
    COMMAND_FALLBACK,
    COMMAND_SOURCES,
    COMMAND_THROUGH,
    FALLBACKS,
    FIX_FALLBACK,
    FIX_SETTINGS,
    HINDSIGHT,
    POLICY_FALLBACK,
    POSE_FALLBACK,
    ROUTE_FALLBACK,
    SCAN_SETTINGS,
    SCANS,
    STEERED,
    WHEELS_FALLBACK,
    Input,
    Inputs,
    is_motion,
)
from restock.ingest.profile.robot_file import with_robot_file
from restock.ingest.profile.tables import Camera, Clock, Episodes, Frames, Motion, Zone
from restock.ingest.profile.tag_rules import TagRules
from restock.ingest.task.condition_files import shipped, with_files
from restock.ingest.task.conditions import Condition, Kind, labels_version, of_kind
from restock.ingest.task.hindsight import GoalRules, GoalSource
from restock.ingest.task.limiter import Limiter
from restock.ingest.task.robot import Robot, refuse_beyond_steering
from restock.ingest.task.signals import Noise
from restock.ingest.task.task import Task
from restock.toml import Checked, parse_toml, read_toml, toml_value, typed

ELSEWHERE = "elsewhere"


class Profile(Checked, frozen=True):
    """One kind of robot. Read with `load_profile`."""

    name: str
    task: Task
    inputs: Inputs
    doc: str = ""
    goal: GoalRules = GoalRules()
    shipped_conditions: list[str] = msgspec.field(default_factory=list, name="conditions")
    shipped_exposures: list[str] = msgspec.field(default_factory=list, name="exposures")
    own_conditions: list[Condition] = msgspec.field(default_factory=list, name="condition")
    behaviour_policy: str = "unknown"  # the driver, if no topic tells
    # Behaviour policy -> its commands (of a person, of navigation) before one is chosen to drive.
    command_sources: dict[str, Input] = msgspec.field(default_factory=dict)
    # The topic that was chosen among them, if the command is that one smoothed or limited: who
    # drives is the source whose command it repeats.
    command_through: Input | None = None
    clock: Clock = Clock()
    episodes: Episodes = Episodes()
    zones: list[Zone] = msgspec.field(default_factory=list, name="zone")
    # Subtracted from poses, goals and plans, which are in metres: UTM coordinates, for example.
    origin_m: tuple[float, float] | None = None
    frames: Frames | None = None
    motion: Motion | None = None
    signals: dict[str, CustomSignal] = msgspec.field(default_factory=dict)
    cameras: dict[str, Camera] = msgspec.field(default_factory=dict)
    tags: TagRules = TagRules()
    noise: Noise = Noise()
    robot: Robot | None = None  # None: the twin's default robot
    limiter: Limiter | None = None  # limits a policy's commands; None: by outline and actions

    @property
    def conditions(self) -> list[Condition]:
        """Return the conditions that label this robot's steps: outcomes."""
        return self._of("outcome", self.shipped_conditions)

    @property
    def exposures(self) -> list[Condition]:
        """Return the situations that are listed beside them."""
        return self._of("exposure", self.shipped_exposures)

    @property
    def constants(self) -> dict[str, float]:
        """Return the names that the SQL of its conditions may use beside the columns of steps."""
        return self.noise.constants | self.task.condition_limits

    def _of(self, kind: Kind, names: Sequence[str]) -> list[Condition]:
        known = shipped(self.constants, kind)
        own = of_kind(self.own_conditions, kind)
        constants = self.constants
        return [known[name] for name in names] + [one.with_constants(constants) for one in own]

    @property
    def definitions(self) -> list[Condition]:
        """Return both, conditions first."""
        return [*self.conditions, *self.exposures]

    @property
    def labels_version(self) -> str:
        return labels_version(self.definitions)

    @property
    def hash(self) -> str:
        """Return 12 hex digits of everything in the profile that rows depend on.

        That leaves out conditions, which can be changed without the recordings (labels depend on
        `labels_version`), their [noise], whose drive it is, and what only the twin needs of it.
        """
        without = msgspec.structs.replace(
            self, shipped_conditions=[], shipped_exposures=[], own_conditions=[]
        )
        values = msgspec.to_builtins(without)
        apart = {"tags", "noise", "robot", "limiter"}
        if self.goal == GoalRules():  # rows are as before there was such a table
            apart |= {"goal"}
        if self.motion is None:
            apart |= {"motion"}
        apart |= {name for name in ("command_sources", "cameras") if not values[name]}
        for signal in values["signals"].values():
            if signal["length"] is None:
                del signal["length"]
        for source in values["command_sources"].values():
            for key in (*SCAN_SETTINGS, *FIX_SETTINGS):
                del source[key]
        apart |= {name for name in ("command_through", "origin_m") if values[name] is None}
        for name in ("heading", *SCANS[1:]):
            if values["inputs"][name] is None:
                del values["inputs"][name]
        for source in filter(None, values["inputs"].values()):
            for key in ("stop_holds", "wheelbase_m", *SCAN_SETTINGS, *FIX_SETTINGS):
                if not source[key]:
                    del source[key]
        rest = {key: value for key, value in values.items() if key not in apart}
        return hashlib.blake2b(msgspec.json.encode(rest), digest_size=6).hexdigest()

    @property
    def transform_topics(self) -> tuple[str, ...]:
        """Return the topics of the transforms that `[frames]` needs."""
        return (self.frames.topic, self.frames.static_topic) if self.frames else ()

    @property
    def sources(self) -> dict[str, Input]:
        """Return the inputs, and the sources of commands as `command_sources.NAME`.

        Sources are optional, as are goal and plan if the task has no goal.
        """
        optional = {
            name: msgspec.structs.replace(source, optional=True)
            for name, source in self.inputs.items()
            if name in ("goal", "plan") and self.task.goal == "none"
        }
        optional |= {
            f"{COMMAND_SOURCES}.{name}": msgspec.structs.replace(source, optional=True)
            for name, source in self.command_sources.items()
        }
        if self.command_through is not None:
            optional[COMMAND_THROUGH] = msgspec.structs.replace(self.command_through, optional=True)
        return dict(self.inputs.items()) | optional

    @property
    def topics(self) -> list[str]:
        """Return every topic that the profile names."""
        named = [source.topic for source in self.sources.values()]
        named += [signal.topic for signal in self.signals.values()]
        named += [camera.topic for camera in self.cameras.values()]
        return list(dict.fromkeys([*named, *self.transform_topics]))

    @property
    def fallbacks(self) -> dict[str, str]:
        """Return what is used instead of each input that the profile leaves out."""
        given = dict(self.inputs.items())
        fallbacks = {name: how for name, how in FALLBACKS.items() if name not in given}
        if is_motion(self.inputs.command.type):
            fallbacks["command"] = COMMAND_FALLBACK.format(topic=self.inputs.command.topic)
        for name, source in given.items():
            if source.wheelbase_m is not None:
                how = STEERED.format(wheelbase_m=source.wheelbase_m, topic=source.topic)
                fallbacks[f"{name}.yaw_rate_radps"] = how
        if self.command_sources and "behaviour_policy" in fallbacks:
            names = ", ".join(self.command_sources)
            if (through := self.command_through) is not None:
                names += f" (the one that {through.topic} repeats, which the command follows)"
            fallbacks["behaviour_policy"] = POLICY_FALLBACK.format(names=names)
        if self.inputs.pose is None:
            fallbacks["pose"] = POSE_FALLBACK
        elif self.inputs.pose.by_fix and self.inputs.heading is None:
            fallbacks["heading"] = FIX_FALLBACK.format(track_m=self.inputs.pose.track_m or 1.0)
        if self.motion is not None:
            fallbacks["wheels"] = WHEELS_FALLBACK.format(window_s=self.motion.window_s)
        if self.task.goal == "none":
            fallbacks |= dict.fromkeys(("goal", "plan"), ROUTE_FALLBACK)
        elif self.goal.source == "hindsight":
            fallbacks |= HINDSIGHT
        return fallbacks

    @property
    def goal_source(self) -> GoalSource | None:
        """Return where the goals of its rows come from; None if they have none."""
        return self.goal.source if self.task.goal == "route" else None

    def zone_of(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> list[str]:
        """Return the name of the first zone that holds each point (N,), or `elsewhere`."""
        x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        index = np.full(x.shape, len(self.zones), np.intp)
        for position in reversed(range(len(self.zones))):
            index[self.zones[position].holds(x, y)] = position
        names = [zone.name for zone in self.zones] + [ELSEWHERE]
        return [names[position] for position in index]


def shipped_profiles() -> list[str]:
    """Return the names of the profiles that come with Restock."""
    folder = files("restock.ingest.profile") / "profiles"
    return sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name[-5:] == ".toml")


def load_profile(name_or_path: str | Path) -> Profile:
    """Load a shipped profile by its name, or one of yours by its path.

    Raises:
        ConfigError: no such profile, or its TOML says something Restock cannot use; names the
            file and the key.
    """
    where = str(name_or_path)
    if where in (names := shipped_profiles()):
        text = (files("restock.ingest.profile") / "profiles" / f"{where}.toml").read_text("utf-8")
        return parse_profile(text, where=f"profile {where!r}")
    path = Path(name_or_path)
    if not path.is_file():
        near = get_close_matches(where, names, n=1)
        raise ConfigError(
            "there is no such profile: it is neither a file nor the name of a shipped profile",
            where=where,
            remedy=f"did you mean {near[0]!r}?"
            if near
            else f"the shipped profiles are: {', '.join(names)}",
        )
    profile = _typed(read_toml(path), where=where, folder=path.parent)
    refuse_beyond_steering(profile.robot, profile.task.actions, where=where)
    return profile


def parse_profile(text: str, *, where: str, folder: Path | None = None) -> Profile:
    """Parse a profile from its TOML text.

    `where` names it in errors, `.sql` files lie in `folder`.
    """
    return _typed(parse_toml(text, where=where), where=where, folder=folder)


def _typed(document: dict[str, Any], *, where: str, folder: Path | None) -> Profile:
    document = with_robot_file(with_files(document, folder, where), folder, where)
    signals = document.get("signals")
    # Each by itself first: msgspec's paths leave out the keys of a table of tables.
    for name, table in signals.items() if isinstance(signals, dict) else ():
        typed(table, CustomSignal, where=where, prefix=f"signals.{name}")
    cameras = document.get("cameras")
    for name, table in cameras.items() if isinstance(cameras, dict) else ():
        typed(table, Camera, where=where, prefix=f"cameras.{name}")
    profile = typed(document, Profile, where=where)
    if not profile.inputs.scans:
        profile = without_lidar(profile)  # whatever number of sectors it gives
    check_profile(profile, where)
    return profile


def without_lidar(profile: Profile) -> Profile:
    """Return the profile of the same robot without a lidar: without scans and sectors."""
    return msgspec.structs.replace(
        profile,
        inputs=msgspec.structs.replace(profile.inputs, **dict.fromkeys(SCANS)),
        task=msgspec.structs.replace(profile.task, sectors=0),
    )


def profile_toml(profile: Profile) -> str:
    """Write the profile as TOML with every default; `read_profile_toml` gives an equal one."""
    values = _given(msgspec.to_builtins(profile))
    plain, tables = [], []
    for name, value in values.items():
        if isinstance(value, dict):
            tables += ["", f"[{name}]", *_lines(value)]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                tables += ["", f"[[{name}]]", *_lines(entry)]
        else:
            plain += _lines({name: value})
    return "\n".join([*plain, *tables]) + "\n"


def read_profile_toml(text: str, *, where: str) -> Profile:
    """Read a profile from such a text; `where` names it in errors.

    Raises:
        ConfigError: as `parse_profile`, also where the text names a file.
    """
    return parse_profile(text, where=where, folder=None)


def with_conditions(profile: Profile, conditions: Sequence[Condition]) -> Profile:
    """Return the profile with other conditions; those that come with Restock go by their names."""
    known = shipped(profile.constants) | shipped(profile.constants, "exposure")
    named = [c for c in conditions if known.get(c.name) == c]
    return msgspec.structs.replace(
        profile,
        shipped_conditions=[c.name for c in of_kind(named, "outcome")],
        shipped_exposures=[c.name for c in of_kind(named, "exposure")],
        own_conditions=[c for c in conditions if c not in named],
    )


def _given(value: Any) -> Any:
    """Return plain values without None, which TOML lacks and which is always the default."""
    if isinstance(value, dict):
        return {key: _given(item) for key, item in value.items() if item is not None}
    return [_given(item) for item in value] if isinstance(value, list | tuple) else value


def _lines(table: dict[str, Any]) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in table.items()]


_POSE = "name a topic with the pose in the map frame under [inputs.pose]"


@dataclass(frozen=True)
class NotLive:
    """One thing that a profile takes and a running robot does not give."""

    takes: str  # "its pose from transforms"
    why: str  # why it is not there
    topics: str  # the tables of the profile that it needs instead
    remedy: str
    settings: str = ""  # that it needs with them


def not_live(profile: Profile) -> list[NotLive]:
    """List what a profile takes that a running robot lacks; empty if it can be followed live."""
    found = []
    pose = profile.inputs.pose
    if profile.frames is not None:
        found.append(
            NotLive(
                "its pose from transforms ([frames])",
                "which are not held live",
                "[inputs.pose]",
                _POSE,
            )
        )
    elif pose is not None and pose.by_fix:
        found.append(
            NotLive(
                "its pose from satellite fixes",
                "whose frame and heading are not computed live",
                "[inputs.pose]",
                f"{_POSE}, such as that of robot_localization's navsat_transform_node",
            )
        )
    if profile.goal_source == "hindsight":
        found.append(
            NotLive(
                "its goals in hindsight",
                "which is not possible live",
                "[inputs.goal], [inputs.plan]",
                "name the topics of goal and plan under [inputs.goal] and [inputs.plan], with"
                ' goal.source = "logged"',
                'goal.source = "logged"',
            )
        )
    return found
