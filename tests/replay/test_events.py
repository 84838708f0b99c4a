"""Events: where a condition began and ended, and what came of it, against a plain loop."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from deltalake import write_deltalake
from support.paths import ROOT
from support.stores import START_NS, TASK, manifest, recording_transitions, write_store

from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import STEP_BITS
from restock.replay.store.store import Store

PERIOD_NS = 200_000_000


def events_by_hand(store: Store) -> dict[str, dict[str, Any]]:
    """Return what the view says, one row after the other."""
    ends = dict(store.sql("SELECT recording_id, end_stamp_ns FROM recordings").fetchall())
    rows = store.sql(
        "SELECT * EXCLUDE (observation, next_observation) FROM transitions ORDER BY ALL"
    )
    episodes: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in rows.to_arrow_table().to_pylist():
        episodes[row["episode_id"]][row["step_index"]] = row
    found = {}
    for episode, steps in episodes.items():
        order = sorted(steps)
        last = steps[order[-1]]
        reached = last["terminated"] and last["reward"] > TASK.rewards.goal / 2
        bump = last["terminated"] and not reached
        cut = not (last["terminated"] or last["truncated"]) or (
            last["truncated"] and last["stamp_ns"] + 2 * PERIOD_NS > ends[last["recording_id"]]
        )
        for place, step in enumerate(order):
            for condition in steps[step]["conditions"]:
                if condition in steps.get(step - 1, {"conditions": []})["conditions"]:
                    continue  # it began before
                end = step
                while condition in steps.get(end + 1, {"conditions": []})["conditions"]:
                    end += 1
                held = [steps[index] for index in range(step, end + 1)]
                later = [steps[index] for index in order if index > end]
                nominal = [row["stamp_ns"] for row in later if not row["conditions"]]
                onset = steps[step]
                over = steps[end + 1]["stamp_ns"] if end + 1 in steps else None
                back = nominal[0] if nominal else last["stamp_ns"] + PERIOD_NS if reached else None
                outcome = "recovered" if back else "open" if cut else "not recovered"
                found[f"{episode}/{condition}/{step}"] = {
                    "onset_ns": onset["stamp_ns"],
                    "end_ns": steps[end]["stamp_ns"],
                    "logged_onset_time": onset["logged_time"],
                    "steps": len(held),
                    "duration_s": ((over or held[-1]["stamp_ns"] + PERIOD_NS) - onset["stamp_ns"])
                    / 1e9,
                    "zone": onset["zone"],
                    "robot": onset["robot"],
                    "behaviour_policy": onset["behaviour_policy"],
                    "policy_before": steps[order[max(place - 1, 0)]]["behaviour_policy"],
                    "policy_after": (later or held)[0 if later else -1]["behaviour_policy"],
                    "clearance_min_m": min(row["clearance_m"] for row in held),
                    "bumped": any(row["bumped"] for row in held) or (bump and not later),
                    "outcome": outcome,
                    "recovered": None if outcome == "open" else outcome == "recovered",
                    "recovered_after_s": (back - onset["stamp_ns"]) / 1e9 if back else None,
                }
    return found


def events_of(store: Store) -> dict[str, dict[str, Any]]:
    rows = store.sql("FROM events").to_arrow_table().to_pylist()
    assert len({row["event_id"] for row in rows}) == len(rows)
    return {row["event_id"]: row for row in rows}


def compare(store: Store) -> None:
    by_hand, seen = events_by_hand(store), events_of(store)
    assert seen.keys() == by_hand.keys()
    for name, row in by_hand.items():
        assert {key: seen[name][key] for key in row} == row, name


def test_events_of_the_sample_logs_are_those_of_a_plain_loop(tmp_path):
    store, profile = tmp_path / "store", load_profile("warehouse_amr")
    ingest(
        ROOT / "sample_logs" / "amr_tuesday",
        profile,
        store=StoreWriter(store),
        tags={"robot": "amr-07"},
    )
    with Store(store) as opened:
        compare(opened)
        assert {row["condition"] for row in events_of(opened).values()} > {"wheel_slip"}


def test_events_of_random_labels_are_those_of_a_plain_loop(tmp_path):
    """Rows are missing in the middle of episodes and at their ends, and log time is not stamps."""
    tables = []
    for number in (1, 2, 3):
        table = recording_transitions(number, episodes=25)
        keep = np.random.default_rng(number).random(len(table)) > 0.1
        tables.append(table.filter(pa.array(keep)))
    with Store(
        write_store(tmp_path / "store", tables, tags=[{"robot": "a"}, {"robot": "b"}])
    ) as store:
        compare(store)
        rows = store.sql(
            "SELECT count(*), count(DISTINCT event_id), count(*) FILTER"
            " (NOT list_contains(conditions, events.condition)"
            " OR step_index NOT BETWEEN onset_step AND end_step)"
            " FROM transitions JOIN event_rows USING (transition_id) JOIN events USING (event_id)"
        ).fetchall()
        held = sum(len(names) for table in tables for names in table["conditions"].to_pylist())
        assert rows == [(held, len(events_of(store)), 0)]


@dataclass(frozen=True)
class Case:
    """Labels `s` slips, `b` blocked, `x` both; events: name, first, last, outcome, after."""

    labels: str
    events: list[tuple[str, int, int, str, float | None]]
    ended: str = "truncated"
    reached: bool = False
    more_s: float = 60.0  # for which the recording goes on


CASES = [
    Case(".ss..", [("wheel_slip", 1, 2, "recovered", 0.4)]),
    Case(".ss", [("wheel_slip", 1, 2, "recovered", 0.4)], ended="terminated", reached=True),
    Case(".ss", [("wheel_slip", 1, 2, "not recovered", None)], ended="terminated"),
    Case(".ss", [("wheel_slip", 1, 2, "not recovered", None)]),
    Case(".ss", [("wheel_slip", 1, 2, "open", None)], more_s=0.2),
    Case(".ss", [("wheel_slip", 1, 2, "open", None)], ended=""),
    # Another condition takes over: nominal is where no condition holds.
    Case(
        "sxb.", [("blocked_aisle", 1, 2, "recovered", 0.4), ("wheel_slip", 0, 1, "recovered", 0.6)]
    ),
    Case(
        "s.s", [("wheel_slip", 0, 0, "recovered", 0.2), ("wheel_slip", 2, 2, "not recovered", None)]
    ),
    Case("....", []),
]


def write_case(path: Path, number: int, case: Case, policies: str = "") -> None:
    """Add a recording of one episode to a store."""
    names = {"s": ["wheel_slip"], "b": ["blocked_aisle"], "x": ["blocked_aisle", "wheel_slip"]}
    count = len(case.labels)
    held = [names.get(letter, []) for letter in case.labels]
    one = recording_transitions(number, episodes=1).slice(0, 1)
    table = pa.concat_tables([one] * count)
    stamps = START_NS + np.arange(count) * PERIOD_NS
    last = np.arange(count) == count - 1
    values = {
        "transition_id": (number << STEP_BITS) + np.arange(count),
        "step_index": np.arange(count),
        "stamp_ns": stamps,
        "conditions": held,
        "condition": [(names or ["nominal"])[0] for names in held],
        "behaviour_policy": list(policies) or ["planner"] * count,
        "terminated": last & (case.ended == "terminated"),
        "truncated": last & (case.ended == "truncated"),
        "reward": last * (TASK.rewards.goal if case.reached else 0.0),
    }
    table = replaced(table, values)
    row = replaced(manifest(table), {"end_stamp_ns": [int(stamps[-1] + case.more_s * 1e9)]})
    write_deltalake(str(path / "recordings"), row, mode="append", description=FORMAT)
    write_deltalake(str(path / "transitions"), table, mode="append", description=FORMAT)


def test_what_came_of_events(tmp_path):
    for number, case in enumerate(CASES, 1):
        write_case(tmp_path / "store", number, case)
    with Store(tmp_path / "store") as store:
        for number, case in enumerate(CASES, 1):
            found = store.sql(
                "SELECT condition, onset_step, end_step, outcome, recovered_after_s FROM events"
                f" WHERE recording_id = '{number:016x}' ORDER BY ALL"
            ).fetchall()
            assert found == [pytest.approx(event) for event in case.events], case


def test_who_drove_before_and_after(tmp_path):
    write_case(tmp_path / "store", 1, Case("s.ss.s", []), policies="pppooo")
    with Store(tmp_path / "store") as store:
        found = store.sql(
            "SELECT onset_step, policy_before, behaviour_policy, policy_after FROM events"
            " ORDER BY onset_step"
        ).fetchall()
    assert found == [(0, "p", "p", "p"), (2, "p", "p", "o"), (5, "o", "o", "o")]
