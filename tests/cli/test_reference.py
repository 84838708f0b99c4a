"""docs/cli.md: it is current, and has every verb, job and option that `--help` has."""

from __future__ import annotations

import re

import pytest
from support.paths import ROOT

from restock.cli import VERBS, main
from restock.cli.completion import every_verb
from restock.cli.reference import rewrite

PAGE = (ROOT / "docs/cli.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^###? restock ([\w ]+)\n(.*?)(?=^##|\Z)", PAGE, re.S | re.M))


def test_the_page_of_verbs_is_current() -> None:
    assert rewrite(PAGE) == PAGE, "run: python -m restock.cli.reference docs/cli.md"
    jobs = [f"twin {job}" for job in ("fit", "gap", "layout", "robot")]
    assert sorted(SECTIONS) == sorted([*VERBS, *jobs])


@pytest.mark.parametrize("verb", SECTIONS)
def test_a_section_has_what_the_help_has(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*verb.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    listed = [one.strip("[]…") for one in re.findall(r"^- `([^ `]*)", SECTIONS[verb], re.M)]
    assert [one for one in listed if one not in shown] == []
    words = every_verb()[verb.split()[0]]
    for job in verb.split()[1:]:
        words = words.jobs[job]
    completed = [] if words.jobs else [one for one in words.options if one != "--help"]
    assert [one for one in listed if one.startswith("--")] == completed


def test_a_default_and_what_is_required_are_said() -> None:
    assert "restock export SOURCE --to {minari" in SECTIONS["export"]
    assert "--out OUT`: The file or directory to write, which must not exist yet. Required." in PAGE
    assert re.search(r"^- `--horizon-s X`: .* Default: `3.0`\.$", SECTIONS["twin fit"], re.M)
    assert "MISSING" not in PAGE


def test_the_page_is_in_the_index_and_the_navigation() -> None:
    assert "(cli.md)" in (ROOT / "docs/index.md").read_text(encoding="utf-8")
    assert "      - cli.md\n" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
