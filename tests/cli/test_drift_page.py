"""`restock coverage drift`: changes are reported as text, JSON and a page."""

from pathlib import Path

import pytest
from support.fleets import SyntheticRobot, fleet_store
from support.page_scripts import Page
from support.shell import Shell

from restock import cli

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    worn = SyntheticRobot("amr-2", changes={"odometry_scale": 0.93})
    robots = [SyntheticRobot(HOSTILE), worn]
    return fleet_store(tmp_path_factory.mktemp("fleet") / "store", robots, recordings=3)


def test_drift_verb_reports_worn_wheel(store: Path, shell: Shell) -> None:
    out = shell.out("coverage", "drift", store)
    assert "amr-2: wheels: odometry_scale 0.9" in out
    assert "since 2026-03-16 (2 of 2 weeks)" in out
    assert cli.main(["coverage", "drift", str(store), "--exit-code"]) == 1


def test_page_matches_json_and_escapes_names(store, tmp_path, shell):
    page = tmp_path / "pages" / "coverage.html"
    document = shell.json("coverage", "drift", store)
    assert cli.main(["coverage", str(store), "--out", str(page)]) == 0
    assert {row["robot"] for row in document["findings"] if row["part"] == "wheels"} == {"amr-2"}
    assert {row["against"] for row in document["tests"]} == {"own reference", "other robots"}
    read = Page(page.read_text("utf-8"))
    assert "Changed: wheels of amr-2" in read.text
    assert "2026-03-16" in read.text
    assert HOSTILE in read.text


def test_untestable_fleet_is_reported(tmp_path, shell):
    store = fleet_store(tmp_path / "store", [SyntheticRobot(None)], weeks=1, episodes=2)
    page = tmp_path / "coverage.html"
    assert cli.main(["coverage", str(store), "--out", str(page)]) == 0
    out = shell.out("coverage", "drift", store, "--exit-code")
    assert "<code>restock ingest --tag robot=NAME</code>" in page.read_text(encoding="utf-8")
    assert "untagged drove in one week only" in out
    assert "--tag robot=NAME" in out
    reason = "Nothing could be tested: every robot drove in one week only, so none has a reference."
    for text in (page.read_text("utf-8"), out):
        assert reason in text
        assert "at least 5 episodes in each" in text
        assert "no change that matters" not in text.lower()


def test_no_change_is_reported_with_number_of_tests(tmp_path, shell):
    store = fleet_store(tmp_path / "store", [SyntheticRobot("amr-1")], recordings=3)
    document = shell.json("coverage", "drift", store)
    own = [row for row in document["tests"] if row["against"] == "own reference"]
    tests = sum(row["p"] is not None for row in own)
    assert document["findings"] == []
    assert document["tested"] == tests > 0
    text = f"No change that matters was found in {tests} tests against the robots' own references"
    assert text in shell.out("coverage", "drift", store)
