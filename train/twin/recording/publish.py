"""Convert a drive to a robot's log messages: rates, timestamps, delays and resolution.

A message has three times. The header's timestamp is when the value was measured, the publish time
is when the sensor's driver sent it, and the log time is when the recorder received it. Sensors have
their own rates, and one of their samples falls on every control tick (the navigation stack waits
for the scan, then commands), so the recording has at each tick what the policy saw. A command is
sent some milliseconds after its tick, because planning takes time. The navigation stack's proposal
is sent before that.

At a tick, a sensor's value is the twin's own measurement. Between ticks, it is the true motion plus
noise of the same size. Values then get the resolution of the hardware, which is also why real
recordings compress well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.task import wrap_angle
from restock.toml import Checked
from restock.train.twin.recording import robot_topics as topics
from restock.train.twin.recording.bag_writer import Message
from restock.train.twin.recording.robot_topics import Drive, Lidar, Odometer

GYRO_LSB_RADPS = 2.0**-10
ACCEL_LSB_MPS2 = 2.0**-8
LIDAR_LSB_M = 2.0**-9  # resolution of ranges, about 2 mm
PLANNING_S = (0.005, 0.007)  # delay from a tick to the navigation stack's proposal
THINKING_S = (0.012, 0.016)  # delay from a tick to its command; longer than any other topic's
BUMPER_POLL_S = 0.02
JITTER_S = 4e-4  # maximum jitter of a sensor's timer, early or late
TICK_TOLERANCE_S = 1e-6


DRIVER_MS = {  # mean delay from a measurement until it is published, which jitters
    "/odom": 1.5,
    "/imu": 0.8,
    "/joint_states": 1.5,
    "/scan": 4.0,
    "/bumper": 1.0,
    "/amcl_pose": 5.0,
    "/tf": 1.5,
    "/ground_truth/condition": 7.0,
    "/ground_truth/exposure": 7.0,
    "/ground_truth/perturbation": 2.0,
    "/ground_truth/markers": 2.0,
    "/ground_truth/traffic": 7.0,
    "/behaviour_policy": 7.0,
    "/goal_pose": 2.0,
    "/plan": 6.0,
    "/diagnostics": 2.0,
    "/tf_static": 0.5,
    "/map": 0.5,
    "/cmd_vel_nav": 0.2,
    "/cmd_vel": 0.2,
}
NETWORK_MS, MAX_NETWORK_MS = 0.4, 3.0  # on to the recorder: shortest usual delay, and longest
TRAFFIC_HZ = 2.0  # rate of traffic messages while anyone moves


Hertz = Annotated[float, Meta(gt=0, le=200)]


class Rates(Checked, frozen=True):
    """The rate of each periodic topic in Hz. Commands come once per control tick."""

    odom: Hertz = 50.0
    imu: Hertz = 50.0
    joint_states: Hertz = 20.0
    scan: float = 10.0
    amcl_pose: Hertz = 10.0
    tf: Hertz = 20.0
    bumper: Hertz = 10.0
    diagnostics: Hertz = 1.0
    plan: Hertz = 1.0  # plans are also sent whenever they change

    def check(self) -> None:
        if self.scan not in (5, 10):
            raise ValueError(f"scan must be 5 or 10, got {self.scan:g}")


@dataclass
class Robot:
    """The recorded robot: its random generator, and the state it keeps between missions."""

    rng: np.random.Generator
    lidar: Lidar
    rates: Rates
    odometer: Odometer
    driven_s: float = 0.0
    _start_ns: int = 0  # start of the current mission

    def publish(self, drive: Drive, start_ns: int) -> list[Message]:
        """Return all messages of a mission that starts at `start_ns`, in order of log time."""
        self._start_ns = start_ns
        reckoned = self.odometer.dead_reckoning(drive.motion)  # (M, 3), at the motion's times
        messages = [
            *self._announcements(drive),
            *self._odometry(drive, reckoned),
            *self._inertial(drive),
            *self._joints(drive),
            *self._scans(drive),
            *self._localisation(drive, reckoned),
            *self._bumper(drive),
            *self._ticks(drive),
            *self._diagnostics(drive),
            *self._scene(drive),
        ]
        self.odometer.carry_on(drive.motion, reckoned)
        self.driven_s += float(drive.tick_s[-1])
        messages.sort(key=lambda message: message.log_ns)  # stable: ties keep the order above
        return messages

    def static(
        self,
        start_ns: int,
        occupied: Bools,
        cell_m: float,
        origin_m: tuple[float, float] = (0.0, 0.0),
    ) -> list[Message]:
        """Return the messages that begin a recording or floor: sensor transforms and the map."""
        self._start_ns = start_ns
        at = np.zeros(1)
        return [
            *self._send("/tf_static", at, [topics.static_transforms(start_ns, self.lidar.x_m)]),
            *self._send("/map", at, [topics.occupancy_map(start_ns, occupied, cell_m, origin_m)]),
        ]

    def _announcements(self, drive: Drive) -> list[Message]:
        """Return the goal, the plans (on change and about once a second), and the drivers."""
        sent = self._send("/goal_pose", np.zeros(1), [topics.goal(self._stamp(0.0), *drive.goal_m)])
        end_s = float(drive.tick_s[-1])
        starts = [float(drive.tick_s[tick]) for tick, _ in drive.plans]
        for start_s, until_s, (_, points) in zip(
            starts, [*starts[1:], end_s], drive.plans, strict=True
        ):
            # Exclude `until_s`, when the next plan is sent, even if `arange` would round to it.
            until_s = max(until_s - TICK_TOLERANCE_S, start_s + TICK_TOLERANCE_S)
            times = np.arange(start_s, until_s, 1 / self.rates.plan)
            messages = [topics.plan(self._stamp(time), points) for time in times.tolist()]
            sent += self._send("/plan", times, messages)
        changed = [
            tick
            for tick, policy in enumerate(drive.policy)
            if tick == 0 or policy != drive.policy[tick - 1]
        ]
        texts = [topics.behaviour_policy(*drive.policy[tick]) for tick in changed]
        return sent + self._send("/behaviour_policy", drive.tick_s[changed], texts)

    def _odometry(self, drive: Drive, reckoned: F64) -> list[Message]:
        times, tick = self._sample(drive, self.rates.odom)
        hardware = drive.perturbation
        rate = drive.motion.at(drive.motion.wheel_rate_radps, times)
        rate += self.rng.normal(0, hardware.encoder_noise_radps, rate.shape)
        rate += hardware.encoder_bias_radps
        speed, turn = self.odometer.speeds(rate)
        speed = _at_ticks(speed, tick, drive.signals["wheel_speed_mps"])
        turn = _at_ticks(turn, tick, drive.signals["wheel_yaw_rate_radps"])
        x, y, yaw = drive.motion.at(reckoned, times).T
        data = topics.odometry(
            self._stamps(times), _f32(x), _f32(y), _f32(wrap_angle(yaw)), _f32(speed), _f32(turn)
        )
        return self._send("/odom", times, data)

    def _inertial(self, drive: Drive) -> list[Message]:
        times, tick = self._sample(drive, self.rates.imu)
        hardware = drive.perturbation
        gyro = drive.motion.at(drive.motion.yaw_rate_radps, times) + hardware.gyro_bias_radps
        gyro += self.rng.normal(0, hardware.gyro_noise_radps, len(times))
        accel = drive.motion.at(drive.motion.accel_mps2, times)
        accel += self.rng.normal(0, hardware.accel_noise_mps2, accel.shape)
        accel[:, 0] += hardware.accel_bias_mps2
        gyro = _at_ticks(gyro, tick, drive.signals["gyro_yaw_rate_radps"])
        ahead = _at_ticks(accel[:, 0], tick, drive.signals["accel_x_mps2"])
        data = topics.imu(
            self._stamps(times),
            _round(gyro, GYRO_LSB_RADPS),
            _round(ahead, ACCEL_LSB_MPS2),
            _round(accel[:, 1], ACCEL_LSB_MPS2),
        )
        return self._send("/imu", times, data)

    def _joints(self, drive: Drive) -> list[Message]:
        times, _ = self._sample(drive, self.rates.joint_states)
        angle = self.odometer.wheel_angles(drive.motion, times)
        rate = drive.motion.at(drive.motion.wheel_rate_radps, times)
        data = topics.joint_states(self._stamps(times), _f32(angle), _f32(rate))
        return self._send("/joint_states", times, data)

    def _scans(self, drive: Drive) -> list[Message]:
        scan_time_s = max(1 / self.rates.scan, drive.perturbation.lidar_period_s)
        ranges_m = _round(drive.ranges_m, LIDAR_LSB_M)
        data = topics.scans(self._stamps(drive.scan_s), ranges_m, self.lidar, scan_time_s)
        return self._send("/scan", drive.scan_s, data)

    def _localisation(self, drive: Drive, reckoned: F64) -> list[Message]:
        """Return /amcl_pose, with the /tf by which the localiser corrects `odom` within `map`."""
        times, tick = self._sample(drive, self.rates.amcl_pose)
        age_s = (drive.signals["stamp_ns"] - drive.signals["pose_stamp_ns"]) * 1e-9
        if drive.perturbation.localisation_period_s:  # publish only new poses
            fresh = (tick >= 0) & (age_s[tick] == 0)
            times, tick = times[fresh], tick[fresh]
        seen = np.stack(
            [drive.signals[f"pose_{name}"] for name in ("x_m", "y_m", "yaw_rad")], axis=-1
        )
        error = seen - drive.motion.at(drive.motion.pose, drive.tick_s)
        error[:, 2] = wrap_angle(error[:, 2])
        between = drive.motion.at(drive.motion.pose, times)
        between += np.stack([np.interp(times, drive.tick_s, e) for e in error.T], axis=-1)
        x, y, yaw = _at_ticks(between, tick, seen).T
        measured_s = times - _at_ticks(np.zeros(len(times)), tick, age_s)
        data = topics.localised_poses(
            self._stamps(measured_s), _f32(x), _f32(y), _f32(wrap_angle(yaw))
        )
        poses = self._send("/amcl_pose", times, data)

        tf_s, _ = self._sample(drive, self.rates.tf)
        newest = np.clip(np.searchsorted(times, tf_s, "right") - 1, 0, None)
        base_then = drive.motion.at(reckoned, measured_s)
        correction = _frame_between(base_then, np.stack([x, y, yaw], axis=-1))[newest]
        odom_to_base = drive.motion.at(reckoned, tf_s)
        data = topics.transforms(self._stamps(tf_s), _pose(correction), _pose(odom_to_base))
        return poses + self._send("/tf", tf_s, data)

    def _bumper(self, drive: Drive) -> list[Message]:
        """Return bumper messages: on change, at their rate, and at every poll while pressed."""
        end_s = float(drive.tick_s[-1])
        polls = np.arange(round(end_s / BUMPER_POLL_S) + 1) * BUMPER_POLL_S
        edges = np.searchsorted(drive.motion.time_s, polls + 1e-9, "right")
        touched = np.concatenate([[0], np.cumsum(drive.motion.bumped)])
        pressed = np.diff(touched[edges], prepend=touched[0]) > 0
        every = max(round(1 / (self.rates.bumper * BUMPER_POLL_S)), 1)
        changed = np.diff(pressed, prepend=pressed[:1])
        sent = pressed | changed | (np.arange(len(polls)) % every == 0)
        return self._send("/bumper", polls[sent], topics.bumpers(pressed[sent]))

    def _ticks(self, drive: Drive) -> list[Message]:
        """Return the true conditions, navigation's proposal and the command of every tick.

        The last command is a stop.
        """
        command = np.concatenate([drive.command, np.zeros((1, 2))])
        thinking = self.rng.uniform(*THINKING_S, len(command))
        reported = {"condition": drive.true_condition, "exposure": drive.true_exposure}
        proposed = np.stack(
            [drive.signals[f"nav_{key}"] for key in ("speed_mps", "yaw_rate_radps")]
        )
        planned_s = drive.tick_s + self.rng.uniform(*PLANNING_S, len(command))
        return [
            *(
                message
                for name, truth in reported.items()
                for message in self._send(
                    f"/ground_truth/{name}",
                    drive.tick_s,
                    [topics.text(text) for text in (*truth, truth[-1])],
                )
            ),
            *self._send("/cmd_vel_nav", planned_s, topics.commands(*proposed)),
            *self._send("/cmd_vel", drive.tick_s + thinking, topics.commands(*command.T)),
        ]

    def _diagnostics(self, drive: Drive) -> list[Message]:
        times, _ = self._sample(drive, self.rates.diagnostics)
        volts = 26.4 - (self.driven_s + times) / 3600 * 0.55
        scan = np.searchsorted(drive.scan_s, times + 1e-9, "right") - 1
        returns = np.isfinite(drive.ranges_m[scan]).mean(axis=1)
        data = []
        for time, voltage, share in zip(times.tolist(), volts, returns, strict=True):
            low = 1 if voltage < 24.0 else 0
            status = [
                ("battery", low, "low" if low else "ok", {"voltage": f"{voltage:.2f}"}),
                ("lidar", 0, "ok", {"returns": f"{share:.2f}"}),
            ]
            data.append(topics.diagnostics(self._stamp(time), status))
        return self._send("/diagnostics", times, data)

    def _scene(self, drive: Drive) -> list[Message]:
        """Return the perturbation and fixed markers once, and traffic on change, at its rate."""
        at, perturbation = np.zeros(1), topics.perturbation_text(drive.perturbation)
        due = np.diff(np.floor(drive.tick_s * TRAFFIC_HZ + 1e-6), prepend=-1) > 0
        due = due[: len(drive.traffic)]
        ticks = np.flatnonzero(due)
        places = drive.traffic[ticks]
        # The first message clears the markers of the previous mission.
        moved = np.ones(len(ticks), np.bool_)
        moved[1:] = (places[1:] != places[:-1]).any(axis=(1, 2))
        ticks, places = ticks[moved], places[moved]
        times = drive.tick_s[ticks]
        return [
            *self._send(topics.PERTURBATION, at, [topics.text(perturbation)]),
            *self._send(topics.MARKERS, at, [topics.mission_markers(self._stamp(0.0), drive)]),
            *self._send(topics.TRAFFIC, times, topics.traffic_markers(self._stamps(times), places)),
        ]

    def _sample(self, drive: Drive, rate_hz: float) -> tuple[F64, NDArray[np.intp]]:
        """Return the times (n,) of a sensor's samples, and the tick of each; -1 between ticks.

        Times between ticks jitter.
        """
        end_s = float(drive.tick_s[-1])
        times = np.arange(int(end_s * rate_hz + 1e-6) + 1) / rate_hz
        tick = np.rint(times / end_s * (len(drive.tick_s) - 1)).astype(np.intp)
        tick = np.where(np.abs(drive.tick_s[tick] - times) < TICK_TOLERANCE_S, tick, -1)
        jitter = self.rng.uniform(-JITTER_S, JITTER_S, len(times))
        return np.where(tick >= 0, drive.tick_s[tick], times + jitter), tick

    def _send(self, topic: str, measured_s: F64, data: Sequence[bytes]) -> list[Message]:
        at_ns = self._start_ns + np.rint(np.asarray(measured_s) * 1e9).astype(np.int64)
        return send(topic, at_ns, data, self.rng)

    def _stamps(self, time_s: F64) -> Ints:
        """Return header stamps, rounded to microseconds."""
        stamps: Ints = self._start_ns + np.rint(time_s * 1e6).astype(np.int64) * 1000
        return stamps

    def _stamp(self, time_s: float) -> int:
        return self._start_ns + round(time_s * 1e6) * 1000


def _at_ticks(between: F64, tick: NDArray[np.intp], seen: NDArray[Any]) -> F64:
    """Replace `between` (n, …) by the twin's own measurements `seen` (T + 1, …) at ticks."""
    on_tick = (tick >= 0).reshape(-1, *[1] * (between.ndim - 1))
    return np.where(on_tick, seen[tick], between)


