"""The parameters that can be fitted, and the search for them: coarse, then by least squares.

Residuals are the differences between replays and the log, by channel. Before position and heading
are compared, each replayed path is moved rigidly onto the logged one (by the mean heading and
position of the segment's fresh poses). Otherwise, a localiser's error at a segment's first pose
would turn and shift the whole path. In the twin, commands take effect at a physics step, so a
replay's latency is a multiple of the timestep. Residuals are interpolated between two of these,
which makes the fit smooth.

A coarse search in one batch comes first, then `mujoco.minimize.least_squares`. Residuals are in
units of their channel's noise. Large ones count linearly and not by their square (soft L1), so that
a wheel that runs over a cable hardly moves the fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from restock.arrays import F64
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Task, wrap_angle
from restock.replay.store.store import Store
from restock.train.twin.calibration.open_loop import LoggedSegments, OpenLoopResult, replay_segments
from restock.train.twin.physics.perturbation import RANGES, Perturbation

BASE = Perturbation()  # the twin before the fit; has the values of parameters that are not fitted
# Channel -> (unit, initial noise). Later, the log's noise is computed from residuals.
CHANNELS: dict[str, tuple[str, float]] = {
    "wheel speed": ("m/s", 0.02),
    "wheel yaw rate": ("rad/s", 0.04),
    "gyro": ("rad/s", 0.04),
    "position": ("m", 0.04),
    "heading": ("rad", 0.02),
}
_ODOMETRY = "nav_msgs/msg/Odometry"
_GOAL = "geometry_msgs/msg/PoseStamped"  # does not prove a localiser: goals have this type, too
_POSE_TYPES = (
    "PoseWithCovarianceStamped",
    "PoseStamped",
    "TFMessage",
    "Pose",
    "PoseWithCovariance",
)


@dataclass(frozen=True)
class Parameter:
    """A field of a `Perturbation` that a log can identify."""

    name: str
    unit: str
    step: float  # step size of its difference quotient; relative for a `ratio`
    useful: float  # half width of the widest useful 95 % interval; of the logarithm for a `ratio`
    ratio: bool = False  # searched by its logarithm
    default: bool = True  # fitted unless others are requested
    own_body: bool = False  # only meaningful if the log's robot has the twin's body


PARAMETERS: dict[str, Parameter] = {
    item.name: item
    for item in (
        # Friction of the floor, and at the left wheel: identified when wheels slide.
        Parameter("friction_scale", "", 0.04, 0.4, ratio=True, own_body=True),
        Parameter("left_friction_scale", "", 0.04, 0.4, ratio=True, own_body=True, default=False),
        Parameter("payload_kg", "kg", 2.0, 20.0, own_body=True),  # identified when speeds change
        Parameter("wheel_radius_scale", "", 0.004, 0.02),  # distance driven ÷ wheels' distance
        Parameter("track_scale", "", 0.004, 0.02),  # angle turned ÷ angle that the wheels report
        Parameter("latency_s", "s", 0.01, 0.03),  # delay from observation to wheels' set point
        Parameter("gain", "", 0.005, 0.02),  # wheel speed ÷ commanded speed
        Parameter("gyro_bias_radps", "rad/s", 0.001, 0.01),  # the gyroscope's reading at rest
    )
}
MEASURED = ("wheel_radius_m", "track_m", "mass_kg", "max_accel_mps2", "max_yaw_accel_radps2")
DEFAULT = tuple(item.name for item in PARAMETERS.values() if item.default)


class Coordinates:
    """The mapping between perturbations and points z of a unit cube with an axis per parameter.

    Parameters that are not fitted have the values of `BASE`.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.parameters = [PARAMETERS[name] for name in names]
        ends = np.array([RANGES[name] for name in names], np.float64).reshape(-1, 2)
        self._ratio = np.array([item.ratio for item in self.parameters], np.bool_)
        ends[self._ratio] = np.log(ends[self._ratio])
        self._low, self._span = ends[:, 0], ends[:, 1] - ends[:, 0]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def steps(self) -> F64:
        """Return the step sizes of difference quotients, (n,) in z."""
        return np.array([item.step for item in self.parameters]) / self._span

    @property
    def useful(self) -> F64:
        """Return the largest half widths (n,) in z of useful intervals."""
        return np.array([item.useful for item in self.parameters]) / self._span

    def values(self, z: F64) -> F64:
        """Return the parameters (..., n) at points (..., n)."""
        inner = self._low + np.asarray(z) * self._span
        return np.where(self._ratio, np.exp(np.where(self._ratio, inner, 0.0)), inner)

    def point(self, perturbation: Perturbation) -> F64:
        """Return the point (n,) of a perturbation, clipped to the cube."""
        values = np.array([getattr(perturbation, name) for name in self.names], np.float64)
        inner = np.where(self._ratio, np.log(np.where(self._ratio, values, 1.0)), values)
        return np.clip((inner - self._low) / self._span, 0.0, 1.0)

    def perturbation(self, z: F64) -> Perturbation:
        """Return the perturbation at a point (n,)."""
        # Rounded so that equal points give equal perturbations, and values stay in their ranges.
        values = dict(zip(self.names, (round(float(v), 9) for v in self.values(z)), strict=True))
        return msgspec.structs.replace(BASE, **values)

    def drivable(self, z: F64) -> F64:
        """Return the point (n,) with its latency rounded to whole physics steps."""
        moved = z.copy()
        if "latency_s" in self.names:
            at = self.names.index("latency_s")
            tick = BASE.timestep_s / self._span[at]
            moved[at] = np.clip(np.round(z[at] / tick), 0, np.floor(1 / tick + 1e-9)) * tick
        return moved

    def without(self, name: str) -> Coordinates:
        """Return these coordinates without one parameter, which then has the value of `BASE`."""
        return Coordinates([other for other in self.names if other != name])


