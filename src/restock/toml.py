"""Read and write TOML as typed structs with ranges, with errors that name the key and its value.

The range of a field is part of its type (`Annotated[float, Meta(ge=0, lt=1)]`). It is checked when
a file is read and when a `Checked` struct is made in Python, and it is in the JSON Schema. A rule
about several fields is in the `check` method of the struct. Every number must be finite, with or
without a range: comparisons with `nan` are silently false, and JSON has neither `nan` nor `inf`.
"""

from __future__ import annotations

import functools
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect as kinds

from restock.errors import ConfigError

T = TypeVar("T")
_STEP = r"(\.\w[\w-]*|\[\d+\]|\[\.\.\.\])(.*)"  # path in msgspec's errors: first step, rest
MAX_NAMED = 12  # an error lists the known keys of a table if there are at most this many
MAX_DEPTH = 64  # levels of nested tables and arrays
_DEEP_KEY = re.compile(rf"""(?<![\w"'.-])(?:[\w"'-]+[ \t]*\.[ \t]*){{{MAX_DEPTH},}}""")


class ValueRefused(ConfigError, ValueError):
    """A value that a struct refuses. It is a ValueError, to which msgspec adds the key."""


class Checked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A struct that also checks its values when it is made in Python, and converts NumPy's numbers.

    Raises:
        ValueRefused: a value does not fit its type or its range, or `check` refuses it.
    """

    def check(self) -> None:
        """Raise ValueError if the values of several fields do not fit together."""

    def __post_init__(self) -> None:
        try:
            for field in _fields(type(self)):
                given = getattr(self, field.name)
                if (value := _plain(given)) is not given:
                    msgspec.structs.force_setattr(self, field.name, value)
                if value is not msgspec.UNSET:
                    _check(field.name, field.type, value)
            self.check()
        except ValueError as error:
            raise ValueRefused(str(error)) from error


_fields = functools.cache(msgspec.structs.fields)


def read_toml(path: Path, *, remedy: str | None = "check the path") -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        ConfigError: the file cannot be read, or is not TOML in UTF-8.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        what = f"cannot be read: {error.strerror}"
        raise ConfigError(what, where=str(path), remedy=remedy) from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", where=str(path)) from error
    return parse_toml(text, where=str(path))


def parse_toml(text: str, *, where: str) -> dict[str, Any]:
    """Parse a TOML document; `where` names it in errors.

    Raises:
        ConfigError: it is not TOML, or is nested more than MAX_DEPTH levels deep.
    """
    too_deep = ConfigError(f"is nested more than {MAX_DEPTH} levels deep", where=where)
    if _DEEP_KEY.search(text):  # tomllib's time for such a key grows with the square of its length
        raise too_deep
    try:
        values = tomllib.loads(text.removeprefix("\ufeff"))  # the BOM that some editors write
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", where=where) from error
    except RecursionError as error:
        raise too_deep from error
    level: list[Any] = [values]
    for _ in range(MAX_DEPTH):
        inner = (one.values() if isinstance(one, dict) else one for one in level)
        level = [one for several in inner for one in several if isinstance(one, dict | list)]
    if level:
        raise too_deep
    return values


def typed(
    document: Mapping[str, Any],
    kind: type[T],
    *,
    where: str,
    remedy: str | None = None,
    renamed: Mapping[str, str] | None = None,
    prefix: str = "",
) -> T:
    """Convert plain values to a typed struct.

    Args:
        renamed: dotted keys of earlier versions -> what to write instead (see restock.renamed).
        prefix: dotted path that precedes each key in errors.

    Raises:
        ConfigError: a key is unknown, missing or renamed, or a value does not fit its type.
    """
    for old, instead in (renamed or {}).items():
        if _has(document, old.split(".")):
            raise ConfigError(f"unknown key `{_join(prefix, old)}`", where=where, remedy=instead)
    try:
        return msgspec.convert(_plain(document), kind)
    except msgspec.ValidationError as error:
        what = _in_words(str(error), document, kind, prefix)
        if meant := _keys_meant(str(error), document, kind, prefix):
            remedy = meant + (f" {remedy}" if remedy else "")
        raise ConfigError(what, where=where, remedy=remedy) from error


def toml_value(value: Any) -> str:
    """Format a string, number, boolean, list or mapping as TOML on one line."""
    if isinstance(value, Mapping):
        items = (f"{_key(key)} = {toml_value(item)}" for key, item in value.items())
        return "{" + ", ".join(items) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, float):
        return repr(float(value))  # JSON has no inf and nan
    # ASCII JSON would have surrogate pairs, which TOML forbids; DEL must be escaped in TOML only.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def _item(kind: kinds.Type) -> kinds.Type | None:
    if isinstance(kind, kinds.DictType):
        return kind.value_type
    if isinstance(kind, kinds.VarTupleType | kinds.ListType):
        return kind.item_type
    return None


def _plain(value: Any) -> Any:
    """Convert NumPy's numbers and arrays to Python's, for JSON and TOML."""
    if type(value).__module__ == "numpy":
        return value.tolist()
    if isinstance(value, list | tuple):
        items = [_plain(one) for one in value]
        same = all(one is other for one, other in zip(items, value, strict=True))
        return value if same else type(value)(items)
    if isinstance(value, Mapping):
        held = {key: _plain(one) for key, one in value.items()}
        return value if all(held[key] is one for key, one in value.items()) else held
    return value


def _check(name: str, kind: Any, value: Any) -> None:
    """Raise ValueError if a value does not fit its type, or has a number that is not finite."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise ValueError(_in_words(str(error), value, kind, name)) from error
    _expect_finite(name, value)


