"""Types of fault in logs that limits are set on, each in three doses.

A fault is planted where its like arises: in the signals, between a recording's messages and the
observation, so that observations, actions, rewards and labels all agree with it, as with a wrong
profile or a wrong clock; or in the rows of a store, as by software that rewrites them. One robot
of the fleet has it, unless it is of all. `right` is a pattern of what a right finding says.

`used_types.py` has those that were left out once, `left_out_types.py` those that still are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from restock.ingest.steps.filling import Filling, Routing

STRATUM = "blocked_aisle"
Draws = np.random.Generator
Signalled = Callable[[Filling, Draws], None]
Rowed = Callable[[pa.Table, Draws], pa.Table]


class Fault(NamedTuple):
    """One type at one dose: where it is planted, and the findings that are right (a pattern)."""

    type: str
    dose: str
    right: str
    signals: Signalled | None = None
    rows: Rowed | None = None
    routed: Signalled | None = None  # planted when the signals are whole
    again: float = 0.0  # share of the robot's episodes that are stored under another recording, too
    of_all: bool = False  # robots, and not of one


# -- in the signals ---------------------------------------------------------------------------


def number(filling: Filling) -> np.ndarray:
    """Return the mission (T,) of each tick: pauses of the recording divide them."""
    return np.cumsum(np.diff(filling.tick_ns, prepend=filling.tick_ns[:1]) > 2 * 10**9)


def missions(filling: Filling, share: float, rng: Draws) -> np.ndarray:
    """Return the ticks (T,) of a share of the missions."""
    mission = number(filling)
    chosen = rng.permutation(int(mission.max()) + 1)
    return np.isin(mission, chosen[: max(round(share * len(chosen)), 1)])


def changed(change: Callable[..., np.ndarray], *names: str, share: float = 1.0) -> Signalled:
    """Replace signals, each by what `change` makes of it, in a share of the missions."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        for name in names:
            column = filling.signals[name]
            filling.signals[name] = np.where(inside, change(column), column)

    return plant


def scale(*names: str, by: float, share: float = 1.0) -> Signalled:
    return changed(lambda column: column * by, *names, share=share)


def later(*names: str, steps: int) -> Signalled:
    return changed(
        lambda column: np.concatenate([np.repeat(column[:1], steps), column[:-steps]]), *names
    )


def permuted(cycle: int) -> Signalled:
    """Commands of another table of actions: each is the one `cycle` places on."""

    def plant(filling: Filling, rng: Draws) -> None:
        table = np.asarray(filling.task.actions)
        given = np.stack([filling.signals[name] for name in COMMAND], axis=1)
        nearest = np.abs(given[:, None] - table).sum(axis=2).argmin(axis=1)
        moved = np.where(nearest > 0, 1 + (nearest - 1 + cycle) % (len(table) - 1), 0)
        filling.signals[COMMAND[0]], filling.signals[COMMAND[1]] = table[moved].T

    return plant


def lost(share: float) -> Signalled:
    """Commands that did not arrive: the one before stands."""

    def plant(filling: Filling, rng: Draws) -> None:
        gone = rng.random(len(filling.tick_ns)) < share
        gone[0] = False
        held = np.maximum.accumulate(np.where(gone, 0, np.arange(len(gone))))
        for name in COMMAND:
            filling.signals[name] = filling.signals[name][held]

    return plant


def lidar(change: Callable[[np.ndarray], np.ndarray], share: float = 1.0) -> Signalled:
    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        seen = filling.signals["sector_clearance_m"]
        new = np.where(inside[:, None], change(seen), seen)
        filling.signals |= {"sector_clearance_m": new, "clearance_m": new.min(axis=1)}

    return plant


def frozen(share: float) -> Signalled:
    """Return a lidar that repeats its first scan of a mission, in a share of the missions."""

    def plant(filling: Filling, rng: Draws) -> None:
        mission = number(filling)
        first = np.searchsorted(mission, mission)
        lidar(lambda seen: seen[first], share)(filling, rng)

    return plant


def shaken(by_m: float) -> Signalled:
    def plant(filling: Filling, rng: Draws) -> None:
        for name in POSE[:2]:
            column = filling.signals[name]
            filling.signals[name] = column + rng.normal(0, by_m, len(column))

    return plant


