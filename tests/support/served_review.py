"""`restock review` as a process of its own, to open in a browser, to end and to kill."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any


class ServedReview:
    """A server on a store. Close it with Ctrl-C, or `kill` it."""

    def __init__(self, store: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "restock", "review", str(store), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        text = ""
        for line in self.process.stdout:
            text += line
            if line.startswith("}"):
                break
        assert text, self.process.communicate()[1]
        document: dict[str, Any] = json.loads(text)
        self.address = str(document["address"])

    def __enter__(self) -> "ServedReview":
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.end()

    def end(self) -> tuple[int, str]:
        """End it with Ctrl-C; return its exit code and what it said."""
        self.process.send_signal(signal.SIGINT)
        said = self.process.communicate(timeout=120)[1]
        return self.process.returncode, said

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()
