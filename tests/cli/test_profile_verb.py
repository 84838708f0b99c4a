"""`restock profile`: reports of lost data, and exit codes."""

from support.driven_robot import Drive, cut_bag, write_bag

from restock import cli


def test_losses_are_reported_by_new_and_check(tmp_path, shell):
    """Regression: `new` did not report losses, and both verbs exited with 0."""
    cut = cut_bag(tmp_path / "bags" / "cut")
    file = tmp_path / "robot.toml"
    err = shell.err("profile", "new", cut, "--out", file, "--salvage", code=3)
    (first, *_) = [line for line in err.splitlines() if line.startswith("lost: ")]
    assert str(cut) in first
    assert f"# LOST: {first.removeprefix('lost: ')}\n" in file.read_text()
    assert "cannot be used yet" not in err

    check = ["profile", "check", str(file), str(cut), "--salvage"]
    assert "lost: " in shell.out(*check, code=3)
    assert shell.json(*check, code=3)["outcome"]["losses"]

    whole = write_bag(Drive(), tmp_path / "whole")
    assert shell.json("profile", "new", whole)["losses"] == []
    assert cli.main(["profile", "check", str(file), str(whole)]) == 0
