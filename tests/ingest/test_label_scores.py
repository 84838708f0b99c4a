"""The true conditions of a step, and labels scored against them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from restock.ingest.task.label_scores import (
    label_scores,
    primary_of,
    score,
    true_names,
    truth_text,
)


def test_the_true_conditions_of_a_step_are_one_text():
    assert truth_text(["recovery", "near_collision", "recovery"]) == "near_collision,recovery"
    assert truth_text([]) == "nominal"
    assert true_names("near_collision, recovery") == {"near_collision", "recovery"}
    assert true_names("nominal") == true_names("") == frozenset()


@pytest.mark.parametrize(
    ("text", "one"),
    [
        ("nominal", "nominal"),
        ("wheel_slip", "wheel_slip"),
        ("blocked_aisle,near_collision,wheel_slip", "near_collision"),
        ("blocked_aisle,recovery", "recovery"),
        ("carpet,blocked_aisle", "blocked_aisle"),
        ("ramp,carpet", "carpet"),
    ],
)
def test_a_reader_that_needs_one_condition_gets_the_most_pressing(text, one):
    assert primary_of(text) == one


def test_a_row_of_several_conditions_is_scored_for_each():
    rows = pa.table(
        {
            "condition": ["recovery", "near_collision", "nominal", "near_collision"],
            "conditions": [["near_collision", "recovery"], ["near_collision"], [], None],
            "true_condition": ["near_collision,recovery", "nominal", "near_collision", None],
        }
    )
    near, after = label_scores(rows, ["near_collision", "recovery"])
    assert (near.precision, near.recall, near.labelled, near.support) == (0.5, 0.5, 2, 2)
    assert (after.precision, after.recall, after.labelled, after.support) == (1, 1, 1, 1)


def test_scores_by_hand():
    given_ = {"slip": np.array([True, True, False, False, True, False])}
    truth = ["slip", "nominal", "slip, blocked", "nominal", None, "slip"]
    (one,) = score(given_, truth)
    assert (one.labelled, one.support, one.known) == (2, 3, 5)
    assert one.precision == pytest.approx(1 / 2)
    assert one.recall == pytest.approx(1 / 3)
    assert one.shortfall == (
        "precision 0.30 short of 0.8, recall 0.47 short of 0.8; true in 60.0% of steps"
    )
    assert score(given_, [None] * 6) == []
    never = score({"slip": np.zeros(2, np.bool_)}, ["nominal", "nominal"])
    assert never == []