@dataclass(frozen=True)
class FitScope:
    """The parameters and channels that a log can identify, and why others are left out."""

    names: tuple[str, ...]
    channels: tuple[str, ...]
    refused: dict[str, str]  # parameter -> why it cannot be fitted
    notes: tuple[str, ...]


def fit_scope(
    store: Store,
    task: Task,
    names: Sequence[str],
    recordings: Sequence[str],
    robot: Robot | None = None,
) -> FitScope:
    """Return which parameters `names` these recordings (empty: all) can identify at all.

    `robot` is that of the profile. If it is None, the twin's stand-in replays the log.

    Raises:
        ConfigError: the recordings can identify none of the parameters.
    """
    refused: dict[str, str] = {}
    notes: list[str] = []
    channels = list(CHANNELS)
    twin = load_profile("warehouse_amr").task.body
    if robot is not None:
        guessed = [name for name in MEASURED if robot.origin_of(name) == "default"]
        if "payload_kg" in names:
            refused["payload_kg"] = (
                "the motor strength of the profile's robot is not known, so the payload cannot be "
                "identified from the lag of the wheels"
            )
        if robot.drive == "ackermann" and "track_scale" in names:
            refused["track_scale"] = (
                "a robot that steers turns by its steering angle, so its track cannot be identified"
            )
        notes.append(
            "fitted values are relative to the profile's robot"
            + (f", of which {', '.join(guessed)} are guesses from its outline" if guessed else "")
            + "; its odometry still uses the profile's values, as in the log"
        )
    elif (task.body.length_m, task.body.width_m) != (twin.length_m, twin.width_m):
        body = f"{task.body.length_m:g} x {task.body.width_m:g} m"
        why = f"the log's robot ({body}) is not the twin's: its mass and its contacts differ"
        refused |= {name: why for name in names if PARAMETERS[name].own_body}
        notes.append(
            f"the log's robot is {body}, the twin's {twin.length_m:g} x {twin.width_m:g} m with"
            " other wheels, mass and ramps: fitted values are ratios of commanded, wheel and "
            "ground motion, not dimensions of that robot"
        )
    wanted = _recording_filter(recordings)
    fallbacks = {row[0] for row in store.sql(
        f"SELECT DISTINCT unnest(stand_ins).input FROM recordings {wanted}"
    ).fetchall()}  # fmt: skip
    if "imu" in fallbacks:
        channels.remove("gyro")
        notes.append("no IMU: yaw rate is known only from headings")
        if "gyro_bias_radps" in names:
            refused["gyro_bias_radps"] = "the log has no gyroscope"
    if pose_is_odometry(store, recordings):
        channels = [name for name in channels if name not in ("position", "heading")]
        why = "the log's pose is the wheels' odometry: nothing measures the motion over ground"
        refused |= {name: why for name in names if name in ("wheel_radius_scale", "friction_scale")}
        notes.append("the pose is odometry: positions and headings are not compared in the fit")
        if "gyro" not in channels and "track_scale" in names:
            refused["track_scale"] = (
                "neither gyroscope nor localisation measures the turn over ground"
            )
    kept = tuple(name for name in names if name not in refused)
    if not kept:
        raise ConfigError(
            "this log can identify none of these parameters: "
            + "; ".join(f"{name}: {reason}" for name, reason in refused.items()),
            where=str(store.path),
            remedy="choose others with --parameters, or use another log",
        )
    return FitScope(kept, tuple(channels), refused, tuple(notes))


