"""Test whether sensors and actions in the logs respond to each other as in the twin.

Each relation has a gain, a delay and an unexplained part. The logs' figures are compared with the
twin's, or with the definition if no twin can be driven. Each action has a motion that the robot
settles to while the action is held. That motion is compared with those of the twin's actions.
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
_MIN_RESPONSE = 0.4  # share of the expected response; a mission with less does not respond
_MIN_SIGNAL = 10.0  # a mission is judged if its expected motion is this many times the noise
MIN_CLUSTERS = 5
_RIDGE = 1e-4  # share of the mean diagonal; keeps fits solvable if rows cannot tell lags apart


@dataclass(frozen=True)
class Response:
    """A fitted response of y to x at L lags, with R bootstrap draws over C clusters."""

    rows: int
    clusters: int
    gain: float
    delay: float  # steps
    unexplained: float  # share of y's mean square that the fit leaves
    gains: F64  # (R,)
    delays: F64  # (R,)
    unexplained_draws: F64  # (R,)
    offset: float  # y when x is 0
    offsets: F64  # (R,)
    kernel: F64  # (L,)
    moments: F64  # (C, L + 1, L + 1) sums of products of x at each lag and y, per cluster

    def unresponsive(self, kernel: F64) -> tuple[int, int]:
        """Count the clusters that do not respond as `kernel` predicts, and those that were judged.

        Clusters are judged if they move enough. Both counts are 0 if fewer than `MIN_CLUSTERS` do.
        """
        xx, xy = self.moments[:, :-1, :-1], self.moments[:, :-1, -1]
        moved = np.einsum("i,cij,j->c", kernel, xx, kernel)
        gain = (xy @ kernel) / np.maximum(moved, 1e-12)
        noise = self.unexplained * self.moments[:, -1, -1].sum() / self.rows
        sure = moved > _MIN_SIGNAL**2 * max(noise, 1e-12)
        known = sure.sum() >= MIN_CLUSTERS
        return int((gain < _MIN_RESPONSE)[sure].sum() * known), int(sure.sum() * known)


def fit_response(
    x: F64, y: F64, cluster: Ints, lags: Ints, rng: np.random.Generator, *, centred: bool = False
) -> Response | None:
    """Fit the response of y (n,) to x (n, L) at `lags` (L,); None if the rows are too few.

    None also if x or y is always 0. Rows with NaN or infinite values are ignored. `centred` fits
    an intercept, too.
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
    ridge = np.where(ridge > 0.0, ridge, ridge[0])  # 0 if a draw has only clusters with constant x
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
    """Return the interval of the ratio of two statistics: values `at`, independent draws (R,).

    `clusters` is the number of clusters of the statistic that has fewer.
    """
    bottom = np.where(np.abs(below) > 1e-9, below, np.nan)
    return interval_of(at[0] / at[1] if at[1] else float("nan"), above / bottom, clusters)


def difference_of(
    first: F64, second: F64, at: tuple[float, float], clusters: int
) -> ConfidenceInterval:
    """Return the interval of the difference of two statistics; arguments as in `ratio_of`."""
    return interval_of(at[0] - at[1], first - second, clusters)


def interval_of(value: float, draws: NDArray[np.float64], clusters: int) -> ConfidenceInterval:
    """Return the interval of a statistic with draws (R,); bounds are NaN if none is finite."""
    finite = draws[np.isfinite(draws)]
    if not len(finite) or not np.isfinite(value):
        return ConfidenceInterval(value, float("nan"), float("nan"))
    return for_few_clusters(ConfidenceInterval(value, *percentiles(finite)), clusters)


def lagged(x: F64, before: list[tuple[Ints, Bools]]) -> F64:
    """Return x (N,) at each of L lags, (N, L); NaN if there is no row at that lag."""
    return np.stack([np.where(known, x[row], np.nan) for row, known in before], axis=1)


