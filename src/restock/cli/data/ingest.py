"""`restock ingest`: recordings -> labelled Parquet transitions in a store."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

from restock.cli import output
from restock.cli.data.totals import IngestSummary
from restock.cli.words import Option, Positional, Repeated
from restock.errors import (
    ConfigError,
    ExitCode,
    RecordingError,
    RestockError,
    StoreError,
    counted,
    visible,
)

if TYPE_CHECKING:
    from restock.ingest.batch import IngestJob
    from restock.ingest.pipeline import IngestResult


@dataclass
class IngestCommand:
    """Turn recordings into labelled transitions in a store.

    PATH is an MCAP file, a rosbag2 folder or one of its files, a ROS 1 bag, a folder of many
    recordings, or a quoted glob. Each recording is added as a whole or not at all. One that is
    already in the store with the same content and definitions is skipped; if its definitions
    changed, the new rows replace the old ones. A recording that cannot be used is reported on
    stderr and adds nothing; the others are still ingested.

    Exit codes: 0 all ingested (or unchanged), 2 nothing was written, 3 written, but a recording
    failed or messages of the topics used were lost.
    """

    paths: Annotated[tuple[str, ...], Positional("PATH")]
    """Recordings, folders of recordings, or globs."""
    store: Annotated[str | None, Option("STORE")] = None
    """The store's folder, or s3://bucket/prefix; created if missing. Required unless
    --dry-run."""
    profile: str = "warehouse_amr"
    """How topics become signals: the name of a shipped profile, or a TOML file."""
    dry_run: bool = False
    """Do everything except writing, and print the result."""
    force: bool = False
    """Also ingest unchanged recordings again."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated files (exit code 3)."""
    repeated: Literal["keep", "refuse", "replace"] = "keep"
    """What to do with a recording that mostly repeats another one in the store (a part of it, a
    copy, a drive recorded again): keep it and say so (the audit `repeated_steps` then fails),
    refuse it, or replace: recordings that are a part of it are removed from the store, and it is
    refused if the store holds as much or more of the drive."""
    tag: Annotated[tuple[str, ...], Repeated("KEY=VALUE")] = ()
    """A tag for the recordings: robot, site, firmware, map, shift, or any other name. It overrides
    tags from the recording or its path; KEY= removes a tag. May be given several times."""
    definitions: Annotated[str | None, Option("DISTRO|PATH")] = None
    """Message definitions for recordings without their own: a ROS distribution (default: humble),
    or a folder (PACKAGE/msg/NAME.msg or .idl) or file that defines a robot's own types."""
    verbose: bool = False
    """Print the details of each recording: topics, signals, labels, what was dropped and why.
    Several recordings otherwise get a line each, and a total."""
    watch: tuple[str, ...] | None = None
    """Keep running, and ingest each recording that arrives in the folders once it is complete; then
    print coverage and audits, with a line of log per event. A quoted COMMAND after --watch is run
    after new recordings, with a JSON document about them on its standard input. Put it last."""
    workers: int = 1
    """How many processes read recordings at the same time."""
    json: bool = False
    """Print one JSON document: {"recordings": [{"path", "status", "transitions", …}]}."""

    def run(self) -> int:
        """Ingest each recording; return the exit code for all."""
        if self.workers > 1:
            from restock.ingest.batch import warm_up

            warm_up()
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.profile.tag_rules import parse_tags

        if not self.paths:
            raise RecordingError("no path given", remedy="restock ingest PATH --store STORE")
        if self.store is None and not self.dry_run:
            raise ConfigError("no store given", remedy="give --store STORE, or --dry-run")
        if self.workers < 1:
            raise ConfigError(f"--workers must be 1 or more, got {self.workers}")
        tags = parse_tags(self.tag, empty=True)
        profile = load_profile(self.profile)  # before slow imports: fails if it does not exist

        from restock.ingest.batch import IngestJob, ingest_all
        from restock.ingest.decoding.definitions import choose_definitions
        from restock.ingest.store.writer import StoreWriter

        store = None if self.dry_run else self.store
        if store is not None:
            StoreWriter(store).expect_folder()  # fail once here, not for each recording
            StoreWriter(store).reach()
        chosen = choose_definitions(self.definitions)
        job = IngestJob(*(profile, store, self.force, self.salvage, chosen, self.repeated, tags))
        if self.watch is not None:
            self._watch(job)
        paths, failures = self._recordings()
        outcomes: list[dict[str, Any]] = []
        in_lines = len(paths) > 1 and not (self.verbose or self.json)
        summary = IngestSummary(paths) if in_lines else None
        lossy = False
        with output.progress("ingest", len(paths)) as advance:
            for path, result in ingest_all(paths, job, workers=self.workers, watch=advance.part):
                advance(1, path.name)
                if isinstance(result, RestockError):
                    reported = str(result)
                    if isinstance(result, StoreError):  # the message names only the store
                        reported = f"{visible(str(path))}: was not added: {reported}"
                    failures.append({"path": str(path), "status": "failed", "error": reported})
                    line = summary.refuse(path, result) if summary is not None else reported
                    sys.stderr.write(f"restock: {line}\n")
                    continue
                lossy |= result.lossy
                outcomes.append(as_json(result))
                if summary is not None:
                    output.print_text(summary.add(result))
                elif not self.json:
                    show(result)
        if store is not None and outcomes:
            StoreWriter(store).clean()
        if summary is not None:
            output.print_text(summary.total())
        if self.json:
            output.print_json({"recordings": outcomes + failures})
        if not outcomes:
            return ExitCode.USAGE
        return ExitCode.LOSSY if failures or lossy else ExitCode.OK

    def _watch(self, job: IngestJob) -> NoReturn:
        if job.store is None or self.force or len(self.watch or ()) > 1:
            raise ConfigError(
                "takes one command, in quotes, or none, and neither --dry-run nor --force",
                where="--watch",
                remedy="restock ingest FOLDER --store STORE --watch",
            )
        from restock.cli.data.watch import Watch

        hook = self.watch[0] if self.watch else None
        Watch(self.paths, job, hook, self.workers, self.json).run()

    def _recordings(self) -> tuple[list[Path], list[dict[str, Any]]]:
        """Return the recordings at all paths, each once, and a failure row per path without any."""
        from restock.ingest.containers.open_recording import recordings_in

        paths: dict[Path, None] = {}
        failures: list[dict[str, Any]] = []
        for name in self.paths:
            try:
                paths.update(dict.fromkeys(recordings_in(name)))
            except RecordingError as error:
                sys.stderr.write(f"restock: {error}\n")
                failures.append({"path": name, "status": "failed", "error": str(error)})
        return list(paths), failures