def _recording_filter(recordings: Sequence[str]) -> str:
    quoted = ", ".join("'" + name.replace("'", "''") + "'" for name in recordings)
    return f"WHERE recording_id IN ({quoted})" if recordings else ""


def pose_is_odometry(store: Store, recordings: Sequence[str]) -> bool:
    """Return whether ingest read odometry but no localiser in each of these recordings."""
    wanted = _recording_filter(recordings)
    rows = store.sql(
        "SELECT recording_id, coalesce(list(DISTINCT type) FILTER (decoded > 0), [])"
        f" FROM recordings LEFT JOIN topics USING (recording_id) {wanted} GROUP BY recording_id"
    ).fetchall()
    return all(
        _ODOMETRY in types and not any(kind.endswith(_POSE_TYPES) for kind in {*types} - {_GOAL})
        for _, types in rows
    )


_KEPT = 512  # replays that are cached
ENOUGH = 0.02  # the solver ends at a smaller gain: cost of a residual of 0.2 standard deviations
FREE = 0.01  # a step with at most this regulariser is hardly damped: the Hessian's diagonal is ~1
SOFT = 2.0  # residuals above this multiple of the noise count linearly
# Lower limits of the noise. If a simulator wrote the log, only its timestep causes residuals.
LEAST = {
    "wheel speed": 0.001,
    "wheel yaw rate": 0.003,
    "gyro": 0.003,
    "position": 0.002,
    "heading": 0.001,
}


class ReplayResiduals:
    """Residuals (replay less log) of any perturbation on one set of segments.

    Args:
        channels: those of `CHANNELS` to compare.
    """

    def __init__(
        self,
        segments: LoggedSegments,
        channels: Sequence[str] = tuple(CHANNELS),
        *,
        nthread: int = 1,
    ) -> None:
        self.segments, self.channels, self.nthread = segments, tuple(channels), nthread
        self._known: dict[Perturbation, dict[str, F64]] = {}

    def of(self, perturbations: Sequence[Perturbation]) -> dict[str, F64]:
        """Return residuals by channel, (P, S, R) each; R is K + 1, or 2 (K + 1) for positions."""
        parts = [self._between(perturbation) for perturbation in perturbations]
        self._drive([twin for pair in parts for twin, weight in pair if weight])
        residuals = {
            channel: np.stack(
                [
                    sum((w * self._known[twin][channel] for twin, w in pair if w), 0.0)
                    for pair in parts
                ]
            )
            for channel in self.channels
        }
        if "gyro" in residuals:
            bias = np.array([perturbation.gyro_bias_radps for perturbation in perturbations])
            residuals["gyro"] = residuals["gyro"] + bias[:, None, None]
        return residuals

    def _between(self, perturbation: Perturbation) -> list[tuple[Perturbation, float]]:
        """Return two replays with weights, whose weighted mean interpolates the latency."""
        ticks = perturbation.latency_s / BASE.timestep_s
        low = int(np.floor(ticks + 1e-6))
        above = max(ticks - low, 0.0)
        pair = [(low, 1 - above), (low + 1, above if above > 1e-6 else 0.0)]
        base = msgspec.structs.replace(perturbation, name="", gyro_bias_radps=0.0)
        latencies = [(min(tick * BASE.timestep_s, 0.5), weight) for tick, weight in pair]
        return [(msgspec.structs.replace(base, latency_s=s), weight) for s, weight in latencies]

    def _drive(self, twins: Sequence[Perturbation]) -> None:
        new = [twin for twin in dict.fromkeys(twins) if twin not in self._known]
        if len(self._known) + len(new) > _KEPT:
            self._known.clear()
            new = list(dict.fromkeys(twins))
        if not new:
            return
        replayed = replay_segments(self.segments, new, nthread=self.nthread)
        residuals = channel_residuals(self.segments, replayed)
        for index, twin in enumerate(new):
            self._known[twin] = {name: residuals[name][index] for name in self.channels}