ACTION_SPEED, ACTION_TURN = "action (speed)", "action (turn)"
WHEEL_SPEED, WHEEL_TURN = "wheels (speed)", "wheels (turn)"
POSE, GYROSCOPE, ACCELEROMETER, PLAN, LIDAR = "pose", "gyroscope", "accelerometer", "plan", "lidar"
COMMANDS = np.arange(-4, 8)  # lags in steps: responses come late, or early if logs are wrong
SENSORS = np.arange(-3, 4)
PLANS = np.arange(-3, 7)
NOW = np.zeros(1, np.int64)
_JUMP_RAD, _JUMP_M = 0.8, 0.6  # larger changes in one step mean that the plan was replaced
_SLOW_MPS = 0.3  # below this speed a waypoint's bearing changes by turning, not by driving past it
_MAX_ASIDE = 0.5  # largest sine of the waypoint's bearing at which driving shortens the route
_MIN_KEPT = 0.5  # rows near slip are left out if at least this share of the motion remains
_MIN_CLEAN = 0.1  # with less of a recording's motion free of slip, the floor is not at fault
_MIN_EPISODES = 5  # recordings with fewer episodes are judged together
_NEAR_STEPS = 5
_FAR = 0.97  # lidar entries beyond this saw nothing
SlipLeftOut = Literal["episodes", "rows", "none"]
GAIN = 1.2  # largest ratio of the logs' gain to the twin's, either way: robots differ
ALIKE = 1.05  # `GAIN` for two sensors that measure the same motion
BIAS_RADPS = 0.02  # largest turn that one sensor may show while another shows none
TURN_RADPS = 0.06  # largest turn that a sensor may show while the action has none
BIAS_MPS2 = 0.2
SIDEWAYS = 0.06  # largest ratio of sideways to forward motion, about 3 degrees
ARM_M = 0.06  # largest distance between the pose's point and the point that the robot turns about
STRAYED = 0.05  # largest share of missions without response, beyond the twin's
_STRAIGHT_RADPS = 0.15  # slower turns count as driving straight


@dataclass(frozen=True)
class Relation:
    """A response of signal `y` to signal `x`."""

    name: str
    x: str
    y: str
    lags: Ints
    of: Callable[[FedRows], tuple[F64, F64]]  # x and y of rows, (N,), or (N, S) for S lidar sectors
    defined: bool = True  # x and y are the same quantity: without a twin, the expected gain is 1
    zero: str = ""  # name under which the gain is reported if it should be 0; else ""
    most: float = GAIN  # largest ratio to the twin's gain, either way; with `zero`, largest |gain|
    offset: float = math.inf  # largest difference to the twin's y when x is 0; inf: no limit
    unit: str = "m/s"  # of y

    def fit(
        self, rows: FedRows, rng: np.random.Generator, leave_out: SlipLeftOut = "none"
    ) -> Response | None:
        """Fit the response of y to x; None if the rows are too few or nothing moves."""
        x, y = self.of(rows)
        y = y.copy()
        y[_rows_to_leave_out(rows, _motion(x, y), leave_out)] = np.nan
        if x.ndim == 2:
            cluster = np.repeat(rows.cluster, x.shape[1])
            return fit_response(x.reshape(-1, 1), y.reshape(-1), cluster, NOW, rng)
        before = [rows.before(int(lag)) for lag in self.lags]
        return fit_response(
            lagged(x, before), y, rows.cluster, self.lags, rng, centred=self.offset < math.inf
        )

    def slip_to_leave_out(self, rows: FedRows) -> SlipLeftOut:
        """Return which logged rows to leave out, so that the robot is not blamed for a wet floor.

        If wheels slip, the floor decides how a robot moves, also in the rows around the labelled
        ones. So episodes with slip are left out as a whole if others remain. A wrong sensor is
        labelled as slip, too, but in nearly all episodes: then fewer rows are left out, or none.
        """
        moves = _motion(*self.of(rows))
        if _find_slippery_episodes(rows, moves).any():
            return "episodes"
        return "rows" if moves[~_near_slip(rows)].sum() >= _MIN_KEPT * moves.sum() else "none"


def _motion(x: F64, y: F64) -> F64:
    """Return the weight of each row in the fit, (N,)."""
    moves = np.where(np.isfinite(y), x, 0.0) ** 2
    return moves if moves.ndim == 1 else np.asarray(moves.sum(axis=1))