def _expect_finite(name: str, value: Any) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value}")
    if isinstance(value, Mapping):
        for key, one in value.items():
            _expect_finite(f"{name}.{key}", one)
    elif isinstance(value, list | tuple):
        for index, one in enumerate(value):
            _expect_finite(f"{name}[{index}]", one)


def _bounds(kind: kinds.Type) -> dict[str, float]:
    bounds = {name: getattr(kind, name, None) for name in ("ge", "gt", "le", "lt")}
    return {name: bound for name, bound in bounds.items() if bound is not None}


def _inside(value: float, bounds: Mapping[str, float]) -> bool:
    return (
        value >= bounds.get("ge", value)
        and value <= bounds.get("le", value)
        and ("gt" not in bounds or value > bounds["gt"])
        and ("lt" not in bounds or value < bounds["lt"])
    )


def _range_in_words(bounds: Mapping[str, float]) -> str:
    """Describe a range: `in [0, 1)`, `at least 1`, `above 0`, `at most 1`, `below 1`."""
    low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
    if low is not None and high is not None:
        left, right = "[" if "ge" in bounds else "(", "]" if "le" in bounds else ")"
        return f"in {left}{low:.10g}, {high:.10g}{right}"
    if low is not None:
        return f"{'at least' if 'ge' in bounds else 'above'} {low:.10g}"
    return f"{'at most' if 'le' in bounds else 'below'} {high:.10g}"


def _in_words(message: str, document: Any, kind: Any, prefix: str) -> str:
    """Reword a message of msgspec: the key as in TOML, and the range in words."""
    what, path = _parted(message)
    for pattern, word in (("contains unknown", "unknown"), ("missing required", "missing")):
        if field := re.fullmatch(rf"Object {pattern} field `(.*)`", what):
            return f"{word} key `{_join(prefix, path, field[1])}`"
    key = _join(prefix, path)
    if re.fullmatch(r"Expected `\w+` [<>]=? .*", what):
        for place, value, name in _places(kinds.type_info(kind), document, path):
            bounds = _bounds(place)
            if isinstance(value, int | float) and bounds and not _inside(value, bounds):
                return f"{_join(prefix, name)} must be {_range_in_words(bounds)}, got {value}"
    if re.match(r"Expected `|Invalid ", what) or not path:
        choices = sorted(set(_choices(kind, document, path)))
        if choices and choices[0].startswith('"'):  # quoted names are sorted first
            what += f"; choose from {', '.join(choices)}"
        return f"`{key}`: {what}" if key else what
    # The message of a struct's `check` begins with a field: `margin …` becomes `loss.margin …`.
    return what if what.startswith((key, "`")) or " " not in what else f"{key}.{what}"


