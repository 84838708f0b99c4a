"""Conditions of a profile that lie in `.sql` files beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from restock.errors import ConfigError
from restock.ingest.task.conditions import settings_of

LARGEST_BYTES = 100_000


def with_files(said: dict[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """A profile's TOML with the text of each `[[condition]] file = "…"` in place of its name.

    A file may say `-- timing: pre` and `-- priority: 45` in comments, as the shipped ones do;
    what the TOML says goes first. Its name must stay in the profile's folder: profiles are
    passed between strangers.

    Raises:
        ConfigError: no such file, or one that lies elsewhere; names the key.
    """
    conditions = said.get("condition")
    if not isinstance(conditions, list):
        return said
    found = [
        _read(entry, f"condition[{place}]", folder, where)
        if isinstance(entry, dict) and "file" in entry
        else entry
        for place, entry in enumerate(conditions)
    ]
    return said | {"condition": found}


def _read(entry: dict[str, Any], key: str, folder: Path | None, where: str) -> dict[str, Any]:
    name = entry["file"]

    def refused(what: str, remedy: str | None = None) -> ConfigError:
        return ConfigError(f"`{key}.file` {what}", where=where, remedy=remedy)

    if "sql" in entry:
        raise refused("stands beside `sql`: give one of them")
    if not isinstance(name, str) or not name.endswith(".sql"):
        raise refused(f"must name a .sql file, got {name!r}")
    if folder is None:
        raise refused("needs a profile that is a file: it is looked for beside it")
    path = (folder / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise refused(f"leads out of the profile's folder: {name}", "put it beside the profile")
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise refused(f"is larger than {LARGEST_BYTES:,} bytes: {name}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise refused(f"cannot be read: {name}: {error}") from error
    stem = {"name": path.stem} if path.stem.isidentifier() else {}
    return stem | settings_of(text) | {k: value for k, value in entry.items() if k != "file"}