def _rows_to_leave_out(rows: FedRows, moves: F64, what: SlipLeftOut) -> Bools:
    if what == "episodes":
        return _find_slippery_episodes(rows, moves)
    return _near_slip(rows) if what == "rows" else np.zeros(len(rows), np.bool_)


def _find_slip(rows: FedRows) -> Bools:
    """Return which rows (N,) slip: labelled rows of episodes whose labels are mostly right.

    A label is wrong if the robot moves as far as its wheels turn, only not where its pose heads.
    """
    labelled = rows.condition == "wheel_slip"
    moved = np.hypot(rows.after("localised_speed"), rows.after("lateral_speed"))
    unlike = np.abs(np.abs(rows.after("wheel_speed")) - moved) > rows.task.slip_limit_mps / 2
    episode = np.unique(rows.episode, return_inverse=True)[1].reshape(-1)
    slips = 2 * np.bincount(episode, labelled & unlike) >= np.bincount(episode, labelled)
    return np.asarray(labelled & slips[episode], np.bool_)


def _near_slip(rows: FedRows) -> Bools:
    """Return which rows (N,) slip or are within `_NEAR_STEPS` of a row that does."""
    slips = _find_slip(rows)
    near = slips.copy()
    for lag in (*range(-_NEAR_STEPS, 0), *range(1, _NEAR_STEPS + 1)):
        place, known = rows.before(lag)
        near |= slips[place] & known
    return near


def _find_slippery_episodes(rows: FedRows, moves: F64) -> Bools:
    """Return which rows (N,) are in slippery episodes of recordings that also move without slip."""
    if not len(rows):
        return np.zeros(0, np.bool_)
    _, first, episode = np.unique(rows.episode, return_index=True, return_inverse=True)
    slipped = np.bincount(episode, _find_slip(rows)) > 0  # (E,)
    recording = np.unique(rows.recording[first], return_inverse=True)[1] + 1  # (E,)
    recording[np.bincount(recording)[recording] < _MIN_EPISODES] = 0
    moved = np.bincount(episode, moves)
    clean = np.bincount(recording, moved * ~slipped)  # (R,)
    ice = clean >= np.maximum(_MIN_CLEAN * np.bincount(recording, moved), 1e-12)
    return np.asarray((slipped & ice[recording])[episode], np.bool_)


def wheel_turn(rows: FedRows) -> F64:
    return rows.after("slip_yaw_rate") + rows.after("gyro_yaw_rate")


