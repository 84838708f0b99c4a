"""Tracing a sampled row to its panel, store, recording and messages, or to what is missing."""

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable, write_deltalake
from support.panels import EVERY, NO_SPLIT, panel_of
from support.paths import ROOT
from support.stores import TASK, manifest, recording_transitions, write_store

from restock.errors import PanelError, RunError, StoreError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT
from restock.ingest.store.writer import StoreWriter
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store
from restock.replay.trace.trace import listed_rows, trace_row

RECORDING = ROOT / "sample_logs" / "amr_tuesday"
MIXTURE = parse_mixture("n_step = 3\n" + EVERY + NO_SPLIT)


@dataclass
class Places:
    """A recording's store, a panel of it, and a run that was fed the panel."""

    store: Path
    panel: Path
    run: Path

    def rows(self, query: str) -> list[dict[str, Any]]:
        with Store(self.store) as store:
            found: list[dict[str, Any]] = store.sql(query).to_arrow_table().to_pylist()
        return found


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> Places:
    folder = tmp_path_factory.mktemp("trace")
    ingest(RECORDING, load_profile("warehouse_amr"), store=StoreWriter(folder / "store"))
    panel = panel_of(folder / "store", MIXTURE, folder / "panel")
    write_run(folder / "run", panel)
    return Places(folder / "store", folder / "panel", folder / "run")


def write_run(path: Path, panel: Panel) -> None:
    """Write what a run keeps of one audited batch: three logged rows and a fresh one."""
    path.mkdir()
    fed = {"path": str(panel.path), "id": panel.id}
    (path / "config.json").write_text(json.dumps({"panel": fed, "seeds": {"run": 5}}))
    ids = panel.meta_column("transition_id")
    logged = [
        {
            "gradient_step": 7,
            "batch_row": place,
            "source": "logs",
            "transition_id": int(ids[row]),
            "panel_row": row,
            "td": float(place),
            "row_hash": hashlib.blake2b(panel.rows[row].tobytes(), digest_size=8).hexdigest(),
        }
        for place, row in enumerate([3, 100, 400])
    ]
    fresh = {"gradient_step": 7, "batch_row": 3, "source": "fresh", "episode": "12"}
    blank = dict.fromkeys(
        (
            "stratum",
            "condition",
            "behaviour_policy",
            "age_days",
            "age_gradient_steps",
            "last_target_sync",
            "action",
            "reward",
        )
    )
    rows = [blank | {"q": 0.0, "td": 0.5, "episode": "x"} | row for row in [*logged, fresh]]
    rows[3]["episode_step"] = 4
    names = {name for row in rows for name in row}
    pq.write_table(
        pa.Table.from_pylist([dict.fromkeys(names) | row for row in rows]), path / "audit.parquet"
    )
    episode = {"episode": 12, "env": 2, "episode_seed": 99, "true_condition": "wheel_slip"}
    pq.write_table(
        pa.Table.from_pylist([episode | {"perturbation": "nominal"}]), path / "episodes.parquet"
    )


def test_audited_row_is_traced_to_its_messages(places):
    found = trace_row(places.run, "7/1", recording=RECORDING)
    assert found.panel is not None
    assert found.panel["row"] == 100
    assert found.panel["same_bytes_as_sampled"]
    assert found.panel["same_observation_as_stored"]
    assert found.origin is not None
    assert found.notes == found.origin.notes == []
    row = found.origin.transition
    assert found.audit is not None
    assert row["transition_id"] == found.audit["transition_id"]
    assert found.origin.recording is not None
    assert found.origin.recording["source_file"] == str(RECORDING)
    assert found.origin.store["newest_version"] == found.origin.store["version"]
    held = {message.input: message for message in found.origin.messages}
    command = held["command"]
    assert command.age_s == 0
    assert command.stamp_ns == row["stamp_ns"]
    assert command.fields["linear.x"] == pytest.approx(row["command_speed_mps"])
    assert command.fields["angular.z"] == pytest.approx(row["command_yaw_rate_radps"])
    assert held["pose"].fields["pose.pose.position.x"] == pytest.approx(row["pose_x_m"])
    assert held["pose"].stamp_ns == row["pose_stamp_ns"]
    assert held["wheels"].fields["twist.twist.linear.x"] == pytest.approx(row["wheel_speed_mps"])
    # No message in an observation is later than the tick, or older than the profile allows.
    low, high = found.origin.moment["window_ns"]
    assert low < held["scan"].log_time_ns <= high
    for name in held.keys() - {"behaviour_policy", "true_condition"}:
        assert held[name].age_s >= 0
        assert held[name].max_age_s is None or held[name].age_s <= held[name].max_age_s
    assert {name for topic in found.origin.topics for name in topic["fills"]} >= {"command", "scan"}


