"""Where a recording's tags come from: the command line, the recording itself, the path it lies at.

What the command line says decides. The recording's own metadata and its path must not contradict
each other; where both say the same, or one of them nothing, there is no question.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from restock.errors import RecordingError


@dataclass
class Told:
    """Tags of a recording, and what there is to say of them."""

    tags: dict[str, str]
    notes: list[str] = field(default_factory=list)


def resolve_tags(
    sources: Mapping[str, Mapping[str, str]],
    given: Mapping[str, str],
    before: Mapping[str, str],
    where: str,
) -> Told:
    """The tags of one recording.

    Args:
        sources: what the recording and its path say, by the name of each source.
        given: what the command line says: it decides, and an empty value takes a tag off.
        before: the recording's tags in the store: those that nothing speaks of any more stay.
        where: the recording, for errors.

    Raises:
        RecordingError: two sources disagree, and the command line does not decide.
    """
    tags = dict(given)
    by: dict[str, str] = {}
    for source, said in sources.items():
        for name, value in said.items():
            if name in given:
                continue
            if tags.setdefault(name, value) != value:
                raise RecordingError(
                    f"its tag {name!r} is {tags[name]!r} by {by[name]}, and {value!r} by {source}",
                    where=where,
                    remedy=f"say which it is: --tag {name}={tags[name]} or --tag {name}={value}",
                )
            by.setdefault(name, source)
    kept = {name: value for name, value in before.items() if name not in tags}
    tags |= kept
    told = Told({name: value for name, value in tags.items() if value})
    if kept:
        names = ", ".join(f"{name}={value}" for name, value in sorted(kept.items()))
        told.notes.append(f"tags kept from the ingest before: {names} (--tag NAME= takes one off)")
    return told
