"""Run the tutorial, whose page and notebook have one source."""

import re
from pathlib import Path

import nbformat
import pytest
from support.notebook import cells_of, executed, filled, notebook_of, text_of
from support.paths import ROOT

PAGE = ROOT / "docs/tutorial.md"


def check_verdicts(notebook: nbformat.NotebookNode) -> None:
    """Check that the text states the verdicts that its cells print."""
    outputs = {cell.source: text_of(cell) for cell in notebook.cells if cell.cell_type == "code"}

    def of(words: str) -> str:
        (text,) = [text for source, text in outputs.items() if words in source]
        return text

    assert "REFUSED" in of("restock compare plain unnormed")
    assert of("fair = compare").startswith("comparable\n")
    # On other processors, rounding may add a condition of few rows to the cause.
    assert re.search(r"^(TARGET|BOTH)$", of("restock diagnose frozen"), re.MULTILINE)
    assert re.search(r"^BUFFER$", of("restock diagnose dry"), re.MULTILINE)
    figures = re.findall(r"(\w+): L ([\d.]+) .*, supply of slip ([\d.]+) ", of("figures = {"))
    lag, supply = ({row[0]: float(row[at]) for row in figures} for at in (1, 2))
    assert max(lag["sound"], lag["dry"]) < 0.25 < lag["frozen"]
    assert supply["dry"] < 0.1 < min(supply["sound"], supply["frozen"])


def test_page_and_notebook_convert_both_ways() -> None:
    page = """# A page

```python
print("one")
```

<!-- output -->

```text
old
```

<!-- end of output -->

<!-- exit codes: 1 -->
```sh
false
```

The end.
"""
    assert cells_of(page) == [
        ("markdown", "# A page"),
        ("code", 'print("one")'),
        ("code", "%%bash --no-raise-error\nfalse"),
        ("markdown", "The end."),
    ]
    notebook = notebook_of(page)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    code[0].outputs = [nbformat.v4.new_output("stream", text="one\n")]
    assert filled(page, notebook, "pictures") == page.replace("old", "one")


@pytest.mark.docs
@pytest.mark.timeout(900)
def test_tutorial_runs_with_stated_verdicts(tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    docs.mkdir()
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    notebook = executed(notebook_of(PAGE.read_text(encoding="utf-8")), docs)
    check_verdicts(notebook)