def _pose_turn(rows: FedRows) -> F64:
    """Return the yaw rate (rad/s) of the pose's heading until the next row; NaN if unknown."""
    if rows.pose is None:
        return np.full(len(rows), np.nan)
    after, known = rows.before(-1)
    turn = (rows.pose[after, 2] - rows.pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.where(known, turn, np.nan) / rows.task.control_period_s


def _straight_speeds(rows: FedRows) -> tuple[F64, F64]:
    """Return the pose's speeds forward and sideways (m/s); sideways is NaN in turns."""
    forward, aside = rows.after("localised_speed"), rows.after("lateral_speed")
    straight = np.abs(rows.after("gyro_yaw_rate")) < _STRAIGHT_RADPS
    return forward, np.where(straight & (aside != 0.0), aside, np.nan)  # 0: no new pose


def _turn_and_drift(rows: FedRows) -> tuple[F64, F64]:
    """Return the yaw rate (rad/s) and the pose's speed sideways (m/s; NaN without a new pose)."""
    aside = rows.after("lateral_speed")
    return rows.after("gyro_yaw_rate"), np.where(aside != 0.0, aside, np.nan)


def _wheel_acceleration(rows: FedRows) -> F64:
    """Return the acceleration of the wheels over the step (m/s2)."""
    change = rows.after("wheel_speed") - rows.now("wheel_speed")
    return np.asarray(change / rows.task.control_period_s)


def _waypoint_turn(rows: FedRows) -> F64:
    """Return the yaw rate (rad/s) by the waypoint's bearing; NaN if driving or replanned."""
    now = np.arctan2(rows.now("near_sin"), rows.now("near_cos"))
    after = np.arctan2(rows.after("near_sin"), rows.after("near_cos"))
    change = (after - now + np.pi) % (2 * np.pi) - np.pi
    driving = np.abs(rows.after("localised_speed")) > _SLOW_MPS
    change[(np.abs(change) > _JUMP_RAD) | driving] = np.nan
    return np.asarray(-change / rows.task.control_period_s)


def _route_speed(rows: FedRows) -> F64:
    """Return how fast the remaining distance shrinks (m/s).

    NaN if the plan was replaced, if the distance is at its maximum, or if the robot does not head
    along the route, as driving elsewhere does not shorten it.
    """
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    shorter = 10.0 * (now - after)
    aside = (np.abs(rows.now("near_sin")) > _MAX_ASIDE) | (rows.now("near_cos") < 0.0)
    shorter[(np.abs(shorter) > _JUMP_M) | (now >= 1.0) | (after >= 1.0) | aside] = np.nan
    return np.asarray(shorter / rows.task.control_period_s)


def _scan_flow(rows: FedRows, turn: F64) -> tuple[F64, F64]:
    """Return the change of lidar sectors (N, S) expected from `turn` (rad/s), and the actual one.

    The actual change is NaN if nothing was seen, at edges, and in slow turns.
    """
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
    Relation("motion of the pose to its heading", POSE, POSE, NOW, _straight_speeds,
             zero="turn", most=SIDEWAYS),
    Relation("motion of the pose to its turn", POSE, POSE, NOW, _turn_and_drift,
             zero="arm", most=ARM_M),
    Relation("acceleration to the wheels", WHEEL_SPEED, ACCELEROMETER, SENSORS,
             lambda rows: (_wheel_acceleration(rows), 5.0 * rows.after("accel_x")), False,
             offset=BIAS_MPS2, unit="m/s2"),
    Relation("bearing of the waypoint to the gyroscope", GYROSCOPE, PLAN, NOW,
             lambda rows: (rows.after("gyro_yaw_rate"), _waypoint_turn(rows)), False),
    Relation("remaining distance to the speed of the pose", POSE, PLAN, PLANS,
             lambda rows: (rows.after("localised_speed"), _route_speed(rows)), False),
    Relation("what the lidar sees to the gyroscope", GYROSCOPE, LIDAR, NOW,
             lambda rows: _scan_flow(rows, rows.after("gyro_yaw_rate")), False),
    Relation("what the lidar sees to the turn of the wheels", WHEEL_TURN, LIDAR, NOW,
             lambda rows: _scan_flow(rows, wheel_turn(rows)), False),
)  # fmt: skip


NOISY_GAIN = 2.0  # `GAIN` for relations whose x and y are different quantities
DELAY_STEPS = 0.6
LATEST_STEPS = 2.0  # without a twin: how late a robot may respond to its commands
UNEXPLAINED = 0.2  # largest unexplained share, after subtracting the twin's
_MAX_LEFT = 0.5  # largest unexplained share if x and y are the same quantity, whatever the twin's
NOISY_UNEXPLAINED = 0.4  # `UNEXPLAINED` for different quantities: driver and place matter, too
_KNOWN_GAIN = 0.3  # if the gain, relative to the twin's, is smaller, a delay means nothing
HELD = 3  # consecutive steps of one action after which the motion counts as that action's
_MIN_HELD = 15  # least rows that hold an action, to judge its motion
_MIN_DISTANCE = 0.25  # a motion is odd this far from its action's; 1: fastest action, per axis
_MIN_SHARE = 0.8  # least share of an action's rows that must move like the same other action
TwinFits = dict[tuple[str, SlipLeftOut], Response | None]  # (relation, rows left out) -> fit


@dataclass(frozen=True)
class Broken:
    """The stretches of a robot's drives in which a relation does not hold."""

    off_by: float  # root mean square error in these stretches, in the unit of y
    usually: float  # root mean square error in all stretches of the other robots
    mended: dict[str, tuple[float, float]]  # cause -> (share mended by undoing it, its size)


