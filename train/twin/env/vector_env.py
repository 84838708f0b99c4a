"""The twin as a Gymnasium vector environment: N warehouses stepped in one native call.

    env = WarehouseVectorEnv(16, conditions={"nominal": 0.4, "wheel_slip": 0.2, ...}, seed=1)
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(actions)

Actions are indices into the task's table of actions. With `action="continuous"` they are (N, 2)
speeds in m/s and yaw rates in rad/s for the same task. The base then gets exactly that command,
but the observation's previous action and the reward's change of action use the nearest action of
the table, as `restock ingest` does with the continuous commands of a log. The same holds for
commands that a limiter has changed.

Autoreset is SAME_STEP (in the metadata): when an episode ends, `observation` is already the first
of the next episode, and the last of the ended episode is in `info["final_obs"]`. Bootstrap on
truncation, never on termination.

`docs/twin.md` lists what `info` holds. `WarehouseEnv` is one warehouse as a plain Gymnasium
environment, without autoreset.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import gymnasium
import msgspec
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.errors import ConfigError, RunError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Limits, Robot, limit, refuse_beyond_steering
from restock.ingest.task.task import OBSERVED, Signals, Task, nearest_action, observe, reward
from restock.ingest.task.task import terminated as is_terminated
from restock.ingest.task.task_sql import Past, Table
from restock.replay.fleet.missions_file import MissionOrder
from restock.state import Stateful, saved
from restock.train.twin.env.episode_queue import (
    EpisodeQueue,
    MissionArm,
    MissionArms,
    MissionOrders,
)
from restock.train.twin.env.interface import Info, PickledByArguments, Step
from restock.train.twin.env.navigation import Navigation, Truth, info_after, info_now
from restock.train.twin.env.render import draw_map
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import DEFAULT, Warehouse
from restock.train.twin.missions import DEFAULT_CONDITIONS, KINDS
from restock.train.twin.physics.episode import (
    EpisodeSpec,
    draw_episode,
    names_and_hashes,
    refuse_other_floors,
    refuse_too_large,
    refuse_unfit,
    with_room,
)
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.perturbation import Perturbation, Schedule, find_perturbation
from restock.train.twin.physics.sensing import Sensing
from restock.train.twin.physics.simulation import BodyState, Simulation

ActionKind = Literal["discrete", "continuous"]
# Task actions (N,), commands (N, 2) in m/s and rad/s, and what to add to `info`.
Chosen = tuple[Ints, F64, dict[str, NDArray[Any]]]


class DiscreteActions:
    """An action space of indices (N,) into the task's actions."""

    def __init__(self, task: Task, num_envs: int) -> None:
        self._num_envs = num_envs
        self._table = np.asarray(task.actions, np.float64)
        self.space = gymnasium.spaces.Discrete(len(task.actions))

    def read(self, actions: NDArray[Any]) -> Chosen:
        """Convert action indices (N,). Raises ConfigError for one outside the table."""
        given = np.asarray(actions).reshape(self._num_envs)
        with np.errstate(invalid="ignore"):
            action = given.astype(np.int64)
        wrong = (action != given) | (action < 0) | (action >= len(self._table))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise ConfigError(
                f"an action must be an index from 0 to {len(self._table) - 1}, got {given[row]}",
                where=f"environment {row} of the twin",
                remedy='for speeds and yaw rates make the environment with action="continuous"',
            )
        return action, self._table[action], {}


