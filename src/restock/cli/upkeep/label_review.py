"""`restock store label --review` and `--corrections`: labels for a person, and verdicts back."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import ExitCode, LabelError
from restock.words import quoted

if TYPE_CHECKING:
    from restock.ingest.relabel import Corrected
    from restock.ingest.store.writer import StoreWriter

NONE = "none"  # in place of a file: takes all corrections out


def review(path: Path, most: int, out: Path | None, *, json: bool) -> int:
    """List the most doubtful events, and write them to a file for verdicts."""
    from restock.cli import output
    from restock.files import expect_file_place, write_text
    from restock.replay.review import doubtful_events, review_csv, review_rows
    from restock.replay.store.store import Store

    if most < 1:
        raise LabelError(f"--review must be 1 or more, got {most}")
    expect_file_place(out, "--out")
    with Store(path) as store:
        rows = review_rows(doubtful_events(store, most), str(path))
    if out is not None:
        try:
            write_text(out, review_csv(rows), exclusive=True)
        except FileExistsError:
            raise LabelError(
                "already exists, and may contain verdicts",
                where=str(out),
                remedy="choose another --out",
            ) from None
        except OSError as error:
            raise LabelError(f"cannot be written: {error.strerror}", where=str(out)) from error
    nothing = "no uncertain event is left to review"
    if out is not None:
        nothing += f": {out} has only a header"
    if json:
        output.print_json(rows)
        if not rows:
            output.say(nothing)
        return ExitCode.OK
    if not rows:
        output.stdout().print(nothing, markup=False, soft_wrap=True)
        return ExitCode.OK
    output.print_parted(
        [_line(row) for row in rows],
        key=["condition", "restock trace STORE"],
        title="events, the most uncertain first",
    )
    output.say(f"to see the first: {rows[0]['open']}")
    output.say(
        f"fill in the last column of {out} with yes, no or FIRST..LAST (the steps where the label "
        f"is true), then run: restock store label {quoted(path)} --corrections {quoted(out)}"
        if out is not None
        else "--out FILE writes them to a CSV file with a column for verdicts"
    )
    return ExitCode.OK


def _line(row: dict[str, Any]) -> dict[str, Any]:
    """Return as much of a line as fits a terminal; the file has all of it."""
    return {
        "condition": row["condition"],
        "labelled": row["labelled"],
        "p": row["probability"],
        "why": row["why"],
        "recording": Path(row["source_file"]).name,
        "from s": row["start_s"],
        "to s": row["end_s"],
        "log time": row["start_time"],
        "episode": row["episode_id"].rpartition("/")[2],
        "steps": f"{row['first_step']}..{row['last_step']}",
        "restock trace STORE": row["event"] and shlex.split(row["open"])[3],
    }


def correct(store: StoreWriter, path: Path, file: str, *, dry_run: bool, json: bool) -> int:
    """Take a file's verdicts into the store, or all corrections out of it."""
    from restock.cli import output
    from restock.ingest.relabel import correct_store, remove_corrections
    from restock.replay.review import read_verdicts
    from restock.replay.store.store import Store

    taken = left_open = 0
    if file == NONE:
        outcomes, version = remove_corrections(store, dry_run=dry_run)
    else:
        with Store(path) as opened:
            verdicts = read_verdicts(Path(file), opened)
        taken, left_open = verdicts.taken, verdicts.left_open
        outcomes, version = correct_store(store, verdicts.given, dry_run=dry_run)
    document = {
        "version": version,
        "dry_run": dry_run,
        "verdicts": taken,
        "without_verdict": left_open,
        "recordings": [asdict(outcome) for outcome in outcomes],
    }
    if json:
        output.print_json(document)
        return ExitCode.OK
    if not outcomes:
        output.stdout().print(
            "there are no corrections to remove" if file == NONE else f"{file} contains no verdict",
            markup=False,
        )
        return ExitCode.OK
    output.print_table(
        [_correction(outcome, name) for outcome in outcomes for name in outcome.changed]
    )
    lines = [] if file == NONE else [f"{taken} verdicts, {left_open} lines without one"]
    if dry_run:
        lines.append("dry run: nothing was written")
    else:
        lines.append("unchanged" if version is None else f"store version {version}")
    for line in lines:
        output.stdout().print(line, markup=False)
    return ExitCode.OK


def _correction(outcome: Corrected, name: str) -> dict[str, Any]:
    changed = outcome.changed[name]
    return {
        "recording": outcome.source_file,
        "labels": f"{outcome.before} -> {outcome.after}",
        "condition": name,
        "rows added": changed.added,
        "removed": changed.removed,
        "confirmed": changed.confirmed,
    }
