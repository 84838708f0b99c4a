"""A profile as stores, panels and runs carry it: one TOML text that needs no other file.

What its reader would look up is in it: the SQL of each `[[condition]]` that was a file. Shipped
conditions stay names. The text may come from a stranger, and is read as a profile file is: values
are checked by type, SQL runs in the same sandbox, and no file is opened.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.task.condition_files import shipped
from restock.ingest.task.conditions import Condition, of_kind
from restock.toml import toml_value


def profile_toml(profile: Profile) -> str:
    """The profile as TOML, every default written out; `read_profile_toml` gives an equal one."""
    values = _given(msgspec.to_builtins(profile))
    plain, tables = [], []
    for name, value in values.items():
        if isinstance(value, dict):
            tables += ["", f"[{name}]", *_lines(value)]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                tables += ["", f"[[{name}]]", *_lines(entry)]
        else:
            plain += _lines({name: value})
    return "\n".join([*plain, *tables]) + "\n"


def read_profile_toml(text: str, *, where: str) -> Profile:
    """A profile from such a text; `where` names it in errors.

    Raises:
        ConfigError: as `parse_profile`, also where the text names a file.
    """
    return parse_profile(text, where=where, folder=None)


def with_conditions(profile: Profile, conditions: Sequence[Condition]) -> Profile:
    """The same profile with other conditions; those that come with Restock go by their names."""
    known = shipped(profile.constants) | shipped(profile.constants, "exposure")
    named = [c for c in conditions if known.get(c.name) == c]
    return msgspec.structs.replace(
        profile,
        shipped_conditions=[c.name for c in of_kind(named, "outcome")],
        shipped_exposures=[c.name for c in of_kind(named, "exposure")],
        own_conditions=[c for c in conditions if c not in named],
    )


def _given(value: Any) -> Any:
    """Plain values without what is None: TOML has no word for it, and it is always the default."""
    if isinstance(value, dict):
        return {key: _given(item) for key, item in value.items() if item is not None}
    return [_given(item) for item in value] if isinstance(value, list | tuple) else value


def _lines(table: dict[str, Any]) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in table.items()]
