"""From a measurement to the recorder: how long each topic's driver and the network take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.recording.bag_writer import Message


@dataclass(frozen=True)
class Delay:
    """From the measurement to the publisher, and on to the recorder; both jitter."""

    driver_ms: float
    network_ms: float = 0.4


DELAYS = {
    "/odom": Delay(1.5),
    "/imu": Delay(0.8),
    "/joint_states": Delay(1.5),
    "/scan": Delay(4.0),
    "/bumper": Delay(1.0),
    "/amcl_pose": Delay(5.0),
    "/tf": Delay(1.5),
    "/ground_truth/condition": Delay(7.0),
    "/ground_truth/perturbation": Delay(2.0),
    "/ground_truth/markers": Delay(2.0),
    "/ground_truth/traffic": Delay(7.0),
    "/behaviour_policy": Delay(7.0),
    "/goal_pose": Delay(2.0),
    "/plan": Delay(6.0),
    "/diagnostics": Delay(2.0),
    "/tf_static": Delay(0.5),
    "/map": Delay(0.5),
    "/cmd_vel": Delay(0.2),
}
MOST_NETWORK_MS = 3.0


def send(
    topic: str, measured_ns: NDArray[np.int64], data: Sequence[bytes], rng: np.random.Generator
) -> list[Message]:
    """Messages measured at these times (n,), sent and received after the topic's delays.

    Networks are mostly quick and now and then slow, but here never slower than a command waits
    for its measurements: the latest sensor is there before the command is sent.
    """
    delay = DELAYS[topic]
    spread = 0.8 + 0.4 * rng.random((2, len(data)))
    sent_ms = delay.driver_ms * spread[0]
    network_ms = delay.network_ms * (spread[1] + rng.exponential(0.5, len(data)))
    received_ms = sent_ms + np.minimum(network_ms, MOST_NETWORK_MS)
    publish = measured_ns + np.rint(sent_ms * 1e3).astype(np.int64) * 1000
    log = measured_ns + np.rint(received_ms * 1e3).astype(np.int64) * 1000
    rows = zip(log.tolist(), publish.tolist(), data, strict=True)
    return [Message(log_ns, publish_ns, topic, item) for log_ns, publish_ns, item in rows]