@dataclass
class Answer:
    """A relation, compared between logs and twin."""

    relation: Relation
    comparisons: list[Comparison]
    gain: float  # factor from x to y in the logs, divided by the twin's; NaN if unknown
    delay: float  # delay from x to y in the logs, less the twin's, in steps
    rows: FedRows | None = None  # of the logs; None if not comparable with other robots' rows
    found: Response | None = None  # the relation as fitted to the logs
    broken: Broken | None = None  # set if more stretches break than for other robots

    @property
    def off(self) -> bool:
        return any(one.off for one in self.comparisons)

    @property
    def holds(self) -> bool:
        """Return whether the relation holds, apart from a wrong scale, delay or zero."""
        left = self.found.unexplained if self.found is not None else 0.0
        return not self.is_off("unexplained") and (not self.relation.defined or left <= _MAX_LEFT)

    @property
    def fine(self) -> bool:
        """Return whether all comparisons are ok or were not run."""
        return all(one.status in ("ok", "not run") for one in self.comparisons)

    def is_off(self, figure: str) -> bool:
        """Return whether a comparison whose check begins with `figure` is off."""
        return any(one.off and one.check.startswith(figure) for one in self.comparisons)


def answers(logs: FedRows, twin: FedRows | None, of_twin: TwinFits) -> list[Answer]:
    """Compare logs and twin by every relation. `of_twin` caches the twin's fits between calls."""
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
    name, what = relation.name, f"response of the {relation.name}"
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
    if expected is None:  # no twin: the gain should be 1, and commands precede their effects
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
            f"missions: {name}", "mission without the response of the " + name,
            found.unresponsive(expected.kernel), expected.unresponsive(expected.kernel), -1.0,
            STRAYED,
        )
    )  # fmt: skip
    by = delay.value if timed else 0.0
    return Answer(relation, made, gain.value, by, logs, found)


def held_motion(rows: FedRows) -> list[F64]:
    """Return, for each action, the wheels' motion (n, 2) in m/s and rad/s in rows that hold it."""
    held = np.ones(len(rows), np.bool_)
    for lag in range(1, HELD):
        place, known = rows.before(lag)
        held &= known & (rows.action[place] == rows.action)
    motion = np.stack([rows.after("wheel_speed"), wheel_turn(rows)], axis=1)
    return [motion[held & (rows.action == action)] for action in range(len(rows.task.actions))]


ACTION = "action: "


def permuted_actions(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    """Yield how far the motion of each logged action is from the same action's motion in the twin.

    Without a twin, motions are compared with the task's table of actions. `note` is the action to
    whose motion most rows are nearest. The check is off if that is clearly another action.
    """
    expected = np.array(logs.task.actions, np.float64)
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-9)
    for action, motion in enumerate(held_motion(twin) if twin is not None else []):
        if len(motion) >= _MIN_HELD:
            expected[action] = np.median(motion, axis=0)
    names = logs.task.action_names
    for action, motion in enumerate(held_motion(logs)):
        name = names[action]
        what = f"motion while the action {name!r} is held"
        if len(motion) < _MIN_HELD:
            yield not_run(ACTION + name, what, "too few rows of the logs hold this action")
            continue
        away = np.linalg.norm((motion[:, None] - expected) / scale, axis=2)  # (n, A)
        middle = np.median(away, axis=0)
        nearest = int(np.bincount(away.argmin(axis=1)).argmax())
        share = float((away.argmin(axis=1) == nearest).mean())
        is_other = nearest != action and middle[action] > _MIN_DISTANCE and share >= _MIN_SHARE
        # The status follows from the share of rows alone, without an interval.
        yield Comparison(
            ACTION + name, what, "distance", "off" if is_other else "ok",
            logs=float(middle[action]), twin=float(middle[nearest]), effect=float(middle[action]),
            most=_MIN_DISTANCE if is_other else None, logs_rows=len(motion), note=names[nearest],
            p=0.0 if is_other else 1.0,
        )  # fmt: skip
