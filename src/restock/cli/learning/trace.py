"""`restock trace`: where did this sampled row come from?"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from restock.replay.trace import trace as tracing
    from restock.replay.trace.origin import Origin

_LONG = 6  # entries of a list that are printed
_TABLES = ("clocks", "signals", "stand_ins")  # of a manifest: for `--json` and `restock sql`


@dataclass
class TraceCommand:
    """Trace a sampled row to its source, down to the recording's messages.

    Of a RUN, ROW is an audited row, STEP/ROW: the gradient step and the row of its batch. Without
    ROW it lists those with the largest TD errors. Of a PANEL, ROW is a row number; of a STORE, a
    transition id. Shows the audited row, the row of the panel and of the store it was drawn from,
    the recording and its time in it, and, with --recording, the messages that were held at
    that tick. A fresh row leads to its episode in the twin, and to the spec that draws it again.
    """

    place: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|PANEL|STORE")]
    """Where the row is."""
    row: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[ROW]")] = None
    """STEP/ROW of a run (1200/17), a row number of a panel, a transition id of a store."""
    recording: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """The recording it is from: shows the messages it was made of."""
    profile: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """The profile that read the recording, if it is not a shipped one."""
    store: Annotated[str | None, tyro.conf.arg(metavar="STORE")] = None
    """Where the store is now, if it was moved."""
    version: Annotated[str | None, tyro.conf.arg(metavar="N|TIME")] = None
    """Of a STORE as it was: a version's number, or a time (2026-11-01T08:00Z); the newest."""
    panel: Annotated[Path | None, tyro.conf.arg(metavar="PANEL")] = None
    """Where the panel is now, if it was moved."""
    rows: int = 20
    """How many audited rows to list, where no ROW is given."""
    json: bool = False
    """Print one JSON document (without ROW: a list)."""

    def run(self) -> None:
        """Trace, and print what was found."""
        from restock.cli import output
        from restock.ingest.store.version import given_version
        from restock.replay.trace.trace import TracePlaces, audited_rows, trace_row

        if self.row is None:
            listed = audited_rows(self.place, self.rows)
            if self.json:
                output.print_json(listed)
                return
            output.print_table(listed, title="audited rows, largest TD error first")
            if listed:
                output.say(f"`restock trace {self.place} {listed[0]['row']}` follows one")
            return
        version = given_version(self.version)
        where = TracePlaces(self.store, self.panel, self.recording, self.profile, version)
        trace = trace_row(self.place, self.row, where)
        if self.json:
            output.print_json(document(trace))
        else:
            _print(trace, self.recording is not None)


def document(trace: tracing.Trace) -> dict[str, Any]:
    """A trace as one document: what `--json` prints. What is not known is null."""
    origin = asdict(trace.origin) if trace.origin is not None else None
    names = ("transition", "reward_parts", "store", "recording", "moment", "topics", "messages")
    return {
        "audit": trace.audit,
        "episode": trace.episode,
        "panel": trace.panel,
        **{name: origin[name] if origin else None for name in names},
        "notes": trace.notes + (origin["notes"] if origin else []),
    }


def _print(trace: tracing.Trace, with_messages: bool) -> None:
    from restock.cli import output

    _section("as it was sampled", trace.audit)
    _section("its episode of the twin", trace.episode)
    stored = trace.origin.transition if trace.origin is not None else {}
    packed = {k: v for k, v in (trace.panel or {}).items() if k == "path" or k not in stored}
    _section("its row of the panel", packed)
    if trace.origin is not None:
        _print_origin(trace.origin, with_messages)
    for note in trace.notes + (trace.origin.notes if trace.origin else []):
        output.stdout().print(f"note: {note}", markup=False)


def _print_origin(origin: Origin, with_messages: bool) -> None:
    from restock.cli import output

    _section("its row of the store", {**origin.store, **origin.transition})
    _section("what its reward is made of", origin.reward_parts)
    manifest = origin.recording or {}
    _section("its recording", {k: v for k, v in manifest.items() if k not in _TABLES})
    _section("when it was", origin.moment)
    if origin.messages:
        output.print_table(
            [
                {
                    "input": message.input,
                    "topic": message.topic,
                    "log_time_ns": message.log_time_ns,
                    "stamp_ns": message.stamp_ns,
                    "age_s": message.age_s,
                    "max_age_s": message.max_age_s,
                    "fields": "; ".join(f"{k} {_short(v)}" for k, v in message.fields.items()),
                }
                for message in origin.messages
            ],
            title="the messages it was made of",
        )
    elif origin.topics:
        columns = [
            name for name in ("topic", "type", "decoded", "fills") if name in origin.topics[0]
        ]
        output.print_table(origin.topics, columns, title="topics that were read")
        if not with_messages:
            file = origin.transition["source_file"]
            output.say(f"--recording {file} shows the messages that it was made of")


def _section(title: str, values: dict[str, Any] | None) -> None:
    """A table of names and values, without what is empty."""
    from restock.cli import output

    known = {name: value for name, value in (values or {}).items() if value not in (None, "", [])}
    if known:
        rows = [{"": name, "value": _short(value)} for name, value in known.items()]
        output.print_table(rows, title=title)
        output.stdout().print()


def _short(value: Any) -> str:
    from restock.cli import output

    if isinstance(value, dict):
        return " ".join(f"{name}: {_short(entry)}" for name, entry in value.items())
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "; ".join(map(_short, value))
    if isinstance(value, list | tuple) and len(value) > _LONG:
        return f"{', '.join(_short(item) for item in value[:_LONG])}, … ({len(value)})"
    return output.cell(value).replace(r"\[", "[")
