"""`restock store label`: labels a store's transitions again from their stored signals."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode, counted

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
    shipped profile of that name, or the copy in the store. Another profile gives other conditions
    to the recordings ingested with a profile of the same name.

    Verdicts of people on labels (`restock review`) stay: they override the rules.
    """

    store: Annotated[Path, Positional()]
    """The store's folder."""
    profile: str | None = None
    """Use the conditions of this profile, a shipped one or a TOML file, for the recordings that
    were ingested with a profile of its name."""
    dry_run: bool = False
    """Do everything except writing, and print what would change."""
    json: bool = False
    """Print one JSON document: {"version", "recordings": [{"recording_id", "changed", …}]}."""

    def run(self) -> int:
        """Label the transitions again, and print what changed."""
        from restock.ingest.relabel import open_for_relabel, relabel_store

        store = open_for_relabel(self.store)
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

    def _conditions_of(self, store: StoreWriter) -> Callable[[str], Sequence[Condition]]:
        from restock.ingest.profile.profile import load_profile, parse_profile

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
                    return parse_profile(text, where=f"profile {name!r}").definitions
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
