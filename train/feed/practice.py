"""Practice: which missions the twin gives next, by arm, and a record of what it gave.

An arm is a kind of missions (`restock.train.twin.env.episode_queue`). The rules:

- natural: as `env.conditions`, `env.missions` and the floors say; the twin is left as it is;
- even: every arm alike; shares: as given; logs: the kinds as often as the logs' episodes met them;
  missions: the ordered missions alone, each at its part;
- success: an arm's weight is its rate of failures, while the agent explores. The failures and
  successes of an arm fade by a half-life; an arm with too few episodes goes by its kind's rate, and
  a kind with too few counts as if all failed;
- regret: what the agent's rate of success lacks to that of a reference driver on the same arm
  (prioritised level replay, arXiv:2010.03934, by arm). What nobody can do is not practised.

Weights become shares that sum to 1, none below its floor, and a share moves at most so far in an
interval. Nothing is drawn here: the twin draws its missions from its own seed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError, RunError
from restock.state import Stateful
from restock.train.dqn.config import PracticeConfig
from restock.train.feed.collector import EndedEpisode
from restock.train.feed.logs import Logs
from restock.train.feed.practice_shares import logged_shares, moved, unordered, with_floors
from restock.train.twin.env.episode_queue import MissionArm
from restock.train.twin.env.interface import ArmedTwin, KindsTwin, Twin

MOVING = ("success", "regret")  # rules whose shares follow what happens
FLOOR = 0.05  # of an arm under those, unless the config says otherwise
WHERE = "practice"


class Practice(Stateful):
    """Counts ended missions by arm; at the end of an interval it sets the twin's shares.

    Raises:
        ConfigError: the rule's shares or floors do not fit the arms, or it lacks what it needs.
    """

    SAME: ClassVar[tuple[str, ...]] = ("names",)
    STATE: ClassVar[tuple[str, ...]] = (
        *("shares", "_episodes", "_failures", "_seen"),
        *("_interval_episodes", "_interval_successes", "_closed_at", "reference"),
    )

    def __init__(
        self,
        config: PracticeConfig,
        arms: Sequence[MissionArm],
        set_shares: Callable[[Sequence[float]], None] | None = None,
        *,
        goal: bool = True,
        logged: Mapping[str, float] | None = None,
        reference: Mapping[str, float] | None = None,
    ) -> None:
        """`logged` are the kinds' shares of the logs' episodes; `goal`: success is defined.

        `reference` is the success by arm of whom regret is against.
        """
        self.config, self._set = config, set_shares
        # Where nothing is chosen, ordered missions count as what they are.
        self.arms = unordered(arms) if config.rule == "natural" else list(arms)
        count = len(self.arms)
        self.names = [arm.name for arm in self.arms]
        self.natural: F64 = np.array([arm.share for arm in self.arms])
        self.floors = self._resolved_floors()
        if config.rule in MOVING and not goal:
            raise ConfigError(
                f'the rule "{config.rule}" needs success, but the task has no goal',
                where=f"{WHERE}.rule",
                remedy='use "even" or "shares"',
            )
        self._episodes, self._failures = np.zeros(count), np.zeros(count)  # fading
        self._seen: Ints = np.zeros(count, np.int64)  # ended so far
        self._interval_episodes: Ints = np.zeros(count, np.int64)
        self._interval_successes: Ints = np.zeros(count, np.int64)
        self._closed_at = 0  # environment steps
        self.reference: F64 = np.full(count, np.nan)
        if reference is not None:
            self.reference = np.array([reference[name] for name in self.names])
        self._fixed = self._fixed_weights(logged)
        self.shares: F64 = (
            self.natural if config.rule == "natural" else with_floors(self.weights, self.floors)
        )
        self._tell()

    @classmethod
    def of(
        cls,
        config: PracticeConfig,
        env: Twin,
        conditions: Mapping[str, float],
        logs: Logs | None,
        *,
        goal: bool,
        reference: Mapping[str, float] | None = None,
    ) -> Practice:
        """For a twin, of `conditions` (`env.conditions`); a restored one has its `reference`.

        Raises:
            ConfigError: the twin cannot be given shares, or as the class.
        """
        kinds = [
            MissionArm(kind, kind, share / sum(conditions.values()))
            for kind, share in conditions.items()
            if share
        ]
        logged = None
        if logs is not None:
            logged = logged_shares(logs.condition, logs.episode, [arm.kind for arm in kinds])
        if isinstance(env, ArmedTwin):
            arms = list(env.mission_arms(config.by))
            tell = env.set_mission_shares
            return cls(config, arms, tell, goal=goal, logged=logged, reference=reference)
        if isinstance(env, KindsTwin):
            tell = partial(_set_kinds, env, [arm.kind for arm in kinds])
            return cls(config, kinds, tell, goal=goal, logged=logged, reference=reference)
        if config.rule != "natural":
            raise ConfigError(
                f'the rule "{config.rule}" chooses missions, and {type(env).__name__} cannot be'
                " given shares",
                where=f"{WHERE}.rule",
                remedy='give it `set_conditions(shares)`, or use "natural"',
            )
        return cls(config, kinds, goal=goal, logged=logged)

    # -- what happens ---------------------------------------------------------------------------

    def note(self, episodes: Sequence[EndedEpisode]) -> None:
        """Count ended missions."""
        fades = 0.5 ** (1 / self.config.half_life_episodes)
        for episode in episodes:
            place = self._place(episode)
            if place is None:
                continue
            success = bool(episode.success)
            self._seen[place] += 1
            self._episodes[place] = fades * self._episodes[place] + 1
            self._failures[place] = fades * self._failures[place] + (not success)
            self._interval_episodes[place] += 1
            self._interval_successes[place] += success

    def advance(self, steps: Mapping[str, int], *, last: bool = False) -> list[dict[str, Any]]:
        """At the end of an interval, its rows for the run's `practice`; the next one's shares.

        Call while no step of the twin is out. `last`: the run ends here, in whatever interval.
        """
        env_steps = steps["env_steps"]
        due = env_steps - self._closed_at >= self.config.every_env_steps
        if not due and not (last and self._interval_episodes.any()):
            return []
        rows = [{**steps, **row} for row in self._rows()]
        self._closed_at = env_steps
        self._interval_episodes[:] = self._interval_successes[:] = 0
        if self.config.rule in MOVING and not last:
            self.shares = moved(
                self.shares, with_floors(self.weights, self.floors), self.config.max_change
            )
            self._tell()
        return rows

    @property
    def weights(self) -> F64:
        """(K,) what the rule goes by, before floors: above 0 somewhere."""
        if self._fixed is not None:
            return self._fixed
        if self.config.rule == "success":
            return self.failure_rate
        regret = np.maximum(self.reference - (1 - self.failure_rate), 0.0)
        return regret if regret.any() else np.ones(len(self.arms))

    @property
    def believed(self) -> Bools:
        """(K,) whether an arm has ended often enough."""
        return self._seen >= self.config.warmup_episodes

    @property
    def failure_rate(self) -> F64:
        """(K,) of an arm's fading episodes, with half a failure more in one more (Jeffreys).

        That of its kind where it has too few; 1 where the kind has.
        """
        kinds = np.unique([arm.kind for arm in self.arms], return_inverse=True)[1]

        def of_kind(values: NDArray[Any]) -> NDArray[Any]:
            return np.bincount(kinds, values)[kinds]

        failures, episodes = of_kind(self._failures), of_kind(self._episodes)
        known = of_kind(self._seen) >= self.config.warmup_episodes
        rate = np.where(known, (failures + 0.5) / (episodes + 1), 1.0)
        return np.where(self.believed, (self._failures + 0.5) / (self._episodes + 1), rate)

    def check_reference(self) -> None:
        """Raises ConfigError where regret is against nobody."""
        if self.config.rule == "regret" and np.isnan(self.reference).any():
            raise ConfigError(
                'the rule "regret" needs the success of a reference driver on each arm',
                where=f"{WHERE}.rule",
                remedy='train with Restock\'s own twin, which measures it, or use "success"',
            )

    def restored(self) -> None:
        """The twin draws by the shares of then; another rule than then goes by its own."""
        if self.config.rule == "natural":
            self.shares = self.natural
        elif self._fixed is not None:
            self.shares = with_floors(self._fixed, self.floors)
        self._tell()

    def mismatch(self, name: str, value: Any) -> Exception:
        """The run practised other arms."""
        return RunError(
            f"practised {', '.join(map(str, value or ()))}; now there are {', '.join(self.names)}",
            where=WHERE,
            remedy="resume it with its own env and practice.by, or start another run",
        )

    def _tell(self) -> None:
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
                "success_rate": 1 - float(rate[place]) if self.believed[place] else None,
                "reference": None
                if np.isnan(self.reference[place])
                else float(self.reference[place]),
                "weight": float(weights[place]),
                "total_episodes": int(self._seen[place]),
            }
            for place, arm in enumerate(self.arms)
        ]

    def _place(self, episode: EndedEpisode) -> int | None:
        """Which arm an episode was of; None where of none."""
        if episode.arm >= 0:
            return episode.arm
        values = json.loads(episode.perturbation_values)
        for place, arm in enumerate(self.arms):
            if arm.holds(episode.true_condition, episode.block, episode.layout, values):
                return place
        return None

    # -- the rule -------------------------------------------------------------------------------

    def _fixed_weights(self, logged: Mapping[str, float] | None) -> F64 | None:
        """Of a rule whose weights do not change; None of one whose do."""
        config = self.config
        if config.rule == "natural":
            return self.natural
        if config.rule == "even":
            return np.ones(len(self.arms))
        if config.rule == "shares":
            return self._by_name(config.shares, "shares")
        if config.rule == "missions":
            weights = np.where([arm.order >= 0 for arm in self.arms], self.natural, 0.0)
            if not weights.any():
                raise ConfigError(
                    'the rule "missions" practises the missions of a file, but none is given',
                    where=f"{WHERE}.rule",
                    remedy="give env.missions a file of `restock coverage gaps --missions-out`",
                )
            return weights
        if config.rule == "logs":
            if not logged:
                raise ConfigError(
                    'the rule "logs" practises with the shares of the logs, but this run has no '
                    "logs"
                    " of the kinds that the twin has",
                    where=f"{WHERE}.rule",
                    remedy="give --panel, or use another rule",
                )
            return self._by_name(logged, "the logs' shares")
        return None

    def _by_name(self, given: Mapping[str, float], key: str) -> F64:
        """(K,) values of arms or of whole kinds, split among a kind's arms as they are natural."""
        found = np.zeros(len(self.arms))
        for name, value in given.items():
            if name in self.names:
                found[self.names.index(name)] += value
                continue
            of_kind = np.array([arm.kind == name and arm.order < 0 for arm in self.arms])
            if not of_kind.any():
                raise ConfigError(
                    f"{name!r} is not a kind of missions that this run can practise",
                    where=f"{WHERE}.{key}",
                    remedy=f"choose from {', '.join(self._known())}",
                )
            parts = np.where(of_kind, self.natural, 0.0)
            found += value * parts / parts.sum()
        return found

    def _known(self) -> list[str]:
        """The names that shares and floors may give: kinds, then arms."""
        return list(dict.fromkeys([*(a.kind for a in self.arms if a.order < 0), *self.names]))

    def _resolved_floors(self) -> F64:
        config = self.config
        least = config.floor
        if least is None:
            least = FLOOR if config.rule in MOVING else 0.0
            # Many arms (floors, orders) leave less for each: half is always free to move.
            least = min(least, 0.5 / max(len(self.arms), 1))
        given = self._by_name(config.floors, "floors")
        floors: F64 = np.maximum(np.full(len(self.arms), least), given)
        if floors.sum() > 1 + 1e-9:
            raise ConfigError(
                f"the floors of {len(self.arms)} arms sum to {floors.sum():.3g}, above 1",
                where=f"{WHERE}.floor",
                remedy=f"give at most {1 / len(self.arms):.3g} where all have the same",
            )
        return floors


def _set_kinds(env: KindsTwin, kinds: Sequence[str], shares: Sequence[float]) -> None:
    env.set_conditions(dict(zip(kinds, shares, strict=True)))


__all__ = ["Practice"]
