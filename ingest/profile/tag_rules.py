"""Tags of a recording: robot, site and others, and where they come from.

A tag is a name with a text value; a recording has one value per name. In the views, `robot`,
`site`, `firmware`, `map` and `shift` are columns, and all tags are in the column `tags`.

Tags come from the command line, the recording's metadata and its path. The command line overrides
the others. Metadata and path must not contradict each other.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TypeAlias

import msgspec

from restock.errors import ConfigError, RecordingError
from restock.toml import Checked

NAMED = ("robot", "site", "firmware", "map", "shift")  # tags that are columns of the views
MAX_TAGS = 64  # most tags of a recording
MAX_NAME, MAX_VALUE = 64, 256  # longest name and value of a tag, in characters


def parse_tags(texts: Iterable[str], *, empty: bool = False) -> dict[str, str]:
    """Parse tags from `KEY=VALUE` texts of the command line.

    Args:
        texts: such as `robot=amr-07`.
        empty: whether a value may be empty (`KEY=`), which removes the tag.

    Raises:
        ConfigError: a text has another form, a name or value is too long, or a name has two values.
    """
    tags: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name, value = name.strip(), value.strip()
        if not equals or not (value or empty):
            raise ConfigError(
                f"{text!r} is not KEY=VALUE", where="--tag", remedy="such as --tag robot=amr-07"
            )
        if problem := tag_problem(name, value):
            raise ConfigError(problem, where="--tag")
        if tags.setdefault(name, value) != value:
            raise ConfigError(
                f"{name} is given twice, as {tags[name]!r} and as {value!r}",
                where="--tag",
                remedy="a recording has one value of a tag: ingest the recordings of each value "
                "separately",
            )
    if len(tags) > MAX_TAGS:
        raise ConfigError(
            f"{len(tags)} tags are too many: at most {MAX_TAGS} are allowed", where="--tag"
        )
    return tags


def tag_problem(name: str, value: str) -> str | None:
    """Return why a tag may not have this name and value, or None."""
    if not 0 < len(name) <= MAX_NAME or "=" in name or not name.isprintable():
        return (
            f"{name[: MAX_NAME + 1]!r} is not a name of a tag: use 1 to {MAX_NAME} "
            "characters, without = and control characters"
        )
    if len(value) > MAX_VALUE:
        return f"the value of {name} has {len(value):,} characters, more than {MAX_VALUE}"
    if not value.isprintable():
        return f"the value of {name} has control characters"
    return None


def in_words(tags: Mapping[str, str]) -> str:
    """Format tags as one line, those in NAMED first."""
    names = [*(name for name in NAMED if name in tags), *sorted(tags.keys() - set(NAMED))]
    return ", ".join(f"{name}={tags[name]}" for name in names)


# One record of metadata: its source as errors call it, the record's name, and its entries.
Metadata: TypeAlias = "tuple[str, str, Mapping[str, str]]"
_TAGS_TABLE = "`[tags]` of the profile"


class TagRules(Checked, frozen=True):
    """The `[tags]` of a profile: how to read tags from a recording's path and metadata.

    `from_path` is a pattern for the end of the path, or a list of patterns, of which the first that
    matches is used. `{robot}` matches that tag's value, `*` any part of a name, `?` one character
    and `**` any number of folders. `from_metadata` maps a tag to an entry of the metadata:
    `robot = "vehicle_id"`, or `"record.vehicle_id"` if several records have that entry.
    """

    from_path: str | list[str] = msgspec.field(default_factory=list)
    from_metadata: dict[str, str] = msgspec.field(default_factory=dict)

    def check(self) -> None:
        for pattern in self.patterns:
            path_pattern(pattern)
        for name in self.from_metadata:
            if problem := tag_problem(name, ""):
                raise ValueError(f"from_metadata: {problem}")

    @property
    def patterns(self) -> list[str]:
        return [self.from_path] if isinstance(self.from_path, str) else self.from_path

    def of_path(self, path: Path, given: Collection[str]) -> dict[str, dict[str, str]]:
        """Return the tags in a path, under the name of their source; {} if there is no pattern.

        Raises:
            RecordingError: no pattern matches, and `given` lacks some tag of the patterns.
        """
        place = Path(os.path.abspath(path)).as_posix()  # noqa: PTH100  (".." out, links kept)
        for pattern in self.patterns:
            if found := path_pattern(pattern).fullmatch(place):
                tags = {name: value for name, value in found.groupdict().items() if value}
                for name, value in tags.items():
                    if problem := tag_problem(name, value):
                        raise RecordingError(problem, where=str(path), remedy="rename the folder")
                return {f"its path ({pattern})": tags}
        requested = {name for pattern in self.patterns for name in path_pattern(pattern).groupindex}
        if requested <= set(given):
            return {}
        listed = " nor ".join(map(repr, self.patterns))
        raise RecordingError(
            f"its path does not match {listed}, the from_path in {_TAGS_TABLE}",
            where=place,
            remedy='correct the pattern, add one for such paths (from_path = ["…", "…"]), or give'
            f" {' '.join(f'--tag {name}=…' for name in sorted(requested))}",
        )

    def of_metadata(
        self, metadata: Sequence[Metadata], given: Collection[str], where: str
    ) -> tuple[dict[str, dict[str, str]], list[str]]:
        """Return the tags in a recording's metadata by the name of their source, and user notes.

        Raises:
            RecordingError: the metadata has two values of a tag that is not `given`.
        """
        found: dict[str, list[tuple[str, str, str]]] = {}  # of each tag: value, source, record
        for source, record, entries in metadata:
            for key, value in entries.items():
                for name in self._names(record, key):
                    if value.strip() and name not in given:
                        found.setdefault(name, []).append((value, source, record))
        named = [name for name in (*NAMED, *self.from_metadata) if name in found]
        sources: dict[str, dict[str, str]] = {}
        left_out: list[str] = []
        room = MAX_TAGS
        for name in dict.fromkeys([*named, *found]):
            value, source, _ = found[name][0]
            other = next((entry for entry in found[name] if entry[0] != value), None)
            # A name that no rule mentions may have different meanings in two records.
            same = name in named or not any(record for _, _, record in found[name])
            if other and same:
                raise _contradiction(name, (value, source), other[:2], where)
            if other or not room or tag_problem(name, value):
                left_out.append(name)
            else:
                sources.setdefault(source, {})[name] = value
                room -= 1
        if not left_out:
            return sources, []
        some = ", ".join(repr(name[:40]) for name in left_out[:5])
        return sources, [
            f"{len(left_out):,} names in its metadata cannot be tags ({some}"
            f"{', …' if len(left_out) > 5 else ''}): too long, not printable, of several values, or"
            f" beyond the {MAX_TAGS}th"
        ]

    def _names(self, record: str, key: str) -> list[str]:
        """Return the names of the tags that take their value from the entry `key` of a record."""
        wanted = (key, f"{record}.{key}")
        requested = [name for name, source in self.from_metadata.items() if source in wanted]
        return requested or [key] * (key not in self.from_metadata)


@dataclass
class RecordingTags:
    """Tags of a recording, and notes for the user."""

    tags: dict[str, str]
    notes: list[str] = field(default_factory=list)


def resolve_tags(
    rules: TagRules,
    path: Path,
    metadata: Sequence[Metadata],
    given: Mapping[str, str],
    before: Mapping[str, str],
) -> RecordingTags:
    """Determine the tags of one recording.

    Args:
        rules: the rules of the profile.
        path: the recording's path.
        metadata: the recording's metadata.
        given: tags from the command line, which override all others; an empty value removes a tag.
        before: tags that the store has of the recording; if no source mentions one, it is kept.

    Raises:
        RecordingError: two sources disagree, or no pattern matches the path, and `given` does not
            decide.
    """
    own, notes = rules.of_metadata(metadata, given, str(path))
    tags: dict[str, tuple[str, str]] = {}
    for source, entries in (own | rules.of_path(path, given)).items():
        for name, value in entries.items():
            if tags.setdefault(name, (value, source))[0] != value and name not in given:
                raise _contradiction(name, tags[name], (value, source), str(path))
    reported = {name: value for name, (value, _) in tags.items()} | dict(given)
    kept = {name: value for name, value in before.items() if name not in reported}
    if kept:
        notes.append(
            f"tags kept from the earlier ingest: {in_words(kept)} (--tag NAME= removes one)"
        )
    return RecordingTags({name: value for name, value in (reported | kept).items() if value}, notes)


def _contradiction(
    name: str, first: tuple[str, str], other: tuple[str, str], where: str
) -> RecordingError:
    return RecordingError(
        f"its tag {name!r} is {first[0][:80]!r} in {first[1]}, but {other[0][:80]!r} in {other[1]}",
        where=where,
        remedy=f"choose one: --tag {name}={first[0][:80]} or --tag {name}={other[0][:80]}",
    )


_TAG = r"\{[A-Za-z_]\w*\}"


@cache
def path_pattern(pattern: str) -> re.Pattern[str]:
    """Compile a `from_path` into a regular expression for absolute paths.

    Raises:
        ValueError: the pattern is invalid; says why.
    """
    parts = pattern.removeprefix("/").split("/")
    if not pattern.startswith("/") and "**" in parts and not re.match(r"[^{*?]", pattern):
        raise ValueError(
            f"from_path {pattern!r}: a pattern with ** must begin with a folder's name, or with /"
        )
    if parts[-1] == "**" or "" in parts:
        raise ValueError(f"from_path {pattern!r}: its last part is the recording's name, such as *")
    tags = re.findall(_TAG, pattern)
    if not tags or len(set(tags)) < len(tags) or re.search("[{}]", re.sub(_TAG, "", pattern)):
        raise ValueError(
            f"from_path {pattern!r} must hold the names of tags in braces, each once, such as"
            " {robot}/*"
        )
    begin = "/" if pattern.startswith("/") else "/(?:.*/)?"
    folders = ("(?:[^/]+/)*" if part == "**" else _part_pattern(part) + "/" for part in parts[:-1])
    return re.compile(begin + "".join(folders) + _part_pattern(parts[-1]))


def _part_pattern(part: str) -> str:
    """Return the regular expression for one part of a path, which must not be empty."""
    wild = {"*": "[^/]*", "?": "[^/]"}
    pieces = (
        f"(?P<{piece[1:-1]}>[^/]+?)" if piece[:1] == "{" else wild.get(piece, re.escape(piece))
        for piece in re.split(f"({_TAG}|[*?])", part)
    )
    return "(?=[^/])" + "".join(pieces)
