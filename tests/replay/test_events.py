"""Events (onset, end and outcome of a condition), compared with a plain loop."""

from collections import defaultdict
from typing import Any

import numpy as np
import pyarrow as pa
from support.stores import TASK, recording_transitions, write_store

from restock.ingest.store.transitions import replaced
from restock.replay.store.store import Store

PERIOD_NS = 200_000_000


def events_by_hand(store: Store) -> dict[str, dict[str, Any]]:
    """Compute the view's rows with a plain loop."""
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


def test_events_match_plain_loop(tmp_path):
    """Some rows are missing, drivers alternate, and a third of the episodes end in recovery."""
    tables = []
    for number in range(1, 10):
        table = recording_transitions(number, episodes=7)
        rng = np.random.default_rng(number)
        keep = rng.random(len(table)) > 0.1
        late = zip(table["episode_index"].to_pylist(), table["step_index"].to_pylist(), strict=True)
        held = zip(table["conditions"].to_pylist(), late, strict=True)
        changed = {
            "behaviour_policy": rng.choice(["planner", "operator"], len(table)),
            "bumped": rng.random(len(table)) < 0.1,
            "conditions": [["recovery"] if e % 3 == 0 and s > 5 else h for h, (e, s) in held],
        }
        tables.append(replaced(table, changed).filter(pa.array(keep)))
    with Store(
        write_store(tmp_path / "store", tables, tags=[{"robot": "a"}, {"robot": "b"}])
    ) as store:
        expected, found = events_by_hand(store), events_of(store)
        assert found.keys() == expected.keys()
        for name, row in expected.items():
            assert {key: found[name][key] for key in row} == row, name
        rows = store.sql(
            "SELECT count(*), count(DISTINCT event_id), count(*) FILTER"
            " (NOT list_contains(conditions, events.condition)"
            " OR step_index NOT BETWEEN onset_step AND end_step)"
            " FROM transitions JOIN event_rows USING (transition_id) JOIN events USING (event_id)"
        ).fetchall()
        held = sum(len(names) for table in tables for names in table["conditions"].to_pylist())
        assert rows == [(held, len(events_of(store)), 0)]
