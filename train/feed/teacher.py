"""The teacher that is queried in the agent's states, and the behaviour network's batches.

The teacher is the twin's operator, or one of yours. Besides its answers, logged rows are cloned.

Logged rows are drawn by the shares of their strata, as the critic's are: a network that clones the
majority finds nothing plausible in the rare cases (arXiv:2310.04413). Fresh rows are drawn
uniformly. If a teacher prefers no side, a row's mirror image is as valid as the row: half of the
rows are drawn mirrored.

The cloned rows are those of named drivers, and of other drivers' successes. An operator is called
when the planner fails, so the logs hold few rows of the operator when nothing is wrong, or beside
people whom the planner gets past, and a clone of the operator's rows alone is poor there. Episodes
in which other drivers reached their goal without help fill that gap (filtered behaviour cloning,
%BC in arXiv:2106.01345).
"""

from __future__ import annotations

import importlib
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

import restock
from restock.arrays import F32, F64, Bools, Ints
from restock.errors import ConfigError, RestockError
from restock.files import first_line
from restock.ingest.task.task import Mirror, Task
from restock.replay.panel.panel import Panel
from restock.replay.sampling.packed_rows import SCALARS, row_columns
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful, restored, saved
from restock.train.dqn.behaviour import UNKNOWN, Labelled, imitation_loss, plausible_actions
from restock.train.dqn.config import GIVEN, TeacherConfig
from restock.train.dqn.learner import Learner
from restock.train.feed.batches import gather_rows
from restock.train.feed.logs import Coded, Logs

Label = NDArray[np.int16]


@runtime_checkable
class Teacher(Protocol):
    """A driver that is queried for actions in N environments, but does not drive them.

    It may read the environment itself, not only the observation. It is queried once per step, in
    order, and once before training begins. If it has `state_dict` and `load_state_dict`, a resumed
    run continues exactly as if it had never stopped.
    """

    def act(self, env: Any, observation: F32, /) -> Ints:
        """Return actions (N,) for observations (N, D); -1 if it has no opinion."""
        ...


class OperatorTeacher(Stateful):
    """The operator of the warehouse twin, without its random errors."""

    STATE: ClassVar[tuple[str, ...]] = ("_operator",)

    def __init__(self, seed: int) -> None:
        from restock.train.twin.env.drivers import Operator

        self._operator = Operator(epsilon=0.0, seed=seed)

    def act(self, env: Any, observation: F32, /) -> Ints:
        """Return the teacher's action in each environment, (N,).

        Raises:
            ConfigError: the environment is not the warehouse twin.
        """
        if not (hasattr(env, "simulation") and hasattr(env, "navigation")):  # read by the operator
            raise ConfigError(
                f'teacher.source = "operator" needs the warehouse twin, but this is a'
                f" {type(env).__name__}",
                remedy="pass another teacher, restock.train.train(teacher=…), or give one as "
                "module:name",
            )
        return self._operator.choose(env)


class _FunctionTeacher:
    """A function wrapped as a teacher."""

    def __init__(self, function: Any) -> None:
        self.act = function


class TeacherFailed(ConfigError):
    """The teacher raised an error or returned invalid actions."""


