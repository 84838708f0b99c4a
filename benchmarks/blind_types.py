"""Twenty types of fault in logs, each in three doses, that no check was made for.

They were written by somebody who had not read the checks, from public bug reports (of which some
are named) and from what is known of such robots. A pattern of what is right asks for the signal or
the relation that is wrong, and for a kind of cause that leads a user to it. "X does not follow
from Y" is right, with the right X. A right signal with a wrong cause is not: `unless` lists the
names of such causes.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa
from row_fault_types import (
    ACCEL,
    COMMAND,
    POSE,
    SPIN,
    WHEELS,
    Draws,
    Fault,
    Rowed,
    Signalled,
    changed,
    lidar,
    missions,
    number,
    with_columns,
)

from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.filling import Filling, Routing
from restock.ingest.task.surroundings import outline_reach

FREE_M = 4.0  # clearance of a sector in which nothing is seen
SLOWED_TO = 0.4  # share of the speed that is left while something is near
LOST_STEPS = 10  # at the end of an episode: 2 s
STEPS_ON = 3
# By priority, as the profile has them.
CONDITIONS = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def says(signal: str, kind: str, unless: str = "") -> str:
    """Return the pattern of a finding of a signal and a kind of cause, in any order.

    The name of the cause, which is what it begins with, may not contain `unless`.
    """
    other = f"(?![A-Z_ ]*(?:{unless}))" if unless else ""
    return f"(?is)^{other}(?=.*(?:{signal}))(?=.*(?:{kind}))"


def wrapped(angle_rad: np.ndarray) -> np.ndarray:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def bearings(sectors: int) -> np.ndarray:
    """Return the middle bearing (K,) of each sector of a scan, in radians, left positive."""
    return (np.arange(sectors) + 0.5) * (2 * np.pi / sectors) - np.pi


def some_missions(
    filling: Filling, share: float, rng: Draws, holds: np.ndarray, in_more_than: float = 0.0
) -> np.ndarray:
    """Return the ticks (T,) of a share of the missions, of which one at least is chosen.

    Only missions are chosen in which `holds` (T,) in more than that share of the ticks.
    """
    mission = number(filling)
    among = np.flatnonzero(np.bincount(mission, holds) > in_more_than * np.bincount(mission))
    chosen = rng.permutation(among)
    return np.isin(mission, chosen[: max(round(share * len(chosen)), 1)])


# -- in the signals ---------------------------------------------------------------------------


def unsigned(share: float) -> Signalled:
    """Lose the sign of the wheel speed, in a share of the missions in which the robot backs up."""

    def plant(filling: Filling, rng: Draws) -> None:
        speed = filling.signals[WHEELS[0]]
        inside = some_missions(filling, share, rng, speed < -0.05)
        filling.signals[WHEELS[0]] = np.where(inside, np.abs(speed), speed)

    return plant


def fused(share: float) -> Signalled:
    """Take the speeds of the pose and of the gyroscope for those of the wheels."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, signals = missions(filling, share, rng), filling.signals
        for wheels, estimate in zip(WHEELS, ("localised_speed_mps", SPIN), strict=True):
            signals[wheels] = np.where(inside, signals[estimate], signals[wheels])

    return plant


def turned_while_turning(by_s: float) -> Signalled:
    """Turn each scan by what the robot turns in a time, as seen that long ago."""

    def plant(filling: Filling, rng: Draws) -> None:
        def change(seen: np.ndarray) -> np.ndarray:
            sectors = seen.shape[1]
            by = np.round(filling.signals[SPIN] * by_s * sectors / (2 * np.pi)).astype(np.int64)
            return np.take_along_axis(seen, (np.arange(sectors) - by[:, None]) % sectors, axis=1)

        lidar(change)(filling, rng)

    return plant


def blind_within(at_m: float) -> Signalled:
    """See nothing in a sector in which something is so near, as if it were the robot itself."""
    return lidar(lambda seen: np.where(seen < at_m, FREE_M, seen))


def sees_the_floor(at_m: float) -> Signalled:
    """See the floor at that distance from the lidar, straight ahead, and further to the sides."""

    def plant(filling: Filling, rng: Draws) -> None:
        def change(seen: np.ndarray) -> np.ndarray:
            bearing = bearings(seen.shape[1])
            ahead = np.cos(bearing)
            floor = at_m / np.maximum(ahead, 1e-6) - outline_reach(bearing, filling.task.body)
            floor = np.where(ahead > 0.1, floor, np.inf) + rng.normal(0, 0.02, seen.shape)
            return np.minimum(seen, np.maximum(floor, 0.0))

        lidar(change)(filling, rng)

    return plant


