"""The teacher that is queried in the agent's states: the twin's operator, or one of yours."""

from __future__ import annotations

import importlib
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

import restock
from restock.arrays import F32, Ints
from restock.errors import ConfigError, RestockError
from restock.files import first_line
from restock.ingest.task.task import Task
from restock.state import Stateful, restored, saved
from restock.train.dqn.behaviour import UNKNOWN
from restock.train.dqn.config import GIVEN, TeacherConfig

Label = NDArray[np.int16]


@runtime_checkable
class Teacher(Protocol):
    """A driver that says what it would do in each of N environments, without driving them.

    It may look at the environment itself, beyond what the observation says. It is queried once a
    step, in order, and once before training begins. If it has `state_dict` and
    `load_state_dict`, a run that is resumed goes on exactly as it would have.
    """

    def act(self, env: Any, observation: F32, /) -> Ints:
        """Return actions (N,) for observations (N, D); -1 if it has no opinion."""
        ...


class OperatorTeacher(Stateful):
    """The operator of the warehouse twin, without its slips of the hand."""

    STATE: ClassVar[tuple[str, ...]] = ("_operator",)

    def __init__(self, seed: int) -> None:
        from restock.train.twin.drivers.operator_policy import Operator

        self._operator = Operator(epsilon=0.0, seed=seed)

    def act(self, env: Any, observation: F32, /) -> Ints:
        """Return the teacher's action in each environment, (N,).

        Raises:
            ConfigError: the environment is not the warehouse twin.
        """
        if not (hasattr(env, "simulation") and hasattr(env, "navigation")):  # what it looks at
            raise ConfigError(
                f'teacher.source = "operator" needs the warehouse twin, but this is a'
                f" {type(env).__name__}",
                remedy="pass another teacher, restock.train.train(teacher=…), or give one as "
                "module:name",
            )
        return self._operator.choose(env)


class _Called:
    """A function that is a teacher."""

    def __init__(self, function: Any) -> None:
        self.act = function


class TeacherFailed(ConfigError):
    """The teacher raised an error, or its answer was invalid."""


class AskedTeacher(Stateful):
    """A teacher whose answers are checked.

    Args:
        teacher: the one that is queried.
        task: whose actions it names.
        name: for errors: `teacher.source` as it was given.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_kept",)

    def __init__(self, teacher: Teacher, task: Task, name: str) -> None:
        self._teacher, self._actions, self._name = teacher, task.action_names, name
        self.requested = self.answered = 0  # states since this process began

    def ask(self, env: Any, observation: F32) -> Label:
        """Return the teacher's action in each environment, (N,); UNKNOWN if it has no opinion.

        Raises:
            TeacherFailed: it raised an error, gave no action, other than N of them, or one that
                the task has not.
        """
        with _of_the_user(f"the teacher {self._name}", self._teacher.act):
            # A copy: what it does to it does not reach what the agent sees and the run keeps.
            given = self._teacher.act(env, observation.copy())
        count = len(observation)
        try:
            label = np.asarray(given)
        except (TypeError, ValueError) as error:  # rows of several lengths, a tensor on a GPU
            raise self._refused(
                f"returned a {type(given).__name__} that is no array: {first_line(error)}"
            ) from error
        if label.shape != (count,) or not np.issubdtype(label.dtype, np.integer):
            what = "nothing" if given is None else f"{label.dtype} {label.shape}"
            raise self._refused(f"returned {what}, not {count} whole numbers, one an environment")
        outside = (label < UNKNOWN) | (label >= len(self._actions))
        if outside.any():
            env_index = int(np.flatnonzero(outside)[0])
            raise self._refused(
                f"returned action {int(label[env_index])} for environment {env_index}: the task's"
                f" are 0 to {len(self._actions) - 1}"
            )
        self.requested += count
        self.answered += int((label != UNKNOWN).sum())
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
) -> AskedTeacher | None:
    """Make the teacher that a run queries in the twin; None if there is none.

    Args:
        given: in place of what the config names: an object with `act`, or a function like it.

    Raises:
        ConfigError: no such module or name, or nothing that can be asked.
    """
    if config.source is None or not config.asks:
        return None
    if config.source == "operator":
        return AskedTeacher(OperatorTeacher(seed), task, config.source)
    if given is None:
        given = _imported(config.source)
    name = config.source if config.source != GIVEN else type(given).__name__
    if isinstance(given, type):
        with _of_the_user(f"making the teacher {name}", given):
            given = given()
    if not hasattr(given, "act"):
        if not callable(given):
            raise ConfigError(
                f"{name} is a {type(given).__name__}, which has no act and cannot be called",
                where="teacher.source",
                remedy="give an object with act(env, observation), or such a function",
            )
        given = _Called(given)
    return AskedTeacher(given, task, name)


@contextmanager
def _of_the_user(what: str, called: Any) -> Iterator[None]:
    """Turn an error of the user's code into one that names its file and line.

    So does SystemExit, which would end a run without a word.
    """
    try:
        yield
    except RestockError:
        raise
    except (Exception, SystemExit) as error:
        raise _raised(what, called, error) from error


def _raised(what: str, called: Any, error: BaseException) -> TeacherFailed:
    said = f": {first_line(error)}" if str(error) else ""
    return TeacherFailed(
        f"{what} raised {type(error).__name__}{said}",
        where=_place(called, error),
        remedy="correct it: it is asked by act(env, observation), and a class is made without"
        " arguments",
    )


def _place(called: Any, error: BaseException) -> str:
    """FILE:LINE of the user's innermost line that the error came through, else of what was called.

    Without frames of libraries and of Restock, which the user's code may call.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}"
    libraries = (
        *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
        str(Path(restock.__file__).parent),
        "<",  # the import system's own
    )
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(libraries)]
    if own:
        return f"{own[-1].filename}:{own[-1].lineno}"
    try:
        return f"{inspect.getsourcefile(called)}:{inspect.getsourcelines(called)[1]}"
    except (TypeError, OSError):  # it has no source
        return "teacher.source"


def _imported(source: str) -> Any:
    """Import what `module:name` names; modules of the working directory are found too."""
    if source == GIVEN:
        raise ConfigError(
            "the run's teacher was passed in from Python, and none is given now",
            where="teacher.source",
            remedy="to be able to continue a run, start it with a teacher given as module:name",
        )
    module, _, name = source.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
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
        raise _raised(f"importing {source}", None, error) from error
    finally:
        sys.path.remove(here)


__all__ = ["AskedTeacher", "Label", "OperatorTeacher", "Teacher", "TeacherFailed", "open_teacher"]
