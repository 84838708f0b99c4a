"""A verb's dataclass as its command line: what tyro is given to parse, and to explain."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import os
import re
import shutil
import sys
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from itertools import pairwise
from typing import Annotated, Any, Literal, Union

import tyro

from restock.cli import COMPLETION, JOBS, VERBS, command_of
from restock.cli.words import Positional, Repeated, declared
from restock.errors import ConfigError, ExitCode

_PREPARED: list[type[Any]] = []
MIN_PROSE = 80  # columns that prose may take above narrower boxes, where the window has them
MIN_COLUMNS = 30  # columns: in a few, tyro lays its boxes out without end
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_OPTIONS = re.compile(r"\[(?:OPTIONS|-(?:[^][]|\[[^][]*\])*)\] ?")  # in a line of usage
_MARKS = {Positional: tyro.conf.Positional, Repeated: tyro.conf.UseAppendAction}
_METAVARS = {str: "TEXT", int: "N", float: "X"}


def prepared(command: type[Any]) -> type[Any]:
    """Return the dataclass with types of which tyro makes plain help, and each option's text.

    `X | None` becomes `Optional[X]`, whose values tyro checks itself; for `X | None` it imports
    typeguard, and with that asyncio. An optional option shows what it takes, not `{None}|STR`, and
    shows no default that says nothing.
    """
    if command not in _PREPARED:
        _PREPARED.append(command)
        hints, texts = typing.get_type_hints(command, include_extras=True), _texts(command)
        command.__doc__ = _joined(inspect.getdoc(command) or "")
        for field in dataclasses.fields(command):
            marked = _prepared(hints[field.name], field.default)
            field.type = Annotated[marked, tyro.conf.arg(help=texts.get(field.name))]
            command.__annotations__[field.name] = field.type
    return command


def _texts(command: type[Any]) -> dict[str, str]:
    """Return the text below each field in one line, without the source's line breaks."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(command))).body
    assert isinstance(tree, ast.ClassDef)
    texts = {}
    for field, below in pairwise(tree.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                texts[name] = " ".join(text.split())
    return texts


def _joined(text: str) -> str:
    """Join each paragraph of a docstring into one line; indented examples stay."""
    paragraphs = text.split("\n\n")
    return "\n\n".join(one if one.startswith(" ") else " ".join(one.split()) for one in paragraphs)


def _prepared(hint: Any, default: Any) -> Any:
    """Return a type with tyro's marks of what it is declared to be, and its hint on the default."""
    kind, optional, how = declared(hint)
    choices: Any = Literal[how.choices] if how.choices else None
    if optional and typing.get_origin(kind) is Literal:  # of which tyro would list None, too
        choices = kind
    shown = choices or optional or kind in _METAVARS
    silent = default in (None, ()) or isinstance(default, bool) or typing.get_origin(kind) is tuple
    marks: list[Any] = [
        how,  # for `parse_plain`
        tyro.conf.arg(
            name=how.name,
            metavar=how.metavar or (_metavar(choices or kind) if shown else None),
            constructor=choices,
            help_behavior_hint="" if silent else None,
        ),
    ]
    marks += [mark for cls, mark in _MARKS.items() if isinstance(how, cls)]
    return Annotated[(typing.Optional[kind] if optional else kind, *marks)]  # noqa: UP045


def _metavar(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return "{" + ",".join(map(str, typing.get_args(kind))) + "}"
    return _METAVARS.get(kind) or str(getattr(kind, "__name__", kind)).upper()


def parse(command: type[Any], prog: str, words: Sequence[str]) -> Any:
    """Parse a command line with tyro, which exits after printing its help or its complaint."""
    command = prepared(command)
    with printed(help_asked=bool({"-h", "--help"} & set(words))):
        return tyro.cli(
            command,
            prog=prog,
            description=command.__doc__,
            args=words,
            use_underscores=False,
            config=(tyro.conf.FlagCreatePairsOff,),  # --json, without a --no-json beside it
        )


class _Held(io.TextIOWrapper):
    """A stream that keeps what is printed, and answers tyro as the real stdout would."""

    def __init__(self, instead_of: io.TextIOBase) -> None:
        encoding = (instead_of.encoding or "utf-8").lower()  # as tyro compares it
        super().__init__(io.BytesIO(), encoding=encoding, newline="")
        self._is_terminal = instead_of.isatty()

    def isatty(self) -> bool:
        return self._is_terminal

    def text(self) -> str:
        self.seek(0)
        return self.read()


@contextmanager
def printed(*, help_asked: bool) -> Iterator[None]:
    """Fit the help, or the complaint, that tyro prints in this block to the window."""
    if shutil.get_terminal_size().columns < MIN_COLUMNS:
        os.environ["COLUMNS"] = str(MIN_COLUMNS)
    if os.environ.get("NO_COLOR") or not (help_asked or sys.stderr.isatty()):
        tyro._experimental_options["ansi_codes"] = False
    if not help_asked:
        yield
        return
    held = _Held(sys.stdout)  # type: ignore[arg-type]
    try:
        with redirect_stdout(held):
            yield
    finally:
        sys.stdout.write(fitted(held.text(), shutil.get_terminal_size().columns))


def fitted(text: str, columns: int) -> str:
    """Wrap the prose of a help to the width of its boxes, with single empty lines between.

    Empty lines in boxes are left out: tyro adds one where an option's text fills its last line.
    """
    given = [(line, _COLOUR.sub("", line)) for line in text.splitlines()]
    boxes = [len(bare) for _, bare in given if bare[:1] in "╭│╰"]
    width = max(min(MIN_PROSE, columns), *boxes, 0)
    lines: list[str] = []
    for line, bare in given:
        if bare.startswith("usage:"):  # the boxes below list the options
            line = bare = f"{_OPTIONS.sub('', bare).rstrip()} [OPTIONS]"
        empty_in_box = bare.startswith("│") and not bare.strip("│ ")
        if empty_in_box or (not bare and lines and not lines[-1]):
            continue
        if line == bare and len(line) > width and not line.startswith(" "):  # not an example
            hanging = "  " if line.startswith("usage:") else ""
            lines += textwrap.wrap(
                line,
                width,
                subsequent_indent=hanging,
                break_on_hyphens=False,
                break_long_words=False,
            )
        else:
            lines.append(line)
    return "\n".join([*lines, ""])


SHELLS = ("bash", "zsh", "tcsh", "fish")


def write_completion(args: list[str]) -> int:
    """Write the script that completes `restock` in a shell.

    Raises:
        ConfigError: a shell and a file are not given.
    """
    if len(args) != 3 or args[1] not in SHELLS:
        raise ConfigError(
            "takes the name of a shell, and a file to write to, or - for stdout",
            where=COMPLETION,
            remedy=f"choose one of {', '.join(SHELLS)}",
        )
    try:
        tyro.cli(
            _every_command(),
            prog="restock",
            args=args,
            use_underscores=False,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
        )
    except SystemExit as stop:
        return int(stop.code or ExitCode.OK)
    return int(ExitCode.OK)


def _every_command() -> Any:
    """Return a union of all verbs; a verb that has nothing but jobs is a union of these."""
    kinds = {}
    for verb in VERBS:
        if verb in ("store", "twin"):
            jobs = {job: prepared(command_of(f"{verb} {job}")) for job in JOBS[verb]}
            kinds[verb] = dataclasses.make_dataclass(verb, [("job", _union(jobs))])
        else:
            kinds[verb] = prepared(command_of(verb))
    return _union(kinds)


def _union(kinds: Mapping[str, type[Any]]) -> Any:
    named = [
        Annotated[kind, tyro.conf.subcommand(name, prefix_name=False, description=None)]
        for name, kind in kinds.items()
    ]
    return Union[tuple(named)]  # noqa: UP007
