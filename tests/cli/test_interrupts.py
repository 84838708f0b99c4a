"""SIGTERM interrupts as Ctrl-C does, also threads that wait for a process."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import duckdb
import pytest

import restock.replay.plan.plan as plan
from restock.cli import main
from restock.cli.learning.train import _stop_on_interrupt
from restock.errors import ExitCode, StoreError
from restock.process import (
    ended_with_us,
    interrupt_running,
    interrupts_raised,
    kill_as_interrupt,
    was_interrupted,
)
from restock.replay import Panel, Store, build_panel, load_mixture

WAITS = [sys.executable, "-c", "import time; print(flush=True); time.sleep(600)"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_kill_acts_like_ctrl_c(number: int) -> None:
    handled: list[int] = []
    usual = signal.signal(number, signal.SIG_DFL)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with kill_as_interrupt():
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), number)
            signal.signal(signal.SIGINT, lambda *_: handled.append(1))
            os.kill(os.getpid(), number)
        assert handled == [1]
        assert signal.getsignal(number) == signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)
        with kill_as_interrupt():
            os.kill(os.getpid(), number)
        assert handled == [1]
    finally:
        signal.signal(number, usual)
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_process_ends_with_block_that_waits_for_it(ctrl_c):
    """It ends even if Ctrl-C is ignored, as in the background of a script."""

    def waiting() -> subprocess.Popen[bytes]:
        before = signal.signal(signal.SIGINT, ctrl_c)
        try:
            process = subprocess.Popen(WAITS, stdout=subprocess.PIPE, start_new_session=True)
        finally:
            signal.signal(signal.SIGINT, before)
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


@pytest.fixture
def usual_ctrl_c() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_ctrl_c")
def test_ctrl_c_in_duckdb_callback_interrupts(store_path, tmp_path, monkeypatch, capsys):
    def stopped(*_: Any, **__: Any) -> None:
        with duckdb.connect(config={"threads": 1}) as connection:
            connection.create_function("stop", _stop, ["BIGINT"], "BIGINT")
            connection.sql("SELECT stop(1)").fetchall()

    monkeypatch.setattr(plan, "read_candidates", stopped)
    code = main(["mix", str(store_path), "--out", str(tmp_path / "panel")])
    assert code == ExitCode.INTERRUPTED
    assert capsys.readouterr().err.endswith("interrupted; no partial files were left\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("usual_ctrl_c")
def test_second_interrupt_ends_training_at_once(capsys):
    with kill_as_interrupt(), _stop_on_interrupt() as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
        deadline, err = time.monotonic() + 60, ""
        while not err and time.monotonic() < deadline:
            err = capsys.readouterr().err
        assert err.startswith("stopping: a checkpoint is written after")
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert was_interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not capsys.readouterr().err


@pytest.mark.usefixtures("usual_ctrl_c")
def test_interrupt_in_duckdb_is_raised_as_interrupt() -> None:
    @interrupts_raised
    def run_query(query: str) -> None:
        """Run `query`; raise errors of DuckDB as a damaged store, as callers may."""
        with duckdb.connect(config={"threads": 1}) as connection:
            connection.create_function("stop", _stop, ["BIGINT"], "BIGINT")
            try:
                connection.sql(query).fetchall()
            except duckdb.Error as error:
                raise StoreError("is damaged") from error

    with pytest.raises(KeyboardInterrupt):
        run_query("SELECT stop(1)")
    with pytest.raises(StoreError):
        run_query("SELECT a")

    def interrupts() -> None:
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(interrupts)
        with pytest.raises(KeyboardInterrupt):
            run_query("SELECT sum(a.range * b.range) FROM range(9000000) a, range(9000000) b")
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        with pytest.raises(StoreError):  # an interrupt that was handled before does not count
            run_query("SELECT a")


@pytest.mark.usefixtures("usual_ctrl_c")
def test_interrupt_at_any_moment_leaves_no_partial_panel(store_path: Path, tmp_path: Path) -> None:
    usual = signal.signal(signal.SIGALRM, signal.default_int_handler)
    done, after_s, panel = False, 0.01, tmp_path / "panel"
    try:
        while not done:
            signal.setitimer(signal.ITIMER_REAL, after_s)
            try:
                with Store(store_path) as store:
                    build_panel(store, load_mixture("coverage"), panel, force=True)
                signal.setitimer(signal.ITIMER_REAL, 0)  # or it would interrupt what follows
                done = True
            except KeyboardInterrupt:
                after_s = 1.8 * after_s + 0.01
            assert not panel.exists() or Panel.open(panel, verify=True).rows.size  # all or nothing
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, usual)


def _stop(value: int) -> int:
    signal.raise_signal(signal.SIGINT)
    return value
