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
    """Let a kill (SIGTERM) and the end of the terminal (SIGHUP) do what Ctrl-C does.

    By default that is a KeyboardInterrupt, in a training a checkpoint. What is ignored (`nohup`)
    stays ignored. Each interrupt is noted, because a library that calls into Python may turn it
    into an error of its own (see `was_interrupted`).
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
