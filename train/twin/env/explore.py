"""Exploration: epsilon-greedy with a linear schedule over environment steps."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

AFTER_LOGS = 0.2  # the offline phase has learnt to drive: chance would only undo that


class LinearEpsilon(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The chance of a uniformly random action: from `start` to `end` over `steps`."""

    start: float | None = None  # None: 1 without logs, AFTER_LOGS with them
    end: float = 0.05
    steps: int = 20_000  # environment steps, counted from the first

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise ValueError(f"epsilon.{name} must be in [0, 1], got {value}")
        if self.steps < 1:
            raise ValueError(f"epsilon.steps must be at least 1, got {self.steps}")

    def at(self, env_steps: int) -> float:
        """Epsilon after `env_steps` environment steps."""
        start = 1.0 if self.start is None else self.start
        part = min(env_steps / self.steps, 1.0)
        return start + part * (self.end - start)


def epsilon_greedy(
    greedy: NDArray[Any], actions: int, epsilon: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Greedy actions (N,) to the actions to take (N,) and the probability of each (N,)."""
    explores = rng.random(len(greedy)) < epsilon
    uniform = rng.integers(actions, size=len(greedy))
    action = np.where(explores, uniform, greedy).astype(np.int64)
    probability = epsilon / actions + (1 - epsilon) * (action == greedy)
    return action, probability.astype(np.float32)