def _parted(message: str) -> tuple[str, str]:
    """Split a message of msgspec into the complaint and the path of the value."""
    what, _, path = message.partition(" - at `$")
    return what, path.rstrip("`")


def _keys_meant(message: str, document: Any, kind: Any, prefix: str) -> str | None:
    """Suggest the key nearest to an unknown one, or list all keys; None if there are too many."""
    what, path = _parted(message)
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", what, re.S)
    if unknown is None:
        return None
    from difflib import get_close_matches

    known = set()
    for place, _, _ in _places(kinds.type_info(kind), document, path):
        if isinstance(place, kinds.StructType):
            known |= {field.encode_name for field in place.fields} | {place.tag_field or ""}
    if near := get_close_matches(unknown[1], known, n=1):
        return f"did you mean `{_join(prefix, path, near[0])}`?"
    known -= {""}
    return f"there are {', '.join(sorted(known))}." if len(known) <= MAX_NAMED else None


def _choices(kind: Any, document: Any, path: str) -> Iterator[str]:
    """Yield the values allowed at the path in a message: quoted names, `a number`, `a table`."""
    for place, _, _ in _places(kinds.type_info(kind), document, path):
        if isinstance(place, kinds.LiteralType):
            yield from (f'"{value}"' for value in place.values)
        elif isinstance(place, kinds.IntType | kinds.FloatType):
            yield "a number"
        elif isinstance(place, kinds.StructType | kinds.DictType):
            yield "a table"


def _places(
    kind: kinds.Type, value: Any, path: str, key: str = ""
) -> Iterator[tuple[kinds.Type, Any, str]]:
    """Yield each type, value and key to which the path in a message of msgspec may refer.

    There are several if a type is a union, or if the path contains `[...]` (any key of a table).
    """
    if isinstance(kind, kinds.UnionType):
        for option in kind.types:
            yield from _places(option, value, path, key)
        return
    if not path:
        yield kind, value, key
        return
    step, rest = re.fullmatch(_STEP, path, re.S).groups()  # type: ignore[union-attr]
    if isinstance(kind, kinds.StructType | kinds.TypedDictType | kinds.DataclassType):
        name = step[1:]
        if isinstance(kind, kinds.StructType) and name == kind.tag_field:
            yield kinds.LiteralType((kind.tag,)), None, key
        for field in kind.fields:
            if field.encode_name == name and isinstance(value, Mapping):
                yield from _places(field.type, value.get(name), rest, _join(key, name))
        return
    inside: Iterable[tuple[Any, Any]] = value.items() if isinstance(value, Mapping) else ()
    if step != "[...]" and isinstance(value, list | tuple):
        inside = [(step, one) for one in value[int(step[1:-1]) :][:1]]
    for name, one in inside:
        item = (
            kind.item_types[int(step[1:-1])] if isinstance(kind, kinds.TupleType) else _item(kind)
        )
        if item is not None:
            yield from _places(item, one, rest, _join(key, str(name)))


def _has(document: Any, keys: list[str]) -> bool:
    """Return whether a document has a value at a path of keys; in arrays, any item may have it."""
    if not keys:
        return True
    if isinstance(document, list):
        return any(_has(one, keys) for one in document)
    key, *rest = keys
    return isinstance(document, Mapping) and key in document and _has(document[key], rest)


def _join(*parts: str) -> str:
    """Join keys with dots, and indices without: `a.b[0].c`."""
    text = ""
    for part in parts:
        part = part.lstrip(".")
        text += part if not text or not part or part.startswith("[") else f".{part}"
    return text


def by_path(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each nested setting with its dotted path, as `--set` takes it."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from by_path(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def changed(settings: msgspec.Struct, names: Sequence[str] = (), **default: Any) -> list[str]:
    """Return which settings in `names` (all, if empty) differ from the struct's defaults.

    `default` gives other defaults for some settings.
    """
    usual = type(settings)(**default)
    named = names or settings.__struct_fields__
    return [name for name in named if getattr(settings, name) != getattr(usual, name)]
