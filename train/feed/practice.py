"""Make a run's twin, and choose the shares of the missions that it practises next, by arm.

An arm is a kind of missions (`restock.train.twin.env.episode_queue`). The rules:

- natural: the shares that `env.conditions`, `env.missions` and the floors give;
- even: the same share for every arm;
- success: an arm's weight is its failure rate while the agent explores. Older episodes count less,
  by a half-life. An arm with too few episodes has its kind's rate, and a kind with too few has 1.

Weights become shares that sum to 1. Under `success`, no share is below a floor, and none changes by
more than a limit per interval. Nothing is drawn here: the twin draws missions from its own seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import ConfigError, RunError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.task import Signals, Task
from restock.replay.fleet.missions_file import MissionOrder, read_missions
from restock.state import Stateful
from restock.train.dqn.config import PracticeConfig, TrainConfig
from restock.train.feed.collector import EndedEpisode
from restock.train.twin.env.episode_queue import MissionArm, MissionArms, MissionOrders
from restock.train.twin.env.interface import Info, Step, Twin
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.planner import planners
from restock.train.twin.physics.perturbation import Schedule, find_perturbation

FLOOR = 0.05  # least share of an arm under the rule "success"
WHERE = "practice"
HALF_LIFE_EPISODES = 20.0  # an episode counts half after so many later ones of its arm
MAX_CHANGE = 0.1  # largest change of a share per interval
INTERVAL_STEPS = 1_000  # environment steps after which shares may change
WARMUP_EPISODES = 5  # episodes of an arm before its own rate is used


class Practice(Stateful):
    """A counter of ended missions by arm, which sets the arms' shares at each interval's end.

    Raises:
        ConfigError: the rule is "success", but the task has no goal.
    """

    SAME: ClassVar[tuple[str, ...]] = ("names",)
    STATE: ClassVar[tuple[str, ...]] = (
        *("shares", "_episodes", "_failures", "_seen"),
        *("_interval_episodes", "_interval_successes", "_closed_at"),
    )

    def __init__(
        self,
        config: PracticeConfig,
        arms: Sequence[MissionArm],
        set_shares: Callable[[Sequence[float]], None] | None = None,
        *,
        goal: bool = True,
    ) -> None:
        """Start counting; `goal` is whether the task defines success."""
        self.config, self._set = config, set_shares
        # Under the rule "natural", ordered missions count for the arms of their kind.
        self.arms = unordered(arms) if config.rule == "natural" else list(arms)
        count = len(self.arms)
        self.names = [arm.name for arm in self.arms]
        self.natural: F64 = np.array([arm.share for arm in self.arms])
        # With many arms the floor is lower, so that floors take up at most half of all missions.
        least = FLOOR if config.rule == "success" else 0.0
        self.floor = min(least, 0.5 / max(count, 1))
        if config.rule == "success" and not goal:
            raise ConfigError(
                'the rule "success" needs success, but the task has no goal',
                where=f"{WHERE}.rule",
                remedy='use "even"',
            )
        self._episodes, self._failures = np.zeros(count), np.zeros(count)  # older ones count less
        self._seen: Ints = np.zeros(count, np.int64)  # episodes ended so far
        self._interval_episodes: Ints = np.zeros(count, np.int64)
        self._interval_successes: Ints = np.zeros(count, np.int64)
        self._closed_at = 0  # environment steps when the last interval was closed
        self._fixed = self._fixed_weights()
        self.shares: F64 = (
            self.natural if config.rule == "natural" else with_floor(self.weights, self.floor)
        )
        self._send_shares()

    # -- counts and shares ----------------------------------------------------------------------

    def note(self, episodes: Sequence[EndedEpisode]) -> None:
        """Count ended missions."""
        fades = 0.5 ** (1 / HALF_LIFE_EPISODES)
        for episode in episodes:
            place = self._arm_index(episode)
            if place is None:
                continue
            success = bool(episode.success)
            self._seen[place] += 1
            self._episodes[place] = fades * self._episodes[place] + 1
            self._failures[place] = fades * self._failures[place] + (not success)
            self._interval_episodes[place] += 1
            self._interval_successes[place] += success

    def advance(self, steps: Mapping[str, int], *, last: bool = False) -> list[dict[str, Any]]:
        """Close the interval if it is over: return its rows of `practice`, and set new shares.

        Return no rows if the interval goes on. Call this while no step of the twin is under way.
        `last` closes the interval early, because the run ends here.
        """
        env_steps = steps["env_steps"]
        due = env_steps - self._closed_at >= INTERVAL_STEPS
        if not due and not (last and self._interval_episodes.any()):
            return []
        rows = [{**steps, **row} for row in self._rows()]
        self._closed_at = env_steps
        self._interval_episodes[:] = self._interval_successes[:] = 0
        if self._fixed is None and not last:
            self.shares = moved(self.shares, with_floor(self.weights, self.floor), MAX_CHANGE)
            self._send_shares()
        return rows

    @property
    def weights(self) -> F64:
        """Return the weights (K,) that the rule gives the arms, before the floor; not all are 0."""
        return self.failure_rate if self._fixed is None else self._fixed

    @property
    def has_own_rate(self) -> Bools:
        """Return whether each arm has enough episodes for a rate of its own, (K,)."""
        return self._seen >= WARMUP_EPISODES

    @property
    def failure_rate(self) -> F64:
        """Return each arm's failure rate, with Jeffreys' prior, (K,); older episodes count less.

        An arm with too few episodes has the rate of its kind; if the kind has too few, it is 1.
        """
        kinds = np.unique([arm.kind for arm in self.arms], return_inverse=True)[1]

        def of_kind(values: NDArray[Any]) -> NDArray[Any]:
            return np.bincount(kinds, values)[kinds]

        failures, episodes = of_kind(self._failures), of_kind(self._episodes)
        known = of_kind(self._seen) >= WARMUP_EPISODES
        rate = np.where(known, (failures + 0.5) / (episodes + 1), 1.0)
        return np.where(self.has_own_rate, (self._failures + 0.5) / (self._episodes + 1), rate)

    def restored(self) -> None:
        """Give the twin the restored shares; those of a fixed rule are computed again."""
        if self.config.rule == "natural":
            self.shares = self.natural
        elif self._fixed is not None:
            self.shares = with_floor(self._fixed, self.floor)
        self._send_shares()

    def mismatch(self, name: str, value: Any) -> Exception:
        """Return the error for resuming a run whose arms (kinds of missions) were others."""
        return RunError(
            f"practised {', '.join(map(str, value or ()))}; now there are {', '.join(self.names)}",
            where=WHERE,
            remedy="resume it with its own env, or start another run",
        )

    def _send_shares(self) -> None:
        if self._set is not None and self.config.rule != "natural":
            self._set(self.shares.tolist())

    def _rows(self) -> list[dict[str, Any]]:
        total = int(self._interval_episodes.sum())
        weights, rate = self.weights, self.failure_rate
        return [
            {
                "rule": self.config.rule,
                "arm": arm.name,
                "condition": arm.kind,
                "natural_share": arm.share,
                "wanted_share": float(self.shares[place]),
                "given_share": self._interval_episodes[place] / total if total else None,
                "episodes": int(self._interval_episodes[place]),
                "success": self._interval_successes[place] / self._interval_episodes[place]
                if self._interval_episodes[place]
                else None,
                "success_rate": 1 - float(rate[place]) if self.has_own_rate[place] else None,
                "weight": float(weights[place]),
                "total_episodes": int(self._seen[place]),
            }
            for place, arm in enumerate(self.arms)
        ]

    def _arm_index(self, episode: EndedEpisode) -> int | None:
        """Return the index of an episode's arm; None if it belongs to no arm."""
        if episode.arm >= 0:
            return episode.arm
        for place, arm in enumerate(self.arms):
            if arm.holds(episode.true_condition, episode.block):
                return place
        return None

    # -- the rule -------------------------------------------------------------------------------

    def _fixed_weights(self) -> F64 | None:
        """Return the weights of a rule that never changes them, (K,); None for "success"."""
        rule = self.config.rule
        if rule == "natural":
            return self.natural
        if rule == "even":
            return np.ones(len(self.arms))
        return None


