"""A small synthetic store of transitions, for tests that need one without a recording."""

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from hashlib import sha256
from itertools import zip_longest
from pathlib import Path

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
from deltalake import write_deltalake

from restock.ingest.store.summary import summarised
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT
from restock.ingest.task.conditions import labels_version, primary, shipped
from restock.ingest.task.schema import STEP_BITS, recording_schema, transition_schema
from restock.ingest.task.task import Body, Task
from restock.replay.store.definitions import Definitions
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from support.paths import ROOT

_kept: list[Definitions] = []
_summaries: dict[bytes, pa.Table] = {}  # manifests with their summaries, of `summarised_once`

TASK = Task(
    body=Body(length_m=0.7, width_m=0.5),
    actions=((0.0, 0.0), (0.4, 0.0), (1.0, 0.0), (0.0, 1.2), (-0.4, 0.0)),
    sectors=4,
)
CONDITIONS = [shipped()[name] for name in sorted(shipped())]
EXPOSURES = list(shipped(kind="exposure").values())
LABEL_CHANCE = {"wheel_slip": 0.03, "blocked_aisle": 0.06, "near_collision": 0.02, "recovery": 0.03}
START_NS = 1_700_000_000 * 10**9


def recording_transitions(
    recording: int,
    *,
    episodes: int = 12,
    seed: int = 0,
    task: Task = TASK,
    ingest: str = "a",
    goal_source: str | None = "logged",
) -> pa.Table:
    """Random transitions of one recording, with the columns and meanings of `ingest.schema`."""
    rng = np.random.default_rng([seed, recording])
    chance = np.random.default_rng([seed, recording, 1])
    lengths = rng.integers(8, 60, episodes)
    rows, size = int(lengths.sum()), task.observation_size
    episode = np.repeat(np.arange(episodes), lengths)
    step = np.concatenate([np.arange(length) for length in lengths])
    last = np.append(step[1:] == 0, True)
    reached = rng.random(episodes) < 0.7
    labels = {name: rng.random(rows) < chance for name, chance in LABEL_CHANCE.items()}
    held = [[name for name in sorted(labels) if labels[name][row]] for row in range(rows)]
    observation = rng.normal(size=(rows, size)).astype(np.float32)
    after = np.where(last[:, None], rng.normal(size=(rows, size)), np.roll(observation, -1, 0))
    recording_id = f"{recording:016x}"
    where = list(zip(episode.tolist(), step.tolist(), strict=True))
    values: dict[str, object] = {
        "transition_id": (np.int64(recording) << STEP_BITS) + np.arange(rows),
        "recording_id": [recording_id] * rows,
        "episode_id": [f"{recording_id}/{index}" for index in episode],
        "episode_index": episode,
        "step_index": step,
        "logged_ns": pa.nulls(rows, pa.int64()),
        "observation": list(observation),
        "next_observation": list(after.astype(np.float32)),
        "action": rng.integers(0, len(task.actions), rows),
        "reward": rng.normal(size=rows) + 5.0 * (last & reached[episode]),
        "terminated": last & reached[episode],
        "truncated": last & ~reached[episode],
        "condition": primary(labels, CONDITIONS),
        "conditions": held,
        "true_condition": [None] * rows,
        "probabilities": [[("recovery", p)] for p in chance.random(rows)],
        "uncertain": [["recovery"] if row % 97 == 0 else [] for row in range(rows)],
        "exposures": [["closing_traffic"] if e % 3 == 0 and s < 6 else [] for e, s in where],
        "true_exposure": pa.nulls(rows, pa.string()),
        "perturbation": np.where(np.arange(rows) % 3 > 0, "wet", None),
        "perturbation_values": [[("friction_scale", 0.5)] if r % 3 else None for r in range(rows)],
        "goal_source": [goal_source if task.goal == "route" else None] * rows,
        "zone": rng.choice(["aisle_1", "aisle_2", "cross"], rows),
        "behaviour_policy": np.where(rng.random(episodes)[episode] < 0.8, "planner", "operator"),
        "behaviour_version": ["1"] * rows,
        "action_probability": pa.nulls(rows, pa.float32()),
        "stamp_ns": START_NS + recording * 3600 * 10**9 + np.arange(rows) * 200_000_000,
        "goal_distance_m": np.where(last & reached[episode], 0.3, 4.0),
        "bumped": labels["near_collision"] & (rng.random(rows) < 0.3) & ~reached[episode],
        "ingest_id": [f"{recording_id}-{ingest}"] * rows,
        "source_file": [f"logs/{recording}.mcap"] * rows,
        "profile_hash": ["0123456789ab"] * rows,
        "task_hash": [task.hash] * rows,
        "labels_version": [labels_version([*CONDITIONS, *EXPOSURES])] * rows,
        "restock_version": ["0.1.0"] * rows,
    }
    schema = transition_schema(size)
    arrays = [
        pa.array(values[field.name], field.type)
        if field.name in values
        else pa.array(rng.normal(size=rows)).cast(field.type, safe=False)
        for field in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def manifest(
    transitions: pa.Table, *, task: Task = TASK, tags: Mapping[str, str] | None = None
) -> pa.Table:
    """Return the `recordings` row of one recording's transitions."""
    first = transitions.slice(0, 1).to_pylist()[0]
    conditions, exposures = (
        [
            {"name": c.name, "timing": c.timing, "priority": c.priority, "sql": c.sql}
            for c in several
        ]
        for several in (CONDITIONS, EXPOSURES)
    )
    row = {
        "recording_id": first["recording_id"],
        "ingest_id": first["ingest_id"],
        "ingested_at": datetime(2026, 1, 1, tzinfo=UTC),
        "source_file": first["source_file"],
        "format": "mcap",
        "duration_s": len(transitions) * 0.2,
        "profile": "warehouse_amr",
        "profile_hash": first["profile_hash"],
        "task_hash": first["task_hash"],
        "labels_version": first["labels_version"],
        "restock_version": first["restock_version"],
        "tags": dict(tags or {}),
        "start_stamp_ns": int(transitions["stamp_ns"].to_numpy().min(initial=START_NS)),
        "end_stamp_ns": int(transitions["stamp_ns"].to_numpy().max(initial=START_NS)) + 200_000_000,
        "steps": len(transitions) + 12,
        "episodes": len(transitions["episode_id"].unique()),
        "transitions": len(transitions),
        "drops": [{"reason": "stale scan", "count": 3}],
        "topics": [
            {"topic": "/odom", "type": "nav_msgs/msg/Odometry", "expected": 900, "decoded": 900}
            | {"skipped": 0, "reason": ""}
        ],
        "label_scores": [
            {"condition": "wheel_slip", "precision": 0.9, "recall": 0.8, "support": 40}
            | {"labelled": 36}
        ],
        "label_counts": [
            {"condition": "wheel_slip", "known": 400, "labelled": 36, "support": 40, "agreed": 32}
            | {"event_labelled": 5, "event_right": 4, "event_support": 6, "event_found": 3}
        ],
        "task_json": msgspec.json.encode(task).decode(),
        "conditions_json": msgspec.json.encode(conditions).decode(),
        "exposures_json": msgspec.json.encode(exposures).decode(),
    }
    schema = recording_schema()
    blank = {pa.string(): "", pa.int64(): 0, pa.int32(): 0, pa.float64(): 0.0}
    row["ticks"] = row["steps"] + 3
    row = {field.name: row.get(field.name, blank.get(field.type, [])) for field in schema}
    return pa.Table.from_pylist([row], schema=schema)


def with_clear_view(table: pa.Table, task: Task = TASK) -> pa.Table:
    """Transitions whose lidar sees nothing: so that its returns say nothing of where walls are."""
    observation = np.array(table["observation"].to_pylist(), np.float32)
    clear = [name.startswith("clearance_") for name in task.observation_names]
    observation[:, clear] = 1.0
    return replaced(table, {"observation": list(observation)})


def write_store(
    path: Path,
    recordings: list[pa.Table],
    *,
    task: Task = TASK,
    tags: Sequence[Mapping[str, str]] = (),
) -> Path:
    """Write recordings and tags, a commit each, as another tool does: without summaries."""
    for transitions, reported in zip_longest(recordings, tags):
        row = manifest(transitions, task=task, tags=reported)
        write_deltalake(str(path / "recordings"), row, mode="append", description=FORMAT)
        write_deltalake(str(path / "transitions"), transitions, mode="append", description=FORMAT)
    return path


def views_over(
    connection: duckdb.DuckDBPyConnection,
    transitions: pa.Table,
    recordings: pa.Table,
    observation_type: str = "FLOAT[]",
    planted: str = "",
) -> Definitions:
    """Return the views of a store over these rows, no summaries; `install_named` adds views.

    `planted` are statements that change the stored tables before.
    """
    with passed_in(connection, given=transitions, manifests=recordings):
        connection.execute(
            "CREATE TABLE stored_transitions AS FROM given;"
            f" CREATE TABLE stored_recordings AS FROM manifests; {planted};"
            " CREATE TABLE stored_ingests AS SELECT recording_id, ingest_id, count(*) AS rows,"
            " recording_id || '/' || ingest_id || '.parquet' AS file FROM stored_transitions"
            " GROUP BY ALL"
        )
    made = Definitions(connection, observation_type)
    _kept.append(made)  # as a store keeps its own
    return made


@lru_cache(64)
def one(recording: int, ingest: str = "a", seed: int = 0) -> tuple[pa.Table, pa.Table]:
    """Return a recording's manifest row and transitions."""
    rows = recording_transitions(recording, ingest=ingest, seed=seed)
    return manifest(rows), rows


def summarised_once(manifest: pa.Table, rows: pa.Table) -> pa.Table:
    """`summary.summarised`, whose SQL takes 0.1 s to plan, once for equal tables in a process."""
    digest = sha256()
    for table in (manifest, rows):
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        digest.update(sink.getvalue())
    key = digest.digest()
    if key not in _summaries:
        _summaries[key] = summarised(manifest, rows)
        if len(_summaries) > 100:
            del _summaries[next(iter(_summaries))]
    return _summaries[key]


def shown(path: Path | str) -> dict[str, int]:
    """recording_id/ingest_id -> rows, as a reader sees the store."""
    with Store(path) as store:
        found = store.sql(
            "SELECT ingest_id, count(*) FROM transitions JOIN recordings USING (ingest_id)"
            " GROUP BY ALL ORDER BY ALL"
        ).fetchall()
    return dict(found)


def hindsight_profile(folder: Path) -> Path:
    """Write the shipped profile with goals in hindsight, in place of those that were recorded."""
    text = (ROOT / "src/restock/ingest/profile/profiles/warehouse_amr.toml").read_text()
    text = re.sub(r"(?ms)^\[inputs\.(?:goal|plan)\].*?(?=^\[)", "", text)
    path = folder / "hindsight.toml"
    path.write_text(text.replace("[clock]", '[goal]\nsource = "hindsight"\n\n[clock]', 1))
    return path
