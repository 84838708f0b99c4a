"""This process: interrupts, child processes, works in step, its cores, and late imports.

A kill does what Ctrl-C does, and child processes end with it. Libraries that are optional or slow
are imported when they are used.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import FrameType, ModuleType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from restock.errors import ConfigError

if TYPE_CHECKING:  # slow to import, and every command imports this
    import subprocess

P = ParamSpec("P")
T = TypeVar("T")
# A work that asks for answers on its way: yields a function of several arguments and its own one.
Work = Generator[tuple[Callable[[list[Any]], Sequence[Any]], Any], Any, T]

_running: set[subprocess.Popen[bytes]] = set()
_interrupted = False


@contextmanager
def kill_as_interrupt() -> Iterator[None]:
    """Let a kill (SIGTERM) and the end of the terminal (SIGHUP) do what Ctrl-C does.

    By default that is a KeyboardInterrupt, in a training a checkpoint. Ignored signals (`nohup`)
    stay ignored. Each interrupt is noted, because a library that calls into Python may turn it into
    an error of its own (see `was_interrupted`).
    """
    handlers = {"SIGTERM": _interrupt, "SIGHUP": _interrupt, "SIGINT": _note_interrupt}
    usual = {
        number: signal.getsignal(number)
        for number in (getattr(signal, name) for name in handlers if hasattr(signal, name))
    }
    ours = [
        number
        for number, handler in usual.items()
        if handler in (signal.SIG_DFL, signal.default_int_handler)
    ]
    if threading.current_thread() is not threading.main_thread():  # no other may set handlers
        ours = []
    if signal.SIGINT in ours:
        went_on_after_interrupt()
    for number in ours:
        signal.signal(number, handlers[number.name])
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, usual[number])


def was_interrupted() -> bool:
    """Return whether an interrupt came that nobody has dealt with.

    DuckDB and Arrow report a KeyboardInterrupt in a Python function that they call as an error of
    theirs. Ask here before taking such an error for a damaged file.
    """
    return _interrupted


def interrupts_raised(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function raise KeyboardInterrupt whatever DuckDB made of it."""

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        before = sys.exception()
        try:
            return function(*args, **kwargs)
        except Exception as error:
            if _by_interrupt(error, before):
                raise KeyboardInterrupt from error
            raise

    return called


def _by_interrupt(error: BaseException | None, before: BaseException | None) -> bool:
    """Return whether an error, or its cause, is an interrupt or what DuckDB makes of one."""
    while error is not None and error is not before:
        said = str(error)
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in said:
            return True
        if "Query interrupted" in said:
            return True
        error = error.__context__
    return False


def went_on_after_interrupt() -> None:
    """Note that an interrupt was dealt with, and did not cause later errors."""
    global _interrupted
    _interrupted = False


def in_step(works: Sequence[Work[T]]) -> Iterator[tuple[int, T | Exception]]:
    """Run works side by side, and answer together what several ask for.

    Yields the place of each work that ends, and what it returned or raised. An error of the answers
    to several is raised: it says not whose it is.
    """
    answers: dict[int, Any] = dict.fromkeys(range(len(works)))
    try:
        while answers:
            wanted: dict[Callable[[list[Any]], Sequence[Any]], dict[int, Any]] = {}
            for place, answer in answers.items():
                try:
                    function, argument = works[place].send(answer)
                    wanted.setdefault(function, {})[place] = argument
                except StopIteration as done:
                    yield place, done.value
                except Exception as error:  # noqa: BLE001  (of that work alone)
                    yield place, error
            answers = {}
            for function, of_each in wanted.items():
                answers |= zip(of_each, function([*of_each.values()]), strict=True)
    finally:
        for work in works:
            work.close()


def alone(work: Work[T]) -> T:
    """Return what a work returns; raise what it raises."""
    ((_, outcome),) = in_step([work])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


@contextmanager
def ended_with_us(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Interrupt a process, once, and wait for it, if the block fails.

    The process needs a session of its own, or Ctrl-C in the terminal reaches it too. It is
    interrupted by a kill (see `kill_as_interrupt`), because Ctrl-C is ignored in the background of
    a script and in what is started there.
    """
    _running.add(process)
    try:
        yield
    except BaseException:
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise
    finally:
        _running.discard(process)


def interrupt_running() -> None:
    """Interrupt processes that other threads wait for, since no interrupt reaches a thread."""
    for process in list(_running):
        process.send_signal(signal.SIGTERM)


def _interrupt(number: int, frame: FrameType | None) -> None:
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        raise KeyboardInterrupt
    handler(number, frame)


def _note_interrupt(number: int, frame: FrameType | None) -> None:
    global _interrupted
    _interrupted = True
    raise KeyboardInterrupt


# optional package -> the extra that has it
EXTRAS = {
    **dict.fromkeys(("altair", "scipy", "vl_convert"), "pages"),
    **dict.fromkeys(("gymnasium", "mujoco", "safetensors", "tensorboard", "torch"), "train"),
    **dict.fromkeys(("onnx", "onnxruntime"), "onnx"),
    **dict.fromkeys(("h5py", "minari", "stable_baselines3", "tianshou"), "libraries"),
    **dict.fromkeys(("wandb", "mlflow"), "track"),
    "mcp": "mcp",
}


def import_extra(name: str, use: str) -> Any:
    """Import an optional package; `use` says what needs it.

    Raises:
        ConfigError: it is not installed; says which command installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise not_installed(name, use) from error


def expect_installed(use: str, *names: str) -> None:
    """Refuse a use of optional packages before anything is written.

    Raises:
        ConfigError: the first that is not installed, and the command that installs it.
    """
    for name in names:
        if not installed(name):
            raise not_installed(name, use)


def not_installed(name: str, use: str, extra: str = "") -> ConfigError:
    """Return the error about an optional package; `extra` is another than its own that has it."""
    remedy = install_command(extra or EXTRAS[name])
    return ConfigError(f"{use} needs {name}, which is not installed", remedy=remedy)


def install_command(extra: str = "") -> str:
    """Return the pip command that adds an extra, or a missing requirement, to this Restock."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("restock").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # imported from a path
        origin = {}
    extras = f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        return f"pip install -e '.{extras}' in the source tree"
    return f"pip install 'restock{extras}'"


def installed(name: str) -> bool:
    """Return whether the module `name` can be imported, without importing it."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # the entry in its place has no spec: it was blocked
        return False


def when_imported(name: str, action: Callable[[], None]) -> None:
    """Call `action` once the module `name` is imported: now, or right after its import."""
    if name in sys.modules:
        action()
    else:
        sys.meta_path.insert(0, _After(name, action))


class _After:
    """A finder that finds one module as the others do, and has its loader do something more."""

    def __init__(self, name: str, action: Callable[[], None]) -> None:
        self.name, self.action = name, action

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != self.name:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            self.action()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


@contextmanager
def hidden(name: str) -> Iterator[None]:
    """Hide the module `name` from imports in this block, unless it is imported already."""
    finder = _Hides(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Hides:
    def __init__(self, name: str) -> None:
        self.name = name

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name == self.name:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
