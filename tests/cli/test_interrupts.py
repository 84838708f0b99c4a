"""A kill is an interrupt, and what waits for a process in a thread can be interrupted too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from restock.interrupts import ended_with_us, interrupt_running, kill_as_interrupt

WAITS = [sys.executable, "-c", "import time; print(flush=True); time.sleep(600)"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_kill_does_what_ctrl_c_does_at_that_moment(number: int) -> None:
    asked: list[int] = []
    usual = signal.signal(number, signal.SIG_DFL)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with kill_as_interrupt():
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), number)
            signal.signal(signal.SIGINT, lambda *_: asked.append(1))
            os.kill(os.getpid(), number)
        assert asked == [1]
        assert signal.getsignal(number) == signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)
        with kill_as_interrupt():
            os.kill(os.getpid(), number)
        assert asked == [1]
    finally:
        signal.signal(number, usual)
        signal.signal(signal.SIGINT, before)


def test_a_process_ends_with_the_block_that_waits_for_it_and_from_another_thread() -> None:
    def waiting() -> subprocess.Popen[bytes]:
        process = subprocess.Popen(WAITS, stdout=subprocess.PIPE, start_new_session=True)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    process = waiting()
    with pytest.raises(KeyboardInterrupt), process, ended_with_us(process):
        raise KeyboardInterrupt
    assert process.returncode != 0

    process = waiting()

    def wait() -> int:
        with process, ended_with_us(process):
            return process.wait()

    with ThreadPoolExecutor(1) as pool:
        ended = pool.submit(wait)
        while not ended.running():
            pass
        while process.poll() is None:
            interrupt_running()
        assert ended.result(timeout=30) != 0