def rattling(by_radps: float) -> Signalled:
    """Add noise to the inertial unit, in proportion to the speed; ten times as much to the accel.

    The unit of `by_radps` is rad/s for each m/s.
    """

    def plant(filling: Filling, rng: Draws) -> None:
        speed = np.abs(filling.signals[WHEELS[0]])
        for name, times in ((SPIN, 1.0), (ACCEL, 10.0)):
            noise = times * by_radps * speed * rng.normal(0, 1, len(speed))
            filling.signals[name] = filling.signals[name] + noise

    return plant


def echoed(share: float) -> Signalled:
    """Take commands for navigation's proposals, in missions that are mostly driven otherwise."""

    def plant(filling: Filling, rng: Draws) -> None:
        signals = filling.signals
        pairs = [(name.replace("command", "nav"), name) for name in COMMAND]
        apart = sum(np.abs(signals[nav] - signals[command]) for nav, command in pairs) > 0.1
        inside = some_missions(filling, share, rng, apart, 0.2)
        for nav, command in pairs:
            known = inside & np.isfinite(signals[nav])
            signals[nav] = np.where(known, signals[command], signals[nav])

    return plant


def pulled_by_iron(by_rad: float) -> Signalled:
    """Turn the heading, by an angle that depends on the heading as a compass's error does."""
    return changed(lambda heading: wrapped(heading + by_rad * np.sin(heading - 0.7)), POSE[2])


def in_another_resolution(by: float) -> Signalled:
    """Scale all positions of a recording: poses, goals and plans."""

    def plant(filling: Filling, rng: Draws) -> None:
        for name in POSE[:2]:
            filling.signals[name] = by * filling.signals[name]
        inputs = filling.inputs
        inputs.__dict__["goals"] = by * inputs.goals
        inputs.__dict__["plans"] = [by * plan for plan in inputs.plans]

    return plant


def in_float32(north_m: float) -> Signalled:
    """Round positions to what float32 resolves of an easting and of a northing."""

    def plant(filling: Filling, rng: Draws) -> None:
        for name, to_m in zip(POSE, (1 / 32, north_m), strict=False):
            filling.signals[name] = to_m * np.round(filling.signals[name] / to_m)

    return plant


def straight_to_the_goal(share: float) -> Signalled:
    """Leave of the plans only their first point and their last one."""

    def plant(filling: Filling, rng: Draws) -> None:
        old, inside = filling.routing, missions(filling, share, rng)
        plans = [*old.plans_m, *(plan[[0, -1]] if len(plan) else plan for plan in old.plans_m)]
        plan = np.where(inside & (old.plan >= 0), old.plan + len(old.plans_m), old.plan)
        filling.routing = Routing(old.goals_m, plans, old.goal, plan, old.order)
        filling.signals |= filling.routing.signals(filling.task, old.goal, plan, filling.signals)

    return plant


def before_the_override(at_m: float) -> Signalled:
    """Store the speed that was asked for where something ahead is so near that it was reduced."""

    def plant(filling: Filling, rng: Draws) -> None:
        seen, speed = filling.signals["sector_clearance_m"], filling.signals[COMMAND[0]]
        ahead = np.abs(bearings(seen.shape[1])) < np.pi / 4
        slowed = (seen[:, ahead].min(axis=1) < at_m) & (speed > 0)
        asked = np.minimum(speed / SLOWED_TO, np.maximum(speed, 1.0))
        filling.signals[COMMAND[0]] = np.where(slowed, asked, speed)

    return plant


def ramped(by_mps2: float) -> Signalled:
    """Let commands follow those that were executed no faster; turns, by twice as much in rad/s2."""

    def plant(filling: Filling, rng: Draws) -> None:
        mission, period_s = number(filling), float(filling.task.control_period_s)
        first = np.diff(mission, prepend=-1) != 0
        for name, most in zip(COMMAND, (by_mps2 * period_s, 2 * by_mps2 * period_s), strict=True):
            column, now = filling.signals[name].copy(), 0.0
            for at, wanted in enumerate(filling.signals[name]):
                before = 0.0 if first[at] else now
                now = before + float(np.clip(wanted - before, -most, most))
                column[at] = now
            filling.signals[name] = column

    return plant


