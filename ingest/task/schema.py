"""The columns of a store: names, types, units and meanings; the Arrow schemas derive from these.

A row is one self-contained transition. It includes the next observation, so that rows can be
filtered and sorted in any way by any engine.
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

# transition_id = (a number from the recording's id) << STEP_BITS | (tick of the recording)
STEP_BITS = 25
GOLDEN = 0x9E3779B97F4A7C15  # 2**64 / golden ratio: the increment of splitmix64's state


def transition_ids(recording_id: str, tick: Ints) -> Ints:
    """Return the transition ids (N,) of a recording's ticks (N,), which are numbered from 0."""
    number = int(recording_id, 16) >> (64 - (63 - STEP_BITS))
    return (number << STEP_BITS) + tick


def splitmix64(states: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return hashes of 64-bit numbers, equal on every machine (Steele et al., OOPSLA 2014)."""
    mixed = (states ^ (states >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    result: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return result


@dataclass(frozen=True)
class Column:
    """A column of a table. Its type leaves out the length of observations, which tasks define."""

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
        "stamp_ns converted to log time; ages are computed from it",  # null: use clock_offset_ns
        nullable=True,
    ),
)
TRANSITION: tuple[Column, ...] = (
    Column(
        "observation", _F32_LIST, "observation at t, from data up to t; float32[D], see the task"
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
        "probability of each condition that defines one",
    ),
    Column(
        "uncertain", pa.list_(pa.string()), "conditions whose probability is in the uncertain band"
    ),
    Column("exposures", pa.list_(pa.string()), "all exposures that hold, whatever the condition"),
    Column(
        "true_exposure",
        pa.string(),
        "all exposures that are true in the simulator, sorted, comma-separated; or nominal",
        nullable=True,
    ),
    Column("perturbation", pa.string(), "name of the twin's parameters", nullable=True),
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
# Numbers are float32, which resolves 1 mm up to 16 km from the map's origin; stamps are int64.
SIGNAL_COLUMNS: tuple[Column, ...] = tuple(
    Column(one.name, _TYPES.get(one.dtype, pa.float32()), one.meaning, nullable=one.optional)
    for one in STORED_SIGNALS
)

COLUMNS: tuple[Column, ...] = IDENTITY + TRANSITION + COVERAGE + SIGNAL_COLUMNS + PROVENANCE


def signal_arrays(signals: Signals) -> dict[str, pa.Array]:
    """Return signals for SQL: unknown values become null, since SQL takes NaN for a number."""
    return {
        name: pa.array(np.asarray(values), from_pandas=name in OPTIONAL_SIGNALS)
        for name, values in signals.items()
    }


def signal_columns(signals: Signals, rows: Ints | slice = slice(None)) -> dict[str, pa.Array]:
    """Convert the stored signals of these rows to columns of the table."""
    arrays = signal_arrays({column.name: signals[column.name][rows] for column in SIGNAL_COLUMNS})
    return {
        column.name: arrays[column.name].cast(column.type, safe=False) for column in SIGNAL_COLUMNS
    }


def steps_schema(custom: Sequence[pa.Field] = ()) -> pa.Schema:
    """Return the schema of the steps that conditions run on: stored and custom signals."""
    keys = [("episode_index", pa.int64()), ("step_index", pa.int64())]
    signals = [(column.name, column.type) for column in SIGNAL_COLUMNS]
    return pa.schema([*(pa.field(*field) for field in keys + signals), *custom])


def transition_schema(observation_size: int, custom: Sequence[pa.Field] = ()) -> pa.Schema:
    """Return the Arrow schema of rows whose observations have `observation_size` entries.

    `custom` are the columns of a profile's custom signals; they come last.
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


# The `recordings` table: one row per ingest, with the input, the definitions used and the counts.
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
    Column("clock_jumps", pa.int32(), "number of jumps of the alignment clock"),
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
    Column("drops", _rows_of(reason=pa.string(), count=pa.int64()), "ticks without an episode"),
    Column(
        "topics",
        _rows_of(
            topic=pa.string(), type=pa.string(), expected=pa.int64(), decoded=pa.int64(),
            skipped=pa.int64(), reason=pa.string(),
        ),
        "messages that the container counts, messages decoded and skipped, and why skipped",
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
        "per topic that was read: log time minus header stamp, and counts of irregular stamps",
    ),
    Column(
        "findings",
        _rows_of(
            kind=pa.string(), topic=pa.string(), what=pa.string(), steps=pa.int64(),
            cause=pa.string(), remedy=pa.string(), repaired=pa.bool_(),
        ),
        "topics that contradict the rest of the recording: by how much, in how many steps, the "
        "likely cause, what to do",
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
        "(latest frame at no step); problems; steps with a frame",
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
        "conditions and exposures that are unknown in all rows of the recording",
    ),
    Column(
        "uncertain_conditions",
        pa.list_(pa.string()),
        "conditions and exposures whose labels depend on an outline that is a guess",
    ),
    Column(
        "corrections",
        _rows_of(
            condition=pa.string(), value=pa.bool_(), episode_index=pa.int64(),
            first_ns=pa.int64(), last_ns=pa.int64(), given_at=pa.timestamp("us", "UTC"),
            rows=pa.int64(),
        ),
        "people's corrections of its labels, see the view `corrections`",
    ),
    Column("profile_toml", pa.string(), "the profile, including the SQL of its files"),
)  # fmt: skip

