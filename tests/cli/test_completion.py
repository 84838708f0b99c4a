"""Completion: the scripts of `restock completion`, asked by the shells that read them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from restock import cli
from restock.cli import completion


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "restock.bash"
    path.write_text(completion.bash(), encoding="utf-8")
    return path


def tab(script: Path, *words: str) -> list[str]:
    """What bash offers for the last word."""
    line = (
        'source "$0"; COMP_WORDS=(restock "$@"); COMP_CWORD=$#; _restock;'
        ' printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", line, str(script), *words], capture_output=True, text=True
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["in"], ["info", "ingest"]),
        (["ingest", "--eng"], ["--engine"]),
        (["ingest", "--engine", ""], ["processes", "ray"]),
        (["profile", ""], ["new", "check"]),
        (["twin", ""], ["fit", "gap", "layout", "robot"]),
        (["twin", "gap", "--trust-p"], ["--trust-position-m"]),
        (["eval", "runs/a", "--no"], ["--no-drive"]),
        (["compare", "a", "b", "--treatment", "m"], ["mixture", "method"]),
        (["sql", "store", "--ru"], ["--run"]),
        (["schema", "st"], ["study"]),
        (["schema", "m"], ["mixture", "missions"]),
        (["mix", "store", "--mixture", ""], ["coverage", "exposure", "steps", "uniform"]),
        (["coverage", "store", "--mixture", "uni"], ["uniform"]),
        (["ingest", "bag", "--profile", "ware"], ["warehouse_amr"]),
        (["mix", "store", "--mixture", "my_own"], []),  # a file, as well
        (["ingest", "bag"], []),  # a file: bash's own completion
    ],
    ids=lambda value: " ".join(value),
)
def test_bash_completes(words: list[str], offered: list[str], script: Path) -> None:
    assert tab(script, *words) == offered


def test_every_verb_and_each_of_its_options_are_there(
    script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As its help lists them: a verb that is added is completed, and one that is renamed."""
    assert set(cli.VERBS) <= set(tab(script, ""))
    for verb, words in completion.every_verb().items():
        if words.jobs:
            continue
        assert cli.main([verb, "--help"]) == 0
        text = capsys.readouterr().out
        assert [flag for flag in words.options if flag not in text] == [], verb
        listed = {word.strip(",") for word in text.split() if word.startswith("--")}
        own = {line.split()[1] for line in text.splitlines() if line.startswith("│ --")}
        assert own <= set(words.options), verb
        assert own <= listed


def test_zsh_reads_its_script(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["completion", "zsh"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("#compdef restock\n")
    assert "'ingest:recordings -> labelled Parquet transitions in a store'" in text
    if shutil.which("zsh") is None:
        pytest.skip("no zsh here")
    (tmp_path / "_restock").write_text(text, encoding="utf-8")
    done = subprocess.run(["zsh", "-n", str(tmp_path / "_restock")], capture_output=True)
    assert done.returncode == 0, done.stderr
