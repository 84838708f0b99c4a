"""docs/profile.md: its console examples on sample_logs/ run as shown, and its keys are complete."""

import re
import shlex
import tomllib
from pathlib import Path

import msgspec
import pytest
from support.pages import Block, blocks
from support.paths import ROOT

from restock.cli import main
from restock.ingest.profile.tables import Clock, Episodes, Frames, Input, Motion, Zone
from restock.ingest.task.task import Body, Rewards, Task

PATH = ROOT / "docs" / "profile.md"
PAGE = PATH.read_text(encoding="utf-8")
FIRST_LINE = PAGE[: PAGE.index("\n## The same on sample_logs/\n")].count("\n")
BLOCKS = [block for block in blocks(PATH) if block.line > FIRST_LINE]
FILES = {block.marks["file"]: block.text for block in BLOCKS if "file" in block.marks}
TABLES_WITHIN = {"body", "rewards"}


def assert_prints_as_shown(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a console block: commands print the lines below them; `…` matches any ending."""
    for part in block.text.removeprefix("$ ").split("\n$ "):
        command, *shown = part.splitlines()
        capsys.readouterr()
        main(shlex.split(command)[1:])
        output = capsys.readouterr().out
        printed = iter(line.rstrip() for line in output.splitlines())
        for line in shown:
            start, left_out, _ = line.partition("…")
            found = any(
                printed_line.startswith(start) if left_out else printed_line == line
                for printed_line in printed
            )
            assert found, f"{block.place}: {command}: no line {line!r} in\n{output}"


@pytest.mark.slow  # two ingests of all sample logs
def test_profile_page_examples_on_sample_logs(tmp_path, monkeypatch, capsys, shell):
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    monkeypatch.chdir(tmp_path)
    ingested, audited, labelled = [block for block in BLOCKS if block.language == "console"]

    assert main(["profile", "new", "sample_logs/amr_tuesday", "--out", "amr.toml"]) == 0
    profile, sql = Path("amr.toml"), Path("sagging.sql")
    name = "diagnostics_battery_voltage_v"
    assert f"uncomment `[signals.{name}]` as `battery_v`, set `length_m` to\n`0.7`" in PAGE
    text = re.sub(r"(?m)^length_m = [\d.]+", "length_m = 0.7", profile.read_text())
    table = re.search(rf"^# \[signals\.{name}\].*?(?=\n\n)", text, re.M | re.S)
    assert table is not None
    taken = re.sub(r"^# ", "", table[0], flags=re.M).replace(name, "battery_v")
    profile.write_text(text.replace(table[0], taken) + FILES["sagging.toml"])
    sql.write_text(FILES["sagging.sql"])
    assert_prints_as_shown(ingested, capsys)

    assert "With 26.25 V in the file" in PAGE
    sql.write_text(sql.read_text().replace("25.8", "26.25"))
    assert_prints_as_shown(audited, capsys)
    assert_prints_as_shown(labelled, capsys)

    audits = shell.json("audit", "store", code={0, 1, 3})["audits"]
    assert [audit["rows"] for audit in audits if audit["audit"] == "stale_labels"] == [0]
    again = shell.json("ingest", "sample_logs/", "--profile", "amr.toml", "--store", "store")
    assert {recording["status"] for recording in again["recordings"]} == {"unchanged"}


def documented_defaults() -> dict[str, dict[str, str]]:
    """Return the defaults on the page by heading and key."""
    found: dict[str, dict[str, str]] = {}
    heading = ""
    for line in PAGE.partition("## Keys of a profile")[2].splitlines():
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
def test_profile_page_has_every_key_and_default(kind, heading, prefix):
    rows = documented_defaults()[heading]
    fields = {field.encode_name: field.default for field in msgspec.structs.fields(kind)}
    keys = {key.removeprefix(prefix) for key in rows if key.startswith(prefix)}
    assert keys == fields.keys() - TABLES_WITHIN
    for key in keys:
        documented, default = rows[prefix + key], fields[key]
        if default in (msgspec.NODEFAULT, msgspec.UNSET, None):
            assert documented == "", key
        else:
            assert tomllib.loads(f"value = {documented}")["value"] == default, key
