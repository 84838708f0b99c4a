"""Completion: the scripts that `restock --tyro-write-completion` writes."""

import subprocess
from pathlib import Path

import pytest

from restock import cli


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_script_has_every_verb(shell: str, tmp_path: Path) -> None:
    script = tmp_path / "restock"
    assert cli.main([cli.COMPLETION, shell, str(script)]) == 0
    text = script.read_text(encoding="utf-8")
    assert [verb for verb in cli.VERBS if verb not in text] == []
    assert "--trust-position-m" in text  # of a job
    if shell == "bash":
        assert subprocess.run(["bash", "-n", str(script)], capture_output=True).stderr == b""
