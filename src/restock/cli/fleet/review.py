"""`restock review`: serves a page on which people judge labels, and stores their verdicts."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode, LabelError, quoted

if TYPE_CHECKING:
    from restock.ingest.relabel import Corrected
    from restock.ingest.store.location import Location
    from restock.replay.review.journal import Written

NONE = "none"  # given instead of a file: removes all corrections


@dataclass
class ReviewCommand:
    """Look at labels one by one, and say whether they are right.

    Serves a page on this machine only, and prints its address. The page shows the path driven, the
    plan, the scan, speeds and clearance around each event, and what the rule saw. Each verdict is
    on disk (STORE/review.jsonl) as soon as its key is pressed. Ctrl-C, or the page's button, writes
    the verdicts into the store, where the labels get a version of their own.

    With --out, it writes a CSV file with a column for verdicts instead. Once filled in, give it as
    FILE. See docs/ingest.md.
    """

    store: Annotated[Path, Positional()]
    """The store's folder."""
    file: Annotated[str | None, Positional("FILE|none")] = None
    """Write the verdicts of this CSV file into the store; `none` removes all corrections."""
    out: Path | None = None
    """Write the events to this new file, review.csv, instead of serving a page."""
    dry_run: bool = False
    """With FILE: do everything except writing, and print what would change."""
    json: bool = False
    """Print one JSON document: {"version", "verdicts", "recordings": [{"recording_id", …}]}; for a
    page {"address"}, with --out {"file"}."""

    def run(self) -> int:
        """Serve the page, write a file of events, or read a file of verdicts."""
        from restock.ingest.store.location import Location

        place = Location.of(self.store)
        if self.file is not None and self.out is not None:
            raise ConfigError("FILE cannot be combined with --out")
        if self.dry_run and self.file is None:
            raise ConfigError("--dry-run needs FILE")
        if self.out is not None:
            return self._write(place, self.out)
        if self.file is not None:
            return self._apply_file(place, self.file)
        return self._serve(place)

    def _write(self, place: Location, out: Path) -> int:
        from restock.files import expect_file_place, write_text
        from restock.replay.review.events import doubtful_events, review_csv, review_rows
        from restock.replay.store.store import Store

        expect_file_place(out, "--out")
        if out.suffix != ".csv":
            raise ConfigError(f"{out.name!r} must end in .csv", where="--out", remedy="rename it")
        if out.exists():
            raise LabelError(
                "already exists, and may contain verdicts",
                where=str(out),
                remedy="choose another --out",
            )
        with Store(place) as store:
            rows = review_rows(doubtful_events(store), str(self.store))
        write_text(out, review_csv(rows), exclusive=True)
        if self.json:
            output.print_json({"file": str(out), "events": len(rows)})
            return ExitCode.OK
        output.print_text(f"{out}: {len(rows)} events" if rows else f"{out}: {NOTHING}")
        if rows:
            then = "fill in its last column with yes, no or FIRST..LAST (steps), then run:"
            output.say(f"{then} restock review {quoted(self.store)} {quoted(out)}")
        return ExitCode.OK

    def _apply_file(self, place: Location, file: str) -> int:
        from restock.ingest.relabel import correct_store, open_for_relabel, remove_corrections
        from restock.replay.review.journal import Written
        from restock.replay.review.verdicts import read_verdicts
        from restock.replay.store.store import Store

        store = open_for_relabel(self.store)
        left_open = 0
        if file == NONE:
            written = Written(*remove_corrections(store, dry_run=self.dry_run))
        else:
            with Store(place) as opened:
                verdicts = read_verdicts(file, opened)
            left_open = verdicts.left_open
            outcomes, version = correct_store(store, verdicts.given, dry_run=self.dry_run)
            written = Written(outcomes, version, verdicts.taken)
        if self.json:
            more = {"dry_run": self.dry_run, "without_verdict": left_open}
            output.print_json(written.document | more)
            return ExitCode.OK
        nothing = "there are no corrections to remove" if file == NONE else "no verdict is new"
        print_written(written, nothing, left_open=left_open, dry_run=self.dry_run)
        return ExitCode.OK

    def _serve(self, place: Location) -> int:
        from restock.report.fleet.review import Review, Server

        place.expect_newest()
        review = Review(place)
        try:
            if not review.data["events"]:
                output.print_text(NOTHING)
                return ExitCode.OK
            if waiting := len(review.journal.counting()):
                output.say(f"{waiting} verdicts of an earlier review wait in {review.journal.path}")
            with Server(review, output.say) as server:
                if self.json:
                    output.print_json({"address": server.address, "events": review.data["total"]})
                else:
                    output.print_text(server.address)
                    output.say("open this address; Ctrl-C writes the verdicts into the store")
                sys.stdout.flush()
                try:
                    server.serve_forever(poll_interval=0.5)
                except KeyboardInterrupt:
                    output.say("")
            written = review.write()
        finally:
            review.close()
        if self.json:  # stdout may have only the JSON document, printed above
            output.say(f"{written.taken} verdicts are written, {len(written.held_back)} held back")
        else:
            print_written(written, "no verdict is new")
        return ExitCode.OK


NOTHING = "no uncertain event is left to review"


def print_written(
    written: Written, nothing: str, *, left_open: int = 0, dry_run: bool = False
) -> None:
    """Print what the verdicts changed, and the verdicts that were not written."""
    for why in written.held_back:
        output.print_text(f"held back: {why}")
    if not written.outcomes:
        output.print_text(nothing)
        return
    output.print_table(
        [_correction(outcome, name) for outcome in written.outcomes for name in outcome.changed]
    )
    if written.taken:
        output.print_text(f"{written.taken} verdicts, {left_open} lines without one")
    if dry_run:
        output.print_text("dry run: nothing was written")
    else:
        version = written.version
        output.print_text("unchanged" if version is None else f"store version {version}")


def _correction(outcome: Corrected, name: str) -> dict[str, Any]:
    return {
        "recording": outcome.source_file,
        "labels": f"{outcome.before} -> {outcome.after}",
        "condition": name,
        **{f"rows {key}": value for key, value in asdict(outcome.changed[name]).items()},
    }
