"""A question to a recording, by Restock and by others that answer SQL: CPU seconds of the process.

    python benchmarks/recording_sql.py --peer PYTHON [--rerun PYTHON] [--quick] [--json] [--check]

Each round starts a server for the sample logs' hour, asks one question about one topic with the
SDK's client, and ends it; the servers take turns. Both get the same question: how far apart the
largest and the smallest forward speed of /odom are. mcap-mcp-server loads the topic into a table
before it can be asked, with messages nested three deep as JSON text. Needs the package mcp here,
and PYTHON with mcap-mcp-server and mcp<2. With `--rerun`, a Python with rerun-sdk[catalog],
`restock sql` and Rerun's catalog get the same question without MCP: Rerun converts the recording
to its own format, serves that, and asks DataFusion. Medians of five rounds.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
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
RERUN = """
import subprocess, sys, tempfile
import rerun as rr
with tempfile.TemporaryDirectory() as folder:
    made = f"{folder}/run.rrd"
    command = [sys.executable, "-m", "rerun_cli", "mcap", "convert", sys.argv[1], "-o", made]
    subprocess.run(command, check=True, capture_output=True)
    with rr.server.Server(datasets={"run": [made]}) as server:
        client = server.client()
        dataset = client.get_dataset("run").filter_contents(["/odom"])
        client.ctx.register_view("odom", dataset.reader(index="message_log_time"))
        (row,) = client.ctx.sql(sys.argv[2]).to_pylist()
        print(*row.values(), sep=",")
"""
RERUN_SPEED = "\"/odom:nav_msgs.msg.Odometry:message\"[1]['twist']['twist']['linear']['x']"
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


def alone(words: list[str]) -> tuple[float, list[Any]]:
    """Return the CPU seconds of a process that prints the answer as CSV, and its values."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spread, count = text.split()[-1].split(",")
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return seconds, [float(spread), int(count)]


def main() -> int:
    parser = option_parser(__doc__, quick="two rounds")
    parser.add_argument("--peer", required=True, metavar="PYTHON", help="that of mcap-mcp-server")
    parser.add_argument("--rerun", metavar="PYTHON", help="that of rerun-sdk[catalog]")
    options = parser.parse_args()
    pythons = {"restock": sys.executable, "mcap-mcp-server": options.peer}
    contenders = {name: partial(answered, name, pythons[name]) for name in CALLS}
    if options.rerun:
        ours = QUESTION.format("twist.twist.linear.x")
        words = [sys.executable, "-m", "restock", "sql", str(RECORDING), ours, "--csv"]
        contenders["restock sql"] = partial(alone, words)
        words = [options.rerun, "-c", RERUN, str(RECORDING), QUESTION.format(RERUN_SPEED)]
        contenders["Rerun's catalog"] = partial(alone, words)
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
