"""Ending well: a kill does what Ctrl-C does, and a process that was started here does not go on."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import FrameType
from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:  # slow to import, and every command imports this
    import subprocess

P = ParamSpec("P")
T = TypeVar("T")

_running: set[subprocess.Popen[bytes]] = set()
_interrupted = False


@contextmanager
def kill_as_interrupt() -> Iterator[None]:
    """A kill (SIGTERM) and the end of the terminal (SIGHUP) do what Ctrl-C does at that moment: by
    default a KeyboardInterrupt, in a training a checkpoint. What is ignored (`nohup`) stays so.

    Each interrupt is noted: a library that calls into Python may turn it into an error of its own
    (see `was_interrupted`).
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
    """Whether an interrupt came, and nothing went on on purpose since. DuckDB and Arrow report a
    KeyboardInterrupt in a Python function that they call as an error of theirs: who would take an
    error for a damaged file asks here first."""
    return _interrupted


def interrupts_raised(function: Callable[P, T]) -> Callable[P, T]:
    """The function, which ends an interrupt with KeyboardInterrupt whatever DuckDB made of it."""

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
    """Whether it, or what led to it, is a KeyboardInterrupt or what DuckDB makes of one."""
    while error is not None and error is not before:
        said = str(error)
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in said:
            return True
        if "Query interrupted" in said:
            return True
        error = error.__context__
    return False


def went_on_after_interrupt() -> None:
    """An interrupt has been dealt with: a later error is none of its doing."""
    global _interrupted
    _interrupted = False


@contextmanager
def ended_with_us(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """A process that must not outlive the block: where the block fails it is interrupted, once, and
    waited for. It needs a session of its own, or Ctrl-C reaches it from the terminal too.

    It is interrupted by a kill (see `kill_as_interrupt`): in the background of a script Ctrl-C is
    ignored, and so it is in what is started there.
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
    """Interrupt those that other threads wait for: no interrupt reaches a thread."""
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


__all__ = [
    "ended_with_us",
    "interrupt_running",
    "interrupts_raised",
    "kill_as_interrupt",
    "was_interrupted",
    "went_on_after_interrupt",
]
