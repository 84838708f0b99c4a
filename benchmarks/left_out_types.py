"""Twenty types of fault in logs, each in three doses, that no check was made for.

They were written by somebody who had not read the checks, from public bug reports (of which some
are named) and from what is known of such robots. A pattern of what is right asks for the signal or
the relation that is wrong, and for a kind of cause that leads a user to it. "X does not follow
from Y" is right, with the right X. A right signal with a wrong cause is not: `unless` lists the
names of such causes.
"""

from __future__ import annotations

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
    inside_of,
    lidar,
    missions,
    number,
    with_columns,
    zeros,
)
from used_types import taken, taken_rest

from restock.ingest.steps.filling import Filling, Routing

MAP_M = (12.0, 10.0)  # of the warehouse, whose racks look alike after half a turn
TRACK_M = 0.5
STRAIGHT = (1, 2)  # actions
GOAL_REWARD = 5.0


def says(signal: str, kind: str, unless: str = "") -> str:
    """Return the pattern of a finding of a signal and a kind of cause, in any order.

    The name of the cause, which is what it begins with, may not contain `unless`.
    """
    other = f"(?![A-Z_ ]*(?:{unless}))" if unless else ""
    return f"(?is)^{other}(?=.*(?:{signal}))(?=.*(?:{kind}))"


def wrapped(angle_rad: np.ndarray) -> np.ndarray:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def places_in_mission(filling: Filling) -> tuple[np.ndarray, np.ndarray]:
    """Return the first tick of each tick's mission (T,), and its own place in it (T,)."""
    mission = number(filling)
    first = np.searchsorted(mission, mission)
    return first, np.arange(len(mission)) - first


# -- in the signals ---------------------------------------------------------------------------


def along_the_map(share: float) -> Signalled:
    """Take the velocity's part along the map's x axis for the wheel speed."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, heading = missions(filling, share, rng), filling.signals[POSE[2]]
        filling.signals[WHEELS[0]] = filling.signals[WHEELS[0]] * np.where(
            inside, np.cos(heading), 1.0
        )

    return plant


def turned_accelerometer(by_rad: float) -> Signalled:
    """Mix the sideways acceleration into the forward one, as a turned mount does."""

    def plant(filling: Filling, rng: Draws) -> None:
        sideways = filling.signals[WHEELS[0]] * filling.signals[SPIN]
        forward = filling.signals[ACCEL]
        filling.signals[ACCEL] = np.cos(by_rad) * forward + np.sin(by_rad) * sideways

    return plant


def specks(share: float) -> Signalled:
    """Put something that is not there, .05 to .6 m away, into single readings of sectors."""

    def plant(filling: Filling, rng: Draws) -> None:
        def change(seen: np.ndarray) -> np.ndarray:
            speck = np.where(rng.random(seen.shape) < share, rng.uniform(0.05, 0.6, seen.shape), 9)
            return np.minimum(seen, speck)

        lidar(change)(filling, rng)

    return plant


def by_turns(seen: np.ndarray) -> np.ndarray:
    """Let the front half of a scan and the rear half see nothing by turns."""
    sectors = seen.shape[1]
    front = np.abs(np.arange(sectors) - (sectors - 1) / 2) < sectors / 4
    even = np.arange(len(seen))[:, None] % 2 == 0
    return np.where(even == front, seen, 4.0)


def pressed(share: float) -> Signalled:
    """Close the bumper's switch for a moment without a contact."""

    def plant(filling: Filling, rng: Draws) -> None:
        bumped = filling.signals["bumped"].astype(np.bool_)
        filling.signals["bumped"] = bumped | (rng.random(len(bumped)) < share)

    return plant


