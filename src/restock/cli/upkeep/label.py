"""`restock store label`: new conditions over the signals that are stored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from restock.ingest.relabel import Relabelled
    from restock.ingest.store.writer import StoreWriter
    from restock.ingest.task.conditions import Condition


@dataclass
class LabelCommand:
    """Label a store's transitions again where their conditions have changed.

    Conditions are computed from the stored signals: no recording is read, and observations, actions
    and rewards do not change. Recordings whose labels are up to date are left unchanged; the others
    change in one commit. Each row stores the version of its labels.

    By default, a recording gets the conditions of the profile with which it was ingested: the
    shipped profile of that name, or the copy in the store. `--profile` gives other conditions, for
    the recordings ingested with a profile of the same name (or, with --all, for every recording).

    With --review, nothing is labelled: it lists the events whose label is most uncertain, each with
    its time, the command that opens it, and a column for a verdict. --corrections writes verdicts
    to the store: they stay when recordings are labelled or ingested again. See docs/ingest.md.
    """

    store: Annotated[Path, tyro.conf.Positional]
    """The store's folder."""
    profile: str | None = None
    """Use the conditions of this profile: the name of a shipped profile, or a TOML file."""
    all: bool = False
    """Also use that profile's conditions for recordings that were ingested with another profile."""
    score: bool = False
    """Label nothing: compare the labels with the true conditions of simulated recordings, by step
    and by event, and print how reliable their probabilities are."""
    by: Annotated[str | None, tyro.conf.arg(metavar="COLUMN")] = None
    """With --score: one score for each value of a column of `recordings` (source_file, map, …)."""
    review: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """List the N most uncertain events."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """With --review: write the events to this CSV file, in which you fill in the column
    `verdict`."""
    corrections: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None
    """Write the verdicts of a CSV file (see docs/ingest.md) to the store; `none` removes all
    corrections."""
    version: Annotated[str | None, tyro.conf.arg(metavar="N|TIME")] = None
    """With --dry-run: an earlier version of the store, its number or a time. Default: the
    newest."""
    dry_run: bool = False
    """Do everything except writing, and print what would change."""
    json: bool = False
    """Print one JSON document: {"version", "recordings": [{"recording_id", "changed", …}]}."""

    def run(self) -> int:
        """Label, and say what changed."""
        from restock.cli import output
        from restock.cli.upkeep import label_quality, label_review
        from restock.ingest.relabel import open_for_relabel, relabel_store
        from restock.ingest.store.version import given_version

        self._check_options()
        if self.score:
            return label_quality.print_scores(self.store, self.by, json=self.json)
        store = open_for_relabel(self.store)
        if self.review is not None:
            return label_review.review(self.store, self.review, self.out, json=self.json)
        if self.corrections is not None:
            return label_review.correct(
                store, self.store, self.corrections, dry_run=self.dry_run, json=self.json
            )
        outcomes, version = relabel_store(
            store,
            self._conditions_of(store),
            dry_run=self.dry_run,
            version=given_version(self.version),
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
            output.stdout().print(f"store version {version}")
        return ExitCode.OK

    def _check_options(self) -> None:
        """Raise ConfigError if options cannot be combined."""
        of_rules = {
            "--profile": self.profile is not None,
            "--all": self.all,
            "--version": self.version is not None,
        }
        for verb, given, others in (
            ("--score", self.score, {"--review": self.review is not None}),
            ("--score", self.score, {"--corrections": self.corrections is not None}),
            ("--review", self.review is not None, {"--corrections": self.corrections is not None}),
            ("--corrections", self.corrections is not None, {"--out": self.out is not None}),
        ):
            clash = [name for name, there in (others | of_rules).items() if there]
            if given and clash:
                raise ConfigError(f"{verb} cannot be combined with {clash[0]}")
        if self.all and self.profile is None:
            raise ConfigError("--all needs --profile FILE")
        if self.by is not None and not self.score:
            raise ConfigError("--by needs --score")
        if self.out is not None and self.review is None:
            raise ConfigError("--out needs --review N")

    def _conditions_of(self, store: StoreWriter) -> Callable[[str], Sequence[Condition]]:
        from restock.ingest.profile.profile import load_profile, read_profile_toml
        from restock.ingest.store.version import given_version

        live = store.live(version=given_version(self.version))
        carried = {row["profile"]: row["profile_toml"] for row in live.to_pylist()}
        given = load_profile(self.profile) if self.profile is not None else None

        def conditions_of(name: str) -> Sequence[Condition]:
            if given is not None and (self.all or given.name == name):
                return given.definitions
            try:
                return load_profile(name).definitions
            except ConfigError as error:
                if text := carried[name]:
                    return read_profile_toml(text, where=f"profile {name!r}").definitions
                raise ConfigError(
                    f"the store holds recordings of profile {name!r}, which cannot be found",
                    where=str(self.store),
                    remedy="give its file: --profile FILE (with --all for every recording)",
                ) from error

        return conditions_of


def as_json(outcome: Relabelled) -> dict[str, Any]:
    """Return an outcome as `--json` prints it."""
    from restock.ingest.store.manifest import score_rows

    return {
        "recording_id": outcome.recording_id,
        "source_file": outcome.source_file,
        "before": outcome.before,
        "after": outcome.after,
        "changed": outcome.changed,
        "named": outcome.named,
        "named_before": outcome.named_before,
        "label_scores": score_rows(outcome.scores),
    }
