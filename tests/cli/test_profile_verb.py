"""`restock profile`: what it says of data that was lost, and the exit codes."""

import json

from support.driven_robot import Drive, cut_bag, write_bag

from restock import cli


def test_losses_are_reported_by_new_and_by_check(tmp_path, capsys):
    """Of a bag whose ingest ended with 3, `new` said nothing, and both ended with 0."""
    cut = cut_bag(tmp_path / "bags" / "cut")
    file = tmp_path / "robot.toml"
    assert cli.main(["profile", "new", str(cut), "--out", str(file), "--salvage"]) == 3
    said = capsys.readouterr().err
    (first, *_) = [line for line in said.splitlines() if line.startswith("lost: ")]
    assert str(cut) in first
    assert f"# LOST: {first.removeprefix('lost: ')}\n" in file.read_text()
    assert "cannot be used yet" not in said

    check = ["profile", "check", str(file), str(cut), "--salvage"]
    assert cli.main(check) == 3
    assert "lost: " in capsys.readouterr().out
    assert cli.main([*check, "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["outcome"]["losses"]

    whole = write_bag(Drive(), tmp_path / "whole")
    assert cli.main(["profile", "new", str(whole), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["losses"] == []
    assert cli.main(["profile", "check", str(file), str(whole)]) == 0