def half_a_turn_away(share: float) -> Signalled:
    """Move poses to the place that looks alike in a symmetric map, facing the other way."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, signals = missions(filling, share, rng), filling.signals
        for name, size_m in zip(POSE, MAP_M, strict=False):
            signals[name] = np.where(inside, size_m - signals[name], signals[name])
        signals[POSE[2]] = np.where(inside, wrapped(signals[POSE[2]] + np.pi), signals[POSE[2]])

    return plant


def averaged_heading(readings: int) -> Signalled:
    """Take the plain mean of the last headings, which is 0 of pi and -pi."""

    def plant(filling: Filling, rng: Draws) -> None:
        first, place = places_in_mission(filling)
        heading = wrapped(filling.signals[POSE[2]])
        last = [heading[first + np.maximum(place - back, 0)] for back in range(readings)]
        filling.signals[POSE[2]] = np.mean(last, axis=0)

    return plant


def drifting(by_radps: float) -> Signalled:
    """Count poses on from each mission's first, with a heading that drifts."""

    def plant(filling: Filling, rng: Draws) -> None:
        (first, place), signals = places_in_mission(filling), filling.signals
        period_s = float(filling.task.control_period_s)
        off = by_radps * period_s * place
        x, y = (np.diff(signals[name], prepend=signals[name][:1]) for name in POSE[:2])
        x, y = np.cos(off) * x - np.sin(off) * y, np.sin(off) * x + np.cos(off) * y
        for name, steps_m in zip(POSE, (x, y), strict=False):
            way = np.cumsum(steps_m)
            signals[name] = signals[name][first] + way - way[first]
        signals[POSE[2]] = wrapped(signals[POSE[2]] + off)

    return plant


def of_wheels(share: float) -> Signalled:
    """Store the speeds of the left and the right wheel as commands."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        speed, turn = (filling.signals[name] for name in COMMAND)
        for name, side in zip(COMMAND, (-1.0, 1.0), strict=True):
            wheel = speed + side * TRACK_M / 2 * turn
            filling.signals[name] = np.where(inside, wheel, filling.signals[name])

    return plant


def from_the_goal(share: float) -> Signalled:
    """Reverse the order of the plans' points."""

    def plant(filling: Filling, rng: Draws) -> None:
        old, inside = filling.routing, missions(filling, share, rng)
        plans = [*old.plans_m, *(plan[::-1] for plan in old.plans_m)]
        plan = np.where(inside & (old.plan >= 0), old.plan + len(old.plans_m), old.plan)
        filling.routing = Routing(old.goals_m, plans, old.goal, plan, old.order)
        filling.signals |= filling.routing.signals(filling.task, old.goal, plan, filling.signals)

    return plant


def without_turning(share: float) -> Signalled:
    """See the plan, and what stands on it, along the map's axes and not the body's."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, routing = missions(filling, share, rng), filling.routing
        heading = np.where(inside, 0.0, filling.signals[POSE[2]])
        filling.signals |= routing.signals(
            filling.task, routing.goal, routing.plan, filling.signals | {POSE[2]: heading}
        )

    return plant


def cut_stamps(to_s: float) -> Signalled:
    """Cut the poses' stamps to multiples of a time."""

    def plant(filling: Filling, rng: Draws) -> None:
        stamp_ns, to_ns = filling.signals["pose_stamp_ns"], round(to_s * 1e9)
        filling.signals["pose_stamp_ns"] = stamp_ns // to_ns * to_ns

    return plant


class WithLosses:
    """The ticks that are left if some are lost after about every twentieth; later ones move up."""

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def __call__(self, filling: Filling) -> np.ndarray:
        first, place = places_in_mission(filling)
        # The same losses each time: signals and routes are planted one after the other.
        hit = np.random.default_rng(0).random(len(first)) < 0.05
        lost = self.steps * np.cumsum(hit)
        last = np.bincount(number(filling))[number(filling)] - 1
        return first + np.minimum(place + lost - lost[first], last)


# -- in the rows ------------------------------------------------------------------------------


def returns(share: float) -> Rowed:
    """Replace each reward by the sum of those from its row to the end of the episode."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        reward = rows["reward"].to_numpy().astype(np.float64)
        so_far = np.cumsum(reward)
        last = np.searchsorted(episode, episode, "right") - 1  # rows are whole episodes, in order
        return with_columns(rows, reward=np.where(inside, so_far[last] - so_far + reward, reward))

    return plant


def reached_from(radius_m: float) -> Rowed:
    """End episodes, with the reward of a goal, as soon as the goal is so near."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, distance_m = (rows[n].to_numpy() for n in ("episode_index", "goal_distance_m"))
        goes_on = np.append(episode[1:] == episode[:-1], False)
        near = goes_on & (np.append(distance_m[1:], np.inf) <= radius_m)
        so_far = np.cumsum(near)
        first = np.searchsorted(episode, episode)
        before = so_far - so_far[first] + near[first]  # of the episode, with this row
        end = near & (before == 1)
        reward, ended = rows["reward"].to_numpy(), rows["terminated"].to_numpy()
        rows = with_columns(
            rows,
            reward=reward + GOAL_REWARD * end,
            terminated=ended | end,
            truncated=rows["truncated"].to_numpy() & ~end,
        )
        return rows.filter(pa.array(end | (before == 0)))

    return plant


