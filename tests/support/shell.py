"""What a user types: a verb in this process, that must end with a code, and what it printed."""

import contextlib
import io
import json
import sys
from typing import Any

from restock.cli import main


class Shell:
    """Runs `restock WORDS`, whose words may be paths; it ends with a code, or one of a set."""

    def printed(self, *words: object, code: int | set[int] = 0) -> tuple[str, str]:
        """Return what it printed on stdout and stderr."""
        streams = [io.TextIOWrapper(io.BytesIO(), "utf-8", newline="") for _ in "oe"]
        for stream, own in zip(streams, (sys.stdout, sys.stderr), strict=True):
            stream.isatty = own.isatty  # a test says of these that they are terminals
        with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
            found = main([*map(str, words)])
        for stream in streams:
            stream.seek(0)
        out, err = (stream.read() for stream in streams)
        assert found in (code if isinstance(code, set) else {code}), (found, words, out, err)
        return out, err

    def out(self, *words: object, code: int | set[int] = 0) -> str:
        return self.printed(*words, code=code)[0]

    def err(self, *words: object, code: int | set[int] = 2) -> str:
        return self.printed(*words, code=code)[1]

    def json(self, *words: object, code: int | set[int] = 0) -> Any:
        """Return the document that it prints with --json."""
        return json.loads(self.out(*words, "--json", code=code))
