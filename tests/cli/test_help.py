"""`--help` prints prose as wide as its boxes, without empty lines, coloured on terminals only."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest

from restock import cli

COLUMNS = (72, 80, 90, 120)


def lines_of(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    """Return a help without the line of its usage."""
    assert cli.main([*words, "--help"]) == 0
    usage, *lines = capsys.readouterr().out.splitlines()
    assert usage.startswith(f"usage: restock {' '.join(words)}")
    return lines


@pytest.mark.parametrize("command", [name for name in cli.FOLDER_OF if name != "study"])
def test_prose_is_wrapped_and_parted_by_single_empty_lines(command, monkeypatch, capsys):
    for columns in COLUMNS:
        monkeypatch.setenv("COLUMNS", str(columns))
        lines = lines_of(capsys, *command.split())
        long = [line for line in lines if len(line) > columns]
        assert [line for line in long if not line.startswith("    ")] == []  # an example
        assert [line for line in lines if not line.strip("│ ") and line] == []  # in a box
        assert ["", ""] not in [lines[at : at + 2] for at in range(len(lines))]


def test_the_jobs_of_a_verb_are_listed_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    text = "\n".join(lines_of(capsys, "twin"))
    assert "  layout  describe a floor\n" in text
    assert "--png" not in text
    assert "--png" in "\n".join(lines_of(capsys, "twin", "layout"))


def on_a_terminal(*words: str, **environment: str) -> str:
    """Return what a command prints on a terminal, stdout and stderr."""
    ours, theirs = pty.openpty()
    others = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    process = subprocess.Popen(
        [sys.executable, "-m", "restock", *words],
        env=others | {"TERM": "xterm-256color", "COLUMNS": "90"} | environment,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    read = b""
    try:
        while part := os.read(ours, 1 << 16):
            read += part
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    process.wait()
    return read.decode()


@pytest.mark.parametrize("words", [("mix", "--help"), ("mix", "--mxture", "a")], ids=" ".join)
def test_no_color_takes_the_colours_off(words: tuple[str, ...]) -> None:
    assert "\x1b[" in on_a_terminal(*words)
    assert "\x1b" not in on_a_terminal(*words, NO_COLOR="1")
