"""`restock store compact`: few large files in place of many small ones."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from restock.errors import ExitCode
from restock.words import counted

if TYPE_CHECKING:
    from restock.ingest.store.writer import StoreWriter


@dataclass
class CompactCommand:
    """Join a store's many small files into a few large ones, so that queries open fewer files.

        restock store compact store/
        restock store compact s3://warehouse/store --dry-run

    Ingest writes one file per recording. This joins the files, to about half a million transitions
    per file, ordered by robot and time, and joins the manifests. Recordings from an older Restock
    get the summaries that answer coverage queries without a scan. No row changes: recordings can be
    ingested again, relabelled and corrected as before, also while this runs. Older versions stay
    readable for 7 days. Until then the disk holds both the old and the new files; afterwards
    `restock ingest` removes the old ones.

    Exit codes: 0 done, 2 refused or stopped at a damaged file (what was joined before it stays
    joined), 3 --drop-damaged lost rows or manifests.
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store: a folder, or s3://bucket/prefix."""
    dry_run: bool = False
    """Print what would be done; write nothing."""
    drop_damaged: bool = False
    """Only repair: read every file of the store, join damaged ones again from the files they were
    made of, or if those are gone, take them out of the store and name the recordings that must be
    ingested again (exit code 3)."""
    json: bool = False
    """Print one JSON document: {"rows", "files_before", "files_after", …}, or with --drop-damaged
    {"joined_again", "dropped", "lost", "unnamed_transitions"}."""

    def run(self) -> ExitCode:
        """Compact, and say what became of the files."""
        from restock.cli import output
        from restock.ingest.store.compaction import compact
        from restock.ingest.store.writer import StoreWriter

        store = StoreWriter(self.store)
        store.expect_store()
        if self.drop_damaged:
            return self._drop_damaged(store)
        done = compact(store, dry_run=self.dry_run)
        if self.json:
            output.print_json(asdict(done))
            return ExitCode.OK
        would = "would write" if self.dry_run else "wrote"
        rows = f"{done.files_before:,} -> {done.files_after:,} files"
        manifests = f"{done.manifests_before:,} -> {done.manifests_after:,} files"
        if done.rows:
            output.say(f"{self.store}: {would} {done.rows:,} transitions together, {rows}")
        elif done.manifests_before == done.manifests_after and not done.summaries:
            output.say(
                f"{self.store}: nothing to join: {counted(done.files_before, 'file')} of"
                f" transitions, {done.manifests_before:,} of manifests"
            )
            rows = manifests = ""
        else:
            output.say(f"{self.store}: no transitions to join")
        if manifests:
            output.say(f"manifests: {manifests}")
        if done.summaries:
            get = "would get" if self.dry_run else "got"
            output.say(
                f"{counted(done.summaries, 'recording')} {get} a summary, having none of the rows"
                " as they are"
            )
        if done.changed_meanwhile:
            output.say(
                f"{done.changed_meanwhile:,} files stayed as they were: other writers changed some"
                " of them meanwhile; run it again"
            )
        return ExitCode.OK

    def _drop_damaged(self, store: StoreWriter) -> ExitCode:
        from restock.cli import output
        from restock.ingest.store.damaged_files import drop_damaged

        done = drop_damaged(store, dry_run=self.dry_run)
        if self.json:
            output.print_json(asdict(done))
        would = "would be " if self.dry_run else ""
        for files, what in ((done.joined_again, "joined again"), (done.dropped, "dropped")):
            for file in files:
                output.say(f"{self.store}: {file} is damaged: {would}{what}")
        if not done.joined_again + done.dropped:
            output.say(f"{self.store}: no file is damaged")
        for one in done.lost:
            corrections = f", {counted(one.corrections, 'correction')}" if one.corrections else ""
            output.say(
                f"ingest again: {one.source_file} (recording {one.recording_id},"
                f" {counted(one.transitions, 'transition')}{corrections})"
            )
        if done.unnamed_transitions:
            unnamed = counted(done.unnamed_transitions, "transition")
            output.say(f"{unnamed} more were of recordings that no manifest names")
        return ExitCode.LOSSY if done.dropped else ExitCode.OK
