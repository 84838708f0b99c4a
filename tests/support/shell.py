"""What a user types: a verb in this process, that must end with a code, and what it printed."""

import json
from typing import Any

import pytest

from restock.cli import main


class Shell:
    """Runs `restock WORDS`, whose words may be paths."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys

    def printed(self, *words: object, code: int = 0) -> tuple[str, str]:
        """Return what it printed on stdout and stderr."""
        self.capsys.readouterr()
        assert main([*map(str, words)]) == code
        return tuple(self.capsys.readouterr())

    def out(self, *words: object, code: int = 0) -> str:
        return self.printed(*words, code=code)[0]

    def err(self, *words: object, code: int = 2) -> str:
        return self.printed(*words, code=code)[1]

    def json(self, *words: object, code: int = 0) -> Any:
        """Return the document that it prints with --json."""
        return json.loads(self.out(*words, "--json", code=code))
