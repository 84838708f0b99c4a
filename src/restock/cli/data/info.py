"""`restock info`: what is in these recordings?"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from restock.errors import ExitCode, RecordingError, visible

NAMED = 10  # attachments, metadata records and their entries that are listed
LONGEST = 60  # characters of an entry's value that are shown


@dataclass
class InfoCommand:
    """Show what is in recordings: format, times, compression, topics, types, counts, rates, QoS.

    PATH is an MCAP file, a rosbag2 folder or one of its files, a ROS 1 bag, a folder of many
    recordings, or a quoted glob. Nothing is written, and messages are decoded only with --clocks. A
    recording that cannot be read is reported on stderr and makes the exit code 2; the others are
    still shown.
    """

    paths: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Recordings, folders of recordings, or globs."""
    typestore: str | None = None
    """ROS 2 distribution whose message definitions are used for recordings without their own.
    Default: humble."""
    definitions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of .msg and .idl files (PACKAGE/msg/NAME.msg) that define a robot's own types, for
    recordings that do not contain the definitions."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated files (exit code 3)."""
    clocks: bool = False
    """Also read the header stamps and compare the clocks: how far log time is ahead of the stamps,
    and how often stamps jump, go back, repeat or are zero."""
    json: bool = False
    """Print one JSON document: {"recordings": [{"path", "format", "messages", "topics", …}]}."""

    def run(self) -> int:
        """Describe each recording; the exit code of the worst of them."""
        from restock.cli import output
        from restock.ingest.containers.open_recording import recordings_in, with_definitions
        from restock.ingest.describe import describe_recording

        if not self.paths:
            raise RecordingError("no path given", remedy="restock info PATH [PATH …]")
        typestore = with_definitions(self.typestore, self.definitions)
        entries: list[dict[str, Any]] = []
        code = ExitCode.OK
        for name in self.paths:
            try:
                paths = recordings_in(name)
            except RecordingError as error:
                sys.stderr.write(f"restock: {error}\n")
                code = ExitCode.USAGE
                continue
            for path in paths:
                try:
                    with output.progress(f"info {path.name}", None) as advance:
                        entry = describe_recording(
                            path,
                            typestore=typestore,
                            salvage=self.salvage,
                            clocks=self.clocks,
                            watch=advance.part,
                        )
                except RecordingError as error:
                    sys.stderr.write(f"restock: {error}\n")
                    code = ExitCode.USAGE
                    continue
                if entry["damage"] and code == ExitCode.OK:
                    code = ExitCode.LOSSY
                entries.append(entry)
                if not self.json:
                    _print(entry)
        if self.json:
            output.print_json({"recordings": entries})
        return code


def _packed(chunks: dict[str, Any]) -> str:
    """How a file's messages are packed, in a line."""
    stored, plain = chunks["stored_bytes"], chunks["plain_bytes"]
    share = f", {stored / plain:.0%} of {plain / 1e6:.1f} MB" if chunks["compression"] else ""
    kind = chunks["compression"] or "not compressed"
    number = f"{chunks['chunks']:,} chunk{'s' if chunks['chunks'] != 1 else ''}"
    return visible(f"{number}, {kind}: {stored / 1e6:.1f} MB{share if plain else ''}")


def _qos(profile: dict[str, Any]) -> str:
    """reliable, volatile, 10: how many messages are kept last, or keep_all."""
    kept = profile.get("history")
    if kept == "keep_last" and "depth" in profile:
        kept = str(profile["depth"])
    words = (profile.get("reliability"), profile.get("durability"), kept)
    return ", ".join(word for word in words if word)


def _print(entry: dict[str, Any]) -> None:
    from restock.cli import output

    clocked = any("clock" in topic for topic in entry["topics"].values())
    rows = [
        {
            **(output.clock_cells(topic.get("clock")) if clocked else {}),
            "topic": name,
            "type": topic["type"],
            "messages": topic["messages"],
            "rate Hz": topic["rate_hz"],
            "encoding": topic["encoding"],
            "offered QoS": "; ".join(map(_qos, topic["qos"])),
        }
        for name, topic in entry["topics"].items()
    ]
    about = (
        visible(entry["path"]),
        entry["format"],
        f"{entry['messages']:,} messages",
        f"{entry['duration_s']:.1f} s" if entry["duration_s"] is not None else "",
        f"{entry['start']} to {entry['end']}" if entry["start"] else "",
        f"{entry['size_bytes'] / 1e6:.1f} MB",
    )
    sys.stdout.write("  ".join(part for part in about if part) + "\n")
    clock = output.CLOCK_COLUMNS if clocked else []
    mixed = {topic["encoding"] for topic in entry["topics"].values()} - {"cdr"}
    coded = ["encoding"] if mixed and entry["format"] != "ros1" else []
    qos = ["offered QoS"] if any(row["offered QoS"] for row in rows) else []
    shown = ["topic", "type", *coded, "messages", "rate Hz", *clock, *qos]
    for packed in entry["chunks"]:
        sys.stdout.write(_packed(packed) + "\n")
    output.print_table(rows, shown)
    output.print_skipped({name: topic["skipped"] for name, topic in entry["topics"].items()})
    for what, names in (
        ("attachments", [item["name"] for item in entry["attachments"]]),
        ("metadata records", entry["metadata"]),
    ):
        if names:
            more = f" and {len(names) - NAMED:,} more" if len(names) > NAMED else ""
            listed = ", ".join(name or "(unnamed)" for name in names[:NAMED])
            sys.stdout.write(f"{what}, {len(names):,}: {listed}{more}\n")
    for said in entry["says"]:
        entries = list(said["entries"].items())
        pairs = [f"{name}={value[:LONGEST]}" for name, value in entries[:NAMED]]
        if len(entries) > NAMED:
            pairs.append(f"and {len(entries) - NAMED:,} more")
        sys.stdout.write(visible(f"{said['source']}: {', '.join(pairs)}") + "\n")
    sys.stdout.flush()
    for line in entry["damage"]:
        sys.stderr.write(visible(f"{entry['path']}: damaged: {line}") + "\n")
    for line in entry["notes"]:
        sys.stderr.write(visible(f"{entry['path']}: {line}") + "\n")
