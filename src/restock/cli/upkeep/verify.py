"""`restock store verify`: compare the checksums of a store's files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from restock.errors import ExitCode
from restock.words import counted


@dataclass
class VerifyCommand:
    """Read every file of a store and compare the checksum of each page.

        restock store verify store/

    `mix`, `export`, `audit`, `coverage gaps` and `info` do this first, but skip a file that was
    found whole before if its size and time are the same. This reads all of them again. `sql` and
    the rest of `coverage` only say how many files nobody has verified.

    Exit codes: 0 all are whole, 1 a file is damaged or missing.
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store: a folder, or s3://bucket/prefix."""
    json: bool = False
    """Print one JSON document: {"files", "damaged": [{"file", "remedy"}]}."""

    def run(self) -> ExitCode:
        """Verify, and list what is damaged."""
        from restock.cli import output
        from restock.ingest.store.damaged_files import verify_store

        done = verify_store(self.store)
        if self.json:
            output.print_json(asdict(done))
        for one in done.damaged:
            output.say(f"{self.store}: {one.file} is damaged or missing: {one.remedy}")
        whole = done.files - len(done.damaged)
        output.say(f"{self.store}: {whole:,} of {counted(done.files, 'file')} whole")
        return ExitCode.FAILED if done.damaged else ExitCode.OK