def with_floor(weights: F64, floor: float) -> F64:
    """Return shares (K,) in proportion to weights, none below `floor`; they sum to 1.

    Shares that would be below the floor are set to it. The other arms divide the rest, evenly if
    all their weights are 0. `floor` is at most 1 / K, and `weights` sum to more than 0.
    """
    held = np.zeros(len(weights), np.bool_)
    shares: F64 = np.full(len(weights), floor)
    while not held.all():
        rest = max(1.0 - floor * int(held.sum()), 0.0)
        weight = np.where(held, 0.0, weights)
        if not weight.sum() > 0:
            weight = (~held).astype(np.float64)
        part = rest * weight / weight.sum()
        below = ~held & (part < floor)
        if not below.any():
            shares = np.where(held, floor, part)
            break
        held |= below
    whole: F64 = shares / shares.sum()
    return whole


def moved(shares: F64, wanted: F64, most: float) -> F64:
    """Move `shares` towards `wanted`, none by more than `most`; they still sum to 1.

    All move by the same fraction of their distance, so the result keeps a floor that both keep.
    """
    farthest = float(np.abs(wanted - shares).max())
    part = 1.0 if farthest <= most else most / farthest
    return np.add(shares, part * (wanted - shares))


def unordered(arms: Sequence[MissionArm]) -> list[MissionArm]:
    """Return the arms without those of ordered missions, whose shares go to arms of their kind."""
    kept = [arm for arm in arms if arm.order < 0]
    for order in (arm for arm in arms if arm.order >= 0):
        total = sum(arm.share for arm in kept if arm.kind == order.kind)
        if not total:
            kept.append(MissionArm(order.kind, order.kind, order.share))
            continue
        kept = [
            replace(arm, share=arm.share * (1 + order.share / total))
            if arm.kind == order.kind
            else arm
            for arm in kept
        ]
    return kept


