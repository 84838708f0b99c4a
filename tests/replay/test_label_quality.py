"""`restock store label --score`: labels against the truth, and their reliability."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.ingest.store.transitions import replaced
from restock.replay.review.events import label_quality
from restock.replay.store.store import Store


def with_truth(table: pa.Table, missed: float) -> pa.Table:
    """Return labels that are the truth, but for a share of true steps without a label."""
    rng = np.random.default_rng(3)
    named = table["conditions"].to_pylist()
    truth = [",".join(sorted(names)) or "nominal" for names in named]
    held = [[name for name in names if rng.random() > missed] for names in named]
    return replaced(table, {"true_condition": truth, "conditions": held})


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    tables = [with_truth(recording_transitions(number), 0.1 * number) for number in (1, 5)]
    return write_store(tmp_path_factory.mktemp("quality") / "store", tables)


def test_the_scores_of_a_store_say_how_sure_they_are(store):
    with Store(store) as opened:
        found = {one.score.condition: one for one in label_quality(opened)}
        for one in found.values():
            assert one.precision.value == 1 == one.event_precision.value
            assert one.recall.low <= one.recall.value == one.score.recall <= one.recall.high <= 1
            assert one.event_recall.low < one.event_recall.value < one.event_recall.high


def test_the_command_prints_scores_and_reliability(store, capsys):
    assert main(["store", "label", str(store), "--score"]) == 0
    said = capsys.readouterr().out
    assert "event recall" in said
    assert "wheel_slip" in said
    assert main(["store", "label", str(store), "--score", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["condition"] for row in document["reliability"]} == {"recovery"}
    assert main(["store", "label", str(store), "--score", "--corrections", "none"]) == 2


def test_a_store_without_truth_has_nothing_to_score(tmp_path, capsys):
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    assert main(["store", "label", str(path), "--score"]) == 0
    assert "nothing to score" in capsys.readouterr().out
