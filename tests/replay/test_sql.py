"""`restock sql`: tables, JSON and CSV; stdin; runs and panels; errors; Ctrl-C."""

import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.long import one_in
from support.panels import panel_of

from restock import cli
from restock.replay.mixture.mixture import load_mixture
from restock.replay.store.store import Store
from restock.train.run.run import Run


@pytest.fixture
def run_dir(tmp_path) -> Path:
    """Return a run directory with the tables that SQL reads."""
    path = tmp_path / "run"
    (path / "eval").mkdir(parents=True)
    (path / "config.json").write_text("{}")
    ids = [(1 << 25) + 3, (1 << 25) + 4, None]
    audit = {"gradient_step": [1, 1, 2], "source": ["logs", "logs", "fresh"], "transition_id": ids}
    pq.write_table(pa.table(audit), path / "audit.parquet")
    pq.write_table(pa.table({"env_steps": [10], "loss": [0.5]}), path / "progress.parquet")
    pq.write_table(pa.table({"policy": ["dqn"]}), path / "eval" / "episodes.parquet")
    return path


def test_json_is_a_list_of_row_objects(store_path, shell, transitions):
    query = "SELECT count(*) AS rows, ['a', 'b'] AS list, 0.0/0 AS nothing FROM transitions"
    rows = shell.json("sql", store_path, query)
    assert rows == [{"rows": len(transitions), "list": ["a", "b"], "nothing": None}]
    assert shell.json("sql", store_path, query + " WHERE false") == [
        {"rows": 0, "list": ["a", "b"], "nothing": None}
    ]


def test_decimals_and_repeated_column_names(store_path, shell):
    """Regressions: decimals were strings, and two columns `a` both had the second one's values."""
    query = "SELECT 2782 * 0.1 AS s, 2.50 * 2 AS whole, 1 AS a, 2 AS a_1, 3 AS a, 4 AS a"
    rows = shell.json("sql", store_path, query)
    assert rows == [{"s": 278.2, "whole": 5, "a": 1, "a_1": 2, "a_2": 3, "a_3": 4}]
    text = shell.out("sql", store_path, query, "--csv")
    assert text == "s,whole,a,a_1,a_2,a_3\n278.2,5.00,1,2,3,4\n"
    lines = shell.out("sql", store_path, "SELECT 1 a, 2 a, 1234567.8::DOUBLE b, -6e5::DOUBLE c")
    assert lines.splitlines()[0].split() == ["a", "a_1", "b", "c"]
    assert lines.splitlines()[2].split() == ["1", "2", "1,234,568", "-600,000"]


def test_times_with_zone_are_text_in_utc(store_path, shell):
    query = "SELECT ingested_at, ingested_at AS again FROM recordings LIMIT 1"
    rows = shell.json("sql", store_path, query)
    assert rows == [{"ingested_at": "2026-01-01 00:00:00Z", "again": "2026-01-01 00:00:00Z"}]


def test_csv_has_header_without_rows(store_path, shell):
    text = shell.out("sql", store_path, "SELECT condition, rows_held FROM ages", "--csv")
    found = list(csv.DictReader(io.StringIO(text)))
    assert {row["condition"] for row in found} >= {"nominal", "wheel_slip"}
    query = "SELECT condition, rows_held FROM ages WHERE false"
    assert shell.out("sql", store_path, query, "--csv") == "condition,rows_held\n"


def test_query_is_read_from_stdin(store_path, shell, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("SELECT 1 AS one;\nSELECT 2 AS two"))
    assert shell.json("sql", store_path, "-") == [{"two": 2}]


def test_run_tables_can_be_queried(run_dir, shell):
    assert shell.json("sql", run_dir, "FROM progress") == [{"env_steps": 10, "loss": 0.5}]
    assert "dqn" in shell.out("sql", run_dir, "FROM eval_episodes")
    assert "gradient_step" in shell.out("sql", run_dir, "FROM columns")


def test_run_columns_are_documented(tmp_path, shell):
    Run.create(tmp_path / "run", {})
    query = "SELECT * FROM columns WHERE column_name = 'row_hash'"
    assert shell.json("sql", tmp_path / "run", query) == [
        {
            "view": "audit",
            "column_name": "row_hash",
            "type": "VARCHAR",
            "meaning": "checksum of the packed row, 16 hex digits; checked by `restock trace`",
        }
    ]
    undocumented = "SELECT count(*) AS n FROM columns WHERE meaning IS NULL AND view <> 'columns'"
    assert shell.json("sql", tmp_path / "run", undocumented) == [{"n": 0}]


def test_sampled_rows_join_logged_transitions(store_path, run_dir, shell, transitions):
    query = (
        "SELECT transition_id, source_file FROM run.audit JOIN transitions USING (transition_id)"
        " ORDER BY ALL"
    )
    rows = shell.json("sql", store_path, run_dir, query)
    assert rows == [
        {"transition_id": (1 << 25) + step, "source_file": "logs/1.mcap"} for step in (3, 4)
    ]


def test_panel_tables_can_be_queried(store_path, tmp_path, shell):
    panel = panel_of(store_path, load_mixture("uniform"), tmp_path / "p")
    query = "SELECT sum(rows) AS rows FROM strata"
    assert shell.json("sql", panel.path, query) == [{"rows": len(panel)}]
    query = "SELECT count(*) AS rows FROM panel.rows JOIN transitions USING (transition_id)"
    places = str(store_path), str(panel.path)
    assert shell.json("sql", *places, query) == [{"rows": len(panel)}]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("FROM coverag", "Did you mean"),
        ("SELECT 'a'::INT", "Could not convert"),
        ("FROM ages_at('2026-12-01')", "\n    epoch_ns("),  # tabs were printed as escapes
    ],
)
def test_invalid_sql_exits_2_without_traceback(store_path, shell, query, message):
    err = shell.err("sql", store_path, query)
    assert message in err
    assert "Traceback" not in err


