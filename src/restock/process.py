"""Process control: interrupts, child processes, coroutines in step, CPU cores, lazy imports.

A kill (SIGTERM) does the same as Ctrl-C, and also ends the child processes. Libraries that are
optional or slow to import are imported when they are first used.
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
# A coroutine whose requests can be batched with those of others. It yields (function, argument);
# `in_step` calls the function once with the arguments of all, and sends each its own answer.
Work = Generator[tuple[Callable[[list[Any]], Sequence[Any]], Any], Any, T]

_running: set[subprocess.Popen[bytes]] = set()
_interrupted = False


@contextmanager
def kill_as_interrupt() -> Iterator[None]:
    """Handle a kill (SIGTERM) and a closed terminal (SIGHUP) as Ctrl-C in this block.

    By default, Ctrl-C raises KeyboardInterrupt; training writes a checkpoint. Ignored signals
    (`nohup`) stay ignored. Interrupts are recorded, because a library that calls into Python may
    turn one into an error of its own (see `was_interrupted`).
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
    if threading.current_thread() is not threading.main_thread():  # only it may set handlers
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
    """Return whether there was an interrupt that has not been handled.

    If DuckDB or Arrow call a Python function, and that raises KeyboardInterrupt, they report an
    error of their own. Check this before such an error is reported as a damaged file.
    """
    return _interrupted


def interrupts_raised(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function raise KeyboardInterrupt if DuckDB turned one into another error."""

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
    """Return whether an interrupt caused an error: look through its contexts, up to `before`."""
    while error is not None and error is not before:
        said = str(error)
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in said:
            return True
        if "Query interrupted" in said:
            return True
        error = error.__context__
    return False


def went_on_after_interrupt() -> None:
    """Record that the last interrupt was handled, so that `was_interrupted` returns False."""
    global _interrupted
    _interrupted = False


def in_step(works: Sequence[Work[T]]) -> Iterator[tuple[int, T | Exception]]:
    """Run coroutines side by side; answer all their requests for the same function by one call.

    Yields the index of each coroutine that ends, with what it returned or raised. An error in a
    shared call is raised here, because it cannot be attributed to one coroutine.
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
                except Exception as error:  # noqa: BLE001  (the other works go on)
                    yield place, error
            answers = {}
            for function, of_each in wanted.items():
                answers |= zip(of_each, function([*of_each.values()]), strict=True)
    finally:
        for work in works:
            work.close()


def alone(work: Work[T]) -> T:
    """Run one coroutine by itself; return what it returns, raise what it raises."""
    ((_, outcome),) = in_step([work])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


@contextmanager
def ended_with_us(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Terminate a child process and wait for it if the block fails.

    The process needs a session of its own, or it would get the terminal's Ctrl-C as well. SIGTERM
    is sent (see `kill_as_interrupt`), because processes in the background of a script, and their
    children, ignore SIGINT.
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
    """Terminate the processes in `ended_with_us` blocks, whose threads receive no interrupt."""
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


# Optional package -> the extra that installs it.
EXTRAS = {
    **dict.fromkeys(("altair", "scipy", "vl_convert"), "pages"),
    **dict.fromkeys(("gymnasium", "mujoco", "safetensors", "tensorboard", "torch"), "train"),
    **dict.fromkeys(("onnx", "onnxruntime"), "onnx"),
    **dict.fromkeys(("h5py", "minari", "stable_baselines3", "tianshou"), "libraries"),
    **dict.fromkeys(("wandb", "mlflow"), "track"),
    "mcp": "mcp",
}


def import_extra(name: str, use: str) -> Any:
    """Import an optional package; `use` is what needs it, for the message.

    Raises:
        ConfigError: it is not installed. The remedy is the command that installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise not_installed(name, use) from error


def expect_installed(use: str, *names: str) -> None:
    """Check that optional packages are installed, before anything is written.

    Raises:
        ConfigError: one is not installed. The remedy is the command that installs it.
    """
    for name in names:
        if not installed(name):
            raise not_installed(name, use)


def not_installed(name: str, use: str, extra: str = "") -> ConfigError:
    """Return the error for a missing optional package; `extra` replaces the one in `EXTRAS`."""
    remedy = install_command(extra or EXTRAS[name])
    return ConfigError(f"{use} needs {name}, which is not installed", remedy=remedy)


def install_command(extra: str = "") -> str:
    """Return the pip command that reinstalls Restock with an extra, or with its requirements."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("restock").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # a source tree that is not installed
        origin = {}
    extras = f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        return f"pip install -e '.{extras}' in the source tree"
    return f"pip install 'restock{extras}'"


def installed(name: str) -> bool:
    """Return whether the module `name` can be imported, without importing it."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # sys.modules[name] has no spec: its import was blocked
        return False


def when_imported(name: str, action: Callable[[], None]) -> None:
    """Call `action` now if the module `name` is imported, else right after its import."""
    if name in sys.modules:
        action()
    else:
        sys.meta_path.insert(0, _After(name, action))


class _After:
    """An import finder that calls `action` after the module `name` was executed."""

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
    """Make imports of the module `name` fail in this block, unless it is already imported."""
    finder = _Hides(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Hides:  # an import finder
    def __init__(self, name: str) -> None:
        self.name = name

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name == self.name:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
