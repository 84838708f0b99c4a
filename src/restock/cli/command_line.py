"""Parse the command line of a verb's dataclass with tyro, and print its help."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import os
import shutil
import sys
import textwrap
import typing
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import tyro

from restock.cli.words import Positional, Repeated, declared

_PREPARED: list[type[Any]] = []
MAX_PROSE = 100  # columns; help texts are wrapped at this width or the terminal's
MIN_COLUMNS = 30  # in narrower terminals, tyro's layout does not terminate
_MARKS = {Positional: tyro.conf.Positional, Repeated: tyro.conf.UseAppendAction}
_METAVARS = {str: "TEXT", int: "N", float: "X"}


def prepared(command: type[Any]) -> type[Any]:
    """Add help texts to a command's dataclass, and annotations that simplify tyro's help.

    `X | None` becomes `Optional[X]`, because tyro would import typeguard and asyncio to read the
    first form. The help shows an optional option as `STR`, not as `{None}|STR`, and leaves out
    the defaults None, (), True and False.
    """
    if command not in _PREPARED:
        _PREPARED.append(command)
        hints, texts = typing.get_type_hints(command, include_extras=True), _texts(command)
        command.__doc__ = inspect.getdoc(command) or ""
        for field in dataclasses.fields(command):
            marked = _prepared(hints[field.name], field.default)
            field.type = Annotated[marked, tyro.conf.arg(help=texts.get(field.name))]
            command.__annotations__[field.name] = field.type
    return command


def _texts(command: type[Any]) -> dict[str, str]:
    """Return the docstring below each field, joined to one line."""
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


def _prepared(hint: Any, default: Any) -> Any:
    """Return a field's type annotated for tyro: metavar, choices, whether to show its default."""
    kind, optional, how = declared(hint)
    choices: Any = Literal[how.choices] if how.choices else None
    if optional and typing.get_origin(kind) is Literal:  # tyro would list None as a choice
        choices = kind
    shown = choices or optional or kind in _METAVARS
    silent = default in (None, ()) or isinstance(default, bool) or typing.get_origin(kind) is tuple
    marks: list[Any] = [
        how,  # `parse_plain` reads this from the annotation
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
    """Parse a command line with tyro, which prints help and errors, and then exits."""
    command = prepared(command)
    columns = shutil.get_terminal_size().columns
    if columns < MIN_COLUMNS:
        os.environ["COLUMNS"] = str(MIN_COLUMNS)
    help_asked = bool({"-h", "--help"} & set(words))
    if os.environ.get("NO_COLOR") or not (help_asked or sys.stderr.isatty()):
        tyro._experimental_options["ansi_codes"] = False
    if help_asked:  # print the description here: tyro does not wrap it
        sys.stdout.write(_wrapped(command.__doc__ or "", min(columns, MAX_PROSE)) + "\n\n")
    return tyro.cli(
        command,
        prog=prog,
        description="",
        args=words,
        use_underscores=False,
        config=(tyro.conf.FlagCreatePairsOff,),  # offer --json, but not --no-json
    )


def _wrapped(text: str, columns: int) -> str:
    """Wrap each paragraph of a docstring, except examples, which are indented."""
    wrapper = textwrap.TextWrapper(columns, break_on_hyphens=False, break_long_words=False)
    parts = text.split("\n\n")
    return "\n\n".join(part if part.startswith(" ") else wrapper.fill(part) for part in parts)
