"""`restock store remove`: recordings out of a store."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from restock.errors import ConfigError, ExitCode
from restock.words import counted, quoted

if TYPE_CHECKING:
    from restock.ingest.prepared import Removed

SHOWN = 3  # recordings whose paths stand in the command that ingests them again


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
    before (`--version N`), which stays readable for 7 days. The recording's files are deleted after
    that by `restock ingest`. The corrections of its labels and its tags from `--tag` are removed
    with it. Panels and runs made from the store do not change.

    Exit codes: 0 done, 2 nothing was removed.
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store: a folder, or s3://bucket/prefix."""
    recordings: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")
    ] = ()
    """What to remove: ids, or paths."""
    dry_run: bool = False
    """Print what would be removed; remove nothing."""
    json: bool = False
    """Print one JSON document: {"recordings": [{"recording_id", "source_file", "transitions",
    "episodes", "corrections", "tags"}], "left", "version_before", "version", "dry_run"}."""

    def run(self) -> ExitCode:
        """Remove, and say what was removed and how to get it back."""
        from restock.cli import output
        from restock.ingest.prepared import remove_recordings
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
        """Say what the table does not."""
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
            lines.append(f"that does not bring back {what}, which were kept in the store alone")
        tags = sorted({f"{k}={v}" for one in done.recordings for k, v in one.tags.items()})
        had = f" (tags were {', '.join(tags)})" if tags else ""
        lines.append(f"give the options from before again, such as --profile or --tag{had}")
        lines.append(
            f"version {done.version_before} still has {it}, for {RETENTION_HOURS // 24} days:"
            f' restock sql {store} --version {done.version_before} "FROM recordings"'
        )
        return lines
