"""How noisy a robot's sensors are: what the limits of conditions are measured by."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from restock.toml import Checked


class Noise(Checked, frozen=True):
    """The `[noise]` of a profile: what the sensors' readings vary by, for probabilities.

    Standard deviations. The SQL of conditions names them as `lidar_noise_m`, and so on.
    """

    lidar_m: Annotated[float, Meta(gt=0)] = 0.015  # standard deviation of a range
    localiser_m: Annotated[float, Meta(gt=0)] = 0.01  # of the distance between two poses, per axis
    wheels_mps: Annotated[float, Meta(gt=0)] = 0.003  # of the wheel speed
    gyro_radps: Annotated[float, Meta(gt=0)] = 0.01  # of the yaw rate, including bias

    @property
    def constants(self) -> dict[str, float]:
        """Each by the name that SQL has for it."""
        named = msgspec.structs.asdict(self)
        return {"_noise_".join(name.rsplit("_", 1)): value for name, value in named.items()}
