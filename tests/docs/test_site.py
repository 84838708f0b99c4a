"""The documentation as a site: it opens from a disk, without a network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT


@pytest.mark.long
def test_pages_and_search_load_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=True)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link)\b[^>]* (?:src|href)="([^"]*)"', page)
    assert "javascripts/iframe-worker.js" in loaded  # without it there is no search from file://
    assert [one for one in loaded if not (tmp_path / one).is_file()] == []
    index = (tmp_path / "search/search_index.js").read_text(encoding="utf-8")
    assert index.startswith("var __index = {")
