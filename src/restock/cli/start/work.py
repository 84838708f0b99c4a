"""Runs stages, and skips a finished stage whose inputs have not changed.

`OUT/start/NAME.json` is the document that the verb of stage NAME printed. `OUT/start/stages.json`
has the command of each stage, a hash of its inputs, and its result.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.cli.start.outcomes import Document, errors
from restock.cli.start.stages import Stage
from restock.errors import ExitCode, RestockError, visible
from restock.files import read_json, write_text
from restock.process import expect_installed

if TYPE_CHECKING:
    from rich.console import Console

FOLDER, RECORD = "start", "stages.json"
LAST_LINES = 20  # shown if a command that runs beside another fails
Dispatch = Callable[[list[str]], int]


@dataclass
class StageResult:
    """The result of a stage, from this call or an earlier one."""

    name: str
    command: str
    status: str  # done | kept (from an earlier call) | failed | planned
    exit_code: int = 0
    outcome: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    seconds: float = 0.0
    stamp: str = ""
    document: Document = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Return whether later stages can use the result: the stage did not fail."""
        return self.status != "failed"

    def summary(self) -> dict[str, Any]:
        """Return the result as JSON values, without `document`, which has a file of its own."""
        return {key: value for key, value in asdict(self).items() if key != "document"}


class Work:
    """Runs stages, and records their results in the folder `out`.

    `say` prints a line. With `plan`, commands are printed and not run. `why` has the purpose of
    stages by name, to print above their commands.
    """

    def __init__(
        self,
        out: Path,
        dispatch: Dispatch,
        say: Callable[[str], None],
        *,
        plan: bool = False,
        why: Mapping[str, str] | None = None,
    ) -> None:
        self.out, self.dispatch, self.say, self.plan = out, dispatch, say, plan
        self.why = why or {}
        self.ended: list[StageResult] = []
        self._stamps: list[str] = []
        self._records: dict[str, Any] = {}
        record = out / FOLDER / RECORD
        if record.is_file():
            self._records = read_json(record)
        elif out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RestockError(
                "already exists, and was not made by `restock start` or `restock demo`",
                where=str(out),
                remedy="choose another --out",
            )
        if not plan:
            expect_installed("training with a report", "torch", "mujoco", "altair")
            (out / FOLDER).mkdir(parents=True, exist_ok=True)
            self._save_records()

    def do(self, stage: Stage) -> StageResult:
        """Run a stage, or reuse its earlier result; print its command and result.

        Raises:
            KeyboardInterrupt: it was interrupted; the next call continues or repeats the stage.
        """
        self.say(f"\n[bold]{len(self.ended) + 1}  {stage.title}[/bold]")
        if (why := self.why.get(stage.name)) is not None:
            self.say(f"[dim]{why}[/dim]")
        if self.plan:
            self.say(f"[cyan]$ {escape(stage.line())}[/cyan]")
            return self._add_result(StageResult(stage.name, stage.line(), "planned"))
        stamp = self._stamp(stage)
        if (kept := self._earlier_result(stage, stamp)) is not None:
            self.say(f"[cyan]$ {escape(stage.line())}[/cyan]  [dim]done before[/dim]")
            return self._add_result(kept)
        began = self._records.get(stage.name, {})
        saved = any(any((path / "checkpoints").glob("*.safetensors")) for path in stage.writes)
        if stage.resume and began.get("stamp") == stamp and saved:
            stage = replace(stage, command=list(stage.resume))
        else:
            self._clear(stage)
        self.say(f"[cyan]$ {escape(stage.line())}[/cyan]")
        # Recorded as begun: if this process dies now, the next call runs the stage again.
        self._records[stage.name] = {"stamp": stamp, "status": "begun"}
        self._save_records()
        return self._add_result(self._run(stage, stamp), reported=stage.shows_progress)

    def _run(self, stage: Stage, stamp: str) -> StageResult:
        printed, stderr_text = io.StringIO(), io.StringIO()
        copied_stderr: Any = _Tee(sys.stderr, stderr_text) if stage.shows_progress else stderr_text
        started = time.monotonic()
        sys.stdout.flush()
        with _run_beside(stage) as other, redirect_stdout(printed), redirect_stderr(copied_stderr):
            code = self.dispatch([*stage.command, "--json"])
            if code in stage.expected:
                code = other() or code
        if code == ExitCode.INTERRUPTED:
            if not stage.shows_progress:
                sys.stderr.write(stderr_text.getvalue())
            raise KeyboardInterrupt
        text = printed.getvalue()
        document = _parse(text)
        good = code in stage.expected and bool(document)
        ended = StageResult(
            stage.name,
            stage.line(),
            "done" if good else "failed",
            int(code),
            stage.outcome(document) if good else [],
            errors(stderr_text.getvalue()),
            [str(path) for path in stage.writes if path.exists()],
            time.monotonic() - started,
            stamp,
            document,
        )
        if document:
            write_text(self._document(stage), text)
        self._records[stage.name] = ended.summary()
        self._save_records()
        return ended

    def _add_result(self, ended: StageResult, *, reported: bool = False) -> StageResult:
        """Add and print the result of a stage, with its errors unless they were `reported`."""
        self.ended.append(ended)
        for line in ended.outcome:
            self.say(f"   {escape(line)}")
        if not ended.good and not reported:
            for line in ended.errors:
                self.say(f"   [yellow]{escape(line)}[/yellow]")
        if ended.files:
            self.say(f"   [dim]-> {escape(', '.join(ended.files))}[/dim]")
        return ended

    def _earlier_result(self, stage: Stage, stamp: str) -> StageResult | None:
        """Return the result of an earlier call with the same inputs, if its files still exist."""
        known = self._records.get(stage.name, {})
        if known.get("status") != "done" or known.get("stamp") != stamp:
            return None
        if any(ended.status == "done" for ended in self.ended):  # an earlier stage ran anew
            return None
        document = self._document(stage)
        if not all(path.exists() for path in (*stage.writes, document)):
            return None
        return StageResult(
            **known | {"status": "kept"}, document=_parse(document.read_text("utf-8"))
        )

    def _stamp(self, stage: Stage) -> str:
        """Hash what a result depends on: the command, the user's files, and earlier stages."""
        parts = [stage.line(), *self._stamps[-1:], *(_fingerprint(path) for path in stage.reads)]
        text = os.fsencode("\n".join(parts))
        self._stamps.append(hashlib.blake2b(text, digest_size=12).hexdigest())
        return self._stamps[-1]

    def _clear(self, stage: Stage) -> None:
        """Remove the stage's earlier files; if the stage has `resume`, move them to `earlier`."""
        for path in stage.writes:
            if not path.exists() or not path.resolve().is_relative_to(self.out.resolve()):
                continue
            if stage.resume:
                aside = self.out / "earlier"
                aside.mkdir(exist_ok=True)
                put = path.rename(aside / f"{path.name}-{1 + len([*aside.iterdir()])}")
                self.say(f"   [dim]the earlier one is now {escape(str(put))}[/dim]")
            elif path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()

    def _document(self, stage: Stage) -> Path:
        return self.out / FOLDER / f"{stage.name}.json"

    def _save_records(self) -> None:
        write_text(self.out / FOLDER / RECORD, json.dumps(self._records, indent=1) + "\n")


