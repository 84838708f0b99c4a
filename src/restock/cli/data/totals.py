"""Summaries of many recordings: a line for each recording, and a total."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import RestockError, counted, visible
from restock.files import first_line

if TYPE_CHECKING:
    from restock.ingest.pipeline import IngestResult

HOUR_S = 3600.0
STATUSES = ("written", "tagged", "dry run", "unchanged", "refused")


class IngestSummary:
    """Counts the recordings of one `restock ingest`; formats a line for each, and the total."""

    def __init__(self, paths: Sequence[Path]) -> None:
        folders = [str(path.parent.absolute()) for path in paths]
        self.folder = os.path.commonpath(folders) if folders else ""
        self.statuses = Counter[str]()
        self.labels = Counter[str]()
        self.reasons = Counter[str]()
        self.found = Counter[str]()  # problem -> number of recordings with it
        self.transitions = self.skipped = self.dropped = 0
        self.duration_s = 0.0

    def name(self, path: Path | str) -> str:
        """Return a recording's path, relative to the folder that contains all recordings."""
        return visible(os.path.relpath(path, self.folder)) if self.folder else visible(str(path))

    def add(self, outcome: IngestResult) -> str:
        """Count an ingested recording; return the line to print about it."""
        from restock.ingest.store.manifest import UNUSED

        row = outcome.manifest
        labels = labels_of(outcome.conditions)
        used = [topic for topic in row["topics"] if topic["reason"] != UNUSED]
        skipped = sum(topic["skipped"] for topic in used)
        flags = {
            "lost data": outcome.lost_messages,
            "contradicts itself": outcome.contradictions,
            "repeats another": outcome.repeats,
        }
        wrong = [name for name, found in flags.items() if found]
        self.statuses[outcome.status] += 1
        self.labels.update(labels)
        self.found.update(wrong)
        self.transitions += row["transitions"]
        self.duration_s += row["duration_s"]
        self.skipped += skipped
        self.dropped += sum(drop["count"] for drop in row["drops"])
        parts = [
            f"{row['transitions']:,} rows",
            f"{row['duration_s'] / 60:.1f} min",
            *([in_words(labels)] if labels else []),
            *([f"{counted(skipped, 'message')} skipped"] if skipped else []),
            *wrong,
        ]
        return f"{outcome.status:<9} {self.name(outcome.path)}: {', '.join(parts)}"

    def refuse(self, path: Path | str, error: RestockError) -> str:
        """Count a recording that was refused; return the line to print about it."""
        what = first_line(error.what)
        self.statuses["refused"] += 1
        self.reasons[re.sub(r"\b\d[\d,.]*", "N", what.partition(":")[0])] += 1
        return f"{'refused':<9} {self.name(path)}: {what}"

    def total(self) -> str:
        """Return the total of all recordings, in one paragraph."""
        whole = sum(self.statuses.values())
        statuses = {name: self.statuses[name] for name in STATUSES if self.statuses[name]}
        parts = [
            f"{counted(whole, 'recording')} ({in_words(statuses)})",
            f"{self.duration_s / HOUR_S:.2f} h",
            counted(self.transitions, "row"),
            f"labels: {in_words(self.labels) or 'none'}",
            f"{counted(self.dropped, 'tick')} dropped",
            f"{counted(self.skipped, 'message')} skipped",
            in_words(self.found) or "nothing lost",
        ]
        if self.reasons:
            parts.append("; ".join(f"{n:,} {why}" for why, n in self.reasons.most_common()))
        return f"total: {'; '.join(parts)}. --verbose has the details."


def labels_of(conditions: Mapping[str, int]) -> dict[str, int]:
    """Return the numbers of rows of the labels, without `nominal` and labels without rows."""
    return {name: rows for name, rows in conditions.items() if rows and name != "nominal"}


def in_words(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {number:,}" for name, number in counts.items())


def info_total(entries: Sequence[Mapping[str, Any]], refused: int) -> str:
    """Return the total of several recordings that `restock info` described."""
    robots = Counter(tuple(sorted(entry["topics"])) for entry in entries)
    topics = set.intersection(*(set(topics) for topics in robots)) if robots else set()
    damaged = sum(bool(entry["damage"]) for entry in entries)
    parts = [
        counted(len(entries) + refused, "recording"),
        f"{sum(entry['duration_s'] or 0 for entry in entries) / HOUR_S:.2f} h",
        f"{sum(entry['size_bytes'] for entry in entries) / 1e9:.2f} GB",
        counted(sum(entry["messages"] for entry in entries), "message"),
        f"{damaged:,} damaged",
        f"{refused:,} refused",
    ]
    common = f"topics of all: {', '.join(sorted(topics)) or 'none'}"
    return f"total: {'; '.join(parts)}\n{common} ({counted(len(robots), 'set')} of topics)"
