"""True conditions of steps, and labels scored against them."""

from dataclasses import fields

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.ingest.store.manifest import LabelScore, label_scores, pooled, score
from restock.ingest.task.schema import primary_of, true_names, truth_text


def test_true_conditions_round_trip_as_text():
    assert truth_text(["recovery", "near_collision", "recovery"]) == "near_collision,recovery"
    assert truth_text([]) == "nominal"
    assert true_names("near_collision, recovery") == {"near_collision", "recovery"}
    assert true_names("nominal") == true_names("") == frozenset()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("nominal", "nominal"),
        ("wheel_slip", "wheel_slip"),
        ("blocked_aisle,near_collision,wheel_slip", "near_collision"),
        ("blocked_aisle,recovery", "recovery"),
        ("carpet,blocked_aisle", "blocked_aisle"),
        ("ramp,carpet", "carpet"),
    ],
)
def test_primary_of_true_conditions(text, expected):
    assert primary_of(text) == expected


def test_row_with_several_conditions_scores_each():
    rows = pa.table(
        {
            "episode_index": [0, 0, 0, 0],
            "step_index": [0, 1, 2, 3],
            "condition": ["recovery", "near_collision", "nominal", "near_collision"],
            "conditions": [["near_collision", "recovery"], ["near_collision"], [], None],
            "true_condition": ["near_collision,recovery", "nominal", "near_collision", None],
            "exposures": [["busy"], ["busy"], [], []],
            "true_exposure": ["nominal", "busy", "busy", None],
        }
    )
    near, after, busy = label_scores(rows, ["near_collision", "recovery"], 0.2)
    assert (near.precision, near.recall, near.labelled, near.support) == (0.5, 0.5, 2, 2)
    assert (after.precision, after.recall, after.labelled, after.support) == (1, 1, 1, 1)
    assert (busy.condition, busy.known, busy.labelled, busy.support) == ("busy", 3, 2, 2)
    # scored against the true exposures
    assert (busy.agreed, busy.event_support, busy.event_found) == (1, 1, 1)


@st.composite
def episodes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw labels and truth (N,) with their episode and step."""
    lengths = draw(st.lists(st.integers(1, 9), min_size=1, max_size=5))
    count = sum(lengths)
    holds, true = (np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
                   for _ in range(2))  # fmt: skip
    return (
        holds,
        true,
        np.repeat(np.arange(len(lengths)), lengths),
        np.concatenate([np.arange(length) for length in lengths]),
    )


def texts(true: np.ndarray) -> list[str]:
    return ["slip" if is_slip else "nominal" for is_slip in true]


@settings(max_examples=60)
@given(episodes(), st.integers(0, 3))
def test_event_scores_match_pairwise_search(drawn, reach):
    holds, true, episode, step = drawn
    found = score({"slip": holds}, texts(true), episode, step, 0.4 / reach if reach else 1.0)
    if not found:
        assert not holds.any()
        assert not true.any()
        return

    def runs(values: np.ndarray) -> list[list[int]]:
        by_hand: list[list[int]] = []
        for row in np.flatnonzero(values).tolist():
            if by_hand and by_hand[-1][-1] == row - 1 and episode[row] == episode[row - 1]:
                by_hand[-1].append(row)
            else:
                by_hand.append([row])
        return by_hand

    def near(run: list[int], values: np.ndarray) -> bool:
        return any(
            values[other] and episode[other] == episode[row] and abs(other - row) <= reach
            for row in run
            for other in range(len(values))
        )

    (result,) = found
    labelled_runs, true_runs = runs(holds), runs(true)
    assert (result.event_labelled, result.event_support) == (len(labelled_runs), len(true_runs))
    assert result.event_right == sum(near(run, true) for run in labelled_runs)
    assert result.event_found == sum(near(run, holds) for run in true_runs)


@settings(max_examples=40)
@given(episodes(), st.randoms())
def test_perfect_labels_score_1_and_parts_add_up(drawn, chance):
    holds, true, episode, step = drawn
    for result in score({"slip": true}, texts(true), episode, step, 0.2):
        assert (
            result.precision == result.recall == result.event_precision == result.event_recall == 1
        )
    whole = score({"slip": holds}, texts(true), episode, step, 0.2)
    cut = chance.randrange(int(episode[-1]) + 1)
    parts = [
        result
        for part in (episode < cut, episode >= cut)
        for result in score(
            {"slip": holds[part]}, texts(true[part]), episode[part], step[part], 0.2
        )
    ]
    names = [field.name for field in fields(LabelScore) if field.name not in ("condition", "known")]
    assert [[getattr(result, name) for name in names] for result in pooled(parts)] == [
        [getattr(result, name) for name in names] for result in whole
    ]