# -- in the rows ------------------------------------------------------------------------------


def some_of(
    rows: pa.Table, share: float, rng: Draws, among: np.ndarray | None = None
) -> np.ndarray:
    """Return whether each row (N,) is in a share of the episodes, of which one at least is chosen.

    With `among`, only episodes are chosen that have a row for which it is true.
    """
    episode = rows["episode_index"].to_numpy()
    chosen = rng.permutation(np.unique(episode if among is None else episode[among]))
    return np.isin(episode, chosen[: max(round(share * len(chosen)), 1)])


def last_of(rows: pa.Table) -> np.ndarray:
    """Return the place (N,) of the last row of each row's episode; rows are whole episodes."""
    episode = rows["episode_index"].to_numpy()
    return np.searchsorted(episode, episode, "right") - 1


def entries(rows: pa.Table, name: str) -> np.ndarray:
    """Return a column of observations, (N, D)."""
    flat = rows[name].combine_chunks().flatten().to_numpy()
    return np.asarray(flat, np.float32).reshape(len(rows), -1)


@cache
def names_of_entries() -> tuple[str, ...]:
    return tuple(load_profile("warehouse_amr").task.observation_names)


def sorted_by_name(share: float) -> Rowed:
    """Store the entries of observations in the alphabetical order of their names."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        inside, order = some_of(rows, share, rng)[:, None], np.argsort(names_of_entries())
        columns = {}
        for name in ("observation", "next_observation"):
            old = entries(rows, name)
            columns[name] = list(np.where(inside, old[:, order], old))
        return with_columns(rows, **columns)

    return plant


def same_previous_action(share: float) -> Rowed:
    """Observe, as the previous action, that of the episode's first step at all its steps."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        inside, episode = some_of(rows, share, rng), rows["episode_index"].to_numpy()
        first = np.searchsorted(episode, episode)
        places = [name.startswith("previous_action_") for name in names_of_entries()]
        at, begin = np.flatnonzero(places), entries(rows, "observation")[first]
        columns = {}
        for name in ("observation", "next_observation"):
            new = entries(rows, name).copy()
            new[np.ix_(inside, at)] = begin[np.ix_(inside, at)]
            columns[name] = list(new)
        return with_columns(rows, **columns)

    return plant


def next_further_on(share: float) -> Rowed:
    """Take the next observation of some steps later, in the same episode."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        row, inside = np.arange(len(rows)), some_of(rows, share, rng)
        later = np.minimum(row + STEPS_ON - 1, last_of(rows))
        order = np.where(inside, later, row)
        return with_columns(rows, next_observation=rows["next_observation"].take(order))

    return plant


def progress_as_the_crow_flies(share: float) -> Rowed:
    """Pay for coming nearer to the goal in a straight line, and not along the plan."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        goes_on = np.arange(len(rows)) < last_of(rows)
        inside = some_of(rows, share, rng) & goes_on
        reward, distance_m, progress_m = (
            rows[name].to_numpy().astype(np.float64)
            for name in ("reward", "goal_distance_m", "progress_m")
        )
        nearer_m = distance_m - np.append(distance_m[1:], 0.0)
        instead = reward + np.clip(nearer_m, -1.0, 1.0) - np.clip(progress_m, -1.0, 1.0)
        return with_columns(rows, reward=np.where(inside, instead, reward))

    return plant


def discounted(by: float) -> Rowed:
    """Multiply each reward by the discount to its step."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        step = rows["step_index"].to_numpy().astype(np.float64)
        return with_columns(rows, reward=rows["reward"].to_numpy() * by**step)

    return plant


def unwritten_ends(share: float) -> Rowed:
    """Lose the last rows of episodes, which then are truncated where the file ends."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        left = last_of(rows) - np.arange(len(rows))
        long = left + rows["step_index"].to_numpy() >= 2 * LOST_STEPS
        inside = some_of(rows, share, rng, long)
        truncated = rows["truncated"].to_numpy() | (inside & (left == LOST_STEPS))
        kept = pa.array(~inside | (left >= LOST_STEPS))
        return with_columns(rows, truncated=truncated).filter(kept)

    return plant


