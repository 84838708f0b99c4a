"""Declare the options of verbs, and parse simple command lines without tyro.

tyro takes a fifth of the time of a short command, so it is used only for help, for errors, and for
lines that `parse_plain` does not handle.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from restock.errors import ConfigError

C = TypeVar("C")


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


def parse_plain(command: type[C], words: Sequence[str]) -> C | None:
    """Parse a simple command line; return None if tyro has to parse it or to report an error.

    In a simple line, options are not abbreviated, values begin with a dash only after "=", and all
    positional arguments are next to each other.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    fields: dict[str, tuple[Any, Option]] = {}
    flags, options = dict[str, tuple[str, bool]](), dict[str, str]()
    for field in dataclasses.fields(command):  # type: ignore[arg-type]
        kind, _, how = declared(hints[field.name])
        fields[field.name] = kind, how
        name = how.name or field.name.replace("_", "-")
        if kind is bool:
            flags[f"--no-{name}" if field.default else f"--{name}"] = field.name, not field.default
        elif isinstance(how, Repeated) or not (isinstance(how, Positional) or _several(kind)):
            options[f"--{name}"] = field.name
    given, places = dict[str, list[str]](), list[int]()
    values, rest = dict[str, Any](), iter(enumerate(words))
    for at, word in rest:
        option, equals, text = word.partition("=")
        if word in flags:
            name, values[name] = flags[word]
        elif option in options:
            name = options[option]
            text = text if equals else next(rest, (at, "-"))[1]
            if text.startswith("-") and not equals:
                return None
            given.setdefault(name, []).append(text)
        elif word.startswith("-"):
            return None
        else:
            places.append(at)
    if places and places[-1] - places[0] != len(places) - 1:
        return None
    left = [words[at] for at in places]
    for name, (kind, how) in fields.items():
        if isinstance(how, Positional) and left:
            count = len(left) if _several(kind) else 1
            given[name], left = left[:count], left[count:]
    try:
        values |= {name: _value(*fields[name], texts) for name, texts in given.items()}
        return None if left else command(**values)
    except (TypeError, ValueError):  # a required argument is missing, or a value is invalid
        return None


def declared(hint: Any) -> tuple[Any, bool, Option]:
    """Return the type of a field, whether it may be None, and its declaration as an option."""
    annotated = typing.get_origin(hint) is typing.Annotated
    kind, *extras = typing.get_args(hint) if annotated else (hint,)
    how = next((one for one in extras if isinstance(one, Option)), Option())
    if optional := typing.get_origin(kind) in (types.UnionType, typing.Union):
        (kind,) = set(typing.get_args(kind)) - {type(None)}
    return kind, optional, how


def _several(kind: Any) -> bool:
    return typing.get_origin(kind) in (tuple, list)


def _value(kind: Any, how: Option, texts: Sequence[str]) -> Any:
    """Convert words to the value of a field; raise ValueError for an invalid word or "None"."""
    if _several(kind):
        return typing.get_origin(kind)(_value(typing.get_args(kind)[0], how, [t]) for t in texts)
    choices = typing.get_args(kind) if typing.get_origin(kind) is Literal else how.choices
    (text,) = texts
    if text == "None" or (choices and text not in choices):
        raise ValueError
    return text if choices else kind(text)


def refuse(command: Any, names: Collection[str], why: str, *, remedy: str) -> None:
    """Refuse options that would have no effect in this use of the command.

    Raises:
        ConfigError: one of the fields in `names` does not have its default value.
    """
    for field in dataclasses.fields(command):
        if field.name in names and getattr(command, field.name) != field.default:
            name = field.name.removesuffix("_dir").replace("_", "-")
            raise ConfigError(
                why, where=f"--no-{name}" if field.default is True else f"--{name}", remedy=remedy
            )


def refuse_empty_paths(command: Any) -> None:
    """Refuse empty paths, which Python would take for the working directory.

    Raises:
        ConfigError: a path is empty; `where` is the option or argument.
    """
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if Path() in (value if isinstance(value, list | tuple) else (value,)):
            raise ConfigError(
                "the path is empty: is a variable of the shell not set?",
                where=field.name.replace("_", "-"),
                remedy='give a path; "." is the working directory',
            )
