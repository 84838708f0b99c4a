"""`restock info`: describe recordings, stores, or this machine."""

from __future__ import annotations

import platform
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from restock import native
from restock.cli import output
from restock.cli.data.totals import info_total
from restock.cli.words import Option, Positional
from restock.errors import ExitCode, RecordingError, counted, quoted, visible
from restock.process import cores, install_command, installed

if TYPE_CHECKING:
    from restock.ingest.containers.recording import Recording
    from restock.ingest.containers.storage import Watch

MAX_NAMED = 10  # listed attachments, metadata records, and entries per record
MAX_VALUE = 60  # characters of an entry's value that are shown
NANOSECONDS = 1_000_000_000
# QoS setting -> names in the order of rmw's enum: early versions of rosbag2 wrote its numbers.
_QOS = {
    "reliability": ("system_default", "reliable", "best_effort"),
    "durability": ("system_default", "transient_local", "volatile"),
    "history": ("system_default", "keep_last", "keep_all"),
}
MAX_PROFILES = 20  # per topic; further QoS profiles are ignored


@dataclass
class InfoCommand:
    """Show what is in recordings: format, times, topics, types, counts, rates, QoS.

    PATH is an MCAP file, a rosbag2 folder or one of its files, a ROS 1 bag, a folder of many
    recordings, or a quoted glob. Nothing is written, and messages are decoded only with --clocks. A
    recording that cannot be read is reported on stderr and makes the exit code 2; the others are
    still shown.

    For a store, it shows what it holds and whether it can be read. Without a PATH, it shows what is
    installed on this machine and what works: for a bug report. The exit code is then 2 if something
    that every command needs is missing; a missing extra is not an error.
    """

    paths: Annotated[tuple[str, ...], Positional("PATH")] = ()
    """Recordings, folders of recordings, globs, or stores."""
    definitions: Annotated[str | None, Option("DISTRO|PATH")] = None
    """Message definitions for recordings without their own: a ROS distribution (default: humble),
    or a folder (PACKAGE/msg/NAME.msg or .idl) or file that defines a robot's own types."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated files (exit code 3)."""
    clocks: bool = False
    """Also read the header stamps and compare the clocks: how far log time is ahead of the stamps,
    and how often stamps jump, go back, repeat or are zero."""
    json: bool = False
    """Print one JSON document: {"recordings": [{"path", "format", "messages", "topics", …}],
    "findings": [{"part", "name", "state", "what", "remedy"}]}; findings are about this machine or
    stores."""

    def run(self) -> int:
        """Describe the machine, each store and each recording; return the worst exit code."""
        stores = [path for path in self.paths if _is_store(path)]
        findings = self._findings(stores)
        wrong = any(one.state == "wrong" for one in findings)
        code, entries = self._describe([path for path in self.paths if path not in stores])
        if self.json:
            found = [one._asdict() for one in findings]
            output.print_json({"recordings": entries, "findings": found})
        elif findings:
            columns = ["part", "name", "state", "what", "remedy"]
            shown = columns if any(one.remedy for one in findings) else columns[:-1]
            output.print_table([one._asdict() for one in findings], shown)
        return ExitCode.USAGE if wrong else code

    def _findings(self, stores: Sequence[str]) -> list[Finding]:
        """Check the stores, or this machine if no path is given."""
        if self.paths and not stores:
            return []

        if not self.paths:
            return check_machine()
        return [finding for path in stores for finding in check_store(path)]

    def _describe(self, paths: Sequence[str]) -> tuple[ExitCode, list[dict[str, Any]]]:
        """Describe each recording; return the worst exit code, and the descriptions."""
        from restock.ingest.containers.open_recording import recordings_in
        from restock.ingest.decoding.definitions import choose_definitions

        choose_definitions(self.definitions)
        entries: list[dict[str, Any]] = []
        code, refused = ExitCode.OK, 0
        for name in paths:
            try:
                found = recordings_in(name)
            except RecordingError as error:
                sys.stderr.write(f"restock: {error}\n")
                code = ExitCode.USAGE
                continue
            for path in found:
                try:
                    with output.progress(f"info {path.name}", None) as advance:
                        entry = describe_recording(
                            path,
                            definitions=self.definitions,
                            salvage=self.salvage,
                            clocks=self.clocks,
                            watch=advance.part,
                        )
                except RecordingError as error:
                    sys.stderr.write(f"restock: {error}\n")
                    code, refused = ExitCode.USAGE, refused + 1
                    continue
                if entry["damage"] and code == ExitCode.OK:
                    code = ExitCode.LOSSY
                entries.append(entry)
                if not self.json:
                    _print(entry)
        if len(entries) > 1 and not self.json:
            output.print_text(info_total(entries, refused))
        return code, entries