def test_missing_panel_view_suggests_no_internal_table(tmp_path, store_path, shell):
    panel = panel_of(store_path, load_mixture("uniform"), tmp_path / "p")
    err = shell.err("sql", panel.path, "FROM transitions")
    assert "does not exist" in err
    assert "pg_" not in err
    assert 'try "FROM columns"' in shell.err("sql", panel.path, "")


def test_invalid_places_are_refused(tmp_path, store_path, run_dir, shell):
    panel = panel_of(store_path, load_mixture("uniform"), tmp_path / "p").path
    for place, words, problem in (
        (tmp_path, [], "it is not a store"),
        (tmp_path / "x", [], "it does not exist"),
        (store_path, [tmp_path], "is not a panel or a run"),
        (store_path, [tmp_path / "x"], "does not exist"),
        (store_path, [panel, panel], "is a second panel"),
        (store_path, [run_dir, run_dir], "is a second run"),
        (store_path, ["--json", "--csv"], "choose one"),
    ):
        assert problem in shell.err("sql", place, *words, "SELECT 1")


def test_prompt_without_query(store_path, monkeypatch, shell):
    lines = iter(["SELECT 41 + 1", "AS answer;", "FROM nope;", "SELECT 7 AS seven;"])

    def answer(prompt: str) -> str:
        try:
            return next(lines)
        except StopIteration:
            raise EOFError from None

    monkeypatch.setattr("builtins.input", answer)
    monkeypatch.setattr(sys, "stdin", type("Terminal", (), {"isatty": lambda self: True})())
    out, err = shell.printed("sql", store_path, "--csv")
    assert out == "answer\n42\nseven\n7\n"
    assert "nope" in err


def test_prompt_has_help_and_lists_tables(store_path, monkeypatch, shell):
    lines = iter([".help", ".tables", r"SELECT 7 AS seven \G", ".quit"])
    monkeypatch.setattr("builtins.input", lambda prompt: next(lines))
    monkeypatch.setattr(sys, "stdin", type("Terminal", (), {"isatty": lambda self: True})())
    out, err = shell.printed("sql", store_path)
    assert ".tables" in err
    assert {"transitions", "coverage"} <= {line.split()[0] for line in out.splitlines()}
    assert out.endswith("row 1\n  seven  7\n")


@pytest.mark.parametrize("ending", ["parquet", "csv", "json"])
def test_export_format_follows_file_ending(store_path, tmp_path, shell, ending):
    out = tmp_path / f"rows.{ending}"
    query = "SELECT range::INT AS n, '=' || range AS text, {'a': [range]} AS nested FROM range(2)"
    line = ["sql", str(store_path), query, "--export", str(out)]
    assert cli.main(line) == 0
    assert [path.name for path in tmp_path.glob("*rows*")] == [out.name]
    if ending == "csv":
        found = out.read_text().splitlines()
        assert found == ["n,text,nested", "0,'=0,{'a': [0]}", "1,'=1,{'a': [1]}"]
    else:
        rows = (
            pq.read_table(out).to_pylist() if ending == "parquet" else json.loads(out.read_text())
        )
        assert rows == [{"n": n, "text": f"={n}", "nested": {"a": [n]}} for n in (0, 1)]
    assert "already there" in shell.err(*line)
    assert "name it .parquet, .csv or .json" in shell.err(*line[:-1], tmp_path / "rows.txt")


@pytest.mark.parametrize("name", one_in(2, ["views.sql", "views.duckdb"]))
def test_exported_views_work_in_plain_duckdb(store_path, tmp_path, shell, name):
    out = tmp_path / name
    assert cli.main(["sql", str(store_path), "--export", str(out)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with Store(store_path) as store:
        questions = ["FROM coverage", "FROM episodes ORDER BY ALL", "FROM cells_below(9)"]
        questions += ["SELECT typeof(observation) FROM transitions LIMIT 1"]
        # Frames are in separate files, which exports leave out.
        questions += ["FROM columns WHERE NOT contains(view, 'frames') ORDER BY ALL"]
        expected = [store.sql(question).fetchall() for question in questions]
    with duckdb.connect(str(out) if name.endswith("duckdb") else ":memory:") as other:
        if name.endswith("sql"):
            other.execute(out.read_text())
        assert [other.sql(question).fetchall() for question in questions] == expected
        assert not other.sql("FROM columns WHERE contains(view, 'frames')").fetchall()
    for words, problem in (
        (["--export", out], "already there"),
        (["--export", tmp_path / "views.db"], "cannot export to .db"),
        (["FROM coverage", "--export", tmp_path / "v.sql"], "runs no query"),
    ):
        assert problem in shell.err("sql", store_path, *words)


def test_ctrl_c_stops_query(store_path):
    endless = "SELECT count(*) FROM range(100000000) a, range(100000000) b WHERE a.range % 7 = 3"
    command = [sys.executable, "-m", "restock", "sql", str(store_path), endless]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    # The query is running once DuckDB uses CPU time; an earlier signal is handled as well.
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and _cpu_seconds(process.pid) < 2.0:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in err


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
