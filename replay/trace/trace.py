"""Trace a sampled row to its source: audit row, panel, store, recording, messages.

A run has the path of its panel, and a panel that of its store, so a trace can begin at any of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from restock.errors import PanelError, RunError, StoreError, quoted
from restock.files import read_json, read_table
from restock.ingest.store.location import Location
from restock.replay.panel.panel import HEADER, Panel
from restock.replay.places import RUN_CONFIG
from restock.replay.store.novelty import strangest
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store, is_store
from restock.replay.trace.origin import Origin, StoreVersion, find_origin, rows_of, sql_file


@dataclass
class Trace:
    """Everything known about one sampled row. Fields that do not apply are None; see `notes`."""

    audit: dict[str, Any] | None = None  # the row as it was sampled
    episode: dict[str, Any] | None = None  # a fresh row's episode, with the spec to drive it again
    panel: dict[str, Any] | None = None
    origin: Origin | None = None  # the row in a store
    notes: list[str] = field(default_factory=list)


def trace_row(place: str | Path, row: str | int, *, recording: Path | str | None = None) -> Trace:
    """Trace one row of a run, a panel or a store back to its messages.

    Args:
        place: a run (`row` is STEP/ROW: gradient step and row of the batch), a panel (`row` is a
            row number) or a store, or `store@12` (`row` is a transition id).
        row: the row.
        recording: the row's recording, to read its messages; None: do not read them.

    Raises:
        RunError, PanelError, StoreError: no such place or row, or the run's panel or the panel's
            store was moved.
        RecordingError: `recording` is not the row's recording.
    """
    path, row = Path(place), str(row)
    trace = Trace()
    if (path / RUN_CONFIG).is_file():
        _trace_run_row(trace, path, row, recording)
    elif (path / HEADER).is_file():
        _trace_panel_row(
            trace, Panel.open(path), _number(row, path, "row number of the panel"), recording
        )
    elif is_store(location := Location.of(place)):
        number = _number(row, path, "transition id")
        version = None
        if location.version is not None:
            with Store(location) as store:
                version = store.version
        trace.origin = find_origin([(str(location), version)], number, recording=recording)
    else:
        raise StoreError(
            "it is not a run, a panel or a store" if path.exists() else "it does not exist",
            where=str(path),
        )
    return trace


def listed_rows(place: str | Path, limit: int = 20) -> list[dict[str, Any]]:
    """Return a run's audited rows with the largest TD errors, or the most novel rows of a store.

    In each dict, `row` is the value to pass to `trace_row`.
    """
    run = Path(place)
    if not (run / RUN_CONFIG).is_file():
        if is_store(location := Location.of(place)):
            with Store(location) as store:
                return strangest(store, limit)
        raise RunError(
            "is not a run or a store: rows can be listed for these only",
            where=str(place),
            remedy="give ROW, a row number of a panel",
        )
    table = _run_table(run, "audit")
    with duckdb.connect() as connection, passed_in(connection, audit=table):
        return rows_of(connection, sql_file("trace_rows.sql"), {"limit": limit})


def _trace_run_row(trace: Trace, run: Path, row: str, recording: Path | str | None) -> None:
    document = read_json(run / RUN_CONFIG, error=RunError)
    trace.audit = audit = _audit_row(run, row)
    if audit["source"] == "fresh":
        _add_twin_episode(trace, run, document, audit)
        return
    run_panel = document.get("panel") or {}
    panel_path = Path(run_panel.get("path", ""))
    if not (panel_path / HEADER).is_file():
        raise PanelError(
            "the run's panel does not exist",
            where=str(panel_path),
            remedy="trace its row where the panel is now: `restock trace PANEL ROW`",
        )
    panel = Panel.open(panel_path)
    if panel.id != run_panel.get("id"):
        raise PanelError(
            f"is panel {panel.id}, the run drew from {run_panel.get('id')}",
            where=str(panel_path),
            remedy="trace the row of that panel: `restock trace PANEL ROW`",
        )
    _trace_panel_row(trace, panel, int(audit["panel_row"]), recording)


def _trace_panel_row(trace: Trace, panel: Panel, number: int, recording: Path | str | None) -> None:
    if not 0 <= number < len(panel):
        raise PanelError(f"has rows 0 to {len(panel) - 1}, not {number}", where=str(panel.path))
    meta = panel.meta.slice(number, 1).to_pylist()[0]
    packed = np.array(panel.rows[number])
    trace.panel = {"path": str(panel.path), "id": panel.id, "row": number, **meta}
    if trace.audit is not None:
        digest = hashlib.blake2b(packed.tobytes(), digest_size=8).hexdigest()
        trace.panel["same_bytes_as_sampled"] = digest == trace.audit["row_hash"]
        if not trace.panel["same_bytes_as_sampled"]:
            trace.notes.append("the row in the panel is not the one that was sampled")
    header = panel.header
    if header.store_version < 0:
        trace.notes.append("the panel was made from a table in memory: there is no store to search")
        return
    sources: list[StoreVersion] = [(header.store, header.store_version)]
    sources += [(other.path, other.version) for other in header.others]
    trace.origin = find_origin(sources, int(meta["transition_id"]), recording=recording)
    stored = np.float32(trace.origin.transition["observation"])
    same = np.array_equal(packed[panel.columns["observation"]], stored)
    trace.panel["same_observation_as_stored"] = same
    if not same:
        trace.notes.append("the observation in the store is not the one that was packed")


def _add_twin_episode(
    trace: Trace, run: Path, document: Mapping[str, Any], audit: Mapping[str, Any]
) -> None:
    """Add a fresh row's episode in the twin, and the spec to generate it again."""
    query = "FROM episodes WHERE episode = $episode"
    table = _run_table(run, "episodes")
    with duckdb.connect() as connection, passed_in(connection, episodes=table):
        rows = rows_of(connection, query, {"episode": int(audit["episode"])})
    trace.episode = {"run_seed": document.get("seeds", {}).get("run")}
    if not rows:
        trace.notes.append(
            "its episode had not ended when the run stopped, or the tables end before it"
        )
        return
    trace.episode |= rows[0]
    if trace.episode.get("episode_seed") is not None:
        trace.episode["spec"] = {
            "condition": trace.episode["true_condition"],
            "seed": trace.episode["episode_seed"],
        }
        trace.notes.append(
            "the twin generates the episode again from its spec; the actions are not kept"
        )
        if trace.episode["perturbation"] != "nominal":
            trace.notes.append(
                f"its perturbation {trace.episode['perturbation']!r} is needed to generate it again"
            )


