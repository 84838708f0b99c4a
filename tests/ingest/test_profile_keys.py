"""docs/profile.md has every key of the tables that it is of, with its default."""

import re
import tomllib

import msgspec
import pytest
from support.paths import ROOT

from restock.ingest.profile.tables import Clock, Episodes, Frames, Input, Motion, Zone
from restock.ingest.task.task import Body, Rewards, Task

PAGE = (ROOT / "docs" / "profile.md").read_text("utf-8").partition("## Keys of a profile")[2]
TABLES_WITHIN = {"body", "rewards"}


def documented() -> dict[str, dict[str, str]]:
    """heading -> key -> its default, as the page has them."""
    found: dict[str, dict[str, str]] = {}
    heading = ""
    for line in PAGE.splitlines():
        if line.startswith("#"):
            heading = line.lstrip("# ")
        elif line.startswith("| `"):
            keys, *_, default = (cell.strip() for cell in line.strip("|").split(" | "))
            names = re.findall(r"`([^`]+)`", keys)
            defaults = re.findall(r"`([^`]+)`", default.strip(" |"))
            rows = found.setdefault(heading, {})
            rows |= dict(zip(names, defaults or [""] * len(names), strict=True))
    return found


@pytest.mark.parametrize(
    ("kind", "heading", "prefix"),
    [
        (Input, "`[inputs.NAME]`", ""),
        (Task, "`[task]`", ""),
        (Body, "`[task.body]`", ""),
        (Rewards, "`[task.rewards]`", ""),
        (Clock, "`[clock]`", ""),
        (Episodes, "`[episodes]`", ""),
        (Frames, "`[frames]`, `[motion]` and `[[zone]]`", "frames."),
        (Motion, "`[frames]`, `[motion]` and `[[zone]]`", "motion."),
        (Zone, "`[frames]`, `[motion]` and `[[zone]]`", "zone."),
    ],
)
def test_the_page_has_every_key_and_its_default(kind, heading, prefix):
    rows = documented()[heading]
    fields = {field.encode_name: field.default for field in msgspec.structs.fields(kind)}
    keys = {key.removeprefix(prefix) for key in rows if key.startswith(prefix)}
    assert keys == fields.keys() - TABLES_WITHIN
    for key in keys:
        said, default = rows[prefix + key], fields[key]
        if default in (msgspec.NODEFAULT, msgspec.UNSET, None):
            assert said == "", key
        else:
            assert tomllib.loads(f"value = {said}")["value"] == default, key
