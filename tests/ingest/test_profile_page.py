"""docs/profile.md: what it shows on sample_logs/ is what comes out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.paths import ROOT

from restock.cli import main

PAGE = (ROOT / "docs" / "profile.md").read_text(encoding="utf-8")


def block(start: str) -> str:
    """An indented block of the page, by how it starts, without its indentation."""
    found = re.search(rf"^    {re.escape(start)}.*?(?=\n\S)", PAGE, re.M | re.S)
    assert found is not None, start
    return re.sub(r"^    ", "", found[0], flags=re.M).strip() + "\n"


def printed(capsys: pytest.CaptureFixture[str]) -> dict:
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow  # two ingests of all sample logs
def test_the_page_on_the_sample_logs(tmp_path, monkeypatch, capsys):
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    monkeypatch.chdir(tmp_path)
    assert main(["profile", "new", "sample_logs/amr_tuesday", "--out", "amr.toml"]) == 0
    profile, sql = Path("amr.toml"), Path("sagging.sql")
    name = "diagnostics_battery_voltage_v"
    assert f"uncomment `[signals.{name}]` as `battery_v`" in PAGE
    text = profile.read_text().replace("length_m = 0.6", "length_m = 0.7")
    table = re.search(rf"^# \[signals\.{name}\].*?(?=\n\n)", text, re.M | re.S)
    assert table is not None
    taken = re.sub(r"^# ", "", table[0], flags=re.M).replace(name, "battery_v")
    own = '\n[[condition]]\nfile = "sagging.sql"\n'
    assert own.strip() in block("[[condition]]\n    file")
    profile.write_text(text.replace(table[0], taken) + own)
    sql.write_text(block("-- The battery's voltage sags").split("\n$ ")[0])
    ingest = ["ingest", "sample_logs/", "--profile", "amr.toml", "--store", "store"]
    assert main([*ingest, "--json"]) == 0
    first = {one["path"]: one for one in printed(capsys)["recordings"]}
    assert all(one["conditions"]["sagging"] == 0 for one in first.values())
    for path, one in first.items():
        assert re.search(rf"^     {re.escape(path)} .* {one['transitions']:,}$", PAGE, re.M)

    assert "With 26.25 V in the file" in PAGE
    sql.write_text(sql.read_text().replace("25.8", "26.25"))
    assert main([*ingest[:1], "sample_logs/amr_tuesday", *ingest[2:], "--json"]) == 0
    capsys.readouterr()
    main(["audit", "store", "--json"])
    (stale,) = [one for one in printed(capsys)["audits"] if one["audit"] == "stale_labels"]
    assert [row["source_file"] for row in stale["sample"]] == ["sample_logs/amr_monday.mcap"]
    assert stale["advice"] in PAGE
    assert main(["label", "store", "--profile", "amr.toml", "--json"]) == 0
    for row in printed(capsys)["recordings"]:
        same = row["before"] == row["after"]
        labels = f"{row['after']}, unchanged" if same else f"{row['before']} -> {row['after']}"
        shown = rf"{re.escape(row['source_file'])} +{re.escape(labels)} +{row['changed']:,}$"
        assert re.search(shown, PAGE, re.M), shown
    main(["audit", "store", "--json"])
    (stale,) = [one for one in printed(capsys)["audits"] if one["audit"] == "stale_labels"]
    assert stale["rows"] == 0
    assert main([*ingest, "--json"]) == 0
    assert {one["status"] for one in printed(capsys)["recordings"]} == {"unchanged"}


def test_every_key_of_a_signal_and_every_reduction_is_on_the_page():
    from typing import get_args

    from restock.ingest.profile.custom_signal import CustomSignal, Reduce
    from restock.ingest.profile.tables import Frames

    for name in (*CustomSignal.__struct_fields__, *get_args(Reduce)):
        assert f"`{name}`" in PAGE or f"`{name} = " in PAGE, name
    for name in ("fixed", "base", "max_age_s"):
        assert name in Frames.__struct_fields__
        assert re.search(rf"^{name} = ", PAGE, re.M), name