def describe_recording(
    path: Path | str,
    *,
    definitions: str | None = None,
    salvage: bool = False,
    clocks: bool = False,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Return format, size, time span and topics of a recording; only `clocks` decodes messages.

    Times are log times. `rate_hz` is a topic's number of messages divided by the recording's
    duration. With `clocks`, all messages are read to compare header stamps with log times; the
    result has a `clock` per topic, and `integrity`: whether checksums confirm what was read.
    `watch` is called with the progress.

    Raises:
        RecordingError: the recording cannot be opened; see `open_recording`.
    """
    from restock.ingest.containers.open_recording import open_recording
    from restock.ingest.containers.storage import LATEST_NS

    with open_recording(path, definitions=definitions, salvage=salvage, watch=watch) as recording:
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
                    "qos": parse_qos(recording.qos(topic.name)),
                    **({"clock": compared.get(topic.name)} if clocks else {}),
                }
                for topic in recording.topics.values()
            },
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


def parse_qos(text: str) -> list[dict[str, Any]]:
    """Return the QoS profiles that publishers offered, without duplicates.

    Reads reliability, durability, history and depth, if the text has them. The text is not parsed
    as YAML, because that is slow and the text may be damaged.
    """
    found: list[dict[str, Any]] = []
    for block in re.split(r"^- ", text, flags=re.MULTILINE)[1 : MAX_PROFILES + 1]:
        values = dict(re.findall(r"^\s*(\w+):\s*(\w+)\s*$", block, re.MULTILINE))
        one: dict[str, Any] = {}
        for key, names in _QOS.items():
            if (value := values.get(key)) is not None:
                known = value.isascii() and value.isdigit() and int(value) < len(names)
                one[key] = names[int(value)] if known else value
        if (depth := values.get("depth", "")).isascii() and depth.isdigit():
            one["depth"] = int(depth)
        if one and one not in found:
            found.append(one)
    return found


def _clocks(recording: Recording) -> dict[str, dict[str, Any]]:
    """Compare the clocks of every topic that can be decoded."""
    from restock.ingest.steps.clocks import STAMP, topic_clock

    wanted = {
        name: [STAMP] if STAMP in recording.leaves(name) else []
        for name, topic in recording.topics.items()
        if topic.skipped is None
    }
    return {
        name: topic_clock(name, columns).as_row()
        | {"log_backsteps": recording.accounts[name].log_backsteps}
        for name, columns in recording.read(wanted).items()
    }


def _date(stamp_ns: int) -> str:
    try:
        moment = datetime.fromtimestamp(stamp_ns // NANOSECONDS, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns is not a date"
    return moment.isoformat().replace("+00:00", "Z")


def _is_store(path: str) -> bool:
    # Look only for Delta logs: `is_store` would import DuckDB even if all paths are recordings.
    logs = [Path(path, table, "_delta_log") for table in ("transitions", "recordings")]
    return "://" in path or all(log.is_dir() for log in logs)


def _size(count: int) -> str:
    """Format bytes in MB, or in kB below one MB."""
    return f"{count / 1e6:.1f} MB" if count >= 999_950 else f"{count / 1e3:.1f} kB"


def _names(names: list[str]) -> str:
    """List names without duplicates, with the count of a name that occurs more than once."""
    often = Counter(names)
    listed = [
        f"{name or '(unnamed)'}{f' ({count})' if count > 1 else ''}"
        for name, count in often.items()
    ]
    more = f" and {len(listed) - MAX_NAMED:,} more" if len(listed) > MAX_NAMED else ""
    return ", ".join(listed[:MAX_NAMED]) + more


def _qos(profile: dict[str, Any]) -> str:
    """Format a QoS profile, as in `reliable, volatile, 10` (keeps 10 messages) or `keep_all`."""
    kept = profile.get("history")
    if kept == "keep_last" and "depth" in profile:
        kept = str(profile["depth"])
    words = (profile.get("reliability"), profile.get("durability"), kept)
    return ", ".join(word for word in words if word)


def _print(entry: dict[str, Any]) -> None:
    clocked = entry["integrity"] is not None
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
        _size(entry["size_bytes"]),
    )
    sys.stdout.write("  ".join(part for part in about if part) + "\n")
    clock = output.CLOCK_COLUMNS if clocked else []
    mixed = {topic["encoding"] for topic in entry["topics"].values()} - {"cdr"}
    coded = ["encoding"] if mixed and entry["format"] != "ros1" else []
    qos = ["offered QoS"] if any(row["offered QoS"] for row in rows) else []
    shown = ["topic", "type", *coded, "messages", "rate Hz", *clock, *qos]
    output.print_table(rows, shown)
    if not clocked:
        sys.stdout.write("not decoded, so damage may be missed: --clocks reads every message\n")
    output.print_skipped({name: topic["skipped"] for name, topic in entry["topics"].items()})
    for what, names in (
        ("attachments", [item["name"] for item in entry["attachments"]]),
        ("metadata records", entry["metadata"]),
    ):
        if names:
            sys.stdout.write(f"{what}, {len(names):,}: {_names(names)}\n")
    for record in entry["says"]:
        entries = list(record["entries"].items())
        pairs = [f"{name}={value[:MAX_VALUE]}" for name, value in entries[:MAX_NAMED]]
        if len(entries) > MAX_NAMED:
            pairs.append(f"and {len(entries) - MAX_NAMED:,} more")
        sys.stdout.write(visible(f"{record['source']}: {', '.join(pairs)}") + "\n")
    sys.stdout.flush()
    for line in entry["damage"]:
        sys.stderr.write(visible(f"{entry['path']}: damaged: {line}") + "\n")
    for line in entry["notes"]:
        sys.stderr.write(visible(f"{entry['path']}: {line}") + "\n")


EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")
FOR_DEVELOPERS = {"dev", "test", "site", "fuzz", "bench"}


class Finding(NamedTuple):
    """One line of the report: what was checked, its state, and what to do about it."""

    part: str
    name: str
    state: str  # ok | missing (an extra) | wrong
    what: str
    remedy: str = ""


def check_machine() -> list[Finding]:
    """Check what is installed on this machine, and what works."""
    return [*_machine(), *_packages(), _torch(), _native(), _disk(Path.cwd())]


def _machine() -> list[Finding]:
    from restock import __version__

    return [
        Finding("restock", "version", "ok", __version__),
        Finding("machine", "python", "ok", platform.python_version()),
        Finding("machine", "system", "ok", f"{platform.platform()}, {cores()} cores"),
    ]


def _packages() -> list[Finding]:
    """Check what Restock and its extras need, and say how to install what is missing."""
    from packaging.requirements import Requirement

    findings = []
    for requirement in map(Requirement, requires("restock") or []):
        extra = EXTRA.search(str(requirement.marker or ""))
        if requirement.name == "restock" or (extra and extra[1] in FOR_DEVELOPERS):
            continue
        if requirement.marker and not requirement.marker.evaluate(
            {"extra": extra[1] if extra else ""}
        ):
            continue  # this requirement is for another platform
        name, wanted = requirement.name, requirement.specifier
        part = f"extra {extra[1]}" if extra else "needed"
        try:
            found, state = version(name), "ok"
        except PackageNotFoundError:
            found, state = "not installed", "missing" if extra else "wrong"
        if state == "ok" and not wanted.contains(found, prereleases=True):
            found, state = f"{found}, and {wanted} is needed", "wrong"
        remedy = "" if state == "ok" else install_command(extra[1] if extra else "")
        findings.append(Finding(part, name, state, found, remedy))
    return findings


def _torch() -> Finding:
    if not installed("torch"):
        return Finding("works", "torch", "missing", "not installed", install_command("train"))
    try:
        import torch
    except (ImportError, OSError) as error:
        return Finding("works", "torch", "wrong", f"cannot be imported: {error}", "reinstall it")
    threads = f"{torch.get_num_threads()} threads"
    if torch.cuda.is_available():
        return Finding("works", "torch", "ok", f"{torch.cuda.get_device_name()}, {threads}")
    return Finding("works", "torch", "ok", f"no CUDA device, {threads}")


def _native() -> Finding:
    """Check whether the compiled training update is available; without it, training is slower."""
    state = native.state()
    if native.IS_THERE:
        return Finding("works", "native code", "ok", state)
    remedy = (
        "install a C compiler and reinstall restock from source; only training is slower without it"
    )
    return Finding("works", "native code", "missing", state, remedy)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    return Finding("machine", "disk here", "ok", f"{free / 1e9:.1f} GB free")


def check_store(path: str) -> list[Finding]:
    """Check what a store holds, how long it takes to open, and whether it can be read.

    Raises:
        StoreError: there is no store, or it cannot be read.
    """
    from restock.replay.store.store import Store

    began = time.monotonic()
    with Store(path) as store:
        store.verify()
        opened = time.monotonic() - began
        counts: dict[str, Any] = dict(
            store.sql(
                "SELECT 'recordings' AS name, count(*) AS n FROM recordings"
                " UNION ALL SELECT 'transitions', count(*) FROM transitions"
            ).fetchall()
        )
        files = len(store.files["stored_transitions"])
        holds = f"{counts['transitions']:,} transitions of {counts['recordings']:,} recordings"
        files_are = f"{files:,} Parquet files"
        found = [
            Finding("store", "version", "ok", f"{store.version}, opened in {opened:.2f} s"),
            Finding("store", "rows", "ok", f"{holds} in {files_are}"),
        ]
        if changed := len(store.changed_by_others):
            what = f"not used: another tool may have changed {counted(changed, 'recording')}"
            remedy = f"rows are counted: `restock store compact {quoted(path)}` makes new summaries"
            found.append(Finding("store", "summaries", "ok", what, remedy))
        return found