def moved(x_m: float, y_m: float = 0.0, share: float = 1.0) -> Signalled:
    """Poses, goals and plans in a map whose origin is elsewhere."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        for name, by in zip(POSE, (x_m, y_m), strict=False):
            filling.signals[name] = filling.signals[name] + by * inside

    return plant


def relocated(x_m: float, y_m: float) -> Signalled:
    """All positions of a recording, in a map with another origin."""

    def plant(filling: Filling, rng: Draws) -> None:
        moved(x_m, y_m)(filling, rng)
        by = np.array([x_m, y_m])
        inputs = filling.inputs
        inputs.__dict__["goals"] = inputs.goals + by
        inputs.__dict__["plans"] = [plan + by for plan in inputs.plans]

    return plant


def other_goals(share: float) -> Signalled:
    """Goals, and the plans to them, of other missions."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, mission = missions(filling, share, rng), number(filling)
        routing = filling.routing
        goal, plan = routing.goal.copy(), routing.plan.copy()
        chosen = np.unique(mission[inside & (plan >= 0)])
        for one, other in zip(chosen, np.roll(chosen, 1), strict=True):
            of_other = np.flatnonzero((mission == other) & (routing.plan >= 0))[0]
            ticks = (mission == one) & (routing.plan >= 0)
            goal[ticks], plan[ticks] = routing.goal[of_other], routing.plan[of_other]
        filling.routing = Routing(routing.goals_m, routing.plans_m, goal, plan, routing.order)
        filling.signals |= filling.routing.signals(filling.task, goal, plan, filling.signals)

    return plant


def one_wheel(by: float) -> Signalled:
    """Odometry that takes the right wheel for smaller than it is, on a track of .5 m."""

    def plant(filling: Filling, rng: Draws) -> None:
        speed, turn = (filling.signals[name] for name in WHEELS)
        left, right = speed - 0.25 * turn, by * (speed + 0.25 * turn)
        filling.signals[WHEELS[0]], filling.signals[WHEELS[1]] = (
            (left + right) / 2,
            (right - left) / 0.5,
        )

    return plant


def slow_clock(by: float) -> Signalled:
    """Poses that are later the longer a recording lasts, as of a clock that runs slow."""

    def plant(filling: Filling, rng: Draws) -> None:
        late_ns = (by * (filling.tick_ns - filling.tick_ns[0])).astype(np.int64)
        row = np.searchsorted(filling.tick_ns, filling.tick_ns - late_ns, "right") - 1
        for name in POSE:
            filling.signals[name] = filling.signals[name][np.maximum(row, 0)]

    return plant


def exchanged(first: str, second: str, share: float) -> Signalled:
    def plant(filling: Filling, rng: Draws) -> None:
        inside = missions(filling, share, rng)
        a, b = filling.signals[first], filling.signals[second]
        filling.signals[first], filling.signals[second] = np.where(inside, [b, a], [a, b])

    return plant


