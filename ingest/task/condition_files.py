"""Conditions that are .sql files: those that come with Restock, and those beside a profile.

A file says the rule, in parts, and in comments the settings:

    -- What it is, and why the rule is as it is.
    -- timing: post
    -- priority: 30
    -- uncertain: 0.2 to 0.8
    -- let slip_mps:
    abs(wheel_speed_mps - localised_speed_mps)
    -- label:
    avg(slip_mps) OVER (episode ROWS BETWEEN 1 PRECEDING AND 1 FOLLOWING) > 0.2
    -- probability:
    1 / (1 + exp(-20 * (slip_mps - 0.2)))

A file of one expression is the label. Comments before the first part are the doc, those in a part
are not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from restock.errors import ConfigError
from restock.files import first_line
from restock.ingest.task.conditions import Condition, Kind
from restock.ingest.task.signals import Noise
from restock.ingest.task.task import STAND_IN_LIMITS

MAX_BYTES = 100_000  # of a condition's file
_PART = re.compile(r"-- (?:let ([A-Za-z]\w*)|(label|probability)):\s*")
_SETTINGS = ("kind", "timing", "priority", "uncertain")


def shipped(
    constants: Mapping[str, float] | None = None, kind: Kind = "outcome"
) -> dict[str, Condition]:
    """Read the conditions of a kind that come with Restock: `ingest/task/conditions/*.sql`.

    `constants` are `Profile.constants` of the robot whose steps they label; None: of the stand-in,
    with a profile's default noise.
    """
    constants = constants or Noise().constants | STAND_IN_LIMITS
    folder = files("restock.ingest.task") / "conditions"
    conditions = {}
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".sql"):
            name = entry.name.removesuffix(".sql")
            text = entry.read_text(encoding="utf-8")
            made = msgspec.convert({"name": name, **settings_of(text)}, Condition)
            if made.kind == kind:
                conditions[name] = made.with_constants(constants)
    return conditions


def settings_of(text: str) -> dict[str, Any]:
    """Parse `sql`, `doc` and the other settings of a condition's file."""
    settings: dict[str, Any] = {}
    doc: list[str] = []
    parts: dict[str, list[str]] = {}
    part: list[str] = []
    lets: dict[str, list[str]] = {}
    for line in text.splitlines():
        if found := _PART.fullmatch(line):
            name, kind = found.groups()
            part = lets.setdefault(name, []) if name else parts.setdefault(kind, [])
        elif not line.startswith("--"):
            if line.strip() and not (lets or parts):
                part = parts.setdefault("label", [])
            part.append(line)
        elif not (lets or parts):
            key, colon, value = line[2:].strip().partition(": ")
            if colon and key in _SETTINGS:
                settings[key] = _value(value)
            else:
                doc.append(line[2:].strip())
    sql = {name: "\n".join(lines).strip() for name, lines in (parts | lets).items()}
    said: dict[str, Any] = {"sql": sql.get("label", ""), "doc": " ".join(doc)}
    if lets:
        said["let"] = {name: sql[name] for name in lets}
    if "probability" in parts:
        said["probability"] = sql["probability"]
    return said | settings


def _value(text: str) -> str | int | list[str | float]:
    """Parse a whole number, `0.2 to 0.8`, or a word; the type check refuses others by key."""
    if text.lstrip("-").isdigit():
        return int(text)
    if " to " not in text:
        return text
    ends = text.split(" to ")
    return [float(end) if re.fullmatch(r"\d*\.?\d+", end) else end for end in ends]


def with_files(document: dict[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """Replace each `[[condition]] file = "…"` of a profile's TOML by the text of that file.

    A file may say `-- timing: pre` and `-- priority: 45` in comments, as the shipped ones do;
    what the TOML says goes first. Its name must stay in the profile's folder: profiles are
    passed between strangers.

    Raises:
        ConfigError: no such file, or one that lies elsewhere; names the key.
    """
    conditions = document.get("condition")
    if not isinstance(conditions, list):
        return document
    read = [
        _read(entry, f"condition[{place}]", folder, where)
        if isinstance(entry, dict) and "file" in entry
        else entry
        for place, entry in enumerate(conditions)
    ]
    return document | {"condition": read}


def _read(entry: dict[str, Any], key: str, folder: Path | None, where: str) -> dict[str, Any]:
    name = entry["file"]

    def refused(what: str, remedy: str | None = None) -> ConfigError:
        return ConfigError(f"`{key}.file` {what}", where=where, remedy=remedy)

    if "sql" in entry:
        raise refused("is given together with `sql`: give only one of them")
    if not isinstance(name, str) or not name.endswith(".sql"):
        raise refused(f"must name a .sql file, got {name!r}")
    if folder is None:
        raise refused("needs a profile that is a file: the name is relative to its folder")
    path = (folder / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise refused(
            f"is outside the profile's folder: {name}", "put it into the profile's folder"
        )
    try:
        if path.stat().st_size > MAX_BYTES:
            raise refused(f"is larger than {MAX_BYTES:,} bytes: {name}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise refused(f"cannot be read: {name}: {first_line(error)}") from error
    stem = {"name": path.stem} if path.stem.isidentifier() else {}
    return stem | settings_of(text) | {k: value for k, value in entry.items() if k != "file"}
