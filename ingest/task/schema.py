"""The columns of a store: names, types, units and meanings; other types are derived from these.

A row is one transition and stands alone: the observation after it is in the row, so rows stay
whole under any filter, sort or engine.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.task.conditions import NOMINAL
from restock.ingest.task.task import OPTIONAL_SIGNALS, STORED_SIGNALS, Signals

# transition_id = (a number from the recording's id) << STEP_BITS | (step of the recording)
STEP_BITS = 25
GOLDEN = 0x9E3779B97F4A7C15  # 2**64 over the golden ratio: the step between splitmix64's states


def transition_ids(recording_id: str, tick: Ints) -> Ints:
    """Return the ids of a recording's steps (N,) by their places on its control clock."""
    number = int(recording_id, 16) >> (64 - (63 - STEP_BITS))
    return (number << STEP_BITS) + tick


def splitmix64(states: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix 64-bit numbers, alike on every machine (Steele, Lea and Flood, OOPSLA 2014)."""
    mixed = (states ^ (states >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    result: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return result


@dataclass(frozen=True)
class Column:
    """A column of the table. `observation` types get their length from the task."""

    name: str
    type: pa.DataType
    meaning: str
    nullable: bool = False


_F32_LIST = pa.list_(pa.float32())

IDENTITY: tuple[Column, ...] = (
    Column("transition_id", pa.int64(), "unique in the store; the same after a re-ingest"),
    Column("recording_id", pa.string(), "hash of the recording's content, 16 hex digits"),
    Column("episode_id", pa.string(), "<recording_id>/<episode_index>"),
    Column("episode_index", pa.int32(), "number of the episode in its recording, from 0"),
    Column("step_index", pa.int32(), "number of the step in its episode, from 0"),
    Column(
        "logged_ns",
        pa.int64(),
        "the time stamp_ns as log time; ages are computed from it",  # null: by clock_offset_ns
        nullable=True,
    ),
)
TRANSITION: tuple[Column, ...] = (
    Column(
        "observation", _F32_LIST, "observation at t: what the robot knew; float32[D], see the task"
    ),
    Column("action", pa.int16(), "index of the discrete action in force over [t, t + 1)"),
    Column("reward", pa.float32(), "reward of [t, t + 1)"),
    Column("next_observation", _F32_LIST, "observation at t + 1; float32[D]"),
    Column("terminated", pa.bool_(), "the episode terminated at t + 1: do not bootstrap"),
    Column(
        "truncated", pa.bool_(), "the episode was truncated at t + 1: time, gap, end of recording"
    ),
)
COVERAGE: tuple[Column, ...] = (
    Column("condition", pa.string(), "the condition of highest priority, or 'nominal'"),
    Column("conditions", pa.list_(pa.string()), "all conditions that hold; empty if nominal"),
    Column(
        "true_condition",
        pa.string(),
        "all conditions that are true in the simulator, sorted, comma-separated; or nominal",
        nullable=True,
    ),
    Column(
        "probabilities",
        pa.map_(pa.string(), pa.float32()),
        "probability of each condition that has a rule for it",
    ),
    Column(
        "uncertain", pa.list_(pa.string()), "conditions that are uncertain by their probability"
    ),
    Column("exposures", pa.list_(pa.string()), "all exposures that hold, whatever the condition"),
    Column(
        "true_exposure",
        pa.string(),
        "all exposures that are true in the simulator, sorted, comma-separated; or nominal",
        nullable=True,
    ),
    Column("perturbation", pa.string(), "name of the twin's parameters in force", nullable=True),
    Column(
        "perturbation_values",
        pa.map_(pa.string(), pa.float64()),
        "parameters that differ from the nominal twin's; null for hardware",
        nullable=True,
    ),
    Column("zone", pa.string(), "named part of the map, or 'elsewhere'"),
    Column("behaviour_policy", pa.string(), "policy that acted: planner, operator, dqn, …"),
    Column("behaviour_version", pa.string(), "version of that policy", nullable=True),
    Column(
        "action_probability",
        pa.float32(),
        "the behaviour policy's probability of the action",
        nullable=True,
    ),
    Column(
        "action_residual", pa.float32(), "scaled distance from the command to the discrete action"
    ),
    Column("progress_m", pa.float32(), "decrease of the length of the plan over [t, t + 1)"),
    Column(
        "goal_source",
        pa.string(),
        "logged: a recorded goal; hindsight: where the robot arrived; null: no goal",
        nullable=True,
    ),
)
PROVENANCE: tuple[Column, ...] = (
    Column("ingest_id", pa.string(), "the ingest that wrote this row; joins `recordings`"),
    Column("source_file", pa.string(), "path of the recording as given, odd characters escaped"),
    Column(
        "profile_hash", pa.string(), "hash of the profile with which it was ingested, 12 hex digits"
    ),
    Column("task_hash", pa.string(), "hash of the definition of observation, action and reward"),
    Column("labels_version", pa.string(), "version of the conditions that labelled it"),
    Column("restock_version", pa.string(), "version of Restock that wrote the row"),
)


_TYPES = {"int64": pa.int64(), "bool": pa.bool_()}
# float32 holds a millimetre up to 16 km from the map's origin; stamps stay int64.
SIGNAL_COLUMNS: tuple[Column, ...] = tuple(
    Column(one.name, _TYPES.get(one.dtype, pa.float32()), one.meaning, nullable=one.optional)
    for one in STORED_SIGNALS
)

COLUMNS: tuple[Column, ...] = IDENTITY + TRANSITION + COVERAGE + SIGNAL_COLUMNS + PROVENANCE


def signal_arrays(signals: Signals) -> dict[str, pa.Array]:
    """Return signals for SQL: unknown values are null, since NaN would pass for a number."""
    return {
        name: pa.array(np.asarray(values), from_pandas=name in OPTIONAL_SIGNALS)
        for name, values in signals.items()
    }


def signal_columns(signals: Signals, rows: Ints | slice = slice(None)) -> dict[str, pa.Array]:
    """Convert the stored signals (of some rows) to columns of the table."""
    arrays = signal_arrays({column.name: signals[column.name][rows] for column in SIGNAL_COLUMNS})
    return {
        column.name: arrays[column.name].cast(column.type, safe=False) for column in SIGNAL_COLUMNS
    }


def steps_schema(custom: Sequence[pa.Field] = ()) -> pa.Schema:
    """Return the schema of steps as conditions see them: stored signals, and custom ones."""
    keys = [("episode_index", pa.int64()), ("step_index", pa.int64())]
    signals = [(column.name, column.type) for column in SIGNAL_COLUMNS]
    return pa.schema([*(pa.field(*field) for field in keys + signals), *custom])


def transition_schema(observation_size: int, custom: Sequence[pa.Field] = ()) -> pa.Schema:
    """Return the Arrow schema of rows whose observations have `observation_size` entries.

    `custom` are the columns of a profile's own signals; they come last.
    """
    sized = pa.list_(pa.field("element", pa.float32()), observation_size)
    return pa.schema(
        [
            pa.field(
                column.name,
                sized if column.type == _F32_LIST else column.type,
                nullable=column.nullable,
            )
            for column in COLUMNS
        ]
        + list(custom)
    )


def _rows_of(**fields: pa.DataType) -> pa.DataType:
    return pa.list_(pa.struct(list(fields.items())))


# One row an ingest: what was read, by which definitions, and what became of it.
RECORDING_COLUMNS: tuple[Column, ...] = (
    Column("recording_id", pa.string(), "hash of the recording's content, 16 hex digits"),
    Column("ingest_id", pa.string(), "id of this ingest; joins `transitions`"),
    Column("ingested_at", pa.timestamp("us", "UTC"), "when it was ingested"),
    Column("source_file", pa.string(), "path of the recording as given, odd characters escaped"),
    Column("format", pa.string(), "container: mcap, rosbag2-sqlite3, rosbag2-mcap, …"),
    Column("integrity", pa.string(), "checksums: verified, unverified or damaged"),
    Column("duration_s", pa.float64(), "time from its first message to its last, by log time"),
    Column("start_stamp_ns", pa.int64(), "time of its first step, on the alignment clock"),
    Column("end_stamp_ns", pa.int64(), "time of its last step, on the alignment clock"),
    Column("clock", pa.string(), "the alignment clock: header.stamp or log_time"),
    Column("clock_offset_ns", pa.int64(), "log time minus alignment clock"),
    Column("clock_jumps", pa.int32(), "how often the alignment clock was set"),
    Column("profile", pa.string(), "name of the profile with which it was ingested"),
    Column("profile_hash", pa.string(), "hash of the profile, 12 hex digits"),
    Column("task_hash", pa.string(), "hash of the definition of observation, action and reward"),
    Column("labels_version", pa.string(), "version of the conditions that labelled it"),
    Column("restock_version", pa.string(), "version of Restock that wrote it"),
    Column(
        "tags",
        pa.map_(pa.string(), pa.string()),
        "robot, site, … and any other tag",
    ),
    Column("ticks", pa.int64(), "number of ticks of the control clock = transitions + "
        "episode_ends + drops"),
    Column("steps", pa.int64(), "number of ticks that belong to an episode"),
    Column("episodes", pa.int64(), "number of episodes with at least one transition"),
    Column("transitions", pa.int64(), "number of rows in `transitions`"),
    Column("episode_ends", pa.int64(), "number of ticks that only end an episode"),
    Column("drops", _rows_of(reason=pa.string(), count=pa.int64()), "ticks that are in no episode"),
    Column(
        "topics",
        _rows_of(
            topic=pa.string(), type=pa.string(), expected=pa.int64(), decoded=pa.int64(),
            skipped=pa.int64(), reason=pa.string(),
        ),
        "number of messages by the container's count, number decoded, and why the rest were not",
    ),
    Column(
        "stand_ins",
        _rows_of(input=pa.string(), instead=pa.string()),
        "inputs that the recording lacks, and what was used instead",
    ),
    Column(
        "label_scores",
        _rows_of(
            condition=pa.string(), precision=pa.float64(), recall=pa.float64(),
            labelled=pa.int64(), support=pa.int64(),
        ),
        "scores of the labels against the true condition; empty if that is not known",
    ),
    Column(
        "label_counts",
        _rows_of(
            condition=pa.string(), known=pa.int64(), labelled=pa.int64(), support=pa.int64(),
            agreed=pa.int64(), event_labelled=pa.int64(), event_right=pa.int64(),
            event_support=pa.int64(), event_found=pa.int64(),
        ),
        "the counts behind those scores, in steps and events",
    ),
    Column(
        "clocks",
        _rows_of(
            topic=pa.string(), messages=pa.int64(), stamped=pa.bool_(), offset_ns=pa.int64(),
            spread_ns=pa.int64(), publish_offset_ns=pa.int64(), jumps=pa.int64(),
            log_backsteps=pa.int64(), backsteps=pa.int64(), duplicates=pa.int64(),
            zero_stamps=pa.int64(), off_clock=pa.int64(), restamped=pa.int64(),
        ),
        "per topic that was read: log time against header stamp, and irregular stamps",
    ),
    Column(
        "findings",
        _rows_of(
            kind=pa.string(), topic=pa.string(), what=pa.string(), steps=pa.int64(),
            cause=pa.string(), remedy=pa.string(), repaired=pa.bool_(),
        ),
        "topics that contradict the rest of the recording: how far, in how many steps, the likely "
        "cause, what to do",
    ),
    Column(
        "signals",
        _rows_of(
            name=pa.string(), unit=pa.string(), type=pa.string(), topic=pa.string(),
            path=pa.string(), meaning=pa.string(), messages=pa.int64(), found=pa.int64(),
            unread=pa.int64(), steps=pa.int64(),
        ),
        "custom signals: unit and source, number of messages, messages with a value, steps with a "
        "value",
    ),
    Column(
        "cameras",
        _rows_of(
            camera=pa.string(), topic=pa.string(), type=pa.string(), expected=pa.int64(),
            decoded=pa.int64(), kept=pa.int64(), thinned=pa.int64(), unused=pa.int64(),
            problems=_rows_of(reason=pa.string(), count=pa.int64()), steps=pa.int64(),
            size_bytes=pa.int64(), file=pa.string(),
        ),
        "per camera: messages expected and decoded; frames kept, thinned out (max_hz) and unused "
        "(in"
        " force at no step); problems; steps with a frame",
    ),
    Column("task_json", pa.string(), "the task, as JSON"),
    Column("conditions_json", pa.string(), "the conditions: name, timing, sql, …, as JSON"),
    Column(
        "exposures_json",
        pa.string(),
        "the exposures, as in conditions_json",
    ),
    Column(
        "unknown_conditions",
        _rows_of(
            condition=pa.string(), kind=pa.string(), signals=pa.list_(pa.string()),
            because=pa.string(),
        ),
        "conditions and exposures that are unknown in all its rows",
    ),
    Column(
        "uncertain_conditions",
        pa.list_(pa.string()),
        "conditions and exposures whose labels rest on an outline that is a guess",
    ),
    Column(
        "corrections",
        _rows_of(
            condition=pa.string(), value=pa.bool_(), episode_index=pa.int64(),
            first_ns=pa.int64(), last_ns=pa.int64(), given_at=pa.timestamp("us", "UTC"),
            rows=pa.int64(),
        ),
        "corrections of its labels by people, see the view",
    ),
    Column("profile_toml", pa.string(), "the profile, including the SQL of its files"),
)  # fmt: skip

# One row a frame of a camera that is in force at a step: `frames/` of a store.
FRAME_COLUMNS: tuple[Column, ...] = (
    Column("recording_id", pa.string(), "id of the recording"),
    Column("camera", pa.string(), "its name in the profile"),
    Column("frame_index", pa.int64(), "number of the message in its topic, by log time, from 0"),
    Column("topic", pa.string(), "topic of the frame"),
    Column("type", pa.string(), "type of the message"),
    Column("log_time_ns", pa.int64(), "when the message was recorded"),
    Column("stamp_ns", pa.int64(), "when the frame was taken, on the alignment clock"),
    Column(
        "first_transition_id", pa.int64(), "time of the first step at which it is the last frame"
    ),
    Column(
        "last_transition_id",
        pa.int64(),
        "time of the last such step, including steps that only end an episode",
    ),
    Column(
        "encoding",
        pa.string(),
        "jpeg or png: the file as recorded; else the encoding of the raw pixels",
    ),
    Column("width", pa.int32(), "in pixels"),
    Column("height", pa.int32(), "in pixels"),
    Column("channels", pa.int16(), "number of channels: colours, and alpha if there is one"),
    Column("bits", pa.int16(), "bits per channel"),
    Column("row_bytes", pa.int32(), "bytes per row of raw pixels; 0 for files"),
    Column("big_endian", pa.bool_(), "byte order of raw pixels"),
    Column("size_bytes", pa.int64(), "number of bytes"),
    Column("sha256", pa.string(), "hash of the bytes as in the recording, 64 hex digits"),
    Column("data", pa.binary(), "the bytes as in the recording"),
)


def frame_schema() -> pa.Schema:
    """Return the Arrow schema of a recording's frames."""
    return pa.schema([pa.field(one.name, one.type, nullable=False) for one in FRAME_COLUMNS])


DOCUMENTS = ("task_json", "conditions_json", "exposures_json", "profile_toml")  # many share one


def recording_schema() -> pa.Schema:
    """Return the Arrow schema of the `recordings` table."""
    return pa.schema(
        [pa.field(column.name, column.type, column.nullable) for column in RECORDING_COLUMNS]
    )


VALUES = pa.map_(pa.string(), pa.float64())


@dataclass(frozen=True)
class Perturbed:
    """Sets of parameters, and which was in force at each of T places; -1: not known."""

    sets: Sequence[tuple[str, Mapping[str, float]] | None]  # name, values; None: unreadable
    row: Ints  # (T,) of `sets`
    notes: list[str] = field(default_factory=list)

    @classmethod
    def unknown(cls, count: int) -> Perturbed:
        """Return unknown parameters, as hardware has: its friction is unknown."""
        return cls([], np.full(count, -1, np.int64))

    @classmethod
    def read(cls, texts: Sequence[str], row: Ints) -> Perturbed:
        """Parse messages `{"name", "values": {field: number}}`, and keep which holds where."""
        sets = [parse_perturbation(text) for text in texts]
        unread = sum(item is None for item in sets)
        many = "message is" if unread == 1 else "messages are"
        notes = [f'perturbation: {unread} {many} not JSON {{"name", "values": {{field: number}}}}']
        return cls(sets, row, notes if unread else [])

    def columns(self, places: Ints) -> tuple[pa.Array, pa.Array]:
        """Return `perturbation` and `perturbation_values` at some places (n,)."""
        named = [None if item is None else item[0] for item in self.sets]
        values = [None if item is None else list(item[1].items()) for item in self.sets]
        row = self.row[places]
        chosen = pa.array(row, pa.int64(), mask=row < 0)
        return (pa.array(named, pa.string()).take(chosen), pa.array(values, VALUES).take(chosen))


def parse_perturbation(text: str) -> tuple[str, dict[str, float]] | None:
    """Parse `{"name": …, "values": {field: number}}` into the two; None if it is something else."""
    try:
        message = json.loads(text)
        name, values = message["name"], message["values"]
        numbers = {field: float(value) for field, value in values.items()}
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    if not isinstance(name, str) or not all(isfinite(value) for value in numbers.values()):
        return None
    return name, numbers


# Where a reader needs one true condition: the first of these, then any other by its name.
PRIMARY = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def truth_text(names: Iterable[str]) -> str:
    """Join a step's true conditions to one text: sorted, commas between; "nominal" for none."""
    return ",".join(sorted(set(names))) or NOMINAL


def true_names(text: str) -> frozenset[str]:
    """Return the true conditions that a text names: none for "nominal"."""
    named = frozenset(part.strip() for part in text.split(","))
    return named - {NOMINAL, ""}


def primary_of(text: str) -> str:
    """Return the one condition of a text that names all, for readers that need one."""
    named = true_names(text)
    for name in (*PRIMARY, *sorted(named)):
        if name in named:
            return name
    return NOMINAL
