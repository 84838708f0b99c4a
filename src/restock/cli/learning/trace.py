"""`restock trace`: follow a sampled row back to the message it came from."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli import output
from restock.cli.words import Option, Positional
from restock.errors import quoted

if TYPE_CHECKING:
    from restock.replay.trace import trace as tracing
    from restock.replay.trace.origin import Origin

_LONG = 6  # a longer list is cut to this many entries
_TABLES = ("clocks", "signals", "stand_ins")  # entries of a manifest to print only with --json


@dataclass
class TraceCommand:
    """Trace a sampled row to its source, down to the recording's messages.

    For a RUN, ROW is an audited row, STEP/ROW: the gradient step and the row of its batch. For a
    PANEL, ROW is a row number; for a STORE, a transition id. It shows the audited row, the row of
    the panel and of the store from which it was drawn, the recording and the time in it, and the
    messages of a given recording that were held at that tick. For a fresh row, it shows the episode
    in the twin, and the spec that generates it again.

    Without ROW, it lists rows: of a RUN, the audited ones with the largest TD errors; of a STORE,
    the strangest of twenty episodes, with what is strange about each.
    """

    place: Annotated[str, Positional("RUN|PANEL|STORE")]
    """The run, panel or store that holds the row."""
    row: Annotated[str | None, Positional("ROW")] = None
    """STEP/ROW of a run (for example 1200/17), a row number of a panel, or a transition id of a
    store."""
    recording: Annotated[Path | None, Option("PATH")] = None
    """The recording of the row: also show the messages from which the row was made."""
    json: bool = False
    """Print one JSON document (without ROW: a list)."""

    def run(self) -> None:
        """Trace the row, or list rows, and print the result."""
        from restock.replay.trace.trace import listed_rows, trace_row

        if self.row is None:
            listed = listed_rows(self.place)
            if self.json:
                output.print_json(listed)
                return
            first = "strangest" if listed and "novelty" in listed[0] else "largest TD error"
            output.print_parted(listed, key=("row",), title=f"rows, {first} first")
            if listed:
                output.say(
                    f"`restock trace {quoted(self.place)} {listed[0]['row']}` traces one of them"
                )
            return
        trace = trace_row(self.place, self.row, recording=self.recording)
        if self.json:
            output.print_json(document(trace))
            return
        _print(trace, self.recording is not None)


def document(trace: tracing.Trace) -> dict[str, Any]:
    """Return a trace as `--json` prints it; an unknown value is None."""
    origin = asdict(trace.origin) if trace.origin is not None else None
    names = (
        *("transition", "reward_parts", "store", "recording", "moment", "topics"),
        *("messages", "frames"),
    )
    return {
        "audit": trace.audit,
        "episode": trace.episode,
        "panel": trace.panel,
        **{name: origin[name] if origin else None for name in names},
        "notes": trace.notes + (origin["notes"] if origin else []),
    }


def _print(trace: tracing.Trace, with_messages: bool) -> None:
    _section("as it was sampled", trace.audit)
    _section("its episode of the twin", trace.episode)
    stored = trace.origin.transition if trace.origin is not None else {}
    packed = {k: v for k, v in (trace.panel or {}).items() if k == "path" or k not in stored}
    _section("its row of the panel", packed)
    if trace.origin is not None:
        _print_origin(trace.origin, with_messages)
    for note in trace.notes + (trace.origin.notes if trace.origin else []):
        output.print_text(f"note: {note}")


def _print_origin(origin: Origin, with_messages: bool) -> None:
    _section("its row of the store", {**origin.store, **origin.transition})
    _section("terms of its reward", origin.reward_parts)
    manifest = origin.recording or {}
    _section("its recording", {k: v for k, v in manifest.items() if k not in _TABLES})
    _section("when it happened", origin.moment)
    if origin.frames:
        files = list(dict.fromkeys(frame["file"] for frame in origin.frames))
        output.print_table(
            [
                frame | {"image": f"{frame['width']} x {frame['height']} {frame['encoding']}"}
                for frame in origin.frames
            ],
            ["camera", "topic", "frame_index", "stamp_ns", "age_s", "image", "size_bytes"],
            title=f"the frames of its cameras, in {', '.join(files)}",
        )
        output.print_text()
    if origin.messages:
        output.print_parted(
            [
                asdict(message)
                | {"fields": "; ".join(f"{k} {_short(v)}" for k, v in message.fields.items())}
                for message in origin.messages
            ],
            ["input", "topic", "log_time_ns", "stamp_ns", "age_s", "max_age_s", "fields"],
            key=("input",),
            title="the messages from which it was made",
        )
    elif origin.topics:
        columns = [
            name for name in ("topic", "type", "decoded", "fills") if name in origin.topics[0]
        ]
        output.print_table(origin.topics, columns, title="topics that were read")
        if not with_messages:
            file = origin.transition["source_file"]
            output.say(f"--recording {file} shows the messages from which it was made")


def _section(title: str, values: dict[str, Any] | None) -> None:
    """Print a table of names and values, without empty values."""
    known = {name: value for name, value in (values or {}).items() if value not in (None, "", [])}
    if known:
        rows = [{"": name, "value": _short(value)} for name, value in known.items()]
        output.print_table(rows, title=title)
        output.print_text()


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return " ".join(f"{name}: {_short(entry)}" for name, entry in value.items())
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "; ".join(map(_short, value))
    if isinstance(value, list | tuple) and len(value) > _LONG:
        return f"{', '.join(_short(item) for item in value[:_LONG])}, … ({len(value)})"
    return output.cell(value)