def late_labels(steps: int) -> Rowed:
    """Give each row the labels of some steps before, in the same episode."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        step = rows["step_index"].to_numpy()
        row = np.arange(len(rows)) - np.minimum(step, steps)
        names = ("conditions", "condition")
        return with_columns(rows, **{name: rows[name].take(row).to_pylist() for name in names})

    return plant


def chained(rows: pa.Table) -> pa.Table:
    """Renumber the rows of each episode; the next observation is that of the next row."""
    episode = rows["episode_index"].to_numpy()
    goes_on = np.append(episode[1:] == episode[:-1], False)
    both = pa.chunked_array([*rows["next_observation"].chunks, *rows["observation"].chunks])
    after = both.take(np.arange(len(rows)) + goes_on * (len(rows) + 1))
    step = np.arange(len(rows)) - np.searchsorted(episode, episode)
    return with_columns(rows, next_observation=after, step_index=step)


def sorted_as_text(share: float) -> Rowed:
    """Sort the steps of episodes as 0, 1, 10, 11, …, 2, 20; the last row then has the end."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        step = rows["step_index"].to_numpy()
        keys = [str(n) if text else f"{n:06}" for n, text in zip(step, inside, strict=True)]
        order = np.lexsort((keys, episode))
        flags = {name: rows[name] for name in ("terminated", "truncated")}
        return chained(with_columns(rows.take(order), **flags))

    return plant


