"""A verb's dataclass as its command line: what tyro is given to parse, and to explain."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Collection
from typing import Annotated, Any, Literal

import tyro

from restock.errors import ConfigError

_PREPARED: list[type[Any]] = []
_METAVARS = {str: "TEXT", int: "N", float: "X"}


def prepared(command: type[Any]) -> type[Any]:
    """The dataclass with its types written so that its help is plain and its parsing quick.

    `X | None` becomes `Optional[X]`, whose values tyro checks itself: for `X | None` it imports
    typeguard, and with that asyncio. An option that may be left out shows what it takes, not
    `{None}|STR`, and no default where that says nothing.
    """
    if command in _PREPARED:
        return command
    _PREPARED.append(command)
    hints = typing.get_type_hints(command, include_extras=True)
    for field in dataclasses.fields(command):
        field.type = _prepared(hints[field.name], field.default)
        command.__annotations__[field.name] = field.type
    return command


def refuse(command: Any, names: Collection[str], why: str, *, remedy: str) -> None:
    """Refuse options that would do nothing: those of these fields whose value is not the default.

    Raises:
        ConfigError: one was given.
    """
    for field in dataclasses.fields(command):
        if field.name in names and getattr(command, field.name) != field.default:
            name = field.name.removesuffix("_dir").replace("_", "-")
            raise ConfigError(
                why, where=f"--no-{name}" if field.default is True else f"--{name}", remedy=remedy
            )


def _prepared(hint: Any, default: Any) -> Any:
    """A type with its metavar and its hint on the default, unless it says its own."""
    bare, *extras = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    if typing.get_origin(bare) in (types.UnionType, typing.Union):
        kinds = [kind for kind in typing.get_args(bare) if kind is not type(None)]
        optional = len(kinds) < len(typing.get_args(bare))
        jobs = [_job(kind) for kind in kinds]
        bare = typing.Optional[jobs[0]] if optional else typing.Union[tuple(jobs)]  # noqa: UP007, UP045
        if optional:
            extras.insert(0, tyro.conf.arg(metavar=_metavar(kinds[0])))
    elif bare in _METAVARS:
        extras.insert(0, tyro.conf.arg(metavar=_METAVARS[bare]))
    if default in (None, False, ()) or typing.get_origin(bare) is tuple:
        extras.insert(0, tyro.conf.arg(help_behavior_hint=""))
    return Annotated[(bare, *extras)] if extras else bare


def _job(kind: Any) -> Any:
    """One of a union's types; a command of its own is prepared as well."""
    inner = typing.get_args(kind)[0] if typing.get_origin(kind) is Annotated else kind
    if dataclasses.is_dataclass(inner) and isinstance(inner, type):
        prepared(inner)
    return kind


def _metavar(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return "{" + ",".join(map(str, typing.get_args(kind))) + "}"
    return _METAVARS.get(kind) or str(getattr(kind, "__name__", kind)).upper()