def dead(sectors: int) -> Callable[[np.ndarray], np.ndarray]:
    """Sectors, from the front to the left, that see nothing."""

    def change(seen: np.ndarray) -> np.ndarray:
        seen = seen.copy()
        seen[:, seen.shape[1] // 2 :][:, :sectors] = 4.0
        return seen

    return change


def spikes(name: str, by: float, share: float) -> Signalled:
    """Single readings that are far off, either way."""

    def plant(filling: Filling, rng: Draws) -> None:
        column = filling.signals[name]
        hit = rng.random(len(column)) < share
        filling.signals[name] = column + by * hit * rng.choice([-1.0, 1.0], len(column))

    return plant


def held(*names: str, share: float) -> Signalled:
    """Signals that keep their value for the middle part of each mission."""

    def plant(filling: Filling, rng: Draws) -> None:
        mission = number(filling)
        count = np.bincount(mission)
        place = np.arange(len(mission)) - np.searchsorted(mission, mission)
        first = ((1 - share) / 2 * count).astype(np.int64)[mission]
        inside = (place >= first) & (place < first + share * count[mission])
        row = np.where(inside, np.arange(len(mission)) - place + first, np.arange(len(mission)))
        for name in names:
            filling.signals[name] = filling.signals[name][row]

    return plant


def aside(by_m: float) -> Signalled:
    """Poses that are elsewhere for five steps of each mission."""

    def plant(filling: Filling, rng: Draws) -> None:
        mission = number(filling)
        for one in np.unique(mission):
            rows = np.flatnonzero(mission == one)
            begin = rng.integers(0, max(len(rows) - 5, 1))
            column = filling.signals[POSE[0]].copy()
            column[rows[begin : begin + 5]] += by_m
            filling.signals[POSE[0]] = column

    return plant


def slower(*names: str | int) -> Signalled:
    """Signals that change only every n-th step; the last argument is n."""
    *signals, every = names

    def plant(filling: Filling, rng: Draws) -> None:
        row = np.arange(len(filling.tick_ns)) // int(every) * int(every)
        for name in signals:
            filling.signals[str(name)] = filling.signals[str(name)][row]

    return plant


def zeros(*names: str, share: float) -> Signalled:
    def plant(filling: Filling, rng: Draws) -> None:
        gone = rng.random(len(filling.tick_ns)) < share
        for name in names:
            filling.signals[name] = np.where(gone, 0.0, filling.signals[name])

    return plant


def of_other_missions(*names: str, share: float) -> Signalled:
    """Signals of the mission before, as of a topic of another robot."""

    def plant(filling: Filling, rng: Draws) -> None:
        inside, mission = missions(filling, share, rng), number(filling)
        begin = np.searchsorted(mission, mission)
        place = np.arange(len(mission)) - begin
        other = (mission - 1) % (mission.max() + 1)
        first, count = np.searchsorted(mission, other), np.bincount(mission)[other]
        row = np.where(inside, first + place % count, np.arange(len(mission)))
        for name in names:
            filling.signals[name] = filling.signals[name][row]

    return plant


def set_back(*names: str, steps: int) -> Signalled:
    """Signals that are late in the second half of the recording."""

    def plant(filling: Filling, rng: Draws) -> None:
        count = len(filling.tick_ns)
        row = np.arange(count) - steps * (np.arange(count) > count // 2)
        for name in names:
            filling.signals[name] = filling.signals[name][row]

    return plant


POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
COMMAND = ("command_speed_mps", "command_yaw_rate_radps")
TURN, SPIN = COMMAND[1], "gyro_yaw_rate_radps"
ACCEL = "accel_x_mps2"
WHEELS = ("wheel_speed_mps", "wheel_yaw_rate_radps")
SIDEWAYS = ("waypoint_near_y_m", "waypoint_far_y_m")
PLAN = (
    *("waypoint_near_x_m", "waypoint_near_y_m", "waypoint_far_x_m", "waypoint_far_y_m"),
    "route_remaining_m",
)

# -- in the rows ------------------------------------------------------------------------------


def with_columns(rows: pa.Table, **columns: object) -> pa.Table:
    for name, values in columns.items():
        at = rows.schema.get_field_index(name)
        field = rows.schema.field(at)
        column = values if isinstance(values, pa.ChunkedArray) else pa.array(values, field.type)
        rows = rows.set_column(at, field, column)
    return rows


def rewards(by: float, share: float = 1.0) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        reward = rows["reward"].to_numpy()
        inside = rng.random(len(reward)) < share
        return with_columns(rows, reward=np.where(inside, by * reward, reward))

    return plant


def rewards_of_others(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        reward = rows["reward"].to_numpy()
        inside = rng.random(len(reward)) < share
        return with_columns(rows, reward=np.where(inside, np.roll(reward, 1), reward))

    return plant


def reward_of_version(step: float) -> Rowed:
    """Rewards of a task whose steps cost more."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        return with_columns(rows, reward=rows["reward"].to_numpy() - step)

    return plant


def unended(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        ended = rows["terminated"].to_numpy()
        return with_columns(rows, terminated=ended & (rng.random(len(ended)) >= share))

    return plant


def ended_by_time(share: float) -> Rowed:
    """Episodes that were cut 2 s before their end, stored as terminated there."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, step = (rows[name].to_numpy() for name in ("episode_index", "step_index"))
        left = np.bincount(episode)[episode] - step  # rows are whole episodes
        inside = (rng.random(int(episode.max()) + 1) < share)[episode] & (left + step > 20)
        terminated = rows["terminated"].to_numpy() | (inside & (left == 11))
        return with_columns(rows, terminated=terminated).filter(pa.array(~inside | (left > 10)))

    return plant


def apart(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        order = np.arange(len(rows))
        inside = np.flatnonzero(rng.random(len(rows)) < share)
        order[inside] = rng.permutation(inside)
        return with_columns(rows, next_observation=rows["next_observation"].take(order))

    return plant


def ahead(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode = rows["episode_index"].to_numpy()
        inside = (rng.random(int(episode.max()) + 1) < share)[episode]
        both = pa.chunked_array([*rows["observation"].chunks, *rows["next_observation"].chunks])
        order = np.arange(len(rows)) + np.where(inside, len(rows), 0)
        return with_columns(rows, observation=both.take(order))

    return plant


def mislabelled(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        held = rows["conditions"].to_pylist()
        named = rows["condition"].to_pylist()
        inside = [i for i, names in enumerate(held) if STRATUM in names]
        plain = [i for i, names in enumerate(held) if not names]
        wrong = rng.permutation(inside)[: round(share * len(inside))].tolist()
        for index in wrong:
            held[index] = [name for name in held[index] if name != STRATUM]
            named[index] = held[index][0] if held[index] else "nominal"
        for index in rng.permutation(plain)[: len(wrong)].tolist():
            held[index], named[index] = [STRATUM], STRATUM
        return with_columns(rows, conditions=held, condition=named)

    return plant


def twice(share: float) -> Rowed:
    """Rows that a writer appended once more."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        chosen = np.flatnonzero(rng.random(len(rows)) < share)
        again = rows.take(chosen)
        again = with_columns(again, transition_id=again["transition_id"].to_numpy() ^ (1 << 55))
        return pa.concat_tables([rows, again])

    return plant


def other_policy(share: float) -> Rowed:
    """Store the planner's episodes under the operator's name, and the other way round."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode = rows["episode_index"].to_numpy()
        inside = (rng.random(int(episode.max()) + 1) < share)[episode]
        names = np.array(rows["behaviour_policy"].to_pylist(), object)
        swapped = np.where(names == "planner", "operator", "planner")
        return with_columns(rows, behaviour_policy=np.where(inside, swapped, names).tolist())

    return plant


def _successes(rows: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's episode (N,), and whether each episode (E,) earned the goal's reward."""
    episode = rows["episode_index"].to_numpy()
    good = rows["terminated"].to_numpy() & (rows["reward"].to_numpy() > 3)
    return episode, np.bincount(episode, good) > 0


def only_failures(condition: str, share: float) -> Rowed:
    """Remove from a condition's episodes a share of those that succeeded."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, success = _successes(rows)
        holds = np.array([condition in names for names in rows["conditions"].to_pylist()])
        gone = (np.bincount(episode, holds) > 0) & success & (rng.random(len(success)) < share)
        return rows.filter(pa.array(~gone[episode]))

    return plant


def without_failures(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, success = _successes(rows)
        gone = ~success & (rng.random(len(success)) < share)
        return rows.filter(pa.array(~gone[episode]))

    return plant


def cut_off(share: float, name: str = COMMAND[0]) -> Signalled:
    return changed(lambda column: np.clip(column, -share, share), name)


def inside_of(rows: pa.Table, share: float, rng: Draws) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's episode (N,), and whether it is in a share of the episodes."""
    episode = rows["episode_index"].to_numpy()
    return episode, (rng.random(int(episode.max()) + 1) < share)[episode]


def no_rewards(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        inside = inside_of(rows, share, rng)[1]
        return with_columns(rows, reward=np.where(inside, 0.0, rows["reward"].to_numpy()))

    return plant


def next_of_others(share: float) -> Rowed:
    """Last rows whose next observation is the first observation of the next episode."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        place = np.arange(len(rows))
        last = np.append(np.diff(episode) != 0, False) & inside
        both = pa.chunked_array([*rows["next_observation"].chunks, *rows["observation"].chunks])
        return with_columns(rows, next_observation=both.take(place + last * (len(rows) + 1)))

    return plant


def ends_early(share: float) -> Rowed:
    """Put ends into the row before the last one."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        before = inside & np.append(episode[1:] == episode[:-1], False)
        ended = rows["terminated"].to_numpy()
        early = np.append(ended[1:], False) & before
        return with_columns(rows, terminated=np.where(inside, early, ended))

    return plant


def cached(share: float) -> Rowed:
    """Observations that are those of the row before, here and there."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode = rows["episode_index"].to_numpy()
        stale = (rng.random(len(rows)) < share) & np.append(False, episode[1:] == episode[:-1])
        return with_columns(
            rows, observation=rows["observation"].take(np.arange(len(rows)) - stale)
        )

    return plant


def labels_of_others(share: float) -> Rowed:
    """Labels that are those of the episode before, step by step."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, inside = inside_of(rows, share, rng)
        first, count = np.searchsorted(episode, episode - 1), np.bincount(episode)
        other = np.maximum(episode - 1, 0)
        step = np.minimum(rows["step_index"].to_numpy(), count[other] - 1)
        row = np.where(inside & (episode > 0), first + step, np.arange(len(rows)))
        names = ("conditions", "condition")
        return with_columns(rows, **{name: rows[name].take(row).to_pylist() for name in names})

    return plant


def second_halves(rows: pa.Table, share: float, rng: Draws) -> tuple[np.ndarray, ...]:
    """Return rows' episode, half of its length, and whether it is the second half, (N,) each."""
    episode, inside = inside_of(rows, share, rng)
    half = np.bincount(episode)[episode] // 2
    return episode, half, inside & (rows["step_index"].to_numpy() >= half)


def split(share: float) -> Rowed:
    """Episodes whose second half is stored as an episode of its own, without an end between."""

    def plant(rows: pa.Table, rng: Draws) -> pa.Table:
        episode, half, second = second_halves(rows, share, rng)
        step = rows["step_index"].to_numpy()
        ids = np.array(rows["episode_id"].to_pylist(), object)
        return with_columns(
            rows,
            episode_id=np.where(second, ids + "b", ids).tolist(),
            episode_index=np.where(second, episode + 1000, episode),
            step_index=np.where(second, step - half, step),
        )

    return plant


DEVELOPED = [
    # the four that were missed
    *(Fault("near collisions from failures only", f"{s:.0%} of successes gone",
            "near_collision.*(succe|fail)", rows=only_failures("near_collision", s), of_all=True)
      for s in (0.6, 0.8, 1.0)),
    *(Fault("wheels scaled", f"by {by:g}", "wheels.*scale|scale.*wheels", scale(*WHEELS, by=by))
      for by in (0.96, 0.92, 0.85)),
    *(Fault("racks elsewhere", f"by {by:g} m", "rack|floor|map", relocated(by, 0.0), of_all=True)
      for by in (0.4, 1.0, 2.0)),
    *(Fault("goals of other missions", f"in {s:.0%} of missions", "goal.*mission|mission.*goal",
            routed=other_goals(s)) for s in (0.25, 0.5, 1.0)),
    # those of earlier rounds
    *(Fault("left and right swapped", f"{s:.0%} of missions", "ACTIONS_(MIRRORED|MIXED)",
            scale(TURN, by=-1, share=s)) for s in (0.1, 0.25, 1.0)),
    *(Fault("commands late", f"{n} steps", "ACTIONS_SHIFTED", later(*COMMAND, steps=n))
      for n in (1, 2, 3)),
    *(Fault("rewards scaled", f"by {by:g}", "REWARD_", rows=rewards(by)) for by in (1.1, 1.5, 10)),
    *(Fault("rewards of the row before", f"{s:.0%} of rows", "REWARD_", rows=rewards_of_others(s))
      for s in (0.05, 0.3, 1.0)),
    *(Fault("terminations lost", f"{s:.0%}", "TERMINATIONS_", rows=unended(s))
      for s in (0.2, 0.5, 1.0)),
    *(Fault("next observations of other rows", f"{s:.0%}", "ROWS_APART", rows=apart(s))
      for s in (0.02, 0.1, 1.0)),
    *(Fault("observations of the step after", f"{s:.0%} of episodes", "FUTURE_", rows=ahead(s))
      for s in (0.1, 0.25, 1.0)),
    *(Fault("gyroscope scaled", f"by {by:.3g}", "gyro", scale(SPIN, by=by))
      for by in (1.1, 1.5, 180 / np.pi)),
    *(Fault("episodes twice", f"{s:.0%}", "EPISODES_REPEATED", again=s) for s in (0.1, 0.3, 1.0)),
    *(Fault("labels wrong", f"{s:.0%} of {STRATUM}", "LABELS_WRONG", rows=mislabelled(s))
      for s in (0.1, 0.2, 0.4)),
    *(Fault("lidar mirrored", f"{s:.0%} of missions", "lidar",
            lidar(lambda seen: seen[:, ::-1], s)) for s in (0.25, 0.5, 1.0)),
    *(Fault("lidar turned", f"{10 * n} degrees", "LIDAR_TURNED",
            lidar(lambda seen, n=n: np.roll(seen, n, axis=1))) for n in (1, 3, 9)),
    *(Fault("lidar scaled", f"by {by:g}", "lidar|clearances", lidar(lambda seen, by=by: by * seen))
      for by in (0.8, 0.65, 0.5)),
    *(Fault("pose late", f"{n} steps", "SENSOR_SHIFTED.*pose", later(*POSE, steps=n))
      for n in (1, 2, 5)),
    *(Fault("pose shaken", f"by {by:g} m", "pose", shaken(by)) for by in (0.03, 0.05, 0.2)),
    *(Fault("commands lost", f"{s:.0%}", "action", lost(s)) for s in (0.15, 0.3, 0.6)),
    *(Fault("actions of another table", f"{n} places on", "ACTIONS_(PERMUTED|MIXED)", permuted(n))
      for n in (1, 3, 5)),
    *(Fault("waypoints mirrored", f"{s:.0%} of missions", "plan",
            routed=scale(*SIDEWAYS, by=-1, share=s)) for s in (0.25, 0.5, 1.0)),
    *(Fault("wheels late", f"{n} steps", "SENSOR_SHIFTED.*wheels", later(*WHEELS, steps=n))
      for n in (1, 2, 4)),
    *(Fault("commands scaled", f"by {by:g}", "COMMAND_SCALED|ACTIONS_COARSE",
            scale(*COMMAND, by=by)) for by in (0.85, 0.7, 0.5)),
    # left out before, and missed or named for a wrong reason by half
    *(Fault("one wheel larger", f"by {by:.0%}", "wheels", one_wheel(1 + by))
      for by in (0.04, 0.08, 0.15)),
    *(Fault("pose's clock slow", f"by {by:.1%}", "pose", slow_clock(by))
      for by in (0.001, 0.003, 0.01)),
    *(Fault("lidar stuck", f"in {s:.0%} of missions", "lidar|clearance", frozen(s))
      for s in (0.1, 0.3, 1.0)),
    *(Fault("gyroscope biased", f"by {by:g} rad/s", "gyro",
            changed(lambda column, by=by: column + by, SPIN)) for by in (0.03, 0.1, 0.3)),
    *(Fault("pose's x and y exchanged", f"in {s:.0%} of missions", "pose",
            exchanged(*POSE[:2], s)) for s in (0.25, 0.5, 1.0)),
    *(Fault("rewards of another task version", f"{by:g} less a step", "REWARD_",
            rows=reward_of_version(by)) for by in (0.02, 0.05, 0.2)),
    *(Fault("rows twice", f"{s:.0%}", "twice|REPEATED", rows=twice(s)) for s in (0.02, 0.1, 0.3)),
    *(Fault("policy mislabelled", f"{s:.0%} of episodes", "policy|planner|operator",
            rows=other_policy(s)) for s in (0.2, 0.5, 1.0)),
    *(Fault("time-outs stored as terminations", f"{s:.0%}", "TERMINATIONS_",
            rows=ended_by_time(s)) for s in (0.3, 0.6, 1.0)),
    *(Fault("localised elsewhere", f"by 1 m in {s:.0%} of missions", "pose|rack|floor|map",
            moved(0.7, 0.7, s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("failed missions left out", f"{s:.0%}", "succe|fail", rows=without_failures(s),
            of_all=True) for s in (0.3, 0.6, 1.0)),
    *(Fault("lidar's sectors dead", f"{n} of 36", "lidar|clearance", lidar(dead(n)))
      for n in (3, 9, 18)),
    *(Fault("plan late", f"{n} steps", "plan", routed=later(*PLAN, steps=n)) for n in (2, 5, 15)),
    *(Fault("lidar short", f"by {by:g} m", "lidar|clearance",
            lidar(lambda seen, by=by: np.maximum(seen - by, 0.0))) for by in (0.1, 0.25, 0.5)),
    *(Fault("commands cut off", f"at {at:g} m/s", "action|command|ACTIONS_|COMMAND_", cut_off(at))
      for at in (0.7, 0.5, 0.3)),
    *(Fault("pose's heading off", f"by {by} degrees", "pose",
            changed(lambda column, by=by: column + np.radians(by), POSE[2])) for by in (3, 8, 20)),
    # left out before, and found by 11 of 18
    *(Fault("accelerometer unscaled", f"by {by:g}", "accel", scale(ACCEL, by=by))
      for by in (1.2, 1.5, 2.0)),
    *(Fault("gyroscope with spikes", f"in {s:.0%} of the steps", "gyro", spikes(SPIN, 3.0, s))
      for s in (0.01, 0.03, 0.1)),
    *(Fault("pose held when tracking is lost", f"{s:.0%} of each mission", "pose",
            held(*POSE, share=s)) for s in (0.1, 0.25, 0.5)),
    *(Fault("pose jumps aside for a second", f"by {by:g} m, once a mission", "pose", aside(by))
      for by in (0.2, 0.5, 1.0)),
    *(Fault("odometry at a lower rate", f"every {n} steps", "wheels|UNCHANGED", slower(*WHEELS, n))
      for n in (2, 5, 10)),
    *(Fault("zeros where a reading is missing", f"in {s:.0%} of the steps", "wheels",
            zeros(*WHEELS, share=s)) for s in (0.03, 0.1, 0.3)),
    *(Fault("wheels saturated", f"at {at:g} m/s", "wheels", cut_off(at, WHEELS[0]))
      for at in (0.7, 0.5, 0.3)),
    *(Fault("lidar loses far returns", f"from {at:g} m on", "lidar|clearance",
            lidar(lambda seen, at=at: np.where(seen > at, 4.0, seen))) for at in (3.0, 2.0, 1.0)),
    *(Fault("commands of another mission", f"in {s:.0%} of missions", "action|ACTIONS_",
            of_other_missions(*COMMAND, share=s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("heading in degrees", f"in {s:.0%} of missions", "pose",
            changed(np.degrees, POSE[2], share=s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("commands rounded", f"to {by:g} m/s and rad/s", "action|command|COMMAND|ACTIONS_",
            changed(lambda column, by=by: by * np.round(column / by), *COMMAND))
      for by in (0.3, 0.5, 1.0)),
    *(Fault("a clock set back", f"by {n * 0.2:g} s, in half of the drive", "wheels|SENSOR_SHIFTED",
            set_back(*WHEELS, steps=n)) for n in (2, 5, 10)),
    *(Fault("rewards left at 0", f"in {s:.0%} of episodes", "REWARD_", rows=no_rewards(s))
      for s in (0.1, 0.3, 1.0)),
    *(Fault("last next observation of the next episode", f"{s:.0%} of episodes",
            "ROWS_APART|next observation", rows=next_of_others(s)) for s in (0.2, 0.5, 1.0)),
    *(Fault("ends a row early", f"{s:.0%} of episodes", "TERMINATIONS_", rows=ends_early(s))
      for s in (0.2, 0.5, 1.0)),
    *(Fault("observations of the step before", f"{s:.0%} of rows", "ROWS_|observation",
            rows=cached(s)) for s in (0.03, 0.1, 0.3)),
    *(Fault("labels of the episode before", f"{s:.0%} of episodes", "LABELS_",
            rows=labels_of_others(s)) for s in (0.1, 0.3, 1.0)),
    *(Fault("episodes split in two", f"{s:.0%}", "episode|ROWS_|rows", rows=split(s))
      for s in (0.1, 0.3, 1.0)),
]  # fmt: skip
DOSES = ("mild", "medium", "strong")
