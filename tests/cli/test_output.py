"""Tables and messages: for a terminal, without colours, and for a pipe."""

from __future__ import annotations

import sys

import pytest

from restock import cli
from restock.cli import output

ROWS = [
    {"audit": "aisles", "status": "fail", "rows": 12_345, "what": "words of it " * 20},
    {"audit": "batteries", "status": "pass", "rows": 0, "what": "short"},
]


def test_a_pipe_gets_all_of_a_table_in_120_columns(capsys: pytest.CaptureFixture[str]) -> None:
    output.print_table(ROWS, title="found")
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 120
    assert text.count("words of it") + text.count("words of\n") >= 18
    assert text.split().count("words") == 20
    assert "12,345" in text
    assert "\x1b" not in text


def test_prose_is_one_line_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    output.stdout().print("a long sentence " * 30)
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_a_message_is_said_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    line = f"wrote runs/a[old]/{'x' * 90}[/y]/:key:.html"
    output.say(line)
    assert capsys.readouterr().err == f"{line}\n"


def test_a_terminal_tells_fail_from_pass_and_is_never_overrun(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "72")
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    output.print_table(ROWS)
    text = capsys.readouterr().out
    assert "\x1b[1;31mfail\x1b[0m" in text
    assert "\x1b[32mpass\x1b[0m" in text
    monkeypatch.setenv("NO_COLOR", "1")
    output.print_table(ROWS)
    text = capsys.readouterr().out
    assert "31m" not in text
    assert "32m" not in text
    bare = text.replace("\x1b[1m", "").replace("\x1b[0m", "")
    assert max(map(len, bare.splitlines())) <= 72


def test_forced_colours_do_not_reach_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    output.print_table(ROWS)
    assert "\x1b" not in capsys.readouterr().out


def test_an_error_is_red_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["inget"]) == 2
    assert capsys.readouterr().err.startswith("restock: no verb")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert cli.main(["inget"]) == 2
    assert capsys.readouterr().err.startswith("\x1b[1;31mrestock:\x1b[0m no verb")
    monkeypatch.setenv("NO_COLOR", "1")
    assert cli.main(["inget"]) == 2
    assert capsys.readouterr().err.startswith("restock: no verb")


@pytest.mark.parametrize("verb", cli.VERBS)
def test_help_has_no_noise(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "{None" not in text
    assert "None)" not in text
    assert "(default: False)" not in text
