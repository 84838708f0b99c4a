"""The interface between environments and policies, and exploration.

`Twin` is the environment that training and evaluation need. `Policy` is a driver: a trained
network, an ONNX file, a script, or your own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Self

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.task.task import Signals
from restock.toml import Checked

if TYPE_CHECKING:  # these import MuJoCo, which a run's config does not need
    from restock.train.twin.env.episode_queue import MissionArm
    from restock.train.twin.physics.episode import EpisodeSpec

AFTER_LOGS = 0.2  # first epsilon after training on logs: more would only undo what was learnt

Probability = Annotated[float, Meta(ge=0, le=1)]


Info = dict[str, Any]
# What `step` of N environments returns: observation (N, D), reward (N,), terminated (N,),
# truncated (N,), info.
Step = tuple[F32, F32, Bools, Bools, Info]


class Twin(Protocol):
    """The vectorised environment that training and evaluation need (`WarehouseVectorEnv`).

    Its missions can be chosen by arm, as `[practice]` does: once shares are set,
    `info["mission_arm"]` (N,) is the arm of each environment's episode.
    """

    num_envs: int

    @property
    def signals(self) -> Signals: ...
    def set_episodes(self, specs: Iterable[EpisodeSpec], /) -> None: ...
    def mission_arms(self) -> Sequence[MissionArm]: ...
    def set_mission_shares(self, shares: Sequence[float], /) -> None: ...
    def reset(self, *, seed: int | None = None) -> tuple[F32, Info]: ...
    def step(self, actions: NDArray[Any], /) -> Step: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any], /) -> None: ...


class Policy(Protocol):
    """A driver in a twin. Its name and version tag its actions in the logs."""

    name: str
    version: str

    def act(self, env: Any, observation: F32) -> tuple[Ints, NDArray[Any]]:
        """Return actions (N,) for observations (N, D), and their probabilities (N,)."""
        ...


class LinearEpsilon(Checked, frozen=True):
    """A probability of random actions that changes linearly from `start` to `end` over `steps`."""

    start: Probability | None = None  # None: 1 without logs, AFTER_LOGS with them
    end: Probability = 0.05
    steps: Annotated[int, Meta(ge=1)] = 20_000  # environment steps, counted from the first

    def at(self, env_steps: int) -> float:
        """Return epsilon after `env_steps` environment steps."""
        start = 1.0 if self.start is None else self.start
        return start + min(env_steps / self.steps, 1.0) * (self.end - start)


def epsilon_greedy(
    greedy: NDArray[Any], actions: int, epsilon: float | F64, rng: np.random.Generator
) -> tuple[Ints, F32]:
    """Replace greedy actions (N,) by random ones at rate `epsilon`; return them and probabilities.

    The rate is one or (N,). The probabilities (N,) are those of the returned actions (N,).
    """
    explores = rng.random(len(greedy)) < epsilon
    uniform = rng.integers(actions, size=len(greedy))
    action = np.where(explores, uniform, greedy).astype(np.int64)
    probability = epsilon / actions + (1 - epsilon) * (action == greedy)
    return action, probability.astype(np.float32)


class PickledByArguments:
    """A base class whose objects are pickled by their constructor's arguments, like EzPickle.

    The copy has the same settings and is not reset yet; the state of the original is not copied.
    """

    spec: Any  # Gymnasium's EnvSpec, set by `gymnasium.make`
    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *given: Any, **named: Any) -> Self:
        """Keep the constructor's arguments."""
        copy = super().__new__(cls)
        copy._arguments = given, named
        return copy

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the class and its arguments for pickle and copy."""
        return _construct, (type(self), *self._arguments), {"spec": self.spec}


def _construct(kind: type[Any], given: tuple[Any, ...], named: dict[str, Any]) -> Any:
    return kind(*given, **named)