class CheckedTeacher(Stateful):
    """A teacher whose answers are checked.

    Args:
        teacher: the teacher to query.
        task: the task whose actions are valid answers.
        name: `teacher.source` as it was given, for errors.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_kept",)

    def __init__(self, teacher: Teacher, task: Task, name: str) -> None:
        self._teacher, self._actions, self._name = teacher, task.action_names, name

    def query(self, env: Any, observation: F32) -> Label:
        """Return the teacher's action in each environment, (N,); UNKNOWN if it has no opinion.

        Raises:
            TeacherFailed: the teacher raised an error, or did not return N actions of the task.
        """
        with _user_errors(f"the teacher {self._name}", self._teacher.act):
            # A copy, so that the teacher cannot change what the agent sees and the run keeps.
            given = self._teacher.act(env, observation.copy())
        count = len(observation)
        try:
            label = np.asarray(given)
        except (TypeError, ValueError) as error:  # rows of unequal length, or a tensor on a GPU
            raise self._refused(
                f"returned a {type(given).__name__} that is not an array: {first_line(error)}"
            ) from error
        if label.shape != (count,) or not np.issubdtype(label.dtype, np.integer):
            what = "nothing" if given is None else f"{label.dtype} {label.shape}"
            raise self._refused(f"returned {what}, not {count} whole numbers, one per environment")
        outside = (label < UNKNOWN) | (label >= len(self._actions))
        if outside.any():
            env_index = int(np.flatnonzero(outside)[0])
            raise self._refused(
                f"returned action {int(label[env_index])} for environment {env_index}: the task's"
                f" are 0 to {len(self._actions) - 1}"
            )
        return label.astype(np.int16)

    def _refused(self, what: str) -> TeacherFailed:
        return TeacherFailed(
            f"the teacher {self._name} {what}",
            where="teacher.source",
            remedy="return an action's index for each environment, (N,), or -1 for no opinion",
        )

    @property
    def _kept(self) -> Any:
        return saved(self._teacher) if hasattr(self._teacher, "state_dict") else None

    @_kept.setter
    def _kept(self, state: Any) -> None:
        if state is not None:
            restored(self._teacher, state)


def open_teacher(
    config: TeacherConfig, task: Task, *, seed: int, given: Any = None
) -> CheckedTeacher | None:
    """Make the teacher that a run queries in the twin; None if there is none.

    Args:
        given: a teacher to use instead of the one that the config names: an object with `act`, or
            a function with the same arguments.

    Raises:
        ConfigError: there is no such module or name, or it has no `act` and cannot be called.
        TeacherFailed: creating or importing the teacher raised an error.
    """
    if config.source is None or not config.queried:
        return None
    if config.source == "operator":
        return CheckedTeacher(OperatorTeacher(seed), task, config.source)
    if given is None:
        given = _import_teacher(config.source)
    name = config.source if config.source != GIVEN else type(given).__name__
    if isinstance(given, type):
        with _user_errors(f"making the teacher {name}", given):
            given = given()
    if not hasattr(given, "act"):
        if not callable(given):
            raise ConfigError(
                f"{name} is a {type(given).__name__}, which has no act and cannot be called",
                where="teacher.source",
                remedy="give an object with act(env, observation), or such a function",
            )
        given = _FunctionTeacher(given)
    return CheckedTeacher(given, task, name)


@contextmanager
def _user_errors(what: str, called: Any) -> Iterator[None]:
    """Turn an error in the user's code into a TeacherFailed that names its file and line.

    This includes SystemExit, which would end the run without a message.
    """
    try:
        yield
    except RestockError:
        raise
    except (Exception, SystemExit) as error:
        raise _teacher_error(what, called, error) from error


def _teacher_error(what: str, called: Any, error: BaseException) -> TeacherFailed:
    message = f": {first_line(error)}" if str(error) else ""
    return TeacherFailed(
        f"{what} raised {type(error).__name__}{message}",
        where=_user_location(called, error),
        remedy="correct it: it is called as act(env, observation), and a class is created without "
        "arguments",
    )


def _user_location(called: Any, error: BaseException) -> str:
    """Return FILE:LINE of the user's innermost line in the traceback, or of the called object.

    Frames of libraries and of Restock, which the user's code may call, do not count.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}"
    libraries = (
        *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
        str(Path(restock.__file__).parent),
        "<",  # frames of the import system, as "<frozen ...>"
    )
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(libraries)]
    if own:
        return f"{own[-1].filename}:{own[-1].lineno}"
    try:
        return f"{inspect.getsourcefile(called)}:{inspect.getsourcelines(called)[1]}"
    except (TypeError, OSError):  # no source file
        return "teacher.source"


def _import_teacher(source: str) -> Any:
    """Import `module:name`; modules in the working directory are found, too."""
    if source == GIVEN:
        raise ConfigError(
            "the run's teacher was passed in from Python, and none is given now",
            where="teacher.source",
            remedy="to be able to continue a run, start it with a teacher given as module:name",
        )
    module, _, name = source.partition(":")
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{source} cannot be imported: {error}",
            where="teacher.source",
            remedy="give a module that Python can import, or a file in the working directory, and "
            "the name of the teacher in it",
        ) from error
    except (Exception, SystemExit) as error:
        raise _teacher_error(f"importing {source}", None, error) from error
    finally:
        sys.path.remove(folder)


_MAX_MEASURED = 128  # rows per condition that the filter is measured on
_LOGS_SHARE = 0.25  # logged rows' share of an online batch if a teacher is queried


def rows_of_policies(policy: Coded, policies: Sequence[str]) -> Bools:
    """Select the rows (n,) that one of `policies` drove."""
    codes = [policy.names.index(name) for name in policies if name in policy.names[:-1]]
    return np.isin(policy.codes, codes)


def rows_of_successes(
    policy: Coded, episode: Coded, reward: F32, discount: F32, policies: Sequence[str]
) -> Bools:
    """Select the rows (n,) of episodes that reached their goal and have no row of `policies`.

    An episode reached its goal if it was terminated (discount 0) with a reward above 0.
    """
    well = (discount == 0.0) & (reward > 0.0)
    count = len(episode.names)
    ended = np.bincount(episode.codes[well], minlength=count) > 0
    helped = np.bincount(episode.codes[rows_of_policies(policy, policies)], minlength=count) > 0
    ended[-1] = False  # the last code stands for an unknown episode
    return np.asarray((ended & ~helped)[episode.codes], np.bool_)


