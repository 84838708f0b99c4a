"""`restock-mcp`, queried over stdio by the client of the protocol's SDK."""

import json
import os
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from support.bag_samples import write_bag

from restock import cli

SERVE = "import sys; from restock.cli import run_mcp; sys.exit(run_mcp())"


def run_job(place: Path, job: Callable[[Any], Awaitable[None]], *options: str) -> None:
    """Start a server for `place` and run `job` with a client of it."""
    mcp = pytest.importorskip("mcp", reason="the extra mcp is not installed")
    anyio = pytest.importorskip("anyio")
    server = mcp.StdioServerParameters(
        command=sys.executable, args=["-c", SERVE, str(place), *options], env=dict(os.environ)
    )

    async def run() -> None:
        async with mcp.Client(mcp.stdio_client(server)) as client:
            await job(client)

    anyio.run(run)


async def call(client: Any, tool: str, **arguments: Any) -> Any:
    """Return a tool's result, or its error as text."""
    found = await client.call_tool(tool, arguments)
    text = found.content[0].text
    return text if found.is_error else json.loads(text)


def test_tools_on_store_are_read_only(store_path, tmp_path):
    outside = tmp_path / "secret.csv"
    outside.write_text("a\n1\n")
    refused = {
        f"FROM read_csv('{outside}')": "disabled by configuration",
        f"FROM '{outside}'": "disabled by configuration",
        f"COPY (SELECT 1) TO '{tmp_path}/x.csv'": "COPY is refused",
        f"ATTACH '{tmp_path}/x.db'": "ATTACH is refused",
        "CREATE TABLE a AS SELECT 1": "CREATE is refused",
        "SET memory_limit = '1GB'": "SET is refused",
        "PRAGMA enable_profiling": "PRAGMA is refused",
        "INSTALL httpfs": "is refused",
        "FROM text": "does not exist",
        "FROM covrage": "the nearest names are",
    }

    async def job(client: Any) -> None:
        tools = (await client.list_tools()).tools
        names = [tool.name for tool in tools]
        assert names == ["sql", "coverage", "events", "trace", "diagnose", "gate"]
        assert all(tool.annotations.read_only_hint and tool.description for tool in tools)
        rows = await call(client, "sql", query="SELECT step_index FROM transitions ORDER BY ALL")
        assert rows["columns"] == ["step_index"]
        assert len(rows["rows"]) == 3 < rows["all_rows"]
        for query, message in refused.items():
            assert message in await call(client, "sql", query=query), query
        found = await call(client, "coverage")
        assert "nominal" in {row["condition"] for row in found["conditions"][:3]}
        events = await call(client, "events", condition="it's none")
        assert events["all_rows"] == 0
        rows = await call(client, "sql", query="SELECT min(transition_id) AS id FROM transitions")
        traced = await call(client, "trace", row=str(rows["rows"][0]["id"]))
        assert traced["transition"]["step_index"] == 0
        assert "is not a row" in await call(client, "trace", row="--recording=/tmp/x.mcap")
        assert "restock gate RUN" in await call(client, "gate")

    before = sorted(tmp_path.iterdir())
    run_job(store_path, job, "--rows", "3")
    assert sorted(tmp_path.iterdir()) == before


def test_slow_queries_are_stopped(store_path):
    endless = "SELECT count(*) FROM range(100000000) a, range(100000000) b"

    async def job(client: Any) -> None:
        assert "stopped after 0.5 s" in await call(client, "sql", query=endless)
        assert "stopped after 0.5 s" in await call(client, "diagnose")

    run_job(store_path, job, "--seconds", "0.5")


def test_tools_on_recording(tmp_path):
    whole = write_bag(tmp_path / "whole", storage="mcap", count=500)
    (file,) = whole.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    async def job(client: Any) -> None:
        rows = await call(client, "sql", query="SELECT ranges FROM scan LIMIT 1")
        assert rows["rows"][0]["ranges"][0] is None  # inf
        assert "disabled" in await call(client, "sql", query=f"FROM read_blob('{cut}')")
        assert "not a store" in await call(client, "coverage")
        rows = await call(client, "sql", query="SELECT count(*) AS n FROM odom")
        assert 0 < rows["rows"][0]["n"] < 500
        assert "cut short" in rows["lost"][0]

    run_job(cut, job)


def test_missing_extra_names_install_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mcp", None)
    assert cli.run_mcp([str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "restock-mcp needs mcp, which is not installed" in err
    assert "[mcp]" in err
