"""`restock compact`: few large files in place of many small ones."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro


@dataclass
class CompactCommand:
    """Join a store's many small files into a few large ones, so that queries open fewer files.

        restock compact store/
        restock compact s3://warehouse/store --dry-run

    Ingest writes one file per recording. This joins the files, to about half a million transitions
    per file, ordered by robot and time, and joins the manifests. Recordings from an older Restock
    get the summaries that answer coverage queries without a scan. No row changes: recordings can be
    ingested again, relabelled and corrected as before, also while this runs. Older versions stay
    readable for 7 days. Until then the disk holds both the old and the new files; afterwards
    `restock ingest` removes the old ones.
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store: a folder, or s3://bucket/prefix."""
    dry_run: bool = False
    """Print what would be joined; write nothing."""
    json: bool = False
    """Print one JSON document: {"rows", "files_before", "files_after", …}."""

    def run(self) -> None:
        """Compact, and say what became of the files."""
        from restock.cli import output
        from restock.ingest.store.compaction import compact
        from restock.ingest.store.writer import StoreWriter

        done = compact(StoreWriter(self.store), dry_run=self.dry_run)
        if self.json:
            output.print_json(asdict(done))
            return
        files = f"{done.files_before:,} -> {done.files_after:,} files"
        output.say(
            f"{self.store}: {'would write' if self.dry_run else 'wrote'} {done.rows:,} transitions"
            f" together, {files}"
        )
        if not self.dry_run:
            output.say(f"manifests: {done.manifests_before:,} -> {done.manifests_after:,} files")
        if done.summaries:
            output.say(f"{done.summaries:,} recordings got the summaries that they lacked")
        if done.changed_meanwhile:
            output.say(
                f"{done.changed_meanwhile:,} files stayed as they were: other writers changed some"
                " of them meanwhile; run it again"
            )
