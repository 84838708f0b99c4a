"""The JSON Schema of a config, for editors: `#:schema FILE` as a TOML file's first line names it.

Types, ranges and defaults are those of the structs that read the file, descriptions the comments
beside their fields. What concerns several keys at once is not in it: only reading the file says.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import inspect as kinds

_FIELD = re.compile(r"^    (\w+): .*?  # (.+)$", re.MULTILINE)


def json_schema(kind: type, title: str) -> str:
    """The schema of a struct's TOML, as JSON text."""
    schema = msgspec.json.schema(kind)
    structs = {struct.__name__: struct for struct in _structs(kinds.type_info(kind), set())}
    for name, definition in schema.get("$defs", {}).items():
        definition["properties"] = {
            key: _without_null(value) for key, value in definition.get("properties", {}).items()
        }
        if "description" in definition:  # a docstring, which keeps its indent before Python 3.13
            definition["description"] = inspect.cleandoc(definition["description"])
        if (struct := structs.get(name)) is None:
            continue
        names = {field.name: field.encode_name for field in msgspec.structs.fields(struct)}
        for part in struct.__mro__:
            if part is msgspec.Struct or not issubclass(part, msgspec.Struct):
                break
            for field, comment in _FIELD.findall(inspect.getsource(part)):
                key = names.get(field)
                if key in definition["properties"]:
                    definition["properties"][key].setdefault("description", comment)
    draft = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps({"$schema": draft, "title": title, **schema}, indent=1) + "\n"


def _structs(kind: kinds.Type, seen: set[type]) -> Iterator[type]:
    """Every struct that a type holds."""
    if isinstance(kind, kinds.StructType):
        if kind.cls in seen:
            return
        seen.add(kind.cls)
        yield kind.cls
        for field in kind.fields:
            yield from _structs(field.type, seen)
    elif isinstance(kind, kinds.UnionType):
        for option in kind.types:
            yield from _structs(option, seen)
    elif isinstance(kind, kinds.TupleType):
        for item in kind.item_types:
            yield from _structs(item, seen)
    elif isinstance(kind, kinds.DictType):
        yield from _structs(kind.value_type, seen)
    elif isinstance(kind, kinds.CollectionType):
        yield from _structs(kind.item_type, seen)


def _without_null(value: dict[str, Any]) -> dict[str, Any]:
    """TOML has no null: what may be left out is a field without one."""
    choices = [choice for choice in value.get("anyOf", ()) if choice != {"type": "null"}]
    if len(choices) == len(value.get("anyOf", ())):
        return value
    rest = {key: item for key, item in value.items() if key != "anyOf" and item is not None}
    return {**choices[0], **rest} if len(choices) == 1 else {"anyOf": choices, **rest}


__all__ = ["json_schema"]
