"""Tables and messages: for a terminal, without colours, and for a pipe."""

import json
import os
import subprocess
import sys
from typing import Any

from support.paths import ROOT

from restock.cli import output

ROWS = [
    {"audit": "aisles", "status": "fail", "rows": 12_345, "what": "words of it " * 20},
    {"audit": "batteries", "status": "pass", "rows": 0, "what": "short"},
]


def test_terminal_table_has_colours_and_fits_width(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "72")
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    output.print_table(ROWS)
    text = capsys.readouterr().out
    assert "\x1b[1;31mfail\x1b[0m" in text
    assert "\x1b[32mpass\x1b[0m" in text
    monkeypatch.setenv("NO_COLOR", "1")
    output.print_table(ROWS)
    text = capsys.readouterr().out
    assert "31m" not in text
    assert "32m" not in text
    bare = text.replace("\x1b[1m", "").replace("\x1b[0m", "")
    assert max(map(len, bare.splitlines())) <= 72


def test_ingest_reports_progress_of_each_stage(monkeypatch, shell):
    """Each stage reports the part done and the whole, if stderr is a terminal."""
    reported: list[tuple[str, int, int]] = []
    original = output.Advance.part

    def part(self: output.Advance, *how_far: Any) -> None:
        reported.append(how_far)
        original(self, *how_far)

    monkeypatch.setattr(output.Advance, "part", part)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    sample = ROOT / "sample_logs" / "amr_tuesday"
    out = shell.out("ingest", sample, "--dry-run", "--json")
    assert json.loads(out)["recordings"][0]["status"] == "dry run"
    by_stage = {}
    for doing, done, whole in reported:
        by_stage.setdefault(doing, []).append((done, whole))
    assert by_stage.keys() == {
        "checking content, bytes",
        "reading, messages",
        "rows and labels, ticks",
    }
    for steps in by_stage.values():
        done, whole = zip(*steps, strict=True)
        assert list(done) == sorted(done)
        assert len(set(whole)) == 1
        assert 0.9 * whole[-1] <= done[-1] <= whole[-1]


def test_progress_bar_does_not_mix_with_stdout() -> None:
    """The bar is on the terminal while stdout, a pipe, gets the data."""
    import pty

    code = (
        "from restock.cli import output\n"
        "with output.progress('x', 2) as advance:\n"
        "    advance.part('y', 1, 3)\n"
        "    print('data')\n"
        "    advance(1)\n"
    )
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=theirs, check=True
    )
    os.close(theirs)
    shown = os.read(ours, 100_000)
    os.close(ours)
    assert done.stdout == b"data\n"
    assert b"x" in shown
    assert b"data" not in shown
