"""`restock store label`: new conditions over stored signals, how good labels are, and verdicts."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import ConfigError, ExitCode, LabelError, counted, quoted

if TYPE_CHECKING:
    from restock.ingest.relabel import Corrected, Relabelled
    from restock.ingest.store.writer import StoreWriter
    from restock.ingest.task.conditions import Condition
    from restock.replay.review import LabelQuality
    from restock.stats import ConfidenceInterval


@dataclass
class LabelCommand:
    """Label a store's transitions again where their conditions have changed.

    Conditions are computed from the stored signals: no recording is read, and observations, actions
    and rewards do not change. Recordings whose labels are up to date are left unchanged; the others
    change in one commit. Each row stores the version of its labels.

    By default, a recording gets the conditions of the profile with which it was ingested: the
    shipped profile of that name, or the copy in the store. Another profile gives other conditions
    to the recordings ingested with a profile of the same name.

    With --review, nothing is labelled: it lists the events whose label is most uncertain, each with
    its time, the command that opens it, and a column for a verdict. --corrections writes verdicts
    to the store: they stay when recordings are labelled or ingested again. See docs/ingest.md.
    """

    store: Annotated[Path, tyro.conf.Positional]
    """The store's folder."""
    profile: str | None = None
    """Use the conditions of this profile, a shipped one or a TOML file, for the recordings that
    were ingested with a profile of its name."""
    score: bool = False
    """Label nothing: compare the labels with the true conditions of simulated recordings, by step
    and by event, and print how reliable their probabilities are."""
    review: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """List the N most uncertain events."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """With --review: write the events to this CSV file, in which you fill in the column
    `verdict`."""
    corrections: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None
    """Write the verdicts of a CSV file (see docs/ingest.md) to the store; `none` removes all
    corrections."""
    dry_run: bool = False
    """Do everything except writing, and print what would change."""
    json: bool = False
    """Print one JSON document: {"version", "recordings": [{"recording_id", "changed", …}]}."""

    def run(self) -> int:
        """Label, and say what changed."""
        from restock.cli import output
        from restock.ingest.relabel import open_for_relabel, relabel_store

        self._check_options()
        if self.score:
            return print_scores(self.store, json=self.json)
        store = open_for_relabel(self.store)
        if self.review is not None:
            return review(self.store, self.review, self.out, json=self.json)
        if self.corrections is not None:
            return correct(
                store, self.store, self.corrections, dry_run=self.dry_run, json=self.json
            )
        outcomes, version = relabel_store(
            store,
            self._conditions_of(store),
            dry_run=self.dry_run,
        )
        rows = [as_json(outcome) for outcome in outcomes]
        if self.json:
            output.print_json({"version": version, "dry_run": self.dry_run, "recordings": rows})
            return ExitCode.OK
        output.print_table(
            [
                {
                    "recording": row["source_file"],
                    "labels": f"{row['before']} -> {row['after']}"
                    if row["before"] != row["after"]
                    else f"{row['after']}, unchanged",
                    "rows changed": row["changed"],
                }
                for row in rows
            ]
        )
        names = sorted({name for o in outcomes for name in (*o.named, *o.named_before)})
        if names:
            output.print_table(
                [
                    {
                        "condition": name,
                        "rows before": sum(o.named_before.get(name, 0) for o in outcomes),
                        "rows after": sum(o.named.get(name, 0) for o in outcomes),
                    }
                    for name in names
                ]
            )
        if version is not None:
            output.print_text(f"store version {version}")
        return ExitCode.OK

    def _check_options(self) -> None:
        """Raise ConfigError if options cannot be combined."""
        given = {
            "--score": self.score,
            "--review": self.review is not None,
            "--corrections": self.corrections is not None,
            "--profile": self.profile is not None,
            "--out": self.out is not None,
        }
        clashes = {
            "--score": ("--review", "--corrections", "--profile"),
            "--review": ("--corrections", "--profile"),
            "--corrections": ("--out", "--profile"),
        }
        for option, others in clashes.items():
            if clash := [name for name in others if given[option] and given[name]]:
                raise ConfigError(f"{option} cannot be combined with {clash[0]}")
        if self.out is not None and self.review is None:
            raise ConfigError("--out needs --review N")

    def _conditions_of(self, store: StoreWriter) -> Callable[[str], Sequence[Condition]]:
        from restock.ingest.profile.profile import load_profile, read_profile_toml

        live = store.live()
        carried = {row["profile"]: row["profile_toml"] for row in live.to_pylist()}
        given = load_profile(self.profile) if self.profile is not None else None
        others = [
            row
            for row in live.to_pylist()
            if given and row["profile"] == given.name and row["task_hash"] != given.task.hash
        ]
        if others:
            sys.stderr.write(
                f"note: {counted(len(others), 'recording')} of the store have another [task] than"
                f" {self.profile}: only labels change here; for observations and rewards ingest"
                " again\n"
            )

        def conditions_of(name: str) -> Sequence[Condition]:
            if given is not None and given.name == name:
                return given.definitions
            try:
                return load_profile(name).definitions
            except ConfigError as error:
                if text := carried[name]:
                    return read_profile_toml(text, where=f"profile {name!r}").definitions
                raise ConfigError(
                    f"the store holds recordings of profile {name!r}, which cannot be found",
                    where=str(self.store),
                    remedy="give its file: --profile FILE",
                ) from error

        return conditions_of


def as_json(outcome: Relabelled) -> dict[str, Any]:
    """Return an outcome as `--json` prints it."""
    from restock.ingest.store.manifest import score_rows

    names = ("recording_id", "source_file", "before", "after", "changed", "named", "named_before")
    return {
        **{name: getattr(outcome, name) for name in names},
        "label_scores": score_rows(outcome.scores),
    }


def print_scores(path: Path, *, json: bool) -> int:
    """Print precision and recall of each condition, and how reliable the probabilities are."""
    from restock.cli import output
    from restock.replay.review import label_quality, reliability, reliability_rows
    from restock.replay.store.store import Store

    with Store(path) as store:
        found = label_quality(store)
        bins = reliability(store).to_pylist()
    if json:
        rows = [quality_json(one) for one in found]
        output.print_json({"scores": rows, "reliability": bins})
        return ExitCode.OK
    if not found:
        output.print_text(
            "no recording in the store contains the true conditions: nothing to score"
        )
        return ExitCode.OK
    output.print_table(score_rows(found))
    reported = [row for row in bins if row["known"]]
    if reported:
        output.print_text(
            "\nA probability is reliable if, among steps with probability p, a share p is true:"
        )
        output.print_table(reliability_rows(reported))
    return ExitCode.OK


def score_rows(found: Sequence[LabelQuality]) -> list[dict[str, Any]]:
    """Return a table row for each condition."""
    return [
        {
            "condition": one.score.condition,
            "true steps": one.score.support,
            "precision": _interval(one.precision),
            "recall": _interval(one.recall),
            "true events": one.score.event_support,
            "event precision": _interval(one.event_precision),
            "event recall": _interval(one.event_recall),
            "uncertain": one.uncertain,
        }
        for one in found
    ]


def quality_json(one: LabelQuality) -> dict[str, Any]:
    """Return counts, and shares with 95 % intervals, as `--json` prints them."""
    shares = ("precision", "recall", "event_precision", "event_recall")
    return {
        **asdict(one.score),
        "uncertain": one.uncertain,
        **{name: asdict(getattr(one, name)) for name in shares},
    }


def _interval(share: ConfidenceInterval) -> str:
    if share.value != share.value:
        return "-"
    return f"{share.value:.2f} ({share.low:.2f} to {share.high:.2f})"


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
        output.print_text(nothing)
        return ExitCode.OK
    output.print_parted(
        [_review_line(row) for row in rows],
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


def _review_line(row: dict[str, Any]) -> dict[str, Any]:
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
        output.print_text(
            "there are no corrections to remove" if file == NONE else f"{file} contains no verdict"
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
        output.print_text(line)
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
