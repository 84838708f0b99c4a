"""stdout and stderr as they are: not UTF-8, on a full disk, or read by nobody any more."""

from __future__ import annotations

import codecs
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from restock.errors import ConfigError


def substitute_what_cannot_be_shown() -> None:
    """Replace characters that a terminal or pipe cannot show, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # a stream that became a pipe under Python's eyes
                stream.reconfigure(errors=SUBSTITUTED)


def _substituted(error: UnicodeError) -> tuple[str, int]:
    """Replace lines and dots by ASCII, and other characters by their numbers, as JSON does."""
    import json

    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(_IN_ASCII.get(one) or json.dumps(one)[1:-1] for one in text), error.end


SUBSTITUTED = "restock.substituted"
_IN_ASCII = {"─": "-", "…": "...", "–": "-", "—": "-", "×": "x", "→": "->"}
codecs.register_error(SUBSTITUTED, _substituted)


@contextmanager
def work_goes_on() -> Iterator[None]:
    """While the block runs, a reader of stdout who goes away (`| head`) does not end the work.

    Raises:
        ConfigError: at the end, where stdout could not be written for another reason.
    """
    patient = _Patient(sys.stdout)
    sys.stdout = cast(TextIO, patient)
    try:
        yield
        patient.flush()
    finally:
        sys.stdout = patient.stream
    if patient.failed is not None and not isinstance(patient.failed, BrokenPipeError):
        raise ConfigError(
            f"cannot be written: {patient.failed.strerror}; all else is done",
            where="what it prints (stdout)",
        ) from patient.failed


class _Patient:
    """A stream that drops what it is given once it cannot be written."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.failed: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        self._do(lambda: self.stream.write(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._do(self.stream.flush)

    def _do(self, print_: Callable[[], object]) -> None:
        if self.failed is None:
            try:
                print_()
            except OSError as error:
                self.failed = error
                drop(self.stream)


def drop(stream: TextIO) -> None:
    """Let what is still buffered, and all that follows, go nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
