"""`restock/Warehouse-v0`: one warehouse as a plain Gymnasium environment, without autoreset."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from restock.arrays import F32
from restock.train.twin.env.interface import MadeAgain
from restock.train.twin.env.vector_env import WarehouseVectorEnv


class WarehouseEnv(gymnasium.Env[F32, Any], MadeAgain):
    """The vector environment with N = 1; `info` holds its values without the leading axis.

    Takes the vector environment's keyword arguments. The one inside is `self.vector`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 5,
    }

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        self.render_mode = render_mode
        self._seeded = arguments.get("seed") is not None
        if not self._seeded:
            arguments.pop("seed", None)
        self.vector = WarehouseVectorEnv(
            1, render_mode=render_mode, autoreset_mode=AutoresetMode.DISABLED, **arguments
        )
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[F32, dict[str, Any]]:
        """Begin the next episode; a seed starts its sequence of episodes again."""
        super().reset(seed=seed)
        if seed is None and not self._seeded:  # unseeded environments differ, as Gymnasium's do
            seed = int(self.np_random.integers(2**31))
        self._seeded = True
        observation, info = self.vector.reset(seed=seed)
        return observation[0], _first(info)

    def step(self, action: Any) -> tuple[F32, float, bool, bool, dict[str, Any]]:
        """One control period. `info["signals_before"]` are the signals that `action` answered."""
        before = self.vector.signals
        observation, reward, terminated, truncated, info = self.vector.step(np.array([action]))
        info["signals_before"] = before
        return (
            *(observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0])),
            _first(info),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """A top-down map, or the frame of the `camera` that was asked for, (H, W, 3) uint8."""
        frames = self.vector.render()
        return frames[0] if frames else None

    def close(self) -> None:
        """Release what `render` holds."""
        self.vector.close()


def _first(info: dict[str, Any]) -> dict[str, Any]:
    return {k: _first(v) if isinstance(v, dict) else v[0] for k, v in info.items()}