def channel_residuals(segments: LoggedSegments, replayed: OpenLoopResult) -> dict[str, F64]:
    """Return every channel's residuals, (P, S, R) each; 0 for poses that are not fresh."""
    predicted, logged = replayed.signals, segments.signals
    residuals = {
        "wheel speed": predicted["wheel_speed_mps"] - logged["wheel_speed_mps"],
        "wheel yaw rate": predicted["wheel_yaw_rate_radps"] - logged["wheel_yaw_rate_radps"],
        "gyro": predicted["gyro_yaw_rate_radps"] - logged["gyro_yaw_rate_radps"],
    }
    weight = segments.pose_fresh / segments.pose_fresh.sum(axis=1, keepdims=True)  # (S, K + 1)
    pose, goal = replayed.pose, segments.pose
    off = wrap_angle(pose[..., 2] - goal[..., 2])  # (P, S, K + 1)
    turn = (off * weight).sum(axis=-1, keepdims=True)
    residuals["heading"] = np.where(segments.pose_fresh, wrap_angle(off - turn), 0.0)
    cos, sin = np.cos(-turn), np.sin(-turn)
    x, y = pose[..., 0] - goal[:, :1, 0], pose[..., 1] - goal[:, :1, 1]
    to = goal[..., :2] - goal[:, :1, :2]
    parts = []
    for value, aim in ((cos * x - sin * y, to[..., 0]), (sin * x + cos * y, to[..., 1])):
        gap = value - aim
        gap = gap - (gap * weight).sum(axis=-1, keepdims=True)
        parts.append(np.where(segments.pose_fresh, gap, 0.0))
    residuals["position"] = np.concatenate(parts, axis=-1)
    return residuals


def position_gap_m(segments: LoggedSegments, replayed: OpenLoopResult) -> F64:
    """Return the distance between twin and log, (P, S, K + 1), after starting at the same pose."""
    gap: F64 = np.hypot(
        replayed.signals["pose_x_m"] - segments.signals["pose_x_m"],
        replayed.signals["pose_y_m"] - segments.signals["pose_y_m"],
    )
    return gap


class SoftL1(minimize.Norm):  # type: ignore[misc]  # mujoco has no types
    """SOFT^2 (sqrt(1 + (r / SOFT)^2) - 1): r^2 / 2 for small residuals, SOFT |r| for large."""

    def value(self, r: F64) -> np.float64:
        """Return the cost of residuals (R, 1)."""
        return np.float64(cost(r[:, 0]))

    def grad_hess(self, r: F64, proj: F64) -> tuple[F64, F64]:
        """Return the gradient (n, 1) and Gauss-Newton Hessian (n, n) for a Jacobian (R, n)."""
        weight = weights(r)
        return proj.T @ (weight * r), proj.T @ (weight * proj)


def cost(r: F64) -> F64:
    """Return the soft L1 cost of residuals (R, ...), summed over the first axis."""
    return np.asarray(SOFT**2 * (np.sqrt(1 + (r / SOFT) ** 2) - 1).sum(axis=0))


def weights(r: F64) -> F64:
    """Return the weight of each residual: the cost's derivative over the residual."""
    return np.asarray(1 / np.sqrt(1 + (r / SOFT) ** 2))


@dataclass(frozen=True)
class FitSolution:
    """The result of a search, and the data for its uncertainty and warnings."""

    coordinates: Coordinates
    z: F64  # (n,)
    residual: F64  # (R,) in units of noise
    jacobian: F64  # (R, n)
    segment: NDArray[np.int64]  # (R,) index of each residual's segment
    scale: dict[str, float]  # channel -> noise, scaled up for correlation along segments
    converged: bool