def _audit_row(run: Path, row: str) -> dict[str, Any]:
    table = _run_table(run, "audit")
    step, _, place = row.partition("/")
    if not (step.isdecimal() and place.isdecimal()):
        raise RunError(
            f"{row!r} is not an audited row",
            where=str(run),
            remedy="write STEP/ROW, a gradient step and a row of its batch, e.g. 1200/17;"
            f" `restock trace {quoted(run)}` lists some",
        )
    query = "FROM audit WHERE gradient_step = $step AND batch_row = $place"
    values = {"step": int(step), "place": int(place)}
    with duckdb.connect() as connection, passed_in(connection, audit=table):
        rows = rows_of(connection, query, values)
    if not rows:
        raise RunError(
            f"the batch of gradient step {step} was not audited, or has no row {place}",
            where=str(run),
            remedy=f"`restock trace {quoted(run)}` lists audited rows; record.audit_share sets how"
            " many there are",
        )
    return rows[0]


def _run_table(run: Path, name: str) -> pa.Table:
    file = run / f"{name}.parquet"
    if not file.is_file():
        raise RunError(f"it has no {file.name}", where=str(run), remedy="train the run first")
    return read_table(
        file, error=RunError, remedy="restore the file from a copy, or train the run again"
    )


def _number(row: str, where: Path, what: str) -> int:
    if not row.isdecimal():
        raise StoreError(
            f"{row!r} is not a {what}",
            where=str(where),
            remedy="give a whole number of 0 or more; STEP/ROW names a row of a run",
        )
    return int(row)
