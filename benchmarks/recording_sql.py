"""A question to a recording over MCP, by Restock and by mcap-mcp-server: CPU seconds of the server.

    python benchmarks/recording_sql.py --peer PYTHON [--quick] [--json] [--check]

Each round starts a server for the sample logs' hour, asks one question about one topic with the
SDK's client, and ends it; the servers take turns. Both get the same question: how far apart the
largest and the smallest forward speed of /odom are. mcap-mcp-server loads the topic into a table
before it can be asked, with messages nested three deep as JSON text. Needs the package mcp here,
and PYTHON with mcap-mcp-server and mcp<2. Medians of five rounds.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from functools import partial
from pathlib import Path
from typing import Any

from harness import finish, in_turns, markdown, medians, option_parser

LOGS = Path(__file__).parent.parent / "sample_logs"
RECORDING = LOGS / "amr_monday.mcap"
SERVE = "import sys; from restock.cli import run_mcp; sys.exit(run_mcp())"
QUESTION = "SELECT max({0}) - min({0}) AS spread, count(*) AS n FROM odom"
CALLS: dict[str, tuple[list[str], list[tuple[str, dict[str, Any]]]]] = {
    "restock": (
        ["-c", SERVE, str(RECORDING)],
        [("sql", {"query": QUESTION.format("twist.twist.linear.x")})],
    ),
    "mcap-mcp-server": (
        ["-m", "mcap_mcp_server", "--data-dir", str(LOGS)],
        [
            ("load_recording", {"file": RECORDING.name, "topics": ["/odom"]}),
            ("query", {"sql": QUESTION.format("(twist_twist_linear->>'x')::DOUBLE")}),
        ],
    ),
}
AT_MOST = 0.5  # of mcap-mcp-server's CPU seconds


def answered(name: str, python: str) -> tuple[float, list[Any]]:
    """Return the CPU seconds of a server, and the values of its answer."""
    import anyio
    import mcp

    words, calls = CALLS[name]
    server = mcp.StdioServerParameters(command=python, args=words, env=dict(os.environ))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)

    async def ask() -> str:
        async with mcp.Client(mcp.stdio_client(server)) as client:
            for tool, arguments in calls:
                found = await client.call_tool(tool, arguments)
            return str(found.content[0].text)

    answer = json.loads(anyio.run(ask))
    if "rows" not in answer:
        raise SystemExit(f"{name}: {answer}")
    (row,) = answer["rows"]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return seconds, list(row.values()) if isinstance(row, dict) else row


def main() -> int:
    parser = option_parser(__doc__, quick="two rounds")
    parser.add_argument("--peer", required=True, metavar="PYTHON", help="that of mcap-mcp-server")
    options = parser.parse_args()
    pythons = {"restock": sys.executable, "mcap-mcp-server": options.peer}
    contenders = {name: partial(answered, name, pythons[name]) for name in CALLS}
    rounds = in_turns(contenders, 2 if options.quick else 5)
    answers = {tuple(values) for each in rounds.values() for _, values in each}
    seconds = medians({name: [one for one, _ in each] for name, each in rounds.items()})
    ratio = seconds["restock"] / seconds["mcap-mcp-server"]
    missed = [] if len(answers) == 1 else [f"the answers differ: {sorted(answers)}"]
    if ratio > AT_MOST:
        missed.append(f"{ratio:.2f} of mcap-mcp-server's time, allowed {AT_MOST}")
    table = markdown(["server", "CPU s"], [[name, f"{one:.2f}"] for name, one in seconds.items()])
    return finish(options, {"seconds": seconds, "ratio": ratio}, missed, [table])


if __name__ == "__main__":
    raise SystemExit(main())