def numbered_otherwise(share: float) -> Rowed:
    """Read the numbers of labels by a list that begins one further on."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        held, named = (rows[name].to_pylist() for name in ("conditions", "condition"))
        inside = some_of(rows, share, rng, np.array([bool(names) for names in held]))
        other = dict(zip(CONDITIONS, (*CONDITIONS[1:], CONDITIONS[0]), strict=True))
        for at in np.flatnonzero(inside):
            new = {other.get(name, name) for name in held[at]}
            held[at] = [name for name in CONDITIONS if name in new]
            named[at] = held[at][0] if held[at] else named[at]
        return with_columns(rows, conditions=held, condition=named)

    return plant


# What a right finding says of each, beside the signal.
UNFIT = (  # names no cause: right where no simple one is
    r"does not (follow|fit|match|agree)|do not (follow|fit|match|agree)|contradict|disagree"
    r"|inconsisten|differ|unlike|no relation|not that of|not explained|unrelated"
)
SIMPLE = "SCALE|SHIFT|BIAS|MIRROR|REPEAT|UNCHANGED"  # causes that are simpler than the fault
SHAKEN = r"nois|jitter|scatter|shak|spike|outlier|jump|VALUES_"

LEFT_OUT: tuple[Fault, ...] = (
    # Odometry's speed is a root of squares, and never negative: gazebo_ros_pkgs 1432 and 1552.
    *(Fault("wheel speed without a sign", f"in {s:.0%} of missions that back up",
            says("wheel|odometry", rf"{UNFIT}|\bsigns?\b|negative|positive|revers|backward|back up"
                 r"|backing|opposite|absolute|direction|MIRROR", "SCALE|SHIFT|BIAS|UNCHANGED"),
            unsigned(s)) for s in (0.3, 0.6, 1.0)),
    # A filter that fuses all sensors publishes on the topic of odometry: navigation 372.
    *(Fault("fused speed on the topic of odometry", f"in {s:.0%} of missions",
            says(r"wheel|odometry|\bslip", rf"{UNFIT}|\bpose|localis|fused|fusion|filter|equal"
                 r"|\bsame\b|cop(y|ies)|gyro|never slip|no slip|without slip|estimate",
                 "SCALE|SHIFT|BIAS|MIRROR|UNCHANGED"),
            routed=fused(s)) for s in (0.1, 0.3, 1.0)),
    # Motion is compensated twice, or with the wrong sign or time: kiss-icp 209, rtabmap_ros 863.
    *(Fault("scan turned while the robot turns", f"by what it turns in {by:g} s",
            says("lidar|clearance|sector|scan", rf"{UNFIT}|while (it|the robot)? ?turn|turning"
                 r"|when .*turns|rotat|skew|distort|compensat|yaw|gyro|\blate\b|delay|\blag"
                 r"|stamp|time of|SHIFT", r"SCALE|MIRROR|BIAS|_TURNED\b"),
            turned_while_turning(by)) for by in (0.15, 0.3, 0.6)),
    # A filter for the robot's own body takes too much: cob_robots 743, laser_filters 193.
    *(Fault("lidar blind close by", f"within {at:g} m",
            says(r"lidar|clearance|sector|scan", rf"{UNFIT}|\bclose|nearby|near (the|to|it|things"
                 r"|returns?|readings?|obstacles?|objects?)|nearer than|below|blind|vanish"
                 r"|missing|nothing|no returns?|never|filter|footprint|hidden|lost|VALUES_",
                 "SCALE|SHIFT|_TURN|MIRROR|BIAS"),
            blind_within(at)) for at in (0.1, 0.25, 0.5)),
    # A lidar's mount gives way, or the robot nods: mowglinext 259, UTRA-ART Caffeine 55.
    *(Fault("lidar tilted to the floor", f"which it sees {at:g} m ahead",
            says("lidar|clearance|sector|scan", rf"{UNFIT}|tilt|pitch|\bfloor|ground|ahead|front"
                 r"|forward|never|beyond|farther|further|at most|cut off|not level|mount"
                 r"|phantom|not there|VALUES_", "SCALE|SHIFT|_TURN|MIRROR|BIAS"),
            sees_the_floor(at)) for at in (3.0, 2.0, 1.2)),
    # A board comes loose, and vibrates with the drive: rosflight_firmware 37, PX4-ECL 254.
    *(Fault("inertial unit loose on its mount", f"noise of {by:g} rad/s for each m/s",
            says(r"gyro|accel|inertial|\bimu\b", rf"{UNFIT}|{SHAKEN}|vibrat|loose|rattl|deviat"
                 r"|spread|mount|unsteady", "SCALE|SHIFT|BIAS|MIRROR|UNCHANGED"),
            rattling(by)) for by in (0.05, 0.15, 0.4)),
    # A magnetometer next to steel gives headings an error that depends on them: fusioncore 93.
    *(Fault("heading of a compass beside iron", f"wrong by up to {by} degrees",
            says(r"\bpose|heading|yaw|localis|compass", rf"{UNFIT}|compass|magnet|\biron|depends"
                 r"|deviat|turned|degrees|frame|drift|sideways|lateral|varies",
                 f"{SIMPLE}|LIDAR"),
            pulled_by_iron(np.radians(by))) for by in (3, 8, 20)),
    # Somebody edits a map's resolution: turtlebot_simulator 49, hector_slam 80.
    *(Fault("map of another resolution", f"{by:g} times as large",
            says(r"\bpose|localis|\bmap\b|rack|position", rf"{UNFIT}|scale|resolution|stretch"
                 r"|larger|longer|faster|further|times as|factor|ratio|rack|elsewhere|walls?\b",
                 "SHIFT|BIAS|MIRROR|LIDAR|UNCHANGED"),
            in_another_resolution(by)) for by in (1.04, 1.1, 1.25)),
    # Positions far from the origin are kept as float32: autoware_universe 3090, lgsvl 463.
    *(Fault("positions rounded by float32", f"northings to {n:g} m",
            says(r"\bpose|localis|position", rf"{UNFIT}|{SHAKEN}|round|coarse|\bgrid|quanti"
                 r"|resolution|float|precision|steps of|multiples|stair|unchanged|stands? still"
                 r"|repeat", "SCALE|BIAS|MIRROR|SHIFT|LIDAR"),
            in_float32(n)) for n in (0.125, 0.25, 0.5)),
    # The planner has no map yet, or a converter keeps the ends only: navigation 102 and 1257.
    *(Fault("plan straight to the goal", f"in {s:.0%} of missions",
            says(r"\bplan|route|waypoint|progress", rf"{UNFIT}|rack|\bwalls?\b|straight|through"
                 r"|obstacle|shorter|cross|blocked|not (driven|followed)|detour|direct|off the"
                 r"|away from|far from|leaves|lidar", "SCALE|SHIFT|MIRROR|UNCHANGED"),
            routed=straight_to_the_goal(s)) for s in (0.1, 0.3, 1.0)),
    # A monitor slows the robot down behind the recorded topic: navigation2 2982 and 3514.
    *(Fault("commands from before the safety override", f"within {at:g} m of things ahead",
            says("action|command", rf"{UNFIT}|not (executed|obeyed|carried out|driven|followed)"
                 r"|override|safety|limit|slow|faster|higher|clearance|\bnear\b|obstacle|close"
                 r"|reduc|COARSE", "SCALE|SHIFT|MIRROR|PERMUT"),
            before_the_override(at)) for at in (0.6, 1.0, 1.6)),
    # A smoother publishes on the recorded topic, but the base takes its input: docs.nav2.org 454.
    *(Fault("commands after a smoother that the base passes by", f"of {by:g} m/s2",
            says("action|command", rf"{UNFIT}|smooth|\bramp|filter|limit|slower than|\blags?\b"
                 r"|gradual|rate of change|accelerat|average|not (executed|carried out|obeyed)"
                 r"|COARSE|between (the|two)|far from|nearest", "SCALE|SHIFT|MIRROR|PERMUT|LOST"),
            ramped(by)) for by in (1.0, 0.5, 0.25)),
    # The topic of proposals is wired behind what selects the driver: perseus-v2 415.
    *(Fault("commands stored as proposals", f"in {s:.0%} of missions driven otherwise",
            says(r"propos|\bnav\b|nav_|navigation", rf"{UNFIT}|repeat|cop(y|ies)|equal|same as"
                 r"|always|leak|echo|(is|are|with) the (action|command)|executed|whoever|operator",
                 "SCALE|SHIFT|MIRROR|PERMUT|ACTION|COMMAND|POLIC"),
            routed=echoed(s)) for s in (0.3, 0.6, 1.0)),
    # A converter sorts the features by name; messages of joints have another order, too.
    *(Fault("entries of observations sorted by name", f"in {s:.0%} of episodes",
            says(r"observ|entr(y|ies)|features?\b|VALUES_", rf"{UNFIT}|order|permut|exchang|swap"
                 r"|sort|shuffl|mixed up|columns?|schema|VALUES_|not what|range|other entr",
                 "SCALE|SHIFT|MIRROR|FUTURE|LABEL|REWARD|ACTION|TERMIN"),
            rows=sorted_by_name(s)) for s in (0.1, 0.3, 1.0)),
    # A buffer of the last action is not updated or reset: IsaacLab 1623, DACBench 94, ray 4573.
    *(Fault("previous action not updated", f"in {s:.0%} of episodes",
            says(r"(previous|last).?actions?|observ|entr(y|ies)|VALUES_", rf"{UNFIT}|stale|constant"
                 r"|unchanged|always|never|not updated|\bstops?\b|the same|frozen|stuck|not what"
                 r"|(previous|last).?action|VALUES_",
                 "SHIFT|MIRROR|PERMUT|SCALE|FUTURE|LABEL|REWARD|TERMIN"),
            rows=same_previous_action(s)) for s in (0.1, 0.3, 1.0)),
    # A buffer for returns of several steps keeps one step's reward: FastTD3 6, DeepRL 110.
    *(Fault(f"next observation {STEPS_ON} steps on", f"in {s:.0%} of episodes",
            says(r"next.observ|\brows?\b|ROWS_|transition", rf"{UNFIT}|ROWS_|apart|ahead|later"
                 r"|further|too far|skip|steps (on|after)|several steps|consecutive"
                 r"|not the (next|one)|other rows?|another row",
                 "SCALE|MIRROR|BIAS|REPEAT|FUTURE|REWARD|ACTION|LABEL"),
            rows=next_further_on(s)) for s in (0.1, 0.3, 1.0)),
    # Distances to goals are measured through walls: habitat-lab 57 and 189, iGibson 80.
    *(Fault("progress paid in a straight line to the goal", f"in {s:.0%} of episodes",
            says("reward", rf"{UNFIT}|REWARD_DIFFERENT|progress|straight|distance|recomput"
                 r"|not what|along the (plan|route)|detour", "SCALE|SHIFT|VERSION|LOST"),
            rows=progress_as_the_crow_flies(s)) for s in (0.1, 0.3, 1.0)),
    # A script multiplies rewards by the discount, which training does again.
    *(Fault("rewards stored discounted", f"by {by:g} a step",
            says("reward|return", rf"{UNFIT}|REWARD_DIFFERENT|discount|decay|shrink|smaller|later"
                 r"|less (and less|the)|along the episode|with (the|each) step|recomput|not what",
                 "SCALE|SHIFT|VERSION|LOST|REPEAT"),
            rows=discounted(by)) for by in (0.995, 0.98, 0.95)),
    # A recorder that is stopped loses what is still in its queues: rosbag2 1397.
    *(Fault("ends of episodes not written", f"the last 2 s in {s:.0%} of episodes",
            says(r"terminat|\bends?\b|episode|\bgoal|succe|truncat", rf"{UNFIT}|TERMINATIONS_"
                 r"|\blost\b|missing|cut (off|short)|shorter|early|too soon|before (the|it|they)"
                 r"|never|not (been )?reached|incomplete|fewer|rare|seldom|without|truncat"
                 r"|last (rows|steps)", "REWARD|SHIFT|REPEAT|LABEL|SENSOR|ACTION|LIDAR"),
            rows=unwritten_ends(s)) for s in (0.2, 0.5, 1.0)),
    # Numbers of classes are read by another list: cocostuff 7, armory 799, rf-detr 961.
    *(Fault("labels by the wrong list of numbers", f"in {s:.0%} of the episodes that have any",
            says("label|condition", rf"{UNFIT}|LABELS_|exchang|swap|permut|another|other label"
                 r"|wrong|conditions give|mixed up|names",
                 "SHIFT|_LATE|SCALE|REWARD|ACTION|SENSOR|TERMIN"),
            rows=numbered_otherwise(s)) for s in (0.1, 0.3, 1.0)),
)  # fmt: skip
