"""Ending well: a kill does what Ctrl-C does, and a process that was started here does not go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import, and every command imports this
    import subprocess

_running: set[subprocess.Popen[bytes]] = set()


@contextmanager
def kill_as_interrupt() -> Iterator[None]:
    """A kill (SIGTERM) and the end of the terminal (SIGHUP) do what Ctrl-C does at that moment: by
    default a KeyboardInterrupt, in a training a checkpoint. What is ignored (`nohup`) stays so."""
    named = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    ours = [number for number in named if signal.getsignal(number) == signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():  # no other may set handlers
        ours = []
    for number in ours:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def ended_with_us(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """A process that must not outlive the block: where the block fails it is interrupted, once, and
    waited for. It needs a session of its own, or Ctrl-C reaches it from the terminal too."""
    _running.add(process)
    try:
        yield
    except BaseException:
        process.send_signal(signal.SIGINT)
        process.wait()
        raise
    finally:
        _running.discard(process)


def interrupt_running() -> None:
    """Interrupt those that other threads wait for: no interrupt reaches a thread."""
    for process in list(_running):
        process.send_signal(signal.SIGINT)


def _interrupt(number: int, frame: FrameType | None) -> None:
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        raise KeyboardInterrupt
    handler(number, frame)


__all__ = ["ended_with_us", "interrupt_running", "kill_as_interrupt"]
