"""Build the documentation site and check that it opens without a network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT


@pytest.mark.long
def test_site_builds_and_loads_nothing_external(tmp_path: Path) -> None:
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    config = config.replace("build/pages", "pages").replace("build/site", "site")
    (tmp_path / "mkdocs.yml").write_text(config.replace("[src]", f"[{ROOT / 'src'}]"))
    subprocess.run([sys.executable, ROOT / "docs/build.py", tmp_path / "pages"], check=True)
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    subprocess.run(command, cwd=tmp_path, check=True)

    site = tmp_path / "site"
    page = (site / "index.html").read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link)\b[^>]* (?:src|href)="([^"]*)"', page)
    assert "./javascripts/iframe-worker.js" in loaded  # needed for search from file://
    assert [one for one in loaded if not (site / one).is_file()] == []
    assert (site / "search.js").is_file()
    reference = (site / "reference.html").read_text(encoding="utf-8")
    assert "build_panel" in reference
    assert "restock ingest" in reference
