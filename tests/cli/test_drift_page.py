"""`restock drift`: names what changed, as text, JSON and a page."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest
from support.fleets import SyntheticRobot, fleet_store
from support.page_scripts import charts_of

from restock import cli

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    worn = SyntheticRobot("amr-2", changes={"odometry_scale": 0.93})
    robots = [SyntheticRobot(HOSTILE), worn]
    return fleet_store(tmp_path_factory.mktemp("fleet") / "store", robots, recordings=3)


class Text(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def test_it_names_the_worn_wheel(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["drift", str(store)]) == 0
    out = capsys.readouterr().out
    assert "amr-2: wheels: odometry_scale 0.9" in out
    assert "since 2026-03-16 (2 of 2 weeks)" in out
    assert cli.main(["drift", str(store), "--exit-code"]) == 1


def test_the_page_says_the_same_and_trusts_no_name(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "pages" / "drift.html"
    assert cli.main(["drift", str(store), "--out", str(page), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["robot"] for row in document["findings"] if row["part"] == "wheels"} == {"amr-2"}
    assert {row["against"] for row in document["tests"]} == {"own reference", "other robots"}
    read = Text()
    read.feed(page.read_text("utf-8"))
    assert "Changed: wheels of amr-2" in read.text
    assert "2026-03-16" in read.text
    assert HOSTILE in read.text
    charts_of(page.read_text(encoding="utf-8"))
    assert "link" not in read.tags


def test_a_fleet_with_nothing_to_compare_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = fleet_store(tmp_path / "store", [SyntheticRobot(None)], weeks=1, episodes=2)
    page = tmp_path / "drift.html"
    assert cli.main(["drift", str(store), "--out", str(page), "--exit-code"]) == 0
    out = capsys.readouterr().out
    assert "<code>restock ingest --tag robot=NAME</code>" in page.read_text(encoding="utf-8")
    assert "untagged drove in one week only" in out
    assert "--tag robot=NAME" in out
    assert "Too little to compare" in page.read_text("utf-8")
    assert "too little to compare" in out
    assert "no change that matters" not in out


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--every", "fortnight"], "no period 'fortnight'"),
        (["--reference", "0"], "reference must be at least 1"),
        (["--least-episodes", "1"], "least_episodes must be at least 2"),
    ],
)
def test_what_it_cannot_do_is_refused(
    flags: list[str], said: str, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["drift", str(store), *flags]) == 2
    assert said in capsys.readouterr().err