class ContinuousActions:
    """An action space of speeds in m/s and yaw rates in rad/s, (N, 2), clipped to its range.

    The task's actions span this range. `info["action"]` (N,) is the task's action nearest to the
    command, and `info["action_residual"]` (N,) the distance between both, as in the store.
    """

    def __init__(self, task: Task, num_envs: int) -> None:
        self._task, self._num_envs = task, num_envs
        table = np.asarray(task.actions, np.float32)
        self.space = gymnasium.spaces.Box(table.min(axis=0), table.max(axis=0), dtype=np.float32)

    def read(self, actions: NDArray[Any]) -> Chosen:
        """Convert commands (N, 2). Raises ConfigError for one that is not finite."""
        requested = np.asarray(actions, np.float64).reshape(self._num_envs, 2)
        if not np.isfinite(requested).all():
            row = int(np.flatnonzero(~np.isfinite(requested).all(axis=1))[0])
            raise ConfigError(
                f"an action must be two finite numbers, got {requested[row].tolist()}",
                where=f"environment {row} of the twin",
                remedy="the policy that chose it has diverged, or its output is not scaled",
            )
        command = np.clip(requested, self.space.low, self.space.high)
        action, residual = nearest_action(self._task, command[:, 0], command[:, 1])
        return action, command, {"action": action, "action_residual": residual}


ACTIONS: Mapping[str, type[DiscreteActions | ContinuousActions]] = {
    "discrete": DiscreteActions,
    "continuous": ContinuousActions,
}


def limit_actions(limits: Limits, task: Task, now: Signals, chosen: Chosen) -> Chosen:
    """Limit the chosen actions; `info["limiter"]` is the rule that limited each.

    The action of a limited command is the task's nearest, as ingest would label it.
    """
    action, command, reported = chosen
    before = np.stack([now["command_speed_mps"], now["command_yaw_rate_radps"]], axis=-1)
    limited = limit(limits, command, now["sector_clearance_m"], before)
    held, command = limited.intervened, limited.command
    nearest, residual = nearest_action(task, *command.T)
    action = np.where(held, nearest, action)
    residual = np.where(held, residual, reported.get("action_residual", 0.0))
    return action, command, {"action": action, "action_residual": residual, "limiter": limited.rule}


OBSERVATION_LIMIT = 20.0  # observations are clipped to [-20, 20]; sensors stay within