class FitProblem:
    """Residuals and their derivatives as functions of a point, for the solver."""

    def __init__(
        self, residuals: ReplayResiduals, coordinates: Coordinates, scale: Mapping[str, float]
    ) -> None:
        self.residuals, self.coordinates, self.scale = residuals, coordinates, dict(scale)

    def residual(self, z: F64) -> F64:
        """Return the residuals (R, k) in units of noise, at points (n, k)."""
        residuals = self.residuals.of([self.coordinates.perturbation(point) for point in z.T])
        parts = [residuals[name] / self.scale[name] for name in self.residuals.channels]
        return np.concatenate([part.reshape(z.shape[1], -1) for part in parts], axis=1).T

    @property
    def segment(self) -> NDArray[np.int64]:
        """Return the index (R,) of each residual's segment."""
        steps, num = self.residuals.segments.horizon_steps + 1, len(self.residuals.segments)
        widths = [2 * steps if name == "position" else steps for name in self.residuals.channels]
        return np.concatenate([np.repeat(np.arange(num), width) for width in widths])

    def jacobian(self, z: F64, residual: F64) -> F64:
        """Return difference quotients (R, n) at z (n, 1), with latency in whole physics steps.

        A wheel starts to slide at a physics step, so wheel speeds jump as friction or payload
        change. A jump is not a slope, so for these two, quotients are taken on both sides. The
        smaller one is used, or 0 if their signs differ.
        """
        del residual  # unused: its latency is interpolated, but quotients start at a whole step
        size, steps = len(self.coordinates), self.coordinates.steps
        at = self.coordinates.drivable(z.reshape(-1))
        # The rounded latency is stepped toward z: residuals at z are interpolated on that side.
        forward = (at + steps <= 1.0) & (z.reshape(-1) >= at - 1e-9)
        forward |= at - steps < 0.0
        step = np.where(forward, steps, -steps)
        both = [
            index
            for index, item in enumerate(self.coordinates.parameters)
            if item.own_body and steps[index] <= at[index] <= 1.0 - steps[index]
        ]
        moves = [np.zeros((size, 1)), np.diag(step), -np.diag(step)[:, both]]
        at_moves = self.residual(at[:, None] + np.hstack(moves))
        slope: F64 = (at_moves[:, 1 : size + 1] - at_moves[:, :1]) / step
        back = (at_moves[:, :1] - at_moves[:, size + 1 :]) / step[both]
        ahead = slope[:, both]
        smaller = np.where(np.abs(ahead) < np.abs(back), ahead, back)
        slope[:, both] = np.where(ahead * back > 0, smaller, 0.0)
        return slope


def search(problem: FitProblem, points: int, best: int, seed: int) -> F64:
    """Try BASE and `points` Sobol points; return the `best` ones of least cost, (best, n)."""
    from scipy.stats import qmc  # imported here because it is slow to import

    sampler = qmc.Sobol(len(problem.coordinates), scramble=True, rng=seed)
    drawn = sampler.random(points) if points else np.zeros((0, len(problem.coordinates)))
    start = problem.coordinates.point(BASE)
    trial = np.array([problem.coordinates.drivable(z) for z in (start, *drawn)])
    batches = [trial[begin : begin + 16] for begin in range(0, len(trial), 16)]
    value = np.concatenate([cost(problem.residual(batch.T)) for batch in batches])
    return trial[np.argsort(value, kind="stable")[:best]]


def solve(problem: FitProblem, start: F64, iterations: int) -> tuple[F64, float, bool]:
    """Solve least squares from `start` (n,); return solution, cost, and whether it converged."""
    size = len(problem.coordinates)
    steps: list[minimize.IterLog] = []

    def watch(trace: list[minimize.IterLog]) -> None:
        steps[:] = trace
        free = trace[-1].regularizer <= FREE  # a damped step gains little even far from the optimum
        if free and 0 < trace[-1].reduction < ENOUGH and len(trace) > 1:
            raise _GoodEnough

    try:
        solution, steps[:] = minimize.least_squares(
            start,
            problem.residual,
            bounds=[np.zeros(size), np.ones(size)],
            jacobian=problem.jacobian,
            norm=SoftL1(),
            x_scale="jac",
            xtol=1e-3,
            gtol=1e-3,
            mu_factor=4.0,
            mu_max=1e3,
            max_iter=iterations,
            verbose=minimize.Verbosity.SILENT,
            iter_callback=watch,
        )
    except _GoodEnough:
        solution = steps[-1].candidate.reshape(start.shape)
        return solution, float(steps[-1].objective), True
    return solution, float(steps[-1].objective), len(steps) <= iterations


class _GoodEnough(Exception):
    """Raised to stop the solver once a step reduces the cost by less than `ENOUGH`."""


def channel_noise(residuals: Mapping[str, F64]) -> dict[str, float]:
    """Return each channel's noise, from residuals (1, S, R) at a solution.

    It is the median deviation, scaled up for the correlation c of neighbouring steps: n residuals
    count as much as n (1 - c) / (1 + c) independent ones.
    """
    scale = {}
    for name, residual in residuals.items():
        runs = residual[0]
        if name == "position":  # x and y
            runs = np.concatenate(np.split(runs, 2, axis=1))
        spread = max(1.4826 * float(np.median(np.abs(runs))), LEAST[name])
        clipped = np.clip(runs, -4 * spread, 4 * spread)
        square = float((clipped**2).mean())
        together = float((clipped[:, 1:] * clipped[:, :-1]).mean()) / max(square, 1e-18)
        together = min(max(together, 0.0), 0.95)
        scale[name] = spread * float(np.sqrt((1 + together) / (1 - together)))
    return scale
