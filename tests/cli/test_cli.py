"""The command line: help, error messages and exit codes."""

import os
import re
import subprocess
import sys

import pytest
from support.paths import ROOT
from support.shell import Shell

from restock import cli, native
from restock.errors import ExitCode
from restock.renamed import OPTIONS
from restock.renamed import VERBS as RENAMED

COMMANDS = [*cli.VERBS, *(f"{verb} {job}" for verb in cli.JOBS for job in cli.JOBS[verb])]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_verb_has_help(command: str, shell: Shell) -> None:
    out = shell.out(*command.split(), "--help")
    assert f"restock {command}" in out
    assert len(out.split()) > 40
    assert not re.search(r"^  --[\w-]+( \S+)?\n  -", out, re.M)  # an option without a text


@pytest.mark.parametrize("command", COMMANDS)
def test_every_verb_is_documented(command: str) -> None:
    pages = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "docs").glob("*.md"))
    assert f"restock {command}" in pages


@pytest.mark.parametrize("verb", RENAMED)
def test_renamed_verb_suggests_new_name(verb, shell):
    err = shell.err(verb, "store")
    assert RENAMED[verb] in err
    named = re.findall(r"`restock (\w+)(?: (\w+))?", err)
    assert all(new in cli.VERBS and verb != new for new, _ in named)


@pytest.mark.parametrize("option", OPTIONS)
def test_removed_option_suggests_replacement(option, shell):
    command = option.rpartition(" ")[0] or "sql"
    assert OPTIONS[option] in shell.err(
        *command.split(), "place", f"--{option.partition('--')[2]}=1"
    )


@pytest.mark.parametrize("words", [["store"], ["store", "none"], ["twin", "none"]], ids=" ".join)
def test_missing_job_lists_jobs(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == ExitCode.USAGE
    printed = "".join(capsys.readouterr())
    assert all(job in printed for job in cli.JOBS[words[0]])


def test_unknown_verb_suggests_nearest(shell: Shell) -> None:
    out, err = shell.printed("inget", code=2)
    assert out == ""
    assert "no verb named 'inget'" in err
    assert "restock ingest" in err


def test_version_is_printed() -> None:
    command = [sys.executable, "-m", "restock", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("restock 0.")
    assert f"\nnative code {native.state()}\n" in done.stdout


PRINTS = """
import sys
from pathlib import Path
from restock import cli
from restock.cli import output
cli._dispatch = lambda args: output.print_wrapped("8 checks: 8 pass")
sys.exit(cli.main([]))
"""


@pytest.mark.parametrize("python", [["-m", "restock", "info", "--help"], ["-c", PRINTS]])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_closed_pipe_is_not_an_error(python: list[str], unbuffered: str) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "wb") as closed:
        done = subprocess.run(
            [sys.executable, *python],
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.stderr == ""
    assert done.returncode == 0


def test_many_rows_are_cut_only_on_terminal(store_path, monkeypatch, shell):
    store = str(store_path)
    columns = "i AS number, range(30) AS numbers, '[a]' || chr(10) || 'b' AS text"
    query = f"SELECT {columns} FROM range(100) AS t(i)"
    lines = shell.out("sql", store, query).splitlines()
    assert len(lines) == 2 + 100  # a header, a rule, and every row on one line
    assert lines[0].split() == ["number", "numbers", "text"]
    assert lines[-1].split()[0] == "99"
    assert lines[-1].endswith(r"[a]\nb")
    assert lines[-1].count(",") == 29
    lines = shell.out("sql", store, f"FROM ({query}) LIMIT 2 \\G").splitlines()
    assert [line.split()[0] for line in lines] == ["row", "number", "numbers", "text"] * 2

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    out, err = shell.printed("sql", store, query)
    assert [line.split()[0] for line in out.splitlines()[2:]] == [str(n) for n in range(40)]
    assert "100 rows, 40 shown" in err
    assert "… 30 in all" in shell.out("sql", store, f"FROM ({query}) LIMIT 1 \\G")


def test_terminal_omits_middle_columns(store_path, monkeypatch, shell):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "40")
    named = ", ".join(f"{number} AS c_{number}" for number in range(1, 20))
    query = f"SELECT NULL AS first, {named}, {{'a': [1, NULL]}} AS last"
    out, err = shell.printed("sql", store_path, query)
    header, _, row = out.splitlines()
    assert max(map(len, out.splitlines())) <= 40
    assert header.split()[0] == "first"
    assert header.split()[-1] == "last"
    assert header.split().count("…") == 1
    assert row.split()[0] == "NULL"
    assert row.endswith("{a: [1, NULL]}")
    assert f"21 columns, {len(header.split()) - 1} shown" in err


@pytest.mark.parametrize(
    "words",
    [
        ["eval", "run", "--on-logs", "own", "--video"],
        ["diagnose", "run", "--seed", "3"],
        ["coverage", "gaps", "store", "--min-rows", "-4"],
        ["export", "run", "--to", "onnx", "--out", "p.onnx", "--cameras", "front"],
        ["audit", "store", "--capacity", "--strict"],
        ["audit", "runs/a", "--reward", "--baseline", "planner"],
    ],
    ids=" ".join,
)
def test_option_without_effect_is_refused(words, shell):
    *_, last = (word for word in words if word.startswith("--"))
    assert last in shell.err(*words)


@pytest.mark.parametrize(
    "words",
    [
        ["ingest", "", "--store", "s"],
        ["start", "", "--out", "s"],
        ["train", "--panel", "", "--out", "s"],
        ["compare", "a", "", "--against", "b"],
    ],
    ids=" ".join,
)
def test_empty_path_is_refused(words, tmp_path, monkeypatch, shell):
    monkeypatch.chdir(tmp_path)
    assert "variable of the shell not set" in shell.err(*words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("more", ["info", "ingest --store s", "sql FROM", "mix --out p"])
def test_credentials_in_address_are_masked(more, shell):
    verb, *words = more.split()
    printed = "".join(shell.printed(verb, "s3://AKIA:hu/sh@bucket/logs", *words, code=2))
    assert "***:***@bucket/logs" in printed
    assert "hu/sh" not in printed