def _round(values: F64, lsb: float) -> F64:
    return np.rint(values / lsb) * lsb


def _f32(values: F64) -> F64:
    """Round values to single precision, as the robot's controllers compute them."""
    return values.astype(np.float32).astype(np.float64)


def _pose(rows: F64) -> tuple[F64, F64, F64]:
    x, y, yaw = rows.T
    return _f32(x), _f32(y), _f32(wrap_angle(yaw))


def _frame_between(inner: F64, outer: F64) -> F64:
    """Return frame B's pose in frame A (n, 3), from a robot's poses: `inner` in B, `outer` in A."""
    yaw = outer[:, 2] - inner[:, 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack(
        [
            outer[:, 0] - (cos * inner[:, 0] - sin * inner[:, 1]),
            outer[:, 1] - (sin * inner[:, 0] + cos * inner[:, 1]),
            yaw,
        ],
        axis=-1,
    )


def send(
    topic: str, measured_ns: Ints, data: Sequence[bytes], rng: np.random.Generator
) -> list[Message]:
    """Return messages measured at these times (n,), with random delays of the topic.

    The network is usually quick and sometimes slow, but never so slow that a measurement arrives
    after the command of its tick is sent.
    """
    spread = 0.8 + 0.4 * rng.random((2, len(data)))
    sent_ms = DRIVER_MS[topic] * spread[0]
    network_ms = NETWORK_MS * (spread[1] + rng.exponential(0.5, len(data)))
    received_ms = sent_ms + np.minimum(network_ms, MAX_NETWORK_MS)
    publish = measured_ns + np.rint(sent_ms * 1e3).astype(np.int64) * 1000
    log = measured_ns + np.rint(received_ms * 1e3).astype(np.int64) * 1000
    rows = zip(log.tolist(), publish.tolist(), data, strict=True)
    return [Message(log_ns, publish_ns, topic, item) for log_ns, publish_ns, item in rows]
