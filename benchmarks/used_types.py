"""Twenty types of fault that were left out once, when limits were set, and are developed on since.

They were written down from others' reports by somebody who had not read the checks. A
pattern of what is right asks for the signal or relation that is wrong, and for a kind of cause
that leads a user to it; a right signal with a wrong cause (a scale where a sign is wrong) is none.
"""

from __future__ import annotations

from collections.abc import Callable

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
    scale,
    second_halves,
    with_columns,
)

from restock.ingest.steps.filling import Filling, Routing

GRAVITY_MPS2 = 9.81
# By priority, as the profile has them.
CONDITIONS = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def says(signal: str, kind: str) -> str:
    """Return the pattern of a finding that names a signal and a kind of cause, in any order."""
    return f"(?is)^(?=.*(?:{signal}))(?=.*(?:{kind}))"


# -- in the signals ---------------------------------------------------------------------------


def by_compass(heading_rad: np.ndarray) -> np.ndarray:
    """Return headings counted from north, clockwise."""
    return (np.pi / 2 - heading_rad + np.pi) % (2 * np.pi) - np.pi


def ahead_of_centre(by_m: float) -> Signalled:
    """Poses of a point ahead of the robot's centre, as of a lidar whose place is left out."""

    def plant(filling: Filling, rng: Draws) -> None:
        heading = filling.signals[POSE[2]]
        for name, part in zip(POSE, (np.cos(heading), np.sin(heading)), strict=False):
            filling.signals[name] = filling.signals[name] + by_m * part

    return plant


def after_a_way(by_m: float) -> Signalled:
    """Poses that stay until the robot has moved so far, or turned by .8 rad for each metre."""

    def plant(filling: Filling, rng: Draws) -> None:
        x, y, heading = (filling.signals[name] for name in POSE)
        mission, row = number(filling), np.arange(len(x))
        for at in range(1, len(x)):
            last = row[at - 1]
            turned = abs((heading[at] - heading[last] + np.pi) % (2 * np.pi) - np.pi)
            near = np.hypot(x[at] - x[last], y[at] - y[last]) < by_m and turned < 0.8 * by_m
            if near and mission[at] == mission[last]:
                row[at] = last
        for name in POSE:
            filling.signals[name] = filling.signals[name][row]

    return plant


