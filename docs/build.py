"""Write the documentation's pages with their reference sections filled in.

    python docs/build.py build/pages

A line `<!-- reference: verbs -->` of a page is replaced by what the code defines: the verbs with
their options, the public names (for mkdocstrings), the tables of a run, the views of a store, or
the audits. What follows from code is not committed, so it cannot be out of date.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import duckdb

DOCS = Path(__file__).parent
FACES = ("restock.ingest", "restock.replay", "restock.train", "restock.twin", "restock.report")
NOT_PAGES = ("build.py", "__pycache__")


def list_verbs() -> Iterator[str]:
    """Yield a section for each verb and each of its jobs: its `--help`."""
    from restock.cli import JOBS, VERBS

    for verb in VERBS:
        yield f"## restock {verb}\n\n```text\n{_help(verb)}```\n"
        for job in JOBS.get(verb, ()):
            yield f"### restock {verb} {job}\n\n```text\n{_help(verb, job)}```\n"


def _help(*words: str) -> str:
    from restock.cli import main

    with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), "utf-8")) as text:
        main([*words, "--help"])
    text.seek(0)
    return "\n".join(line.rstrip() for line in text.read().splitlines()) + "\n"


def list_names() -> Iterator[str]:
    """Yield a directive of mkdocstrings for each public name."""
    for face in FACES:
        module = importlib.import_module(face)
        yield f"## {face}\n\n{module.__doc__}\n"
        for name in module.__all__:
            value = getattr(module, name)
            if not callable(value):  # a table
                continue
            home = value.__module__
            yield f"::: {home}.{name}\n"


def list_run_tables() -> Iterator[str]:
    """Yield every table of a run, with every column."""
    from restock.train.run.run_tables import EVAL_CLONES, EVAL_EPISODES, TABLES

    evaluated = {"eval/episodes": EVAL_EPISODES, "eval/clones": EVAL_CLONES}
    for name, schema in {**TABLES, **evaluated}.items():
        yield f"## {name}.parquet\n\nA row is {schema.metadata[b'doc'].decode()}.\n"
        columns = [(c.name, str(c.type), c.metadata[b"meaning"].decode()) for c in schema]
        yield from _table(("column", "type", "meaning"), columns)


def list_views() -> Iterator[str]:
    """Yield every view of a store, with every column."""
    from restock.ingest.task.schema import frame_schema, recording_schema, transition_schema
    from restock.replay.store.definitions import (
        FRAMES_SQL,
        HELD_CONDITIONS,
        definitions,
        install_columns,
        view_docs,
    )

    with duckdb.connect() as connection:
        connection.register("stored_transitions", transition_schema(2).empty_table())
        connection.register("stored_recordings", recording_schema().empty_table())
        connection.register("stored_frames", frame_schema().empty_table())
        connection.execute(definitions("FLOAT[]") + definitions(names=[FRAMES_SQL]))
        install_columns(connection)
        rows = connection.sql("FROM columns").fetchall()
    for view, doc in view_docs().items():
        of_view = [row[1:] for row in rows if row[0] == view]
        if view == HELD_CONDITIONS:
            doc += ". It has the columns of `transitions`, and one more"
            of_view = [row for row in of_view if row[0] == "condition"]
        yield f"### {view}\n\n{doc[0].upper()}{doc[1:]}.\n"
        columns = [(name, _short_type(kind), *rest) for name, kind, *rest in of_view]
        yield from _table(("column", "type", "unit", "meaning"), columns)


def _short_type(kind: str) -> str:
    return "STRUCT(…)[]" if kind.startswith("STRUCT") else kind


def list_audits() -> Iterator[str]:
    """Yield the table of the audits that come with Restock."""
    from restock.replay.store.audit import load_thresholds, shipped_audits

    thresholds = load_thresholds()
    rows = [
        (
            audit.name,
            audit.severity,
            audit.doc + (f" Needs `--{audit.place}`." if audit.needs else ""),
            ", ".join(f"{key} = {value}" for key, value in thresholds.get(audit.name, {}).items()),
        )
        for audit in shipped_audits()
    ]
    yield from _table(("audit", "severity", "finds", "thresholds"), rows)


def _table(names: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(names)} |\n|{' --- |' * len(names)}"
    for row in rows:
        cells = [str(cell).replace("|", "\\|").replace("<", "&lt;") for cell in row]
        yield f"| {' | '.join(cells)} |"
    yield ""


REFERENCES: dict[str, Callable[[], Iterator[str]]] = {
    "verbs": list_verbs,
    "names": list_names,
    "run tables": list_run_tables,
    "views": list_views,
    "audits": list_audits,
}


def build_pages(out: Path) -> None:
    """Copy the pages to `out`, with their references filled in."""
    os.environ["COLUMNS"] = "100"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(DOCS, out, ignore=shutil.ignore_patterns(*NOT_PAGES))
    for page in out.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        filled = re.sub(
            r"<!-- reference: ([\w ]+) -->", lambda found: "\n".join(REFERENCES[found[1]]()), text
        )
        page.write_text(filled, encoding="utf-8")


if __name__ == "__main__":
    build_pages(Path(sys.argv[1]))
