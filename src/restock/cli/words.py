"""Declare the options of verbs, parse their command lines, and print their help."""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import textwrap
import types
import typing
from collections.abc import Collection, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

from restock.errors import ConfigError

C = TypeVar("C")
MAX_WIDTH = 100  # columns; help is wrapped at this width or the terminal's
_METAVARS = {str: "TEXT", int: "N", float: "X"}


@dataclasses.dataclass(frozen=True)
class Option:
    """An option. By default, its name and metavar come from the field's name and type."""

    metavar: str | None = None
    name: str | None = None
    choices: tuple[str, ...] = ()


class Positional(Option):
    """A positional argument."""


class Repeated(Option):
    """An option that may be given several times."""


def parse(command: type[C], prog: str, words: Sequence[str]) -> C:
    """Parse a command line: the fields of the dataclass `command` are its options.

    Raises:
        ConfigError: the line has an unknown option, or a value that does not fit.
        SystemExit: the help was asked for, and printed.
    """
    help_asked = bool({"-h", "--help"} & set(words))
    width = min(shutil.get_terminal_size().columns, MAX_WIDTH)
    parser = _Parser(
        prog=prog,
        allow_abbrev=False,
        formatter_class=partial(
            argparse.RawDescriptionHelpFormatter, width=width, max_help_position=20
        ),
    )
    hints = typing.get_type_hints(command, include_extras=True)
    usage = [prog, "[OPTION]…"]
    for field in dataclasses.fields(command):  # type: ignore[arg-type]
        usage += _add(parser, field, hints[field.name])
    if help_asked:
        parser.usage = " ".join(usage)
        _describe(parser, command, width)
    values, unknown = parser.parse_known_intermixed_args(words)
    if unknown:
        parser.refuse(unknown[0])
    given = {name: value for name, value in vars(values).items() if value is not None}
    return command(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


class _Parser(argparse.ArgumentParser):
    """A parser that raises its errors."""

    def error(self, message: str) -> NoReturn:
        remedy = f"`{self.prog} --help` explains its options"
        raise ConfigError(message, where=self.prog, remedy=remedy)

    def refuse(self, word: str) -> NoReturn:
        """Refuse a word that fits no option, and suggest the nearest option."""
        from difflib import get_close_matches

        known = [name for name in self._option_string_actions if name.startswith("--")]
        near = get_close_matches(word.partition("=")[0], known, n=1)
        self.error(f"unknown: {word}" + (f" (did you mean {near[0]}?)" if near else ""))


def _add(parser: _Parser, field: dataclasses.Field[Any], hint: Any) -> list[str]:
    """Add a field to a parser; return how its usage shows it, if it is not a mere option.

    Its default stays that of the dataclass: what is not given is None after parsing.
    """
    kind, how = _declared(hint)
    needed = field.default is field.default_factory is dataclasses.MISSING
    name = how.name or field.name.replace("_", "-")
    if kind is bool:
        flag = f"--no-{name}" if field.default else f"--{name}"
        parser.add_argument(
            flag, dest=field.name, action="store_const", const=not field.default, default=None
        )
        return []
    several = typing.get_origin(kind) is tuple
    item = typing.get_args(kind)[0] if several else kind
    choices = typing.get_args(item) if typing.get_origin(item) is Literal else how.choices
    metavar = how.metavar or (None if choices else _METAVARS.get(item, field.name.upper()))
    settings: dict[str, Any] = {"metavar": metavar, "choices": choices or None}
    settings["type"] = str if choices else _path if item is Path else item
    if several and not isinstance(how, Repeated):
        settings["nargs"] = "*"
    shown = metavar or f"{{{','.join(choices)}}}"
    if isinstance(how, Positional):
        if not (several or needed):
            settings["nargs"] = "?"
        parser.add_argument(field.name, **settings)
        shown += "…" * several
        return [shown if needed else f"[{shown}]"]
    action = "append" if isinstance(how, Repeated) else "store"
    parser.add_argument(f"--{name}", dest=field.name, required=needed, action=action, **settings)
    return [f"--{name} {shown}"] if needed else []


def _path(text: str) -> Path:
    """Convert a word to a path; refuse "", which Python would take for the working directory."""
    if not text:
        raise argparse.ArgumentTypeError("the path is empty: is a variable of the shell not set?")
    return Path(text)


def _declared(hint: Any) -> tuple[Any, Option]:
    """Return the type of a field without None, and its declaration as an option."""
    annotated = typing.get_origin(hint) is typing.Annotated
    kind, *extras = typing.get_args(hint) if annotated else (hint,)
    how = next((one for one in extras if isinstance(one, Option)), Option())
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        (kind,) = set(typing.get_args(kind)) - {type(None)}
    return kind, how


def _describe(parser: _Parser, command: type[Any], width: int) -> None:
    """Give a parser the texts of its help: the docstrings of the dataclass and of its fields."""
    import ast
    import inspect

    wrapper = textwrap.TextWrapper(width, break_on_hyphens=False, break_long_words=False)
    parts = (inspect.getdoc(command) or "").split("\n\n")
    parser.description = "\n\n".join(  # examples are indented, and stay as they are
        part if part.startswith(" ") else wrapper.fill(part) for part in parts
    )
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(command))).body
    assert isinstance(tree, ast.ClassDef)
    defaults = {field.name: field.default for field in dataclasses.fields(command)}
    actions = {action.dest: action for action in parser._actions}
    for field, below in pairwise(tree.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                default = defaults[name]
                silent = not default or default in (True, dataclasses.MISSING)
                known = "" if silent else f" (default: {default})"
                actions[name].help = (" ".join(text.split()) + known).replace("%", "%%")


def refuse(command: Any, names: Collection[str], why: str, *, remedy: str) -> None:
    """Refuse options that would have no effect in this use of the command.

    Raises:
        ConfigError: one of the fields in `names` does not have its default value.
    """
    for field in dataclasses.fields(command):
        if field.name in names and getattr(command, field.name) != field.default:
            name = field.name.replace("_", "-")
            raise ConfigError(
                why, where=f"--no-{name}" if field.default is True else f"--{name}", remedy=remedy
            )
