"""A folder of recordings: a line per recording, and a total with the figures of --json."""

from collections import Counter
from pathlib import Path

import pytest
from support.driven_robot import cut_bag, write_bags
from support.paths import SHARED

from restock.cli import main
from restock.ingest.containers.open_recording import recordings_in


def totals(recordings: list[dict]) -> tuple[int, int, Counter]:
    labels = Counter[str]()
    for one in recordings:
        labels.update({k: v for k, v in one.get("conditions", {}).items() if k != "nominal"})
    done = [one for one in recordings if one["status"] != "failed"]
    dropped = sum(drop["count"] for one in done for drop in one["drops"])
    return sum(one["transitions"] for one in done), dropped, +labels


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_bags(tmp_path_factory.mktemp("bags"), 3)
    cut_bag(folder / "cut")
    return folder


def test_folder_prints_line_per_recording_and_total(bags, tmp_path, shell):
    rows, dropped, labels = totals(shell.json("ingest", bags, "--dry-run", code=3)["recordings"])
    out, err = shell.printed("ingest", bags, "--store", tmp_path / "s", code=3)
    *lines, total = out.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"written   drive{n}" for n in range(3)]
    assert err.startswith("restock: refused   cut: ")
    assert len(err.splitlines()) == 1
    assert total.startswith("total: 4 recordings (written 3, refused 1); ")
    parts = total.split("; ")
    assert f"{rows:,} rows" in parts
    assert f"{dropped:,} ticks dropped" in parts
    assert all(f"{name} {number:,}" in total for name, number in labels.items())

    out = shell.out("ingest", bags, "--store", tmp_path / "s", "--salvage", code=3)
    assert "cut: " in out
    assert "total: 4 recordings (written 1, unchanged 3); " in out
    words = ["ingest", str(bags), "--store", str(tmp_path / "other"), "--profile", "turtlebot3"]
    assert "; 3 gives no transition with the profile 'turtlebot3'; " in shell.out(*words, code=2)
    assert "lost data 1" in out.splitlines()[-1]


def test_single_recording_and_verbose_print_details(bags, shell):
    one = shell.out("ingest", bags / "drive0", "--dry-run")
    assert "episodes ended by: " in one
    out, err = shell.printed("ingest", bags, "--dry-run", "--verbose", code=3)
    assert one in out
    assert "--salvage" in err


def test_info_of_folder_ends_with_totals(bags, shell):
    found = shell.json("info", bags, code=2)["recordings"]
    total, topics = shell.out("info", bags, code=2).splitlines()[-2:]
    assert total.startswith("total: 4 recordings; ")
    assert f"; {sum(one['messages'] for one in found):,} messages; 0 damaged; 1 refused" in total
    assert set.intersection(*(set(one["topics"]) for one in found)) == set(
        topics.removeprefix("topics of all: ").partition(" (")[0].split(", ")
    )


@pytest.mark.skipif(not (SHARED / "fleet-neato").is_dir(), reason="no fleet-neato")
def test_public_fleet_prints_line_per_recording(tmp_path, shell):
    fleet, profile = SHARED / "fleet-neato", tmp_path / "neato.toml"
    main(["profile", "new", str(fleet), "--out", str(profile)])
    words = ["ingest", str(fleet), "--profile", str(profile), "--store", str(tmp_path / "s")]
    out, err = shell.printed(*words, code=3)
    assert len(out.splitlines()) + len(err.splitlines()) == len(recordings_in(fleet)) + 1
    assert "2023-replayed/mac_take_2_bag: 159 rows, 0.8 min, repeats another" in out