# The table `frames/` of a store: one row per camera frame that is the latest frame at some step.
FRAME_COLUMNS: tuple[Column, ...] = (
    Column("recording_id", pa.string(), "id of the recording"),
    Column("camera", pa.string(), "its name in the profile"),
    Column("frame_index", pa.int64(), "number of the message in its topic, by log time, from 0"),
    Column("topic", pa.string(), "topic of the frame"),
    Column("type", pa.string(), "type of the message"),
    Column("log_time_ns", pa.int64(), "when the message was recorded"),
    Column("stamp_ns", pa.int64(), "when the frame was taken, on the alignment clock"),
    Column(
        "first_transition_id", pa.int64(), "id of the first step at which it is the latest frame"
    ),
    Column(
        "last_transition_id",
        pa.int64(),
        "id of the last such step, including steps that only end an episode",
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


DOCUMENTS = ("task_json", "conditions_json", "exposures_json", "profile_toml")  # equal in many rows


def recording_schema() -> pa.Schema:
    """Return the Arrow schema of the `recordings` table."""
    return pa.schema(
        [pa.field(column.name, column.type, column.nullable) for column in RECORDING_COLUMNS]
    )


VALUES = pa.map_(pa.string(), pa.float64())


@dataclass(frozen=True)
class Perturbed:
    """Sets of the twin's parameters, and the set in force at each of T ticks."""

    sets: Sequence[tuple[str, Mapping[str, float]] | None]  # name, values; None: unreadable
    row: Ints  # (T,) indices into `sets`; -1: unknown
    notes: list[str] = field(default_factory=list)

    @classmethod
    def unknown(cls, count: int) -> Perturbed:
        """Return unknown parameters, as for hardware, whose friction is unknown."""
        return cls([], np.full(count, -1, np.int64))

    @classmethod
    def read(cls, texts: Sequence[str], row: Ints) -> Perturbed:
        """Parse messages `{"name", "values": {field: number}}`; `row` (T,) indexes `texts`."""
        sets = [parse_perturbation(text) for text in texts]
        unread = sum(item is None for item in sets)
        many = "message is" if unread == 1 else "messages are"
        notes = [f'perturbation: {unread} {many} not JSON {{"name", "values": {{field: number}}}}']
        return cls(sets, row, notes if unread else [])

    def columns(self, places: Ints) -> tuple[pa.Array, pa.Array]:
        """Return `perturbation` and `perturbation_values` at these ticks (n,)."""
        named = [None if item is None else item[0] for item in self.sets]
        values = [None if item is None else list(item[1].items()) for item in self.sets]
        row = self.row[places]
        chosen = pa.array(row, pa.int64(), mask=row < 0)
        return (pa.array(named, pa.string()).take(chosen), pa.array(values, VALUES).take(chosen))


def parse_perturbation(text: str) -> tuple[str, dict[str, float]] | None:
    """Parse `{"name": …, "values": {field: number}}` into name and values; None if malformed."""
    try:
        message = json.loads(text)
        name, values = message["name"], message["values"]
        numbers = {field: float(value) for field, value in values.items()}
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    if not isinstance(name, str) or not all(isfinite(value) for value in numbers.values()):
        return None
    return name, numbers


# True conditions that a reader that needs only one prefers, in order; the rest follow by name.
PRIMARY = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def truth_text(names: Iterable[str]) -> str:
    """Join a step's true conditions: sorted and comma-separated, or "nominal" if there are none."""
    return ",".join(sorted(set(names))) or NOMINAL


def true_names(text: str) -> frozenset[str]:
    """Parse the text of `truth_text`; "nominal" gives an empty set."""
    named = frozenset(part.strip() for part in text.split(","))
    return named - {NOMINAL, ""}


def primary_of(text: str) -> str:
    """Return the one true condition of a text of `truth_text`, for readers that need one."""
    named = true_names(text)
    for name in (*PRIMARY, *sorted(named)):
        if name in named:
            return name
    return NOMINAL