# Entries of a manifest that are not printed: definitions, and values printed under other keys.
_LEFT_OUT = (
    *("task_json", "conditions_json", "profile_toml", "source_file", "label_scores"),
    "label_counts",
)


# Attributes of a result that are printed.
_PRINTED = ("path", "status", "version", "messages", "conditions", "named", "exposures")


def as_json(outcome: IngestResult) -> dict[str, Any]:
    """Return an outcome as `--json` prints it."""
    from restock.ingest.store.manifest import GOOD

    # Counts of events by condition; manifests written by early versions lack them.
    counts = {row["condition"]: row for row in outcome.manifest.get("label_counts") or []}

    row = {key: value for key, value in outcome.manifest.items() if key not in _LEFT_OUT}
    return {
        **{name: getattr(outcome, name) for name in _PRINTED},
        "label_scores": [
            {
                **counts.get(score["condition"], {}),
                **score,
                "good": None not in (p, r) and min(p, r) >= GOOD,
            }
            for score in outcome.manifest["label_scores"]
            for p, r in [(score["precision"], score["recall"])]
        ],
        "endings": outcome.endings,
        "losses": outcome.lost_messages,
        "notes": outcome.notes,
        "repeats": asdict(outcome.repeats) if outcome.repeats else None,
        **row,
    }