def packed_successes(policy: Coded, episode: Coded, packed: F32, policies: Sequence[str]) -> Bools:
    """Apply `rows_of_successes` to packed rows (n, W)."""
    columns = row_columns((packed.shape[1] - len(SCALARS)) // 2)
    reward, discount = (
        np.asarray(packed[:, columns[name]]).ravel() for name in ("reward", "discount")
    )
    return rows_of_successes(policy, episode, reward, discount, policies)


def select_cloned(panel: Panel, teacher: TeacherConfig) -> Bools:
    """Select the rows (n,) of a panel that are cloned before the first environment step."""
    policy = Coded.of(panel.meta["behaviour_policy"])
    rows = rows_of_policies(policy, teacher.policies)
    if teacher.successes:
        episode = Coded.of(panel.meta["episode_id"])
        rows |= packed_successes(policy, episode, panel.rows, teacher.policies)
    return rows


class Imitation(Stateful):
    """A source of batches of states with the action that a teacher took or would have taken.

    Args:
        batch_size: M.
        mirror: makes mirror images of the task's rows; None: rows are not mirrored.

    Raises:
        ConfigError: the logs have no row of the policies to clone.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_rng",)

    def __init__(
        self,
        config: TeacherConfig,
        logs: Logs | None,
        ring: FreshRing,
        *,
        batch_size: int,
        seed: int,
        mirror: Mirror | None = None,
    ) -> None:
        self.logs, self.ring, self._mirror = logs, ring, mirror
        self.batch_size, self._seed = batch_size, seed
        self._rng = np.random.default_rng([seed, 7])
        self._offline = self._online = _WeightedRows(np.empty(0, np.int64), np.empty(0))
        if logs is not None:
            by_teacher = rows_of_policies(logs.behaviour_policy, config.policies)
            every = by_teacher
            if config.successes:
                every = by_teacher | packed_successes(
                    *(logs.behaviour_policy, logs.episode, logs.rows.numpy(), config.policies)
                )
            self._offline = _WeightedRows.of(logs, every)
            # If a teacher answers in the agent's own states, others' successes are not used online.
            self._online = _WeightedRows.of(logs, by_teacher) if config.queried else self._offline
        if not len(self._offline.rows):
            names = None if logs is None else logs.behaviour_policy.names[:-1]  # without "unknown"
            refuse_no_rows(config, names)
        self.offline_updates = (config.offline_updates or 0) if len(self._offline.rows) else 0
        self._logged = 0  # logged rows in an online batch
        if len(self._online.rows):
            self._logged = round(batch_size * _LOGS_SHARE) if config.queried else batch_size

    @property
    def cloned(self) -> Ints:
        """Return the rows (n,) of the logs that online batches are drawn from."""
        return self._online.rows

    def draw_offline(self) -> Labelled:
        """Draw a batch (M,) of logged rows alone."""
        return self._gather(self._offline, self.batch_size)

    def draw_online(self) -> Labelled:
        """Draw a batch (M,) of logged rows, then fresh ones; all logged while the ring is empty."""
        return self._gather(self._online, self._logged if len(self.ring) else self.batch_size)

    def _gather(self, drawn: _WeightedRows, logged: int) -> Labelled:
        rows = drawn.sample(logged, self._rng)
        fresh = self.batch_size - logged
        slots = self.ring.sample(fresh, self._rng) if fresh else np.empty(0, np.int64)
        observation, action = self._states(rows, slots)
        if self._mirror is not None:
            turned = self._rng.random(len(observation)) < 0.5
            observation[turned] = self._mirror.observation(observation[turned])
            action[turned] = self._mirror.action(action[turned])
        return Labelled(torch.from_numpy(observation), torch.from_numpy(action))

    def _states(self, rows: Ints, slots: Ints) -> tuple[F32, Ints]:
        """Return observations (n, D) and actions (n,): logged ones, then the teacher's answers."""
        logged, fresh = len(rows), torch.from_numpy(self.ring.rows)
        packed = torch.empty(logged + len(slots), fresh.shape[1])
        if self.logs is not None and logged:
            gather_rows(self.logs.rows, torch.from_numpy(rows), packed[:logged])
        gather_rows(fresh, torch.from_numpy(slots), packed[logged:])
        taken, answered = packed[:logged, -3].numpy(), self.ring.meta["teacher_action"][slots]
        action = np.concatenate([taken.astype(np.int64), answered])
        return packed.numpy()[:, self.ring.columns["observation"]], action

    def measure(self, learner: Learner) -> list[dict[str, Any]]:
        """Return rows of the run's table `teacher`: the filter's effect by source and condition.

        Each condition is measured on up to 128 random rows that online batches can contain.
        """
        rng = np.random.default_rng([self._seed, 8, learner.gradient_steps])
        groups: dict[tuple[str, str], tuple[F32, Ints]] = {}
        none = np.empty(0, np.int64)
        if self.logs is not None and len(self.cloned):
            codes = self.logs.condition.codes[self.cloned]
            for code in np.unique(codes).tolist():
                rows = _sample_rows(self.cloned[codes == code], rng)
                groups["logs", self.logs.condition.names[code]] = self._states(rows, none)
        for code, name in enumerate(self.ring.conditions):
            slots = _sample_rows(np.sort(self.ring.by_condition.members(code)), rng)
            if len(slots):
                groups["fresh", name] = self._states(none, slots)
        return [
            {"source": source, "condition": name, **_measure_filter(learner, *states)}
            for (source, name), states in groups.items()
        ]


def _sample_rows(rows: Ints, rng: np.random.Generator) -> Ints:
    return rows if len(rows) <= _MAX_MEASURED else rng.choice(rows, _MAX_MEASURED, replace=False)


@torch.no_grad()
def _measure_filter(learner: Learner, observation: F32, action: Ints) -> Mapping[str, Any]:
    """Measure the filter in states (n, D) with the teacher's actions (n,)."""
    if learner.behaviour is None:
        raise RuntimeError("there is no behaviour network to measure")
    states = torch.from_numpy(observation).to(learner.device)
    logits = learner.behaviour.network(states)
    plausible = plausible_actions(logits, learner.behaviour.ratio)
    q = learner.network(states)
    chosen = q.masked_fill(~plausible, -torch.inf).argmax(dim=1)
    answer = torch.from_numpy(action).to(learner.device)
    requested = answer != UNKNOWN
    teachers = answer.clamp_min(0)

    def share(holds: torch.Tensor) -> float | None:
        return float(holds[requested].float().mean()) if bool(requested.any()) else None

    return {
        "ratio": float(learner.behaviour.ratio),
        "rows": len(action),
        "asked_rows": int(requested.sum()),
        "loss": float(imitation_loss(logits, answer)) if bool(requested.any()) else None,
        "agreement": share(logits.argmax(dim=1) == teachers),
        "plausible_actions": float(plausible.sum(dim=1).float().mean()),
        "teacher_plausible": share(plausible.gather(1, teachers.unsqueeze(1)).squeeze(1)),
        "changed": float((chosen != q.argmax(dim=1)).float().mean()),
        "chosen_agreement": share(chosen == teachers),
    }


def refuse_no_rows(config: TeacherConfig, logged: Sequence[str] | None) -> None:
    """Raise ConfigError if the logs must have rows of the teacher's policies, but have none.

    Logs must have such rows if no teacher is queried in the twin, or if `teacher.policies` is not
    the default and there are logs.

    Args:
        logged: names of the logs' behaviour policies; None: there are no logs.
    """
    if not config.has_filter or set(config.policies) & set(logged or ()):
        return
    chosen = config.policies and config.policies != TeacherConfig().policies
    if config.queried and (logged is None or not chosen):
        return
    have = "this run has no logs" if logged is None else f"the logs have {', '.join(logged)}"
    raise ConfigError(
        f'teacher.source = "{config.source}" clones the rows of '
        f"{', '.join(config.policies) or 'nobody'}, but {have}",
        where="teacher.policies",
        remedy="give a --panel with rows of those policies, or choose other policies",
    )


@dataclass(frozen=True)
class _WeightedRows:
    """Logged rows (n,), and cumulative probabilities of a draw that follow the strata's shares."""

    rows: Ints
    cumulative: F64

    @classmethod
    def of(cls, logs: Logs, chosen: Bools) -> _WeightedRows:
        weight = np.zeros(len(logs))
        for share, members in zip(logs.shares, logs.stratum_rows, strict=True):
            inside = members[chosen[members]]
            if len(inside):
                weight[inside] += share / len(inside)
        rows = np.flatnonzero(weight > 0)
        cumulative = np.cumsum(weight[rows])
        return cls(rows, cumulative / cumulative[-1] if len(rows) else cumulative)

    def sample(self, count: int, rng: np.random.Generator) -> Ints:
        place = np.searchsorted(self.cumulative, rng.random(count), side="right")
        return self.rows[np.minimum(place, len(self.rows) - 1)]
