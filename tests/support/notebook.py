"""A page of the documentation as a notebook: one source, executed once, for both.

The page is the source. Each of its `sh` and `python` blocks becomes a cell, what is between them
becomes text. Executing writes what the cells put out into the page, between the marks

    <!-- output: clocks.png: what the picture shows -->     a picture's name, where there is one
    <!-- end of output -->

and into a notebook beside the other things that are built:

    python -m support.notebook docs/tutorial.md build   (in tests/; `make notebook` does it)
"""

import base64
import os
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

SHELL = "%%bash"  # the cell magic of a shell block
_PIECE = re.compile(
    r"(?P<marks>(?:<!-- exit codes: [\d ]+ -->\n)?)"
    r"```(?P<language>sh|python)\n(?P<code>.*?)\n```\n"
    r"(?:\n<!-- output(?:: (?P<picture>[\w.]+): (?P<caption>.*?))? -->\n"
    r"(?P<output>.*?)<!-- end of output -->\n)?",
    re.DOTALL,
)

_STYLE = re.compile("\x1b\\[[0-9;]*m")


def cells_of(page: str) -> list[tuple[str, str]]:
    """Return the cells of a page in order, each ("markdown" | "code", its source)."""
    cells = []
    at = 0
    for piece in _PIECE.finditer(page):
        cells.append(("markdown", page[at : piece.start()].strip()))
        code = piece["code"]
        if piece["language"] == "sh":
            magic = f"{SHELL} --no-raise-error" if piece["marks"] else SHELL
            code = f"{magic}\n{code}"
        cells.append(("code", code))
        at = piece.end()
    cells.append(("markdown", page[at:].strip()))
    return [(kind, source) for kind, source in cells if source]


def notebook_of(page: str) -> nbformat.NotebookNode:
    """Return the page as a notebook whose cells were not executed yet."""
    make = {"markdown": new_markdown_cell, "code": new_code_cell}
    cells = [
        make[kind](source, id=f"cell-{number}")
        for number, (kind, source) in enumerate(cells_of(page))
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel})


def executed(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """Return the notebook with its outputs, run in `folder` by this Python and its `restock`."""
    from nbclient import NotebookClient

    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    client = NotebookClient(
        notebook, timeout=600, kernel_name="python3", record_timing=False, coalesce_streams=True
    )
    client.execute(cwd=str(folder), env={**os.environ, "PATH": path, "COLUMNS": "100"})
    notebook.metadata.pop("language_info", None)  # the version of Python says nothing here
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if output.output_type == "stream":
                output.text = _STYLE.sub("", output.text)  # a page has no colours of a terminal
    return notebook


def text_of(cell: nbformat.NotebookNode) -> str:
    """Return what a cell printed and showed, as text."""
    parts = []
    for output in cell.outputs:
        if output.output_type == "stream":
            parts.append(output.text)
        elif "image/png" not in output.get("data", {}):
            parts.append(output.data["text/plain"] + "\n")
    lines = "".join(parts).rstrip().splitlines()
    return "".join(line.rstrip() + "\n" for line in lines)


def picture_of(cell: nbformat.NotebookNode) -> bytes | None:
    """Return the picture that a cell showed, as PNG."""
    shown = [output.data for output in cell.outputs if output.output_type != "stream"]
    pictures = [data["image/png"] for data in shown if "image/png" in data]
    return base64.b64decode(pictures[0]) if pictures else None


def filled(page: str, notebook: nbformat.NotebookNode, pictures: str) -> str:
    """Return the page with the outputs of an executed notebook; its pictures lie in this folder."""
    cells = iter([cell for cell in notebook.cells if cell.cell_type == "code"])

    def piece(found: re.Match[str]) -> str:
        cell = next(cells)
        if found["output"] is None:
            return found[0]
        text = text_of(cell)
        shown = f"\n```text\n{text}```\n" if text else ""
        if found["picture"]:
            shown += f"\n![{found['caption']}]({pictures}/{found['picture']})\n"
        head = found[0][: found.start("output") - found.start()]
        return f"{head}{shown}\n<!-- end of output -->\n"

    return _PIECE.sub(piece, page)


def pictures_of(page: str, notebook: nbformat.NotebookNode) -> dict[str, bytes]:
    """Return the pictures of a page by their names."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    found: dict[str, Any] = {
        piece["picture"]: picture_of(cell)
        for piece, cell in zip(_PIECE.finditer(page), cells, strict=True)
        if piece["picture"]
    }
    return found


def main(path: Path, out: Path) -> None:
    """Execute a page; write it and its pictures, and its notebook into the folder `out`."""
    page = path.read_text(encoding="utf-8")
    notebook = executed(notebook_of(page), path.parent)
    pictures = path.with_suffix("")
    pictures.mkdir(exist_ok=True)
    for name, content in pictures_of(page, notebook).items():
        (pictures / name).write_bytes(content)
    path.write_text(filled(page, notebook, pictures.name), encoding="utf-8")
    out.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, out / f"{path.stem}.ipynb")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