MISSIONS = "env.missions"


def mission_orders(config: TrainConfig) -> tuple[MissionOrder, ...]:
    """Read the ordered missions of the config; empty if it names none.

    Raises:
        ConfigError: the missions file cannot be read or is invalid.
    """
    missions = config.env.missions
    return read_missions(missions).missions if isinstance(missions, str) else missions or ()


def mission_arms(config: TrainConfig) -> MissionArms:
    """Make the arms of a run's missions.

    Raises:
        ConfigError: an ordered mission does not fit on the floors.
    """
    floors, ordered = open_floors(config.env.layouts), mission_orders(config)
    routes = planners(floors)
    perturbation = find_perturbation(config.env.perturbation, where="env.perturbation")
    return MissionArms(
        floors,
        routes,
        config.env.conditions,
        schedule=perturbation if isinstance(perturbation, Schedule) else None,
        orders=MissionOrders(ordered, floors, routes, where=MISSIONS) if ordered else None,
        orders_share=config.env.missions_share,
    )


def check_missions(config: TrainConfig, profile: Profile) -> None:
    """Refuse missions that the twin cannot drive, before anything is written.

    Raises:
        ConfigError: an ordered mission or an arm does not fit on the floors.
    """
    if not mission_orders(config) and config.practice == PracticeConfig():
        return
    Practice(config.practice, mission_arms(config).arms, goal=profile.task.goal != "none")


def make_twin(
    config: TrainConfig,
    profile: Profile,
    num_envs: int,
    nthread: int = 1,
    layouts: str | None = None,
) -> Twin:
    """Make a run's twin, on other floors if `layouts` is given; `NoTwin` without `env.twin`."""
    if not config.env.twin:
        return NoTwin(profile.task)
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

    twin: Twin = WarehouseVectorEnv(
        num_envs,
        perturbation=find_perturbation(config.env.perturbation, where="env.perturbation"),
        conditions=config.env.conditions,
        seed=config.seed,
        nthread=nthread,
        task=profile.task,
        robot=profile.robot,
        layouts=layouts or config.env.layouts,
        # Only evaluation gives `layouts`; it drives fixed episodes, not ordered missions.
        missions=() if layouts is not None else mission_orders(config),
        missions_share=config.env.missions_share,
        nav_command=profile.inputs.nav_command is not None,
    )
    return twin


class NoTwin:
    """A placeholder for the twin of a run on the logs alone; a step in it raises an error."""

    num_envs = 1

    def __init__(self, task: Task) -> None:
        self._observation: F32 = np.zeros((1, task.observation_size), np.float32)

    @property
    def signals(self) -> Signals:
        return {}

    def set_episodes(self, specs: Iterable[Any], /) -> None:
        raise RuntimeError("a run on the logs alone does not drive")

    def mission_arms(self) -> list[MissionArm]:
        return []

    def set_mission_shares(self, shares: Sequence[float], /) -> None:
        raise RuntimeError("a run on the logs alone does not drive")

    def reset(self, *, seed: int | None = None) -> tuple[F32, Info]:
        return self._observation, {}

    def step(self, actions: NDArray[Any], /) -> Step:
        raise RuntimeError("a run on the logs alone does not drive")

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        pass