def show(outcome: IngestResult) -> None:
    """Print the counts of one recording as tables."""
    from restock.ingest.profile.tag_rules import in_words
    from restock.ingest.store.manifest import UNUSED

    row = outcome.manifest
    output.print_text(
        f"{visible(outcome.path)}  {row['format']}  {row['duration_s']:.1f} s  "
        f"recording {row['recording_id']}"
    )
    episodes = (
        f"{counted(row['transitions'], 'transition')} in {counted(row['episodes'], 'episode')}"
    )
    tags = in_words(row["tags"] or {})
    if outcome.status in ("unchanged", "tagged"):
        how = f"now with tags {tags or 'none'}, " if outcome.status == "tagged" else ""
        output.print_text(
            f"{outcome.status}: {how}{episodes} are in the store already"
            " (--force ingests them again)"
        )
        notes = "\n".join([*map(visible, outcome.notes), ""])
        output.print_text(notes)
        return
    into = f"{outcome.status}: {episodes}, profile {row['profile']} {row['profile_hash']}"
    output.print_text(into + (f", store version {outcome.version}" if outcome.version else ""))
    if tags:
        output.print_text(f"tags: {tags}")
    used = [topic for topic in row["topics"] if topic["reason"] != UNUSED]
    clocks = {clock["topic"]: clock for clock in row["clocks"] or []}
    used = [{**topic, **output.clock_cells(clocks.get(topic["topic"]))} for topic in used]
    columns = ["topic", "type", "expected", "decoded", "skipped", *output.CLOCK_COLUMNS]
    output.print_table(used, output.reported(used, columns))
    output.print_skipped({topic["topic"]: topic["reason"] for topic in used})
    if len(used) < len(row["topics"]):
        rest = [topic["expected"] for topic in row["topics"] if topic["reason"] == UNUSED]
        topics = counted(len(rest), "further topic")
        output.print_text(f"{topics} ({sum(rest):,} messages): not used by the profile")
    if row["signals"]:
        output.print_table(
            [
                {
                    "signal": signal["name"],
                    "unit": signal["unit"],
                    "from": f"{signal['topic']} {signal['path']}",
                    "messages": signal["messages"],
                    "with a value": signal["found"],
                    "ticks with a value": signal["steps"],
                }
                for signal in row["signals"]
            ]
        )
    if row.get("cameras"):
        output.print_table(
            [
                {
                    "camera": one["camera"],
                    "messages": one["expected"],
                    "frames kept": one["kept"],
                    "bytes": one["size_bytes"],
                    "thinned out": one["thinned"],
                    "used at no step": one["unused"],
                    "no image": sum(problem["count"] for problem in one["problems"]),
                    "steps with a frame": one["steps"],
                }
                for one in row["cameras"]
            ]
        )
    scores = {score.condition: score for score in outcome.scores}

    def score_cells(name: str) -> dict[str, Any]:
        score = scores.get(name)
        return {
            "precision": score.precision if score else None,
            "recall": score.recall if score else None,
            "truly": score.support if score else None,
            "": score.shortfall if score else "",
        }

    labels = [
        {
            "condition": name,
            "transitions": count,
            "named by it": outcome.named[name],
            "share": outcome.named[name] / max(row["transitions"], 1),
            **score_cells(name),
        }
        for name, count in outcome.conditions.items()
    ]
    output.print_table(labels, output.reported(labels))
    if outcome.exposures:  # exposures are in a table of their own
        labels = [
            {"exposure": name, "transitions": count, **score_cells(name)}
            for name, count in outcome.exposures.items()
        ]
        output.print_table(labels, output.reported(labels))
    for line in _list_unknown(row):
        output.print_text(line)
    output.print_text(
        f"{counted(row['ticks'], 'tick')} = {counted(row['transitions'], 'transition')}"
        f" + {counted(row['episode_ends'], 'episode end')}"
        f" + {sum(drop['count'] for drop in row['drops']):,} dropped"
    )
    if row["drops"]:
        output.print_table([{"dropped": d["reason"], "ticks": d["count"]} for d in row["drops"]])
    endings = ", ".join(f"{reason} {count}" for reason, count in outcome.endings.items())
    output.print_text(f"episodes ended by: {endings}")
    for item in row["stand_ins"]:
        output.print_text(f"no {item['input']}: {item['instead']}")
    for note in outcome.notes:
        output.print_text(note)
    for loss in outcome.lost_messages:
        output.print_text(f"lost: {loss}")
    for contradiction in outcome.contradictions:
        output.print_text(contradiction)
    output.print_text()


def _list_unknown(row: Mapping[str, Any]) -> list[str]:
    """List the conditions that are unknown for a recording's rows, one line per reason."""
    by_reason: dict[str, list[str]] = {}
    for one in row["unknown_conditions"] or []:
        by_reason.setdefault(one["because"], []).append(one["condition"])
    return [f"unknown (null, {why}): {', '.join(names)}" for why, names in by_reason.items()]