class WarehouseVectorEnv(VectorEnv[F32, NDArray[Any], NDArray[Any]], Stateful, PickledByArguments):
    """N warehouses as a Gymnasium vector environment; `docs/twin.md` explains `info`."""

    # What changes while episodes run; the rest (layout, noise, traffic's paths) follows from specs.
    STATE = (
        *("specs", "observation", "signals", "previous_action", "steps", "bumps", "episode_number"),
        *("episode_seed", "episode_condition", "block", "episodes_begun"),
        *("mission_arm", "diverged", "queue", "simulation", "sensing", "truth", "navigation"),
    )
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {"specs": list[EpisodeSpec]}

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        conditions: Mapping[str, float] | None = None,
        perturbation: Perturbation | Schedule | str | Mapping[str, Any] | None = None,
        seed: int = 0,
        nthread: int = 1,
        render_mode: str | None = None,
        task: Task | None = None,
        robot: Robot | None = None,
        layouts: str | Sequence[Warehouse | str] = DEFAULT,
        missions: Sequence[MissionOrder] = (),
        missions_share: float = 0.5,
        nav_command: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        action: ActionKind = "discrete",
    ) -> None:
        """`conditions` are shares of episodes per kind; `nthread` 0 uses every core.

        A `perturbation` applies to every episode whose spec has none of its own. A schedule draws
        one for each such episode (fixed episodes get its base), which is then in `env.specs`. It
        may also be the name of a built-in perturbation, a TOML file, or a table.

        `robot` is the `[robot]` of a profile with the task's outline; None is the stand-in.

        `layouts` are floors, or what `restock.train.twin.floors.floors.open_floors` reads, such as
        `generated:train`. If an episode's spec names no floor, its seed draws one.

        With `nav_command`, the signals contain the navigation stack's proposal, as on a robot whose
        profile has that input. In a task without a route the proposal is always unknown.

        If `missions` are ordered, they are `missions_share` of the drawn episodes.

        Raises:
            ConfigError: an unknown condition, shares below 0, a floor without room for
                a condition's episodes, a robot that cannot be built or is wider than an aisle, an
                unknown render mode, or an autoreset mode other than SAME_STEP and DISABLED.
        """
        if isinstance(perturbation, str | Mapping):
            perturbation = find_perturbation(perturbation, where="the twin")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"unknown render_mode {render_mode!r}", where="the twin", remedy="give rgb_array"
            )
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.task = task or load_profile("warehouse_amr").task
        self.floors = open_floors(layouts)
        self.layout_names = np.array([floor.name for floor in self.floors])
        self.floor_objects = np.empty(len(self.floors), object)
        self.floor_objects[:] = self.floors
        self.layout = np.zeros(num_envs, np.int64)  # floor index of the running episodes
        schedule = perturbation if isinstance(perturbation, Schedule) else None
        base = perturbation.base if isinstance(perturbation, Schedule) else perturbation
        self.perturbation = base or Perturbation()
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            raise ConfigError("autoreset must be SameStep or Disabled", where="the twin")
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.navigation = Navigation(self.floors, num_envs, self.task, proposes=nav_command)
        planners, orders = self.navigation.planners, None
        if missions:
            orders = MissionOrders(missions, self.floors, planners, where="env.missions")
        arms = MissionArms(
            *(self.floors, planners, conditions or DEFAULT_CONDITIONS),
            schedule=schedule,
            orders=orders,
            orders_share=missions_share,
        )
        refuse_unfit(self.floors, [kind for kind, share in arms.conditions.items() if share])
        self.queue = EpisodeQueue(num_envs, arms, seed)

        if robot is not None:
            refuse_too_large(self.floors, self.task.body)
            refuse_beyond_steering(robot, self.task.actions, where="the twin")
        limit = np.full(self.task.observation_size, OBSERVATION_LIMIT, np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-limit, limit, dtype=np.float32)
        self._actions = ACTIONS[action](self.task, num_envs)
        self.single_action_space = self._actions.space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

        timestep = self.perturbation.timestep_s
        self.simulation = Simulation(
            *(num_envs, self.task, self.floors, timestep, nthread),
            robot=robot_model(robot, self.task.body),
        )
        self.sensing = Sensing(self.simulation, self.task)
        self.truth = Truth(self.task, num_envs)
        own: tuple[Table, ...] = ("reward_terms", OBSERVED)
        self.past = {t: Past(self.task, t, num_envs) for t in own if getattr(self.task, t)}
        self.limits: Limits | None = None  # a limiter that every command passes
        self.specs: list[EpisodeSpec] = [EpisodeSpec("nominal", 0)] * num_envs
        self.diverged = 0  # episodes that ended in a NaN or beyond MuJoCo's limits
        self.signals: Signals = {}
        self.observation = np.zeros((num_envs, self.task.observation_size), np.float32)
        self.previous_action = np.zeros(num_envs, np.int64)
        self.steps = np.zeros(num_envs, np.int64)  # driven so far in the running episodes
        self.bumps = np.zeros(num_envs, np.int64)
        self.episodes_begun = np.zeros(num_envs, np.int64)  # rises with every episode
        self.episode_number = np.full(num_envs, -1)
        self.mission_arm = np.full(num_envs, -1)
        self.episode_seed = np.zeros(num_envs, np.int64)
        self.episode_condition = np.full(num_envs, "nominal", f"U{max(16, *map(len, KINDS))}")
        self.block = np.full(num_envs, "none", "U16")
        self.perturbation_name = np.full(num_envs, "nominal", object)  # object: any length
        self.perturbation_values = np.full(num_envs, "{}", object)  # JSON of what is not nominal

    # -- floors ---------------------------------------------------------------------------------

    def floor_of(self, env: int) -> Warehouse:
        """Return the floor that an environment's episode is on."""
        return self.floors[int(self.layout[env])]

    # -- episodes -------------------------------------------------------------------------------

    def mission_arms(self) -> list[MissionArm]:
        """Return the arms that practice can choose among, each with its natural share."""
        return self.queue.missions.arms

    def set_mission_shares(self, shares: Sequence[float]) -> None:
        """Set one share per arm of `mission_arms`, for episodes that begin from now on."""
        self.queue.practise(shares)

    def set_episodes(self, specs: Iterable[EpisodeSpec]) -> None:
        """Run these episodes, in order, from the next reset on; then draw episodes as usual.

        `info["episode_number"]` is an episode's index among them, or -1 if it was drawn.
        """
        self.queue.set_fixed(specs)

    def _begin(self, ids: Ints) -> None:
        """Start the next episode of each environment in `ids`."""
        for env in ids.tolist():
            spec, self.episode_number[env], self.mission_arm[env] = self.queue.next(env)
            self._lay_out(env, spec)
            if self.episode_number[env] >= 0:  # measure `closest_m` only in fixed episodes
                self.simulation.traffic.closest_m[env] = np.inf
        self.steps[ids] = self.bumps[ids] = self.previous_action[ids] = 0
        first = self.sensing.sense(ids, self.steps[ids])
        self.sensing.add_motion(ids, first)
        self.navigation.add_route(first, ids)
        self.navigation.propose(first)
        for past in self.past.values():
            past.begin(ids, first)
        if OBSERVED in self.past:
            first[OBSERVED] = self.past[OBSERVED].now(ids)
        observed = observe(self.task, first, first, self.previous_action[ids])
        self.observation[ids] = _bound(observed)
        if self.signals:
            for name, column in self.signals.items():
                column[ids] = first[name]
        else:
            self.signals = first

    def _lay_out(self, env: int, spec: EpisodeSpec) -> None:
        perturbation = spec.perturbation or self.perturbation
        if perturbation.timestep_s != self.simulation.timestep_s:
            raise ConfigError(
                f"an episode needs timestep_s = {perturbation.timestep_s}, the environment"
                f" runs at {self.simulation.timestep_s}",
                where=f"episode {spec.condition}/{spec.seed}",
                remedy="make the environment with that perturbation",
            )
        floor = self.queue.missions.floor_of(spec)
        episode = draw_episode(spec, self.floors[floor], self.navigation.planners[floor])
        episode = with_room(episode, self.floors[floor], self.simulation.outline_m)
        self.specs[env] = spec
        self.layout[env] = floor
        self.simulation.reset(env, episode, perturbation, floor)
        self.sensing.reset(env, episode.noise, perturbation)
        self.navigation.reset(env, episode, floor)
        self.truth.reset(np.array([env]))
        self.episode_condition[env], self.block[env] = spec.condition, episode.block
        self.episode_seed[env] = spec.seed
        self.perturbation_name[env] = perturbation.name
        self.perturbation_values[env] = json.dumps(perturbation.changed())
        self.episodes_begun[env] += 1

    # -- gymnasium ------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[F32, Info]:
        """Begin an episode in all environments, or only in `options["reset_mask"]` (N,)."""
        super().reset(seed=seed)
        ids = np.arange(self.num_envs)
        mask = (options or {}).get("reset_mask")
        if mask is not None and self.signals:
            ids = np.flatnonzero(mask)
        if seed is not None:
            self.queue.seed = seed
            self.queue.drawn[ids] = 0
        if len(ids) == self.num_envs:
            self.signals = {}
        else:
            self.signals = {name: column.copy() for name, column in self.signals.items()}
        self._begin(ids)
        return self.observation.copy(), info_now(self)

    def step(self, actions: NDArray[Any]) -> Step:
        """Step one control period; `actions` are action indices (N,) or commands (N, 2)."""
        if not self.signals:
            raise gymnasium.error.ResetNeeded("call env.reset() before env.step()")
        now, sim, task = self.signals, self.simulation, self.task
        chosen = self._actions.read(actions)
        if self.limits is not None:
            chosen = limit_actions(self.limits, task, now, chosen)
        action, command, reported = chosen
        everyone = np.arange(self.num_envs)
        sim.drive(command)
        self.truth.note_situation(sim, self.navigation.plans_m)
        self.steps += 1

        after = self.sensing.sense(everyone, self.steps)
        self.sensing.add_motion(everyone, after, now)
        offset = self.navigation.add_route(after)
        progress = now["route_remaining_m"] - after["route_remaining_m"]
        earned = reward(task, now, after, progress, action, self.previous_action)
        terminated = is_terminated(task, after)
        invalid = sim.diverged
        self.bumps += sim.bumped
        self.navigation.update(after, offset, self.sensing)
        self.navigation.propose(after)
        for past in self.past.values():
            past.step(after)
        if task.reward_terms:
            earned = earned + self.past["reward_terms"].now(everyone)
        if task.observed:
            after[OBSERVED] = self.past[OBSERVED].now(everyone)

        terminated &= ~invalid
        truncated = ((self.steps >= task.time_limit_steps) & ~terminated) | invalid
        observed = _bound(observe(task, after, now, action))
        truth = self.truth.condition(sim.slipped, sim.bumped, self.sensing.true_clearance_m)
        info = info_after(self, after, progress, truth, terminated) | reported
        if invalid.any():
            self.diverged += int(invalid.sum())
            earned = np.where(invalid, np.float32(0), earned)
            observed[invalid] = self.observation[invalid]
        self.observation, self.signals, self.previous_action = observed, after, action.copy()
        done = terminated | truncated
        if done.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            info["final_obs"], info["_final_obs"] = observed.copy(), done.copy()
            self.signals = {name: column.copy() for name, column in after.items()}
            self._begin(np.flatnonzero(done))
        return self.observation.copy(), earned, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a map of every environment from above, (H, W, 3) uint8 each."""
        if self.render_mode is None:
            return None
        return tuple(draw_map(self, env) for env in range(self.num_envs))

    # -- recorders ------------------------------------------------------------------------------

    def set_block_callback(
        self, callback: Callable[[BodyState], None] | None, period_s: float = 0.02
    ) -> None:
        """Call `callback` with the true state every `period_s` of simulated time; None: no calls.

        The physics is the same with and without it. `period_s` is rounded to whole substeps, and
        calls are evenly spaced only if it divides .1 s. They come before the step's autoreset.
        """
        self.simulation.callback = callback
        self.simulation.callback_period_s = period_s

    # -- state ----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a bit-exact continuation, and the task and floors that it needs."""
        floors = names_and_hashes(self.floors)
        own = {"past": saved(self.past)} if self.past else {}
        return {"task_hash": self.task.hash, "floors": floors, **own, **super().state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from the state of an environment with the same arguments.

        Raises:
            RunError: the state is from another number of environments, another task or other
                floors, or is not such a state.
        """
        self.expect_state(state, ("task_hash", "floors", *self.STATE))
        specs = msgspec.convert(state["specs"], list[EpisodeSpec])
        if len(specs) != self.num_envs or state["task_hash"] != self.task.hash:
            raise RunError(
                f"the saved state has {len(specs)} environments and task {state['task_hash']}, but"
                f" there are {self.num_envs} here, with task {self.task.hash}",
                where="state of the twin",
                remedy="make the environment as it was made when the state was saved",
            )
        refuse_other_floors(state["floors"], self.floors)
        for env, spec in enumerate(specs):
            self._lay_out(env, spec)
        for table, past in self.past.items():
            past.load_state_dict(state["past"][table])
        super().load_state_dict(state)


def _bound(observation: F32) -> F32:
    known = np.where(np.isnan(observation), np.float32(0.0), observation)
    return known.clip(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)


class WarehouseEnv(gymnasium.Env[F32, Any], PickledByArguments):
    """The vector environment with N = 1; `info` holds its values without the leading axis.

    It takes the vector environment's keyword arguments. The vector environment is `self.vector`.
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
        """Step one control period; `info["signals_before"]` are the signals before the step."""
        before = self.vector.signals
        observation, reward, terminated, truncated, info = self.vector.step(np.array([action]))
        info["signals_before"] = before
        return (
            *(observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0])),
            _first(info),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Return a map from above, (H, W, 3) uint8."""
        frames = self.vector.render()
        return frames[0] if frames else None


def _first(info: dict[str, Any]) -> dict[str, Any]:
    return {k: _first(v) if isinstance(v, dict) else v[0] for k, v in info.items()}
