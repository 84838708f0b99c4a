"""Description of a recording as plain data: the content of `restock info`."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from restock.ingest.containers.formats.storage import Watch
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import LATEST_NS
from restock.ingest.steps.clocks import STAMP, topic_clock

NANOSECONDS = 1_000_000_000
# rmw's numbers, which rosbag2 wrote before it wrote names
_QOS = {
    "reliability": ("system_default", "reliable", "best_effort"),
    "durability": ("system_default", "transient_local", "volatile"),
    "history": ("system_default", "keep_last", "keep_all"),
}
MAX_PROFILES = 20  # of a topic: publishers that offer others
JUMP_S = 1.0  # a change of (log time - stamp) that means a clock was set, as in profiles


def describe_recording(
    path: Path | str,
    *,
    typestore: str | None = None,
    salvage: bool = False,
    clocks: bool = False,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Format, size, time span and topics of one recording; nothing is decoded but for `clocks`.

    Times are log times. `rate_hz` is the messages of a topic over the recording's duration. With
    `clocks` the whole recording is read for its header stamps, every topic has its `clock`, and
    `integrity` is known; `watch` is told how far that is.

    Raises:
        RecordingError: it cannot be opened; see `open_recording`.
    """
    with open_recording(path, typestore=typestore, salvage=salvage, watch=watch) as recording:
        span = recording.span_ns
        duration_s = (span[1] - span[0]) / NANOSECONDS if span else None
        notes = list(recording.notes)
        if span and (span[0] < 0 or span[1] == LATEST_NS):
            notes.append("its log times are before 1970 or after 2262: implausible stamps")
        compared = _clocks(recording) if clocks else {}
        return {
            "path": str(path),
            "format": recording.format,
            "files": [str(file) for file in recording.files],
            "size_bytes": recording.size_bytes,
            "start_ns": span[0] if span else None,
            "end_ns": span[1] if span else None,
            "start": _date(span[0]) if span else None,
            "end": _date(span[1]) if span else None,
            "duration_s": duration_s,
            "messages": recording.messages,
            "integrity": recording.integrity if clocks else None,
            "topics": {
                topic.name: {
                    "type": topic.type,
                    "messages": topic.expected,
                    "rate_hz": topic.expected / duration_s if duration_s else None,
                    "encoding": topic.encoding,
                    "definition": topic.definition,
                    "skipped": topic.skipped,
                    "qos": offered(recording.qos(topic.name)),
                    **({"clock": compared.get(topic.name)} if clocks else {}),
                }
                for topic in recording.topics.values()
            },
            "chunks": [packed._asdict() for packed in recording.packed],
            "attachments": [
                {"name": extra.name, "media_type": extra.media_type, "size_bytes": extra.size_bytes}
                for extra in recording.extras
                if extra.kind == "attachment"
            ],
            "metadata": [extra.name for extra in recording.extras if extra.kind == "metadata"],
            "says": [
                {"source": source, "entries": dict(entries)}
                for source, _, entries in recording.metadata
            ],
            "notes": notes,
            "damage": [item.what for item in recording.damage],
        }


def offered(text: str) -> list[dict[str, Any]]:
    """Return the quality of service that publishers offered, each profile once.

    Reads reliability, durability, history and depth as far as the file has them. It is not parsed
    as YAML: that is slow, and it may be damaged.
    """
    found: list[dict[str, Any]] = []
    for block in re.split(r"^- ", text, flags=re.MULTILINE)[1 : MAX_PROFILES + 1]:
        said = dict(re.findall(r"^\s*(\w+):\s*(\w+)\s*$", block, re.MULTILINE))
        one: dict[str, Any] = {}
        for key, names in _QOS.items():
            if (value := said.get(key)) is not None:
                known = value.isascii() and value.isdigit() and int(value) < len(names)
                one[key] = names[int(value)] if known else value
        if (depth := said.get("depth", "")).isascii() and depth.isdigit():
            one["depth"] = int(depth)
        if one and one not in found:
            found.append(one)
    return found


def _clocks(recording: Recording) -> dict[str, dict[str, Any]]:
    """Compare the clocks of every topic that can be decoded."""
    wanted = {
        name: [STAMP] if STAMP in recording.leaves(name) else []
        for name, topic in recording.topics.items()
        if topic.skipped is None
    }
    return {
        name: topic_clock(name, columns, JUMP_S).as_row()
        | {"log_backsteps": recording.accounts[name].log_backsteps}
        for name, columns in recording.read(wanted).items()
    }


def _date(stamp_ns: int) -> str:
    try:
        moment = datetime.fromtimestamp(stamp_ns // NANOSECONDS, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns is not a date"
    return moment.isoformat().replace("+00:00", "Z")
