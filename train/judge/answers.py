"""Test whether the logs' sensors and actions answer to each other as the twin's do.

For each relation: the gain, the delay and the unexplained part, in the logs against the twin; or
against the definition if no twin can be driven. And for each action: the motion that it
comes to when held: which of the twin's actions is that?
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.stats import ConfidenceInterval, cluster_counts, for_few_clusters, percentiles
from restock.train.judge.fed_rows import Comparison, FedRows, judged, not_run, shares_compared

RESAMPLES = 200
_ANSWERS = 0.4  # of what should follow; less is none
_SURELY = 10.0  # times the noise: what moves in a mission, for its answer to be known
MIN_CLUSTERS = 5
_RIDGE = 1e-4  # of the mean diagonal: lags that the rows do not tell apart


@dataclass(frozen=True)
class Response:
    """A fitted response, with its R bootstrap draws."""

    rows: int
    clusters: int
    gain: float
    delay: float  # steps
    unexplained: float  # of y's mean square
    gains: F64  # (R,)
    delays: F64  # (R,)
    unexplained_draws: F64  # (R,)
    offset: float  # of y where x is 0
    offsets: F64  # (R,)
    kernel: F64  # (L,)
    moments: F64  # (C, L + 1, L + 1) of each cluster, of x and y

    def strayed(self, kernel: F64) -> tuple[int, int]:
        """Count the clusters that surely do not answer by `kernel`, of those that move enough."""
        xx, xy = self.moments[:, :-1, :-1], self.moments[:, :-1, -1]
        moved = np.einsum("i,cij,j->c", kernel, xx, kernel)
        gain = (xy @ kernel) / np.maximum(moved, 1e-12)
        noise = self.unexplained * self.moments[:, -1, -1].sum() / self.rows
        sure = moved > _SURELY**2 * max(noise, 1e-12)
        known = sure.sum() >= MIN_CLUSTERS
        return int((gain < _ANSWERS)[sure].sum() * known), int(sure.sum() * known)


def fit_response(
    x: F64, y: F64, cluster: Ints, lags: Ints, rng: np.random.Generator, *, centred: bool = False
) -> Response | None:
    """Fit the response of y (n,) to x (n, L) at `lags` (L,); None if too little is known.

    Rows with a value that is not finite are left out. `centred`: to x and a constant.
    """
    known = np.isfinite(y) & np.isfinite(x).all(axis=1)
    x, y = x[known], y[known]
    place = np.unique(cluster[known], return_inverse=True)[1].reshape(-1)
    clusters = int(place.max(initial=-1)) + 1
    if clusters < MIN_CLUSTERS or not (y**2).sum() or not (x**2).sum():
        return None
    sums = np.stack([np.bincount(place, column, clusters) for column in (*x.T, y)], axis=1)
    count = np.bincount(place, minlength=clusters)
    joint = np.concatenate([x, y[:, None]], axis=1)
    width = joint.shape[1]
    moments = np.stack(
        [
            np.bincount(place, joint[:, i] * joint[:, j], clusters)
            for i in range(width)
            for j in range(width)
        ],
        axis=1,
    )  # (C, W * W)
    counts = np.concatenate([np.ones((1, clusters)), cluster_counts(clusters, RESAMPLES, rng)])
    drawn: F64 = np.asarray(counts @ moments, np.float64).reshape(-1, width, width)
    rows = np.maximum(counts @ count, 1).astype(np.float64)[:, None]
    mean = (counts @ sums) / rows
    if centred:
        drawn = drawn - rows[..., None] * mean[:, :, None] * mean[:, None, :]
    xx, xy, yy = drawn[:, :-1, :-1], drawn[:, :-1, -1], drawn[:, -1, -1]
    ridge = _RIDGE * np.trace(xx, axis1=1, axis2=2) / (width - 1)
    ridge = np.where(ridge > 0.0, ridge, ridge[0])  # a draw may have only clusters without a change
    h = np.linalg.solve(xx + ridge[:, None, None] * np.eye(width - 1), xy[..., None])[..., 0]
    gain = h.sum(axis=1)
    safe = np.where(np.abs(gain) > 1e-9, gain, 1e-9)
    delay = (h * lags).sum(axis=1) / safe
    left = yy - 2 * (h * xy).sum(axis=1) + np.einsum("ri,rij,rj->r", h, xx, h)
    unexplained = np.clip(left / np.maximum(yy, 1e-12), 0.0, None)
    offset = mean[:, -1] - (h * mean[:, :-1]).sum(axis=1)
    return Response(
        len(y), clusters, float(gain[0]), float(delay[0]), float(unexplained[0]),
        gain[1:], delay[1:], unexplained[1:], float(offset[0]), offset[1:],
        h[0], moments.reshape(-1, width, width).astype(np.float64),
    )  # fmt: skip


def ratio_of(above: F64, below: F64, at: tuple[float, float], clusters: int) -> ConfidenceInterval:
    """Return the interval of a ratio of statistics with independent draws (R,) and values `at`.

    `clusters` are those of the one that has fewer.
    """
    bottom = np.where(np.abs(below) > 1e-9, below, np.nan)
    return interval_of(at[0] / at[1] if at[1] else float("nan"), above / bottom, clusters)


def difference_of(
    first: F64, second: F64, at: tuple[float, float], clusters: int
) -> ConfidenceInterval:
    """Return the interval of a difference, with independent draws (R,) and values `at`.

    `clusters` are those of the one that has fewer.
    """
    return interval_of(at[0] - at[1], first - second, clusters)


def interval_of(value: float, draws: NDArray[np.float64], clusters: int) -> ConfidenceInterval:
    """Return the interval of a statistic with draws (R,) over clusters; NaN if not known."""
    finite = draws[np.isfinite(draws)]
    if not len(finite) or not np.isfinite(value):
        return ConfidenceInterval(value, float("nan"), float("nan"))
    return for_few_clusters(ConfidenceInterval(value, *percentiles(finite)), clusters)


def lagged(x: F64, before: list[tuple[Ints, Bools]]) -> F64:
    """Return x (N,) at each of L lags, (N, L); NaN if the row of that lag is unknown."""
    return np.stack([np.where(known, x[row], np.nan) for row, known in before], axis=1)


ACTION_SPEED, ACTION_TURN = "action (speed)", "action (turn)"
WHEEL_SPEED, WHEEL_TURN = "wheels (speed)", "wheels (turn)"
POSE, GYROSCOPE, ACCELEROMETER, PLAN, LIDAR = "pose", "gyroscope", "accelerometer", "plan", "lidar"
COMMANDS = np.arange(-4, 8)  # lags of commands: robots answer late, logs may be wrong either way
SENSORS = np.arange(-3, 4)
PLANS = np.arange(-3, 7)
NOW = np.zeros(1, np.int64)
_JUMP_RAD = 0.8  # a plan was replaced, not turned
_SLOW_MPS = 0.3  # slower than this a waypoint's bearing changes by turning, not by driving past it
_JUMP_M = 0.6
_AHEAD = 0.5  # sine of the waypoint's bearing, at most, for the way to be what is driven
_MOST = 0.5  # of what moves
_CLEAN = 0.1  # of what moves in a recording, in episodes without slip, for slip to be the floor's
_MIN_EPISODES = 5  # of a recording that is judged by itself
_NEAR_STEPS = 5
_FAR = 0.97  # of the lidar's range: nothing was seen
SlipLeftOut = Literal["episodes", "rows", "none"]
GAIN = 1.2  # of logs over the twin's, or its inverse: robots answer differently
ALIKE = 1.05  # of two sensors that measure one motion
BIAS_RADPS, TURN_RADPS = 0.02, 0.06  # of a turn by one sensor where another, or an action, has none
BIAS_MPS2 = 0.2
SIDEWAYS = 0.06  # of the way forward, about 3 degrees
ARM_M = 0.06  # from where the robot turns to where its pose is
STRAYED = 0.05  # of the missions
_STRAIGHT_RADPS = 0.15


@dataclass(frozen=True)
class Relation:
    """A response of signal `y` to signal `x`."""

    name: str
    x: str
    y: str
    lags: Ints
    of: Callable[[FedRows], tuple[F64, F64]]  # x and y of the rows, (N,) each; or (N, S)
    defined: bool = True  # x is y, so that the gain is 1 where there is no twin to ask
    zero: str = ""  # instead of a gain, a figure of this name, which is 0 in the twin too
    most: float = GAIN  # times the twin's gain, or its inverse
    offset: float = math.inf  # most of y where x is 0, less the twin's, in y's unit
    unit: str = "m/s"  # of y

    def fit(
        self, rows: FedRows, rng: np.random.Generator, leave_out: SlipLeftOut = "none"
    ) -> Response | None:
        """Fit the response; None if the rows say too little."""
        x, y = self.of(rows)
        y = y.copy()
        y[_left_out(rows, _motion(x, y), leave_out)] = np.nan
        if x.ndim == 2:
            cluster = np.repeat(rows.cluster, x.shape[1])
            return fit_response(x.reshape(-1, 1), y.reshape(-1), cluster, NOW, rng)
        before = [rows.before(int(lag)) for lag in self.lags]
        return fit_response(
            lagged(x, before), y, rows.cluster, self.lags, rng, centred=self.offset < math.inf
        )

    def slip_to_leave_out(self, rows: FedRows) -> SlipLeftOut:
        """Return which logged rows to leave out, so that the robot is not blamed for a wet floor.

        Where wheels slip, the floor decides how a robot moves, also in the rows around those
        labelled: so whole episodes are left out, as long as others remain. But a wrong sensor looks
        like slip too, all the time: then nearly every episode of its recording is so labelled.
        """
        moves = _motion(*self.of(rows))
        if _on_ice(rows, moves).any():
            return "episodes"
        return "rows" if moves[~_near_slip(rows)].sum() >= _MOST * moves.sum() else "none"


def _motion(x: F64, y: F64) -> F64:
    """Return the weight of each row in the fit, (N,)."""
    moves = np.where(np.isfinite(y), x, 0.0) ** 2
    return moves if moves.ndim == 1 else np.asarray(moves.sum(axis=1))


def _left_out(rows: FedRows, moves: F64, what: SlipLeftOut) -> Bools:
    if what == "episodes":
        return _on_ice(rows, moves)
    return _near_slip(rows) if what == "rows" else np.zeros(len(rows), np.bool_)


def _slips(rows: FedRows) -> Bools:
    """Return which rows (N,) are labelled so, if they mostly move less or more than the wheels.

    Who moves as far, but not where the pose heads, does not slip.
    """
    labelled = rows.condition == "wheel_slip"
    moved = np.hypot(rows.after("localised_speed"), rows.after("lateral_speed"))
    unlike = np.abs(np.abs(rows.after("wheel_speed")) - moved) > rows.task.slip_limit_mps / 2
    episode = np.unique(rows.episode, return_inverse=True)[1].reshape(-1)
    slips = 2 * np.bincount(episode, labelled & unlike) >= np.bincount(episode, labelled)
    return np.asarray(labelled & slips[episode], np.bool_)


def _near_slip(rows: FedRows) -> Bools:
    """Return which rows (N,) are labelled as slipping or within a few steps of one."""
    slips = _slips(rows)
    near = slips.copy()
    for lag in (*range(-_NEAR_STEPS, 0), *range(1, _NEAR_STEPS + 1)):
        place, known = rows.before(lag)
        near |= slips[place] & known
    return near


def _on_ice(rows: FedRows, moves: F64) -> Bools:
    """Return the rows (N,) of episodes with slip, in recordings that also move without slip.

    Recordings of few episodes are judged together.
    """
    if not len(rows):
        return np.zeros(0, np.bool_)
    _, first, episode = np.unique(rows.episode, return_index=True, return_inverse=True)
    slipped = np.bincount(episode, _slips(rows)) > 0  # (E,)
    recording = np.unique(rows.recording[first], return_inverse=True)[1] + 1  # (E,)
    recording[np.bincount(recording)[recording] < _MIN_EPISODES] = 0
    moved = np.bincount(episode, moves)
    clean = np.bincount(recording, moved * ~slipped)  # (R,)
    ice = clean >= np.maximum(_CLEAN * np.bincount(recording, moved), 1e-12)
    return np.asarray((slipped & ice[recording])[episode], np.bool_)


def wheel_turn(rows: FedRows) -> F64:
    return rows.after("slip_yaw_rate") + rows.after("gyro_yaw_rate")


def _pose_turn(rows: FedRows) -> F64:
    """Return the yaw rate (rad/s) of the pose's heading to the row after; NaN if unknown."""
    if rows.pose is None:
        return np.full(len(rows), np.nan)
    after, known = rows.before(-1)
    turn = (rows.pose[after, 2] - rows.pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.where(known, turn, np.nan) / rows.task.control_period_s


def _sideways(rows: FedRows) -> tuple[F64, F64]:
    """Return the pose's speed forward and sideways, of rows that drive straight on."""
    forward, aside = rows.after("localised_speed"), rows.after("lateral_speed")
    straight = np.abs(rows.after("gyro_yaw_rate")) < _STRAIGHT_RADPS
    return forward, np.where(straight & (aside != 0.0), aside, np.nan)  # 0: there was no new pose


def _swinging(rows: FedRows) -> tuple[F64, F64]:
    """Return the yaw rate, and the pose's speed sideways."""
    aside = rows.after("lateral_speed")
    return rows.after("gyro_yaw_rate"), np.where(aside != 0.0, aside, np.nan)


def _gained(rows: FedRows) -> F64:
    """Return the acceleration of the wheels over the step, m/s2."""
    change = rows.after("wheel_speed") - rows.now("wheel_speed")
    return np.asarray(change / rows.task.control_period_s)


def _turned_waypoint(rows: FedRows) -> F64:
    """Return the yaw rate (rad/s) that the near waypoint's bearing shows.

    NaN where driving or the plan moved it.
    """
    now = np.arctan2(rows.now("near_sin"), rows.now("near_cos"))
    after = np.arctan2(rows.after("near_sin"), rows.after("near_cos"))
    change = (after - now + np.pi) % (2 * np.pi) - np.pi
    driving = np.abs(rows.after("localised_speed")) > _SLOW_MPS
    change[(np.abs(change) > _JUMP_RAD) | driving] = np.nan
    return np.asarray(-change / rows.task.control_period_s)


def _route_speed(rows: FedRows) -> F64:
    """Return how fast the way to go became shorter, m/s.

    NaN if the plan jumped or is at its maximum, or if the robot does not head along it: who
    drives elsewhere does not shorten it.
    """
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    shorter = 10.0 * (now - after)
    aside = (np.abs(rows.now("near_sin")) > _AHEAD) | (rows.now("near_cos") < 0.0)
    shorter[(np.abs(shorter) > _JUMP_M) | (now >= 1.0) | (after >= 1.0) | aside] = np.nan
    return np.asarray(shorter / rows.task.control_period_s)


def _scan_flow(rows: FedRows, turn: F64) -> tuple[F64, F64]:
    """Return how sectors (N, S) would change by a turn on the spot (rad/s), and how they did."""
    now, after = rows.sectors(), rows.sectors(after=True)
    width = 2 * np.pi / max(rows.task.sectors, 1)
    slope = (np.roll(now, -1, axis=1) - np.roll(now, 1, axis=1)) / (2 * width)
    expected = slope * (turn * rows.task.control_period_s)[:, None]
    changed = after - now
    unseen = (now > _FAR) | (after > _FAR)
    unseen |= np.roll(unseen, 1, axis=1) | np.roll(unseen, -1, axis=1)
    unseen |= np.abs(slope) > 1.0  # an edge: what lies behind it comes into view
    unseen |= (np.abs(turn) < 0.2)[:, None]
    return expected, np.where(unseen, np.nan, changed)


RELATIONS = (
    Relation("speed of the wheels to the action", ACTION_SPEED, WHEEL_SPEED, COMMANDS,
             lambda rows: (rows.command()[:, 0], rows.after("wheel_speed"))),
    Relation("speed of the pose to the action", ACTION_SPEED, POSE, COMMANDS,
             lambda rows: (rows.command()[:, 0], rows.after("localised_speed"))),
    Relation("yaw rate of the gyroscope to the action", ACTION_TURN, GYROSCOPE, COMMANDS,
             lambda rows: (rows.command()[:, 1], rows.after("gyro_yaw_rate")), offset=TURN_RADPS,
             unit="rad/s"),
    Relation("yaw rate of the wheels to the action", ACTION_TURN, WHEEL_TURN, COMMANDS,
             lambda rows: (rows.command()[:, 1], wheel_turn(rows)), offset=TURN_RADPS,
             unit="rad/s"),
    Relation("speed of the pose to the wheels", WHEEL_SPEED, POSE, SENSORS,
             lambda rows: (rows.after("wheel_speed"), rows.after("localised_speed")),
             most=ALIKE),
    Relation("yaw rate of the wheels to the gyroscope", GYROSCOPE, WHEEL_TURN, SENSORS,
             lambda rows: (rows.after("gyro_yaw_rate"), wheel_turn(rows)),
             most=ALIKE, offset=BIAS_RADPS, unit="rad/s"),
    Relation("yaw rate of the pose to the gyroscope", GYROSCOPE, POSE, SENSORS,
             lambda rows: (rows.after("gyro_yaw_rate"), _pose_turn(rows)), offset=BIAS_RADPS,
             unit="rad/s"),
    Relation("motion of the pose to its heading", POSE, POSE, NOW, lambda rows: _sideways(rows),
             zero="turn", most=SIDEWAYS),
    Relation("motion of the pose to its turn", POSE, POSE, NOW, lambda rows: _swinging(rows),
             zero="arm", most=ARM_M),
    Relation("acceleration to the wheels", WHEEL_SPEED, ACCELEROMETER, SENSORS,
             lambda rows: (_gained(rows), 5.0 * rows.after("accel_x")), False,
             offset=BIAS_MPS2, unit="m/s2"),
    Relation("bearing of the waypoint to the gyroscope", GYROSCOPE, PLAN, NOW,
             lambda rows: (rows.after("gyro_yaw_rate"), _turned_waypoint(rows)), False),
    Relation("remaining distance to the speed of the pose", POSE, PLAN, PLANS,
             lambda rows: (rows.after("localised_speed"), _route_speed(rows)), False),
    Relation("what the lidar sees to the gyroscope", GYROSCOPE, LIDAR, NOW,
             lambda rows: _scan_flow(rows, rows.after("gyro_yaw_rate")), False),
    Relation("what the lidar sees to the turn of the wheels", WHEEL_TURN, LIDAR, NOW,
             lambda rows: _scan_flow(rows, wheel_turn(rows)), False),
)  # fmt: skip


NOISY_GAIN = 2.0  # of relations that are no measurement of the same thing
DELAY_STEPS = 0.6
LATEST_STEPS = 2.0  # without a twin: how late a robot may answer to its commands
UNEXPLAINED = 0.2
_LEFT = 0.5  # most of two measurements of the same thing, with a twin or without
NOISY_UNEXPLAINED = 0.4  # where it depends on who drives, and where
_KNOWN_GAIN = 0.3  # of logs over the twin's, for a delay to mean something
HELD = 3  # steps of one action in a row, for its motion to be that action's
_MIN_HELD = 15
_AWAY = 0.25  # of the fastest action on each axis
_MAX_ROWS = 0.8  # of an action's, those with the motion of one other
TwinFits = dict[tuple[str, SlipLeftOut], Response | None]  # by relation and what it leaves out


@dataclass(frozen=True)
class Broken:
    """The stretches of a robot's drives in which a relation does not hold."""

    off_by: float  # root mean square in these stretches, in the unit of y
    usually: float  # and in the other robots'
    mended: dict[str, tuple[float, float]]  # by cause: the share that holds without it, its size


@dataclass
class Answer:
    """A relation in logs and twin."""

    relation: Relation
    comparisons: list[Comparison]
    gain: float  # logs over twin; NaN: not known
    delay: float  # logs less twin, steps
    rows: FedRows | None = None  # of the logs, if these can be compared with other robots'
    found: Response | None = None
    broken: Broken | None = None  # in some stretches, beside other robots

    @property
    def off(self) -> bool:
        return any(one.off for one in self.comparisons)

    @property
    def holds(self) -> bool:
        """Return whether a scale, a delay and a zero of its own make the relation hold."""
        left = self.found.unexplained if self.found is not None else 0.0
        return not self.is_off("unexplained") and (not self.relation.defined or left <= _LEFT)

    @property
    def fine(self) -> bool:
        """Return whether no comparison is off or undecided."""
        return all(one.status in ("ok", "not run") for one in self.comparisons)

    def is_off(self, figure: str) -> bool:
        """Return whether the gain, delay or unexplained part is off."""
        return any(one.off and one.check.startswith(figure) for one in self.comparisons)


def answers(logs: FedRows, twin: FedRows | None, of_twin: TwinFits) -> list[Answer]:
    """Compare every relation. `of_twin` keeps the twin's fits for the next logs."""
    rng = np.random.default_rng([0, 1])
    return [_answer(relation, logs, twin, rng, of_twin) for relation in RELATIONS]


def _answer(
    relation: Relation,
    logs: FedRows,
    twin: FedRows | None,
    rng: np.random.Generator,
    of_twin: TwinFits,
) -> Answer:
    leave_out = relation.slip_to_leave_out(logs)
    found = relation.fit(logs, rng, leave_out)
    kept = relation.name, leave_out
    if twin is not None and kept not in of_twin:
        of_twin[kept] = relation.fit(twin, rng, leave_out)
    expected = of_twin.get(kept)
    name, what = relation.name, f"answer of the {relation.name}"
    if found is not None and relation.zero:
        figure = interval_of(found.gain, found.gains, found.clusters)
        row = judged(
            f"{relation.zero}: {name}", what, "difference", figure, logs=found.gain, twin=0.0,
            least=-relation.most, most=relation.most, logs_rows=found.rows,
        )  # fmt: skip
        return Answer(relation, [row], 1.0, 0.0)
    if found is None or (expected is None and (twin is not None or not relation.defined)):
        reason = "too few rows, or nothing moves, in the " + ("logs" if found is None else "twin")
        if found is not None and twin is None:
            reason = "no twin to compare with"
        row = not_run(f"gain: {name}", what, reason)
        return Answer(relation, [row], float("nan"), 0.0, rows=logs)
    most, most_left = (
        (relation.most, UNEXPLAINED) if relation.defined else (NOISY_GAIN, NOISY_UNEXPLAINED)
    )
    if expected is None:  # a speed equals a speed, and commands precede what they cause
        gain = interval_of(found.gain, found.gains, found.clusters)
        delay = interval_of(found.delay, found.delays, found.clusters)
        made = [judged(f"gain: {name}", what, "ratio", gain, logs=found.gain, twin=None,
                       least=1 / most, most=most, logs_rows=found.rows)]  # fmt: skip
        if abs(gain.value) > _KNOWN_GAIN:
            made.append(
                judged(f"delay: {name}", what, "steps later", delay, logs=found.delay, twin=None,
                       least=-DELAY_STEPS, most=LATEST_STEPS, logs_rows=found.rows)
            )  # fmt: skip
        over = min(max(found.delay, 0.0), LATEST_STEPS)
        return Answer(relation, made, gain.value, found.delay - over, logs, found)
    fewer = min(found.clusters, expected.clusters)
    gain = ratio_of(found.gains, expected.gains, (found.gain, expected.gain), fewer)
    delay = difference_of(found.delays, expected.delays, (found.delay, expected.delay), fewer)
    left = difference_of(
        found.unexplained_draws,
        expected.unexplained_draws,
        (found.unexplained, expected.unexplained),
        fewer,
    )
    timed = len(relation.lags) > 1 and abs(gain.value) > _KNOWN_GAIN
    compared = [
        ("gain", "ratio", gain, found.gain, expected.gain, 1 / most, most),
        *[("delay", "steps later", delay, found.delay, expected.delay, -DELAY_STEPS, DELAY_STEPS)]
        * timed,
        ("unexplained", "difference", left, found.unexplained, expected.unexplained, -1.0,
         most_left),
    ]  # fmt: skip
    if math.isfinite(relation.offset):
        bias = difference_of(
            found.offsets, expected.offsets, (found.offset, expected.offset), fewer
        )
        compared.append(("offset", "difference", bias, found.offset, expected.offset,
                         -relation.offset, relation.offset))  # fmt: skip
    made = [
        judged(
            f"{figure}: {name}", what, measure, interval, logs=of_logs, twin=of_twin,
            least=low, most=high, logs_rows=found.rows, twin_rows=expected.rows,
        )
        for figure, measure, interval, of_logs, of_twin, low, high in compared
    ]  # fmt: skip
    made.append(
        shares_compared(
            f"missions: {name}", "mission without the answer of the " + name,
            found.strayed(expected.kernel), expected.strayed(expected.kernel), -1.0, STRAYED,
        )
    )  # fmt: skip
    by = delay.value if timed else 0.0
    return Answer(relation, made, gain.value, by, logs, found)


def held_motion(rows: FedRows) -> list[F64]:
    """Return the motion (n, 2) of the rows that hold each action: m/s and rad/s by the wheels."""
    held = np.ones(len(rows), np.bool_)
    for lag in range(1, HELD):
        place, known = rows.before(lag)
        held &= known & (rows.action[place] == rows.action)
    motion = np.stack([rows.after("wheel_speed"), wheel_turn(rows)], axis=1)
    return [motion[held & (rows.action == action)] for action in range(len(rows.task.actions))]


ACTION = "action: "


def permuted_actions(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    """Yield how far each logged action's motion is from that action's in the twin.

    Without a twin, the task's table is compared with. The note is the action whose motion most of
    its rows have: the check is off if that is surely another one.
    """
    expected = np.array(logs.task.actions, np.float64)
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-9)
    for action, motion in enumerate(held_motion(twin) if twin is not None else []):
        if len(motion) >= _MIN_HELD:
            expected[action] = np.median(motion, axis=0)
    names = logs.task.action_names
    for action, motion in enumerate(held_motion(logs)):
        name = names[action]
        what = f"motion under the action {name!r}, held"
        if len(motion) < _MIN_HELD:
            yield not_run(ACTION + name, what, "hardly held in the logs")
            continue
        away = np.linalg.norm((motion[:, None] - expected) / scale, axis=2)  # (n, A)
        middle = np.median(away, axis=0)
        nearest = int(np.bincount(away.argmin(axis=1)).argmax())
        share = float((away.argmin(axis=1) == nearest).mean())
        is_other = nearest != action and middle[action] > _AWAY and share >= _MAX_ROWS
        # A median decided by a share: there is no interval to show.
        yield Comparison(
            ACTION + name, what, "distance", "off" if is_other else "ok",
            logs=float(middle[action]), twin=float(middle[nearest]), effect=float(middle[action]),
            most=_AWAY if is_other else None, logs_rows=len(motion), note=names[nearest],
            p=0.0 if is_other else 1.0,
        )  # fmt: skip
