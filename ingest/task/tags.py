"""Tags: whose drive a recording is. Text by name, one of each a recording.

`robot`, `site`, `firmware`, `map` and `shift` are columns of the views; all, with any other names,
are in their column `tags`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from restock.errors import ConfigError

NAMED = ("robot", "site", "firmware", "map", "shift")  # columns of the views
MAX_TAGS = 64  # of a recording
MAX_NAME, MAX_VALUE = 64, 256  # characters


def parse_tags(texts: Iterable[str], *, flag: str = "--tag", empty: bool = False) -> dict[str, str]:
    """Tags of `KEY=VALUE` texts, as the command line has them.

    Args:
        texts: such as `robot=amr-07`.
        flag: the option, for errors.
        empty: whether a value may be empty (`KEY=`): it then takes the tag off.

    Raises:
        ConfigError: a text of another form, a name or value that is too long, or a name with two
            values.
    """
    tags: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name, value = name.strip(), value.strip()
        if not equals or not (value or empty):
            raise ConfigError(
                f"{text!r} is not KEY=VALUE", where=flag, remedy=f"such as {flag} robot=amr-07"
            )
        if problem := tag_problem(name, value):
            raise ConfigError(problem, where=flag)
        if tags.setdefault(name, value) != value:
            raise ConfigError(
                f"{name} is given twice, as {tags[name]!r} and as {value!r}",
                where=flag,
                remedy="a recording has one value of a tag: ingest the recordings of each value "
                "separately",
            )
    if len(tags) > MAX_TAGS:
        raise ConfigError(
            f"{len(tags)} tags are too many: at most {MAX_TAGS} are allowed", where=flag
        )
    return tags


def tag_problem(name: str, value: str) -> str | None:
    """Why this cannot be a tag, or None."""
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
    """Tags on one line, the named ones first."""
    names = [*(name for name in NAMED if name in tags), *sorted(tags.keys() - set(NAMED))]
    return ", ".join(f"{name}={tags[name]}" for name in names)
