"""The JSON Schema of mixture files, made from the structs that read them.

Editors complete and check a mixture by it: `#:schema FILE` as the first line of a TOML file names
it to Taplo and to VS Code's Even Better TOML. `python -m restock.replay.mixture.mixture_schema`
writes the file that is shipped; a test holds that it is what the structs say.
"""

from __future__ import annotations

import inspect
import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from restock.replay.mixture import mixture, schedules, sources

FILE = "mixture.schema.json"
_FIELD = re.compile(r"^    (\w+): .*?  # (.+)$", re.MULTILINE)


def shipped_schema() -> str:
    """The schema as it is shipped."""
    return (files("restock.replay.mixture") / "mixtures" / FILE).read_text(encoding="utf-8")


def mixture_schema() -> str:
    """The schema of `Mixture`, with the comments beside its fields as descriptions."""
    schema = msgspec.json.schema(mixture.Mixture)
    for name, definition in schema["$defs"].items():
        definition["properties"] = {
            key: _plain(value) for key, value in definition["properties"].items()
        }
        homes = (mixture, sources, schedules)
        struct = next(getattr(home, name) for home in homes if hasattr(home, name))
        for key, comment in _FIELD.findall(inspect.getsource(struct)):
            if key in definition["properties"]:
                definition["properties"][key]["description"] = comment
    whole = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Restock mixture",
        **schema,
    }
    return json.dumps(whole, indent=1, sort_keys=False) + "\n"


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    """TOML has no null: what may be left out is a field without one."""
    choices = [choice for choice in value.get("anyOf", ()) if choice != {"type": "null"}]
    if len(choices) == len(value.get("anyOf", ())):
        return value
    rest = {key: item for key, item in value.items() if key != "anyOf" and item is not None}
    return {**choices[0], **rest} if len(choices) == 1 else {"anyOf": choices, **rest}


if __name__ == "__main__":
    (Path(__file__).parent / "mixtures" / FILE).write_text(mixture_schema(), encoding="utf-8")