def thinned(share: float) -> Rowed:
    """Remove a share of the rows on which the robot is to drive straight on."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        ends = rows["terminated"].to_numpy() | rows["truncated"].to_numpy()
        straight = np.isin(rows["action"].to_numpy(), STRAIGHT) & ~ends
        return chained(rows.filter(pa.array(~straight | (rng.random(len(rows)) >= share))))

    return plant


# What a right finding says of each, beside the signal.
UNFIT = (  # names no cause: right where no simple one is
    r"does not (follow|fit|match|agree)|do not (follow|fit|match|agree)|contradict|disagree"
    r"|inconsisten|differ|unlike|no relation|not that of|not explained|unrelated"
)
SIMPLE = "SCALE|SHIFT|BIAS|MIRROR|REPEAT|UNCHANGED"  # causes that are simpler than the fault
NOTHING = r"zero|(?<![\d.])0(?![\d.])"
SEAMS = (  # rows that are not one step apart
    r"ROWS_|next observation|\bgaps?\b|consecutive"
    r"|(rows?|steps?|observations?|stamps?|transitions?) (\w+ ){0,4}"
    r"(follow|missing|removed|left out|lost|skip|jump|apart|contradict|too far)"
)

LEFT_OUT: tuple[Fault, ...] = (
    # Drivers give odometry's twist in its parent's frame: open_vins 224, segway_rmp 28.
    *(Fault("wheel speed along the map's axis", f"in {s:.0%} of missions",
            says(r"wheel|odometry", rf"{UNFIT}|frame|ax[ei]s|world|heading|direction",
                 SIMPLE),
            along_the_map(s)) for s in (0.1, 0.3, 1.0)),
    # Drivers set small rates to 0 so that a heading does not drift at rest.
    *(Fault("gyroscope with a dead band", f"below {at:g} rad/s",
            says(r"gyro|inertial|\bimu\b", rf"{UNFIT}|dead|{NOTHING}|small|slow|threshold"
                 r"|below", "SHIFT|BIAS|MIRROR"),
            changed(lambda column, at=at: np.where(np.abs(column) < at, 0.0, column), SPIN))
      for at in (0.05, 0.15, 0.4)),
    # Units are mounted turned, or drivers exchange axes: novatel_oem7_driver 41, imu_tools 219.
    *(Fault("accelerometer turned on its mount", f"by {by} degrees",
            says("accel", rf"{UNFIT}|ax[ei]s|turned|rotat|mount|sideways|lateral|exchang|frame"
                 r"|heading|yaw", SIMPLE),
            turned_accelerometer(np.radians(by))) for by in (30, 60, 90)),
    # Dust, rain and sunlight give a lidar single near returns, which drivers can filter out.
    *(Fault("lidar sees specks of dust", f"in {s:.1%} of the readings",
            says("lidar|clearance|sector", rf"{UNFIT}|spike|outlier|speck|nois|single|jump"
                 r"|flicker|vanish|VALUES_|one (scan|step)", "SCALE|SHIFT|TURN|MIRROR"),
            specks(s)) for s in (0.002, 0.01, 0.05)),
    # Two lidars get into one topic: cartographer_ros 1391, slam_toolbox 462.
    *(Fault("front and rear lidar by turns on one topic", f"in {s:.0%} of missions",
            says("lidar|clearance|sector", rf"{UNFIT}|turns|alternat|every (other|second)|flicker"
                 r"|jump|two|half|blind|dead|missing|nothing|VALUES_", "SCALE|SHIFT|TURN|MIRROR"),
            lidar(by_turns, s)) for s in (0.1, 0.3, 1.0)),
    # A switch bounces, or a threshold is too low: stretch_body 312.
    *(Fault("bumper pressed without a contact", f"in {s:.1%} of the steps",
            says(r"bump|contact", rf"{UNFIT}|often|more|many|without|nothing|far|free|clear|false"
                 r"|share|\brate\b|pressed", "LABEL|REWARD|SCALE"),
            routed=pressed(s)) for s in (0.005, 0.02, 0.05)),
    # Global localisation picks the wrong one of two places that look alike.
    *(Fault("localised half a turn away", f"in {s:.0%} of missions",
            says(r"pose|localis|heading|\bplan\b", rf"{UNFIT}|rack|floor|\bmap\b|elsewhere"
                 r"|turned|rotat|180|behind|away|opposite|symmetr", f"{SIMPLE}|LIDAR"),
            half_a_turn_away(s)) for s in (0.1, 0.3, 1.0)),
    # Filters average yaw without wrapping it: mav_control_rw 19, autoware 1132, NUbots 1651.
    *(Fault("heading averaged across 180 degrees", f"over {n} readings",
            says(r"pose|heading|yaw", rf"{UNFIT}|wrap|jump|spike|outlier|averag|smooth|filter|180"
                 r"|\blate\b|delay", "SCALE|BIAS|MIRROR|UNCHANGED|LIDAR"),
            averaged_heading(n)) for n in (2, 3, 5)),
    # Somebody takes the odometry's frame for the map's, and leaves its corrections out.
    *(Fault("pose counted on without corrections", f"drifts by {by:g} rad/s",
            says(r"pose|localis|heading", rf"{UNFIT}|drift|grow|odometry|dead reckon|rack|floor"
                 r"|\bmap\b|elsewhere|turned|\bbias|correct", "SCALE|SHIFT|MIRROR|UNCHANGED"),
            drifting(by)) for by in (0.005, 0.02, 0.06)),
    # An idle joystick publishes stops on the same topic: turtlebot 105, rqt_common_plugins 180.
    *(Fault("stops of an idle joystick among commands", f"in {s:.0%} of the steps",
            says("action|command", rf"{UNFIT}|stop|{NOTHING}|not executed|not carried out"
                 r"|source|publisher|interleav", "SCALE|SHIFT|MIRROR|PERMUT"),
            zeros(*COMMAND, share=s)) for s in (0.05, 0.15, 0.4)),
    # Joined data sets mean different things by two numbers: speed and yaw rate, or two wheels.
    *(Fault("wheel speeds stored as commands", f"in {s:.0%} of missions",
            says("action|command", rf"{UNFIT}|\bleft\b(?! out)|\bright\b|\bunits?\b|table"
                 r"|PERMUT|COARSE|far from|nearest", "SHIFT|MIRROR|SCALE"),
            of_wheels(s)) for s in (0.1, 0.3, 1.0)),
    # A planner publishes its path from the goal to the start: ros-planning/navigation 162.
    *(Fault("plan from the goal to the start", f"in {s:.0%} of missions",
            says(r"\bplan|route|waypoint|progress", rf"{UNFIT}|revers|opposite|order|backward"
                 r"|behind|grow|longer|ends? (at|away|far)|not end|starts?\b|direction"
                 r"|not (driven|followed)", "SCALE|SHIFT|UNCHANGED"),
            routed=from_the_goal(s)) for s in (0.1, 0.3, 1.0)),
    # A converter subtracts the robot's position from points, and forgets to turn them.
    *(Fault("points of the plan along the map's axes", f"in {s:.0%} of missions",
            says(r"\bplan|route|waypoint", rf"{UNFIT}|frame|ax[ei]s|turned|rotat|heading|bearing"
                 r"|world|\bmap\b|body|direction", "SCALE|SHIFT|MIRROR|UNCHANGED"),
            routed=without_turning(s)) for s in (0.1, 0.3, 1.0)),
    # Seconds are kept as float32 (mmdetection3d 296), 3, 12 and 48 days after the start.
    *(Fault("pose's stamps rounded", f"to 1/{n} s",
            says(r"pose|localis|slip", rf"{UNFIT}|stamp|clock|\btime\b|round|jitter|period|float"
                 r"|coarse|resolution", "SCALE|BIAS|MIRROR"),
            cut_stamps(1 / n)) for n in (32, 8, 2)),
    # A recorder drops frames (hilti-slam-challenge-2021 6), and a data set counts time by frames.
    *(Fault("steps lost without a gap in the stamps", f"{n} at a time",
            says(r"pose|localis|wheel|gyro|steps?\b|stamps?|clock|rows?\b|signals|plan",
                 rf"{UNFIT}|lost|missing|gap|jump|skip|drop|too far|apart|period|faster"
                 r"|further|clock|stamps?", SIMPLE),
            taken(WithLosses(n)), routed=taken_rest(WithLosses(n))) for n in (1, 2, 4)),
    # A script for sequence models writes the returns to go over the rewards.
    *(Fault("returns stored as rewards", f"in {s:.0%} of episodes",
            says("reward|return", rf"{UNFIT}|REWARD_DIFFERENT|\bsums?\b|return|accumul|cumul|total"
                 r"|to the end|recomput|not what", "SCALE|SHIFT|VERSION"),
            rows=returns(s)) for s in (0.1, 0.3, 1.0)),
    # Somebody labels goals again by another radius, as was done for D4RL's ant mazes (HIQL 2).
    *(Fault("goal counted as reached from further away", f"from {by:g} m",
            says(r"goal|terminat|\bends?\b|success|episode", rf"{UNFIT}|TERMINATIONS_|radius|far"
                 r"|distance|early|before|not (been )?reached|without|away|too soon|short"
                 r"|\d m\b|elsewhere", "LOST|REWARD_SCALE|REPEAT"),
            rows=reached_from(by)) for by in (0.6, 0.9, 1.4)),
    # People who press a button to label are late by the time that they take to see and act.
    *(Fault("labels late", f"by {n} steps",
            says("label|condition", rf"{UNFIT}|LABELS_|\blate\b|delay|shift|lag|steps? (after|of)"
                 r"|earlier|conditions give|stale"),
            rows=late_labels(n)) for n in (2, 5, 10)),
    # A converter sorts files that are named by unpadded numbers: MobilityGen 54, cvat 3270.
    *(Fault("steps sorted as text", f"in {s:.0%} of episodes",
            says(r"rows?\b|steps?\b|observation|stamps?|episode|transition",
                 rf"{SEAMS}|order|sort|shuffl|backward|back in time|mixed up", SIMPLE),
            rows=sorted_as_text(s)) for s in (0.1, 0.3, 1.0)),
    # Somebody balanced steering angles for behaviour cloning by removing straight driving.
    *(Fault("straight driving thinned out", f"without {s:.0%} of it",
            says(r"rows?\b|steps?\b|observation|stamps?|episode|transition|straight|action",
                 rf"{SEAMS}|thin|fewer|rare|seldom|period|straight|dropped|filter", SIMPLE),
            rows=thinned(s)) for s in (0.1, 0.3, 0.8)),
)  # fmt: skip