@contextmanager
def _run_beside(stage: Stage) -> Iterator[Callable[[], int]]:
    """Run a stage's second command as a process; yield a function that waits for its exit code.

    Its last lines are shown if it fails. It is terminated at the end of the block.
    """
    if not stage.beside:
        yield lambda: int(ExitCode.OK)
        return
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # one core for each of the two commands
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "restock", *stage.beside],
            stdout=subprocess.DEVNULL,
            stderr=output,
            env=environment,
        )

        def wait() -> int:
            if code := process.wait():
                output.seek(0)
                sys.stderr.write("".join(output.readlines()[-LAST_LINES:]))
            return code

        try:
            yield wait
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()


class _Tee:
    """A stream that also copies what is written to it."""

    def __init__(self, stream: Any, copy: io.StringIO) -> None:
        self._stream, self._copy = stream, copy

    def write(self, text: str) -> int:
        self._copy.write(text)
        return int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def make_printer(console: Console) -> Callable[[str], None]:
    """Return a function that prints a line of markup, and flushes it before stderr is written."""

    def say(line: str) -> None:
        console.print(line, soft_wrap=True)
        console.file.flush()

    return say


def escape(text: str) -> str:
    """Escape text for a console that reads markup."""
    return visible(text, keep="\n").replace("[", r"\[")


def _parse(text: str) -> Any:
    try:
        document = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return {"rows": document} if isinstance(document, list) else document


def _fingerprint(path: Path) -> str:
    """Return names, sizes and times of the files at a path, as text that changes with them."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    parts = []
    for file in filter(Path.is_file, files):
        status = file.stat()
        parts.append(f"{file} {status.st_size} {status.st_mtime_ns}")
    return "\n".join(parts)