def test_reward_parts_sum_to_reward(places):
    steps = places.rows("FROM transitions ORDER BY transition_id")
    whole = 0
    for row in steps[::80]:
        origin = trace_row(places.store, str(row["transition_id"])).origin
        assert origin is not None
        last = row["terminated"] or row["truncated"]
        assert (origin.reward_parts is None) == last
        if origin.reward_parts is not None:
            whole += 1
            assert sum(origin.reward_parts.values()) == pytest.approx(row["reward"], abs=2e-6)
    assert whole > 5


def test_fresh_row_is_traced_to_seed_of_episode(places):
    found = trace_row(places.run, "7/3")
    assert found.origin is None
    assert found.episode == {
        "run_seed": 5,
        "episode": 12,
        "env": 2,
        "episode_seed": 99,
        "true_condition": "wheel_slip",
        "perturbation": "nominal",
        "spec": {"condition": "wheel_slip", "seed": 99},
    }
    assert found.audit is not None
    assert found.audit["episode_step"] == 4


def test_audited_rows_are_listed_by_td_error(places):
    assert [row["row"] for row in listed_rows(places.run, 3)] == ["7/2", "7/1", "7/3"]


def test_panel_row_can_be_traced(places):
    found = trace_row(places.panel, "5")
    assert found.panel is not None
    assert found.origin is not None
    assert found.panel["transition_id"] == found.origin.transition["transition_id"]
    assert trace_row(places.panel, 5) == found


def test_missing_rows_are_refused(places, tmp_path):
    for place, row, error, problem in (
        (places.run, "12", RunError, "is not an audited row"),
        (places.run, "8/0", RunError, "was not audited"),
        (places.run, "8/²", RunError, "is not an audited row"),
        (places.panel, "1000000", PanelError, "has rows 0 to"),
        (places.store, "5", StoreError, "no transition 5"),
        (places.store, "seven", StoreError, "'seven' is not a transition id"),
        (places.store, "²", StoreError, "'²' is not a transition id"),
        (places.store, -1, StoreError, "'-1' is not a transition id"),
        (tmp_path, "1", StoreError, "it is not a run, a panel or a store"),
        (tmp_path / "nowhere", "1", StoreError, "it does not exist"),
    ):
        with pytest.raises(error, match=problem):
            trace_row(place, row)


def test_moved_places_are_reported_with_remedy(places, tmp_path):
    store, panel = tmp_path / "store", tmp_path / "panel"
    shutil.copytree(places.store, store)
    panel_of(store, MIXTURE, panel)
    write_run(tmp_path / "run", Panel.open(panel))
    store.rename(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="restock trace STORE"):
        trace_row(tmp_path / "run", "7/0")
    panel.rename(tmp_path / "moved")
    with pytest.raises(PanelError, match="restock trace PANEL ROW"):
        trace_row(tmp_path / "run", "7/0")
    build_panel(recording_transitions(1), MIXTURE, panel, task=TASK)
    with pytest.raises(PanelError, match="the run drew from"):
        trace_row(tmp_path / "run", "7/0")


def test_trace_notes_later_relabelling(tmp_path):
    before = recording_transitions(1)
    writer = write_store(tmp_path / "store", [before, recording_transitions(2)])
    panel_of(writer, MIXTURE, tmp_path / "panel")
    later = recording_transitions(1, ingest="b")
    named = ["recovery", *later["condition"].to_pylist()[1:]]
    replace_recording(tmp_path / "store", replaced(later, {"condition": named}))
    found = trace_row(tmp_path / "panel", "0").origin
    assert found is not None
    assert found.transition["condition"] == before["condition"][0].as_py()
    assert any("again since" in note and "-> recovery" in note for note in found.notes)
    replace_recording(tmp_path / "store", later.slice(1))
    found = trace_row(tmp_path / "panel", "0").origin
    assert found is not None
    assert "the newest version of the store no longer has this row" in found.notes


def replace_recording(store: Path, rows: pa.Table) -> None:
    """Replace a recording's rows in one commit, as an ingest does."""
    write_deltalake(str(store / "recordings"), manifest(rows), mode="append", description=FORMAT)
    table = DeltaTable(str(store / "transitions"))
    predicate = f"recording_id = '{rows['recording_id'][0].as_py()}'"
    write_deltalake(table, rows, mode="overwrite", predicate=predicate)


def test_trace_verb_prints_text_and_json(places, shell):
    assert "7/2" in shell.out("trace", places.run)
    arguments = ["trace", str(places.run), "7/2", "--recording", str(RECORDING)]
    out = shell.out(*arguments)
    for text in ("as it was sampled", "its recording", "/cmd_vel", "same_bytes_as_sampled"):
        assert text in out
    document = shell.json(*arguments)
    assert document["messages"][0]["topic"] == "/cmd_vel"
    assert document["transition"]["recording_id"] == document["recording"]["recording_id"]
    assert document["notes"] == []
    for words, problem in (([places.run, "9/9"], "was not audited"), ([places.panel], "give ROW")):
        assert problem in shell.err("trace", *words)
