"""Exports read back by libraries that cannot live in this environment."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.paths import ROOT


def read_with(library: str, *paths: Path) -> Any:
    """Read with the real library, in a Python that has it; skip the test if none has."""
    apart = ROOT / ".venv-neighbours" / "bin" / "python"
    python = os.environ.get("RESTOCK_NEIGHBOURS_PYTHON") or str(
        apart if apart.exists() else sys.executable
    )
    probe = f"import importlib.util as u; raise SystemExit(u.find_spec('{library}') is None)"
    if subprocess.run([python, "-c", probe], check=False).returncode:
        pytest.skip(f"{python} has no {library}")
    done = subprocess.run(
        [python, ROOT / "tests" / "replay" / f"read_with_{library}.py", *paths],
        capture_output=True,
        text=True,
        check=False,
        cwd=paths[0].parent,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])
