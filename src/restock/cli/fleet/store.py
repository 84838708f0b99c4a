"""`restock store`: joins a store's files, removes recordings from it, and verifies its files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode, counted, quoted

if TYPE_CHECKING:
    from restock.ingest.store.removal import Removed
    from restock.ingest.store.writer import StoreWriter


@dataclass
class CompactCommand:
    """Join a store's many small files into a few large ones, so that queries open fewer files.

        restock store compact store/
        restock store compact s3://warehouse/store --dry-run

    Ingest writes one file per recording. This joins the files, to about half a million transitions
    per file, ordered by robot and time, and joins the manifests. Rows that another tool changed get
    new summaries, which answer coverage queries. No row changes: recordings can be ingested again,
    relabelled and corrected as before, also while this runs. Older versions stay readable for 7
    days. Until then the disk holds both the old and the new files; afterwards `restock ingest`
    removes the old ones.

    Exit codes: 0 done, 2 refused or stopped at a damaged file (what was joined before it stays
    joined), 3 --drop-damaged lost rows or manifests.
    """

    store: Annotated[str, Positional("STORE")]
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
        """Join the files, and print how many there were and are."""
        from restock.ingest.store.writer import StoreWriter, compact

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
                f"{counted(done.summaries, 'recording')} {get} a summary, as they had none for "
                "their present rows"
            )
        if done.changed_meanwhile:
            output.say(
                f"{done.changed_meanwhile:,} files stayed as they were: other writers changed some"
                " of them meanwhile; run it again"
            )
        return ExitCode.OK

    def _drop_damaged(self, store: StoreWriter) -> ExitCode:
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
            output.say(f"{unnamed} more belonged to recordings that no manifest names")
        return ExitCode.LOSSY if done.dropped else ExitCode.OK


SHOWN = 3  # recordings to name in the command that ingests them again


@dataclass
class RemoveCommand:
    """Take recordings out of a store: those that were ingested twice, or by mistake.

        restock store remove store/ 3f2a9c0d7b61e854
        restock store remove store/ 3f2a9c logs/copy.mcap --dry-run

    Name a recording by its id, by the first digits of its id (at least 6), or by the path it was
    ingested by; the end of the path is enough, for example the file's name. `restock sql STORE
    "SELECT recording_id, source_file FROM recordings"` lists them. All of them are removed in one
    commit, or none: a name that fits no recording, or several, is refused.

    This does not ask first, as it can be undone: ingest the recording again, or read the version
    before (`STORE@N`), which stays readable for 7 days. The recording's files are deleted after
    that by `restock ingest`. The corrections of its labels and its tags from `--tag` are removed
    with it. Panels and runs made from the store do not change.

    Exit codes: 0 done, 2 nothing was removed.
    """

    store: Annotated[str, Positional("STORE")]
    """The store: a folder, or s3://bucket/prefix."""
    recordings: Annotated[tuple[str, ...], Positional("RECORDING")] = ()
    """What to remove: ids, or paths."""
    dry_run: bool = False
    """Print what would be removed; remove nothing."""
    json: bool = False
    """Print one JSON document: {"recordings": [{"recording_id", "source_file", "transitions",
    "episodes", "corrections", "tags"}], "left", "version_before", "version", "dry_run"}."""

    def run(self) -> ExitCode:
        """Remove the recordings, and print how to get them back."""
        from restock.ingest.store.removal import remove_recordings
        from restock.ingest.store.writer import StoreWriter

        store = StoreWriter(self.store)
        store.expect_store()
        if not self.recordings:
            raise ConfigError(
                "names no recording to remove",
                where="restock store remove",
                remedy=f'`restock sql {quoted(self.store)} "SELECT recording_id, source_file FROM'
                ' recordings"` lists them',
            )
        done = remove_recordings(store, self.recordings, dry_run=self.dry_run)
        if self.json:
            output.print_json(asdict(done) | {"dry_run": self.dry_run})
            return ExitCode.OK
        output.print_table(
            [
                {
                    "recording": one.recording_id,
                    "path": one.source_file,
                    "transitions": one.transitions,
                    "episodes": one.episodes,
                }
                for one in done.recordings
            ]
        )
        for line in self._lines(done):
            output.say(line)
        return ExitCode.OK

    def _lines(self, done: Removed) -> list[str]:
        """Say how much was removed, and how to get it back."""
        from restock.ingest.store.writer import RETENTION_HOURS

        what = counted(len(done.recordings), "recording")
        rows = counted(sum(one.transitions for one in done.recordings), "transition")
        left = f"{done.left:,} left" if done.left else "none is left: the store is empty"
        if done.version is None:
            return [f"{self.store}: would remove {what}, {rows} ({left})"]
        lines = [f"{self.store}: removed {what}, {rows} ({left}); store version {done.version}"]
        it = "it" if len(done.recordings) == 1 else "them"
        store = quoted(self.store)
        paths = [quoted(one.source_file) for one in done.recordings[:SHOWN]]
        paths += ["…"] * (len(done.recordings) > SHOWN)
        lines.append(f"to get {it} back: restock ingest {' '.join(paths)} --store {store}")
        if corrections := sum(one.corrections for one in done.recordings):
            what = f"{counted(corrections, 'correction')} of labels"
            lines.append(f"that does not bring back {what}, which only the store had")
        tags = sorted({f"{k}={v}" for one in done.recordings for k, v in one.tags.items()})
        had = f" (tags were {', '.join(tags)})" if tags else ""
        lines.append(f"give the options from before again, such as --profile or --tag{had}")
        lines.append(
            f"version {done.version_before} still has {it}, for {RETENTION_HOURS // 24} days:"
            f' restock sql {quoted(f"{self.store}@{done.version_before}")} "FROM recordings"'
        )
        return lines


@dataclass
class VerifyCommand:
    """Read every file of a store, or of a panel, and compare all checksums.

        restock store verify store/
        restock store verify panel/

    `mix`, `export`, `audit`, `coverage gaps` and `info` do this first, but skip a file that was
    found whole before if its size and time are the same. This command reads all files again. `sql`
    and the rest of `coverage` only say how many files have not been verified.

    Exit codes: 0 all are whole, 1 a file is damaged or missing (2 for a panel).
    """

    store: Annotated[str, Positional("STORE")]
    """The store: a folder, or s3://bucket/prefix. Or a panel."""
    json: bool = False
    """Print one JSON document: {"files", "damaged": [{"file", "remedy"}]}."""

    def run(self) -> ExitCode:
        """Verify all files, and list the damaged ones."""
        from restock.ingest.store.damaged_files import verify_store
        from restock.replay.places import kind_beside

        if kind_beside(self.store) == "panel":
            return self._verify_panel()
        done = verify_store(self.store)
        if self.json:
            output.print_json(asdict(done))
        for one in done.damaged:
            output.say(f"{self.store}: {one.file} is damaged or missing: {one.remedy}")
        whole = done.files - len(done.damaged)
        output.say(f"{self.store}: {whole:,} of {counted(done.files, 'file')} whole")
        return ExitCode.FAILED if done.damaged else ExitCode.OK

    def _verify_panel(self) -> ExitCode:
        from restock.replay.panel.panel import Panel

        panel = Panel.open(self.store, verify=True)
        files = len(panel.header.files)
        if self.json:
            output.print_json({"files": files, "damaged": []})
        output.say(f"panel {panel.id}: {counted(files, 'file')} and {len(panel):,} rows whole")
        return ExitCode.OK