def open_loop(share: float) -> Signalled:
    """Wheels that report the command which was in force, and nothing that was measured."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, mission = missions(filling, share, rng), number(filling)
        first = np.diff(mission, prepend=-1) != 0
        for wheels, command in zip(WHEELS, COMMAND, strict=True):
            before = np.where(first, 0.0, np.roll(filling.signals[command], 1))
            filling.signals[wheels] = np.where(inside, before, filling.signals[wheels])

    return plant


def sees_itself(sectors: int, at_m: float) -> Signalled:
    """Sectors, behind to the left, in which a part of the robot's own is as near as that."""

    def change(seen: np.ndarray) -> np.ndarray:
        seen = seen.copy()
        place = slice(seen.shape[1] * 5 // 6, seen.shape[1] * 5 // 6 + sectors)
        seen[:, place] = np.minimum(seen[:, place], at_m)
        return seen

    return lidar(change)


def zero_for_nothing(share: float) -> Signalled:
    """Sectors without a return that read 0, in a share of their readings."""

    def plant(filling: Filling, rng: Draws) -> None:
        def change(seen: np.ndarray) -> np.ndarray:
            nothing = seen >= float(filling.task.range_max_m) - 1e-6
            return np.where(nothing & (rng.random(seen.shape) < share), 0.0, seen)

        lidar(change)(filling, rng)

    return plant


def proposals(share: float) -> Signalled:
    """Commands that are what navigation proposed, whoever drove."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        for name in COMMAND:
            proposed = filling.signals[name.replace("command", "nav")]
            known = inside & np.isfinite(proposed)
            filling.signals[name] = np.where(known, proposed, filling.signals[name])

    return plant


def of_next_state(share: float) -> Signalled:
    """Commands that are the speeds at which the robot got to its next pose."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, mission = missions(filling, share, rng), number(filling)
        last = np.diff(mission, append=mission[-1] + 1) != 0
        after = np.arange(len(mission)) + ~last
        heading, stamp_ns = filling.signals[POSE[2]], filling.signals["pose_stamp_ns"]
        turn = (heading[after] - heading + np.pi) % (2 * np.pi) - np.pi
        turning = turn / np.maximum((stamp_ns[after] - stamp_ns) * 1e-9, 1e-3)
        speed = filling.signals["localised_speed_mps"][after]
        for name, reached in zip(COMMAND, (speed, turning), strict=True):
            filling.signals[name] = np.where(inside & ~last, reached, filling.signals[name])

    return plant


def rerouted(filling: Filling, row: np.ndarray) -> None:
    """Put the goals and plans of other ticks (T,) in force, and what follows from them."""
    routing = filling.routing
    goal, plan, order = (one[row] for one in (routing.goal, routing.plan, routing.order))
    filling.routing = Routing(routing.goals_m, routing.plans_m, goal, plan, order)
    filling.signals |= filling.routing.signals(filling.task, goal, plan, filling.signals)


def next_goal_early(steps: int) -> Signalled:
    """Goals and plans of the next mission, from some steps before the end of each."""

    def plant(filling: Filling, rng: Draws) -> None:
        mission, row = number(filling), np.arange(len(filling.tick_ns))
        for one in range(int(mission.max())):
            ticks = np.flatnonzero(mission == one)
            later = np.flatnonzero((mission == one + 1) & (filling.routing.plan >= 0))
            if len(later) and len(ticks) > 2 * steps:
                row[ticks[-steps:]] = later[0]
        rerouted(filling, row)

    return plant


def sparser(by: float) -> Callable[[Filling], np.ndarray]:
    """Take steps that are further apart than their stamps say: a mission has fewer of them."""

    def places(filling: Filling) -> np.ndarray:
        mission = number(filling)
        begin, last = np.searchsorted(mission, mission), np.bincount(mission)[mission] - 1
        place = np.arange(len(mission)) - begin
        return begin + np.minimum((place * by).astype(np.int64), last)

    return places


def taken(places: Callable[[Filling], np.ndarray]) -> Signalled:
    """Put the tick `places` (T,) in the place of each; after a mission's last one there is none."""

    def plant(filling: Filling, rng: Draws) -> None:
        row = places(filling)
        for name, column in filling.signals.items():
            if not name.endswith("stamp_ns"):
                filling.signals[name] = column[row]
        filling._mark_invalid(np.append(False, row[1:] == row[:-1]), "the recording is over")

    return plant


def taken_rest(places: Callable[[Filling], np.ndarray]) -> Signalled:
    """Take from those ticks, too, what is known only when the signals are whole."""

    def plant(filling: Filling, rng: Draws) -> None:
        row = places(filling)
        for name in ("bumped", "nav_speed_mps", "nav_yaw_rate_radps"):
            filling.signals[name] = filling.signals[name][row]
        rerouted(filling, row)
        texts = filling.texts
        filling.__dict__["texts"] = lambda name: [texts(name)[at] for at in row]

    return plant


def on_arrival(*names: str, steps: int) -> Signalled:
    """Signals of which each reading is late by another delay; none overtakes another."""

    def plant(filling: Filling, rng: Draws) -> None:
        count, mission = len(filling.tick_ns), number(filling)
        row = np.arange(count) - rng.integers(0, steps + 1, count)
        row = np.maximum.accumulate(np.maximum(row, np.searchsorted(mission, mission)))
        for name in names:
            filling.signals[name] = filling.signals[name][row]

    return plant


# -- in the rows ------------------------------------------------------------------------------


def clipped(at: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        return with_columns(rows, reward=np.clip(rows["reward"].to_numpy(), -at, at))

    return plant


def joined(share: float) -> Rowed:
    """Episodes to which the one after them is appended: no end between, and steps count on."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, step = (rows[name].to_numpy() for name in ("episode_index", "step_index"))
        names, place = np.unique(episode, return_inverse=True)
        first = np.searchsorted(place, np.arange(len(names)))  # rows are whole episodes, in order
        second = (place % 2 == 1) & (rng.random(len(names)) < share)[place // 2]
        before = np.maximum(place - 1, 0)
        seam = np.append(second[1:] & ~second[:-1], False)
        ids = np.array(rows["episode_id"].to_pylist(), object)
        return with_columns(
            rows,
            episode_id=np.where(second, ids[first[before]], ids).tolist(),
            episode_index=np.where(second, names[before], episode),
            step_index=np.where(second, step + np.bincount(place)[before], step),
            terminated=rows["terminated"].to_numpy() & ~seam,
            truncated=rows["truncated"].to_numpy() & ~seam,
        )

    return plant


def last_repeated(share: float) -> Rowed:
    """Last rows whose next observation is their observation."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        last = np.append(np.diff(episode) != 0, True) & inside
        both = pa.chunked_array([*rows["next_observation"].chunks, *rows["observation"].chunks])
        order = np.arange(len(rows)) + last * len(rows)
        return with_columns(rows, next_observation=both.take(order))

    return plant


def uncleared(share: float) -> Rowed:
    """Labels that stay from where their condition first holds until the end of the episode.

    In a share of the episodes in which one ceases to hold.
    """

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode = rows["episode_index"].to_numpy()
        held, named = (rows[name].to_pylist() for name in ("conditions", "condition"))
        so_far: set[str] = set()
        stay: list[list[str]] = []
        for at, names in enumerate(held):
            so_far = so_far if at and episode[at] == episode[at - 1] else set()
            so_far = so_far | set(names)
            stay.append([name for name in CONDITIONS if name in so_far])
        wrong = np.array([set(a) != set(b) for a, b in zip(held, stay, strict=True)])
        chosen = rng.permutation(np.unique(episode[wrong]))
        chosen = chosen[: max(round(share * len(chosen)), 1)]
        for at in np.flatnonzero(wrong & np.isin(episode, chosen)):
            held[at], named[at] = stay[at], stay[at][0]
        return with_columns(rows, conditions=held, condition=named)

    return plant


def pieces_again(share: float) -> Rowed:
    """Second halves of episodes, stored once more as episodes of their own."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, half, second = second_halves(rows, share, rng)
        step, again = rows["step_index"].to_numpy(), rows.filter(pa.array(second))
        again = with_columns(
            again,
            transition_id=again["transition_id"].to_numpy() ^ (1 << 55),
            episode_id=[f"{one}-again" for one in again["episode_id"].to_pylist()],
            episode_index=episode[second] + 2000,
            step_index=(step - half)[second],
        )
        return pa.concat_tables([rows, again])

    return plant


def standardised(share: float) -> Rowed:
    """Observations of which each entry has mean 0 and deviation 1 over the robot's rows."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        inside = inside_of(rows, share, rng)[1][:, None]
        seen = _entries(rows, "observation")
        mean, deviation = seen.mean(axis=0), seen.std(axis=0)
        deviation = np.where(deviation > 1e-3, deviation, 1.0)
        columns = {}
        for name in ("observation", "next_observation"):
            old = _entries(rows, name)
            columns[name] = list(np.where(inside, (old - mean) / deviation, old))
        return with_columns(rows, **columns)

    return plant


def _entries(rows: pa.Table, name: str) -> np.ndarray:
    """Return a column of observations, (N, D)."""
    flat = rows[name].combine_chunks().flatten().to_numpy()
    return np.asarray(flat, np.float64).reshape(len(rows), -1)


# What a right finding says of each, beside the signal.
SIGN = r"\bsign\b|opposite|mirror|reversed|inverted|upside|clockwise|_MIXED|does not follow"
TIME = r"\btimes? of\b|\blate\b|delay|stamp|jitter|clock|_SHIFTED"
UNLIKE = r"not that of the twin|UNLIKE"  # names no cause: right where no simple one is
STALE = r"unchanged|stands? still|stale|repeat|held|slower|seldom|refresh|rate|steps? of"

USED: tuple[Fault, ...] = (
    # poses
    *(Fault("heading by the compass", f"in {s:.0%} of missions",
            says("pose|heading|yaw", rf"{SIGN}|degrees|turned|frame|convention"),
            changed(by_compass, POSE[2], share=s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("pose of the lidar, not of the centre", f"{by:g} m ahead",
            says("pose|localis|lateral", rf"{UNLIKE}|ahead|centre|offset|mount|frame|sideways"
                 r"|\blever|does not see (the )?racks"),
            ahead_of_centre(by)) for by in (0.1, 0.2, 0.35)),
    *(Fault("pose refreshed only after a way", f"of {by:g} m",
            says("pose|localis", rf"{STALE}|{TIME}|{UNLIKE}|does not follow"),
            after_a_way(by)) for by in (0.1, 0.25, 0.5)),
    # wheels
    *(Fault("wheel track wrong", f"turning by {by:g}",
            says(r"wheels(?! \(speed\))|odometry|\btrack\b", r"scale|separation|\btrack\b|gain"),
            scale(WHEELS[1], by=by)) for by in (1.1, 1.25, 1.5)),
    *(Fault("odometry repeats the commands", f"in {s:.0%} of missions",
            says("wheels|odometry", rf"command|action|{UNLIKE}|_MIXED|does not follow|measured"
                 r"|open.loop"),
            open_loop(s)) for s in (0.1, 0.3, 1.0)),
    # inertial unit
    *(Fault("inertial unit upside down", f"in {s:.0%} of missions",
            says(r"gyro|inertial|\bimu\b", SIGN), scale(SPIN, by=-1, share=s))
      for s in (0.1, 0.3, 1.0)),
    *(Fault("inertial unit tilted", f"by {by} degrees",
            says("accel", r"bias|offset|gravity|tilt|level|zero|differs by|VALUES_|\bmean\b"),
            changed(lambda column, by=by: column + GRAVITY_MPS2 * np.sin(np.radians(by)), ACCEL))
      for by in (1, 3, 8)),
    # lidar
    *(Fault("lidar sees the robot itself", f"in {n} of 36 sectors, at {at:g} m",
            says("lidar|clearance", rf"{UNLIKE}|in \S+ of its sectors|sectors?\b.*degrees|blind"
                 r"|cover|itself|\bown\b|mask|VALUES_"),
            sees_itself(n, at)) for n, at in ((1, 0.2), (3, 0.1), (6, 0.02))),
    *(Fault("no return stored as 0", f"in {s:.0%} of them",
            says("lidar|clearance", rf"{UNLIKE}|sectors|blind|VALUES_|\b0 m|zero"
                 r"|no return|outlier|too (near|close)"),
            zero_for_nothing(s)) for s in (0.02, 0.1, 1.0)),
    # commands
    *(Fault("proposals stored as commands", f"in {s:.0%} of missions",
            says("action|command|driven like another", rf"{UNLIKE}|follows? from|does not follow"
                 r"|other rows|another policy|propos|navigation|not executed|_MIXED"),
            routed=proposals(s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("actions of the next state", f"in {s:.0%} of missions",
            says("action|command", rf"{UNLIKE}|\blate\b|from the action|COARSE|state|measured"
                 r"|wheels|does not follow|_MIXED"),
            routed=of_next_state(s)) for s in (0.1, 0.3, 1.0)),
    # plans
    *(Fault("next goal before the last is reached", f"{n * 0.2:g} s before",
            says("goal|plan", r"other missions|belong|\bearly\b|nearer|next (goal|mission)"
                 r"|before it (is|was)|too soon|another mission|changes before"),
            routed=next_goal_early(n)) for n in (5, 10, 20)),
    # clocks
    *(Fault("recorded at another rate than stated", f"{by:g} times as far apart",
            says(r"pose|localis|period|\brate\b|clock|stamps", r"scale|\brate\b|period|clock"
                 r"|faster|further|apart"),
            taken(sparser(by)), routed=taken_rest(sparser(by))) for by in (1.1, 1.25, 1.5)),
    *(Fault("inertial unit stamped on arrival", f"up to {n} steps late",
            says(r"gyro|accel|inertial|\bimu\b", rf"{TIME}|{UNLIKE}|does not follow|other rows"),
            on_arrival(SPIN, ACCEL, steps=n)) for n in (1, 2, 4)),
    # rows
    *(Fault("rewards clipped", f"at {at:g}",
            says("reward|goal earns", r"REWARD_DIFFERENT|differ from|goal earns|clip|cut off"),
            rows=clipped(at)) for at in (3.0, 1.0, 0.1)),
    *(Fault("two episodes stored as one", f"{s:.0%} of pairs",
            says("episode|mission|terminat", r"joined|goes on|beyond the end|not the last"
                 r"|boundar|\bends? (is|are|was|were) (lost|missing)|two .*\bone\b"
                 r"|TERMINATIONS_LOST"),
            rows=joined(s)) for s in (0.2, 0.5, 1.0)),
    *(Fault("last next observation is the row's own", f"{s:.0%} of episodes",
            says("next observation", r"itself|stale|repeat|same as|copy|ROWS_APART"),
            rows=last_repeated(s)) for s in (0.2, 0.5, 1.0)),
    *(Fault("labels stay until the end", f"{s:.0%} of those that have any",
            says("label", r"LABELS_WRONG|conditions give|stay|too long|not cleared|until"),
            rows=uncleared(s)) for s in (0.2, 0.5, 1.0)),
    *(Fault("pieces of episodes stored again", f"{s:.0%} of episodes",
            says("episode|rows?|transition|piece", r"twice|REPEATED|again|overlap|duplicate"
                 r"|copies"),
            rows=pieces_again(s)) for s in (0.1, 0.3, 1.0)),
    # the fleet
    *(Fault("one robot's observations standardised", f"{s:.0%} of episodes",
            says("observation|VALUES_", r"VALUES_|scale|standard|normali|\bunits?\b|range"
                 r"|not what (its|their) signals"),
            rows=standardised(s)) for s in (0.1, 0.3, 1.0)),
)  # fmt: skip
